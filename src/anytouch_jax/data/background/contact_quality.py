"""Quality of the contact filter: compared with a column that reports contact, and as an image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from anytouch_jax.data.background.contact_labels import (
    REFERENCES,
    reference_contact,
    threshold_of_rows,
)
from anytouch_jax.data.background.contact_scores import ContactScores, spread
from anytouch_jax.data.background.estimate import scale_image
from anytouch_jax.data.images import ImageError, decode
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write

# of `contact_sheet`
TILE = 120
PER_ROW = 10
_HEAD = 28  # pixels of the height of a title
_MARGIN = 20  # pixels of a tile around its image, for the score
# BGR, as OpenCV writes
_RED = (60, 60, 230)
_GREEN = (80, 180, 60)
_BLACK = (0, 0, 0)
Colour = tuple[int, int, int]


@dataclass(frozen=True)
class ContactQuality:
    """The filter compared with a reference column.

    Attributes:
        reference: The column.
        above: The value above which it reports contact.
        rows: Rows that were compared.
        skipped: Rows without a reference or a score.
        positives: Rows with contact by the reference.
        predicted: Rows with contact by the filter.
        hits: Rows with contact by both.
        precision: Of contact, NaN if the filter finds none.
        recall: Of contact, NaN if there is none.
        correlation: Pearson's, of score and reference, NaN if one is constant.
        parts: (rows, precision, recall) by sensor and by source of the background.
    """

    reference: str
    above: float
    rows: int
    skipped: int
    positives: int
    predicted: int
    hits: int
    precision: float
    recall: float
    correlation: float
    parts: dict[str, tuple[int, float, float]]

    def lines(self) -> list[str]:
        """Return the figures as lines of text."""
        lines = [
            f"contact by {self.reference} > {self.above:g} on {self.positives:,} of {self.rows:,} "
            f"rows ({self.skipped:,} without reference or score): precision {self.precision:.3f}, "
            f"recall {self.recall:.3f}, correlation {self.correlation:.3f}"
        ]
        for name, (rows, precision, recall) in self.parts.items():
            lines.append(f"  {name}: {rows:,} rows, precision {precision:.3f}, recall {recall:.3f}")
        return lines


def contact_quality(
    manifest: Manifest,
    scores: ContactScores,
    *,
    reference: str | None = None,
    above: float | None = None,
    thresholds: Mapping[str, float] | None = None,
) -> ContactQuality:
    """Compare the filter with a column that reports contact.

    Rows with a value and a score are compared, except the split `background`.

    Args:
        manifest: The frames.
        scores: Of its rows.
        reference: The column, by default the first existing one of REFERENCES.
        above: The value above which it reports contact, by default that of REFERENCES.
        thresholds: By sensor, in place of those of THRESHOLDS.

    Raises:
        UserError: If there is no such column or row.
    """
    name, truth = reference_contact(manifest, reference)
    limit = REFERENCES.get(name, 0.0) if above is None else above
    relevant = manifest.text_column("split") != "background"
    used = np.flatnonzero(relevant & ~np.isnan(truth) & ~np.isnan(scores.score))
    if not used.size:
        raise UserError(
            f"no row has both a value in {name} and a score; name another column with --reference, "
            "or give an image of the untouched gel with --background"
        )
    score = scores.score[used]
    sources = scores.reasons[used]
    sensors = manifest.text_column("sensor")[used]
    predicted = score > threshold_of_rows(manifest, thresholds, 0.0)[used]
    positive = truth[used] > limit
    hit = positive & predicted

    def figures(members: np.ndarray) -> tuple[int, float, float]:
        hits = int(hit[members].sum())
        found = int(predicted[members].sum())
        real = int(positive[members].sum())
        precision = hits / found if found else np.nan
        recall = hits / real if real else np.nan
        return int(members.sum()), precision, recall

    parts = {f"sensor {sensor}": figures(sensors == sensor) for sensor in sorted(set(sensors))}
    parts |= {f"background {source}": figures(sources == source) for source in sorted(set(sources))}
    is_constant = len(used) < 2 or np.ptp(score) == 0 or np.ptp(truth[used]) == 0
    correlation = np.nan if is_constant else float(np.corrcoef(score, truth[used])[0, 1])
    rows, precision, recall = figures(np.ones(len(used), bool))
    return ContactQuality(
        reference=name,
        above=limit,
        rows=rows,
        skipped=int(relevant.sum()) - rows,
        positives=int(positive.sum()),
        predicted=int(predicted.sum()),
        hits=int(hit.sum()),
        precision=precision,
        recall=recall,
        correlation=correlation,
        parts=parts,
    )


def contact_sheet(
    manifest: Manifest,
    scores: ContactScores,
    path: str | Path,
    *,
    thresholds: Mapping[str, float] | None = None,
    rows: int = 4,
) -> Path:
    """Write a PNG of frames without contact (red) and with contact (green), by rising score.

    Frames are spread evenly over the scores of each side, so the doubtful ones are next to each
    other.

    Args:
        manifest: The frames.
        scores: Of its rows.
        path: The file.
        thresholds: By sensor, in place of those of THRESHOLDS.
        rows: Rows of PER_ROW frames for each side.

    Raises:
        UserError: If no row has a score.
    """
    is_scored = ~np.isnan(scores.score) & (manifest.text_column("split") != "background")
    if not is_scored.any():
        raise UserError(
            "no frame has a contact score, so there is nothing to show; leave out --image"
        )
    contact = scores.score > threshold_of_rows(manifest, thresholds, 0.0)
    bands = []
    for title, members, colour in (
        ("no contact", ~contact, _RED),
        ("contact", contact, _GREEN),
    ):
        side = np.flatnonzero(is_scored & members)
        by_score = side[np.argsort(scores.score[side], kind="stable")]
        chosen = spread(by_score, rows * PER_ROW)
        tiles = [_tile(manifest, row, float(scores.score[row]), colour) for row in chosen]
        missing = -len(tiles) % PER_ROW
        tiles += [_blank(TILE, TILE)] * missing
        head = _blank(_HEAD, TILE * PER_ROW)
        _write(head, f"{title}: {len(side)} frames", (6, 20), 0.55, colour)
        bands.append(head)
        for start in range(0, len(tiles), PER_ROW):
            bands.append(np.hstack(tiles[start : start + PER_ROW]))
    atomic_write(path, cv2.imencode(".png", np.vstack(bands))[1].tobytes())
    return Path(path)


def _tile(manifest: Manifest, row: int, score: float, colour: Colour) -> np.ndarray:
    """Return a square BGR tile with the frame, its score and a coloured border."""
    tile = _blank(TILE, TILE)
    try:
        image = decode(manifest.file(row))[..., ::-1]
    except ImageError:
        return tile
    image = scale_image(image, TILE - _MARGIN)
    height, width = image.shape[:2]
    left = (TILE - width) // 2
    tile[2 : 2 + height, left : left + width] = image
    cv2.rectangle(tile, (left - 1, 1), (left + width, 2 + height), colour, 1)
    _write(tile, f"{score:.1f}", (left, height + 16), 0.4, _BLACK)
    return tile


def _blank(height: int, width: int) -> np.ndarray:
    return np.full((height, width, 3), 255, np.uint8)


def _write(image: np.ndarray, text: str, at: tuple[int, int], size: float, colour: Colour) -> None:
    cv2.putText(image, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
