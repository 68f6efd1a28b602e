"""Contact labels of a manifest: what its columns say, and the thresholds of scores."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.manifest.schema import shown
from anytouch_jax.errors import UserError
from anytouch_jax.sensors import RECORDS

# Score above which a frame is contact. Measured on real frames for gelsight_mini (with and without
# dots), gelslim and gelsight. The one of 9dtact is below its one light press. The default of the
# other sensors is untested.
DEFAULT_THRESHOLD = 6.5
THRESHOLDS: Mapping[str, float] = {
    name: record.contact_threshold
    for name, record in RECORDS.items()
    if record.contact_threshold is not None
}
# Columns that report contact, in order of preference, and the value above which they do.
REFERENCES: Mapping[str, float] = {
    "label.force": 0.0,
    "label.contact": 0.5,
    "label.contact_score": 7.0,
}
_WORDS = {"true": 1.0, "false": 0.0, "none": np.nan, "": np.nan}


def threshold_of_rows(
    manifest: Manifest, thresholds: Mapping[str, float] | None, fraction: float
) -> np.ndarray:
    """Return the threshold of every row, f64 (rows,).

    Args:
        manifest: The frames.
        thresholds: By sensor, in place of those of THRESHOLDS.
        fraction: As in `mark_contact`; it is only checked here.

    Raises:
        UserError: For thresholds or a fraction that cannot be used.
    """
    if not 0 <= fraction <= 1:
        raise UserError(
            f"--fraction is a part of the highest score of a sequence, 0 to 1, not {fraction:g}"
        )
    given = thresholds or {}
    table = {**THRESHOLDS, **given}
    sensors = manifest.table["sensor"].to_pylist()
    for name in given:
        if name not in sensors:
            raise UserError(
                f"a threshold is given for the sensor {name!r}, which the manifest does not have; "
                "leave it out"
            )
        if not np.isfinite(table[name]):
            raise UserError(f"the threshold of {name} must be a number, not {table[name]}")
    return np.array([table.get(name, DEFAULT_THRESHOLD) for name in sensors])


def known_contact(manifest: Manifest) -> np.ndarray:
    """Return `label.contact` of every row, f64 (rows,), NaN if unknown.

    Raises UserError for another word.
    """
    contact = np.full(len(manifest), np.nan)
    if "label.contact" not in manifest.table.column_names:
        return contact
    for row, value in enumerate(manifest.table["label.contact"].to_pylist()):
        word = str(value).strip().lower()
        try:
            contact[row] = _WORDS[word] if word in _WORDS else float(word)
        except ValueError:
            raise UserError(
                f"{manifest.where(row)}: column 'label.contact' must be a number, true or false, "
                f"is {shown(value)}"
            ) from None
    return contact


def reference_contact(
    manifest: Manifest, reference: str | None = None
) -> tuple[str, npt.NDArray[np.float64]]:
    """Return the column that reports contact (default: first of REFERENCES) and its numbers.

    Raises UserError if the manifest has none.
    """
    columns = manifest.table.column_names
    name = reference or next((column for column in REFERENCES if column in columns), None)
    if name is None or name not in columns:
        raise UserError(
            f"the manifest has no column {name or ' or '.join(REFERENCES)} to compare the contact "
            "filter with; name one with --reference"
        )
    if name == "label.contact":
        return name, known_contact(manifest)
    return name, manifest.number_column(name)
