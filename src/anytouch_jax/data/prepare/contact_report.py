"""How good the contact filter is: precision and recall against a reference column, and a picture of both sides."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from anytouch_jax.data.images import ImageError, decode
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.prepare.contact import ContactScores, known_contact, limits_of
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write

# The columns that tell contact, in the order they are looked for, and the value above which they mean it.
REFERENCES: Mapping[str, float] = {"label.force": 0.0, "label.contact": 0.5, "label.contact_score": 7.0}
TILE, PER_ROW = 120, 10


@dataclass(frozen=True)
class ContactQuality:
    """The filter against a reference: `precision` and `recall` of contact, NaN where nothing was found or is there.

    `rows` were compared; `positives` are contact by the reference, `found` by the filter, `hits` by both. `correlation`
    is Pearson's, of the score and the reference. `parts`: (rows, precision, recall) by sensor and by where the
    background is from.
    """

    reference: str
    above: float
    rows: int
    skipped: int
    positives: int
    found: int
    hits: int
    correlation: float
    parts: dict[str, tuple[int, float, float]]

    @property
    def precision(self) -> float:
        return self.hits / self.found if self.found else float("nan")

    @property
    def recall(self) -> float:
        return self.hits / self.positives if self.positives else float("nan")

    def lines(self) -> list[str]:
        """The figures as lines of text."""
        return [
            f"contact by {self.reference} > {self.above:g} on {self.positives:,} of {self.rows:,} rows "
            f"({self.skipped:,} without reference or score): precision {self.precision:.3f}, recall {self.recall:.3f}, "
            f"correlation {self.correlation:.3f}",
            *(f"  {name}: {rows:,} rows, precision {precision:.3f}, recall {recall:.3f}"
              for name, (rows, precision, recall) in self.parts.items()),
        ]  # fmt: skip


def known_contact_by(manifest: Manifest, reference: str | None = None) -> tuple[str, npt.NDArray[np.float64]]:
    """The column that tells of contact (default: the first of REFERENCES that is there) and its numbers, NaN for none.

    Raises UserError when there is none, or none of numbers.
    """
    name = reference or next((one for one in REFERENCES if one in manifest.table.column_names), None)
    if name is None or name not in manifest.table.column_names:
        raise UserError(
            f"the manifest has no column {name or ' or '.join(REFERENCES)} to compare the contact filter with"
        )
    if name == "label.contact":
        return name, known_contact(manifest)
    try:
        return name, np.array([np.nan if one is None else float(one) for one in manifest.table[name].to_pylist()])
    except (TypeError, ValueError):
        raise UserError(f"column {name} holds something that is no number; contact is told by a number") from None


def contact_quality(
    manifest: Manifest,
    scores: ContactScores,
    *,
    reference: str | None = None,
    above: float | None = None,
    thresholds: Mapping[str, float] | None = None,
) -> ContactQuality:
    """Compare the filter's verdict with column `reference` > `above` (default: the first of REFERENCES that is there).

    Rows that have a value and a score are compared, but those of the split `background`. `thresholds` replaces entries
    of THRESHOLDS. Raises UserError when no such column or row is there.
    """
    name, truth = known_contact_by(manifest, reference)
    limit = REFERENCES.get(name, 0.0) if above is None else above
    asked = np.asarray(manifest.table["split"].to_pylist(), object) != "background"
    used = np.flatnonzero(asked & ~np.isnan(truth) & ~np.isnan(scores.score))
    if not used.size:
        raise UserError(f"no row has both a value in {name} and a score")
    score, origins = scores.score[used], scores.reasons[used]
    sensors = np.asarray(manifest.table["sensor"].to_pylist(), object)[used]
    found, there = score > limits_of(manifest, thresholds, 0.0)[used], truth[used] > limit
    hit = there & found
    groups = {f"sensor {one}": sensors == one for one in sorted(set(sensors))}
    groups |= {f"background {one}": origins == one for one in sorted(set(origins))}
    parts = {
        one: (int(mine.sum()), _share(hit[mine], found[mine]), _share(hit[mine], there[mine]))
        for one, mine in groups.items()
    }
    counts = (len(used), int(asked.sum()) - len(used), int(there.sum()), int(found.sum()), int(hit.sum()))
    return ContactQuality(name, limit, *counts, _correlation(score, truth[used]), parts)


def contact_picture(manifest: Manifest, scores: ContactScores, path: str | Path, *,
                    thresholds: Mapping[str, float] | None = None, rows: int = 4) -> Path:  # fmt: skip
    """A PNG for each eye: `rows` rows of kept frames (green frame) and as many of dropped ones (red), by rising score.

    Frames are spread evenly over the scores on each side, so the doubtful ones stand at the border: the end of the
    dropped and the start of the kept. The number is the score. Raises UserError when no row has a score.
    """
    limits = limits_of(manifest, thresholds, 0.0)
    splits = np.asarray(manifest.table["split"].to_pylist(), object)
    known = np.flatnonzero(~np.isnan(scores.score) & (splits != "background"))
    if not known.size:
        raise UserError("no frame has a contact score, so there is nothing to show")
    kept = known[scores.score[known] > limits[known]]
    dropped = known[scores.score[known] <= limits[known]]
    bands = []
    for title, side, colour in (("no contact", dropped, (60, 60, 230)), ("contact", kept, (80, 180, 60))):
        order = side[np.argsort(scores.score[side], kind="stable")]
        chosen = (
            order[np.unique(np.linspace(0, max(len(order) - 1, 0), rows * PER_ROW).astype(int))]
            if len(order)
            else order
        )
        bands.append(_band(f"{title}: {len(side)} frames", manifest, chosen, scores.score, colour))
    atomic_write(path, cv2.imencode(".png", np.vstack(bands))[1].tobytes())
    return Path(path)


def _band(
    title: str, manifest: Manifest, chosen: np.ndarray, score: np.ndarray, colour: tuple[int, int, int]
) -> np.ndarray:
    tiles = [_tile(manifest, row, float(score[row]), colour) for row in chosen]
    tiles += [np.full((TILE, TILE, 3), 255, np.uint8)] * (-len(tiles) % PER_ROW)
    head = np.full((28, TILE * PER_ROW, 3), 255, np.uint8)
    cv2.putText(head, title, (6, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, colour, 1, cv2.LINE_AA)
    return np.vstack([head, *(np.hstack(tiles[at : at + PER_ROW]) for at in range(0, len(tiles), PER_ROW))])


def _tile(manifest: Manifest, row: int, score: float, colour: tuple[int, int, int]) -> np.ndarray:
    """A square BGR tile with the frame, its score and a coloured border."""
    tile = np.full((TILE, TILE, 3), 255, np.uint8)
    try:
        picture = decode(manifest.file(row))[..., ::-1]
    except ImageError:
        return tile
    shrink = (TILE - 20) / max(picture.shape[:2])
    size = max(1, round(picture.shape[1] * shrink)), max(1, round(picture.shape[0] * shrink))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    left = (TILE - size[0]) // 2
    tile[2 : 2 + size[1], left : left + size[0]] = small
    cv2.rectangle(tile, (left - 1, 1), (left + size[0], 2 + size[1]), colour, 1)
    cv2.putText(tile, f"{score:.1f}", (left, size[1] + 16), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (0, 0, 0), 1, cv2.LINE_AA)
    return tile


def _share(part: np.ndarray, whole: np.ndarray) -> float:
    return int(part.sum()) / int(whole.sum()) if whole.any() else float("nan")


def _correlation(score: np.ndarray, truth: np.ndarray) -> float:
    if len(score) < 2 or np.ptp(score) == 0 or np.ptp(truth) == 0:
        return float("nan")
    return float(np.corrcoef(score, truth)[0, 1])
