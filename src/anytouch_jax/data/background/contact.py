"""Contact filter: which frames are touched, by difference from the background image.

The score of a frame and where its background comes from are in `contact_scores`, thresholds and
labels in `contact_labels`, and comparisons in `contact_quality`. Their names can be imported from
here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pyarrow as pa

from anytouch_jax.data.background.contact_labels import (
    DEFAULT_THRESHOLD,
    REFERENCES,
    THRESHOLDS,
    known_contact,
    reference_contact,
    threshold_of_rows,
)
from anytouch_jax.data.background.contact_quality import (
    PER_ROW,
    TILE,
    ContactQuality,
    contact_quality,
    contact_sheet,
)
from anytouch_jax.data.background.contact_scores import (
    ContactScores,
    contact_scores,
    read_backgrounds,
    spread,
    store_backgrounds,
)
from anytouch_jax.data.manifest.manifest import Manifest, replace_column, select_rows
from anytouch_jax.data.manifest.schema import EXAMPLES
from anytouch_jax.errors import UserError

__all__ = [
    "DEFAULT_THRESHOLD",
    "PER_ROW",
    "REFERENCES",
    "THRESHOLDS",
    "TILE",
    "ContactQuality",
    "ContactReport",
    "ContactScores",
    "contact_quality",
    "contact_scores",
    "contact_sheet",
    "known_contact",
    "mark_contact",
    "read_backgrounds",
    "reference_contact",
    "spread",
    "store_backgrounds",
    "threshold_of_rows",
]

_SCORE = "label.contact_score"
_SCORE_GIVEN = "label.contact_score_given"


@dataclass(frozen=True)
class ContactReport:
    """What `mark_contact` did.

    Attributes:
        scores: The scores.
        contact: Rows with contact.
        free: Rows without contact.
        unknown: Rows whose contact is unknown.
        dropped: Rows that were left out.
        labelled: Rows that keep the label that they had.
        thresholds: By sensor, those that were used.
    """

    scores: ContactScores
    contact: int
    free: int
    unknown: int
    dropped: int
    labelled: int
    thresholds: dict[str, float]

    def lines(self) -> list[str]:
        """Return the report as lines of text."""
        sources = ", ".join(f"{reason} {count:,}" for reason, count in self.scores.counts.items())
        lines = [
            f"{len(self.scores.score):,} rows: contact {self.contact:,}, no contact {self.free:,}, "
            f"unknown {self.unknown:,}; dropped {self.dropped:,}",
            f"background: {sources}",
        ]
        faults = self.scores.faults
        if faults:
            lines.append("images that cannot be used:")
            lines += [f"  {fault}" for fault in faults[:EXAMPLES]]
        if len(faults) > EXAMPLES:
            lines.append("  (and more: `anytouch data verify` names them)")
        lines += self._estimated()
        limits = ", ".join(f"{sensor} {limit:g}" for sensor, limit in self.thresholds.items())
        last = f"contact is a score above: {limits}"
        if self.labelled:
            last += f"; {self.labelled:,} rows keep the label.contact that they had"
        return [*lines, last]

    def _estimated(self) -> list[str]:
        """Return the line on recordings without a background image, none if all have one."""
        all_of = self.scores.recordings
        decided = self.scores.decided
        if not all_of:
            return []
        line = (
            f"untouched gel estimated for {decided:,} of {all_of:,} recordings "
            f"({decided / all_of:.0%})"
        )
        if decided < all_of:
            line += (
                ". The labels of the others stay empty. To decide them, pass --background with "
                "an image of the untouched gel"
            )
        return [line]


def mark_contact(
    manifest: Manifest,
    scores: ContactScores,
    *,
    thresholds: Mapping[str, float] | None = None,
    fraction: float = 0.0,
    drop: bool = False,
) -> tuple[Manifest, ContactReport]:
    """Return the manifest with its contact labels, and a report.

    The columns are `label.contact_score` and `label.contact` (1, 0 or null if unknown). An existing
    `label.contact` is kept, because its writer knew more than an image shows. An existing score
    column is renamed to `<name>_given`.

    Args:
        manifest: The frames.
        scores: Of its rows.
        thresholds: By sensor, in place of those of THRESHOLDS.
        fraction: Contact also needs this fraction of the highest score of its sequence, which
            excludes the start and the end of contact.
        drop: Remove frames without contact, but never the split `background` nor frames of unknown
            contact.

    Raises:
        UserError: If nothing would be left.
    """
    limits = threshold_of_rows(manifest, thresholds, fraction)
    known = known_contact(manifest)
    background = manifest.text_column("split") == "background"
    contact = _decided(manifest, scores.score, limits, fraction)
    contact[background] = 0
    contact = np.where(np.isnan(known), contact, known > 0)
    free = contact == 0
    marked = _with_labels(manifest, scores.score, contact)
    stays = ~free | background if drop else np.ones(len(manifest), bool)
    if not stays.any():
        raise UserError(
            "every frame is without contact by these thresholds; nothing would be left. "
            "Lower --threshold or --fraction, or leave out --drop"
        )
    sensors = manifest.table["sensor"].to_pylist()
    report = ContactReport(
        scores,
        contact=int((contact == 1).sum()),
        free=int(free.sum()),
        unknown=int(np.isnan(contact).sum()),
        dropped=int((~stays).sum()),
        labelled=int(np.isfinite(known).sum()),
        thresholds=dict(sorted(zip(sensors, limits.tolist(), strict=True))),
    )
    return select_rows(marked, np.flatnonzero(stays)), report


def _decided(
    manifest: Manifest, score: np.ndarray, limits: np.ndarray, fraction: float
) -> np.ndarray:
    """Return the contact of every row by its score, f64 (rows,): 1, 0 or NaN without a score."""
    sequence = manifest.codes("sequence", own=True)
    highest = np.zeros(sequence.max() + 1)
    np.fmax.at(highest, sequence, score)
    is_contact = (score > limits) & (score >= fraction * highest[sequence])
    return np.where(np.isnan(score), np.nan, is_contact)


def _with_labels(manifest: Manifest, score: np.ndarray, contact: np.ndarray) -> Manifest:
    table = manifest.table
    if _SCORE in table.column_names:
        table = table.select([name for name in table.column_names if name != _SCORE_GIVEN])
        table = table.append_column(_SCORE_GIVEN, table[_SCORE])
    scores = pa.array(score, pa.float32(), mask=np.isnan(score))
    labels = pa.array(np.nan_to_num(contact).astype(np.int64), pa.int64(), mask=np.isnan(contact))
    marked = replace_column(replace(manifest, table=table), _SCORE, scores)
    return replace_column(marked, "label.contact", labels)
