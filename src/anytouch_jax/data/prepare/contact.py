"""Which frames are touched: the difference from the recording's background frame (the paper, appendix A.1).

The score of a frame is the 98th percentile of its colour difference (0 to 255) from the untouched gel, after what is no
contact has been taken away: dark marker dots, which shear moves, are closed in both pictures; a change of exposure or
tint over the whole picture is subtracted as the median of each colour; noise is blurred. Lengths are in pixels of a
picture scaled to 160 on its long side, so thresholds do not depend on the camera's resolution.

The background is the file in `background_path`, else it is estimated from the frames of the same unit (else of the
same sequence): the median of the quarter of them that lies nearest to the median of all. That holds where the gel is
free, at each place, in most of these frames; a recording that never lets go has no background to be found in it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest.manifest import Manifest, replace_column, select_rows
from anytouch_jax.errors import UserError

Scored = tuple[int, float, str]  # row, score, reason
LONG_SIDE, DOT, BLUR, EDGE, PERCENTILE = 160, 13, 1.5, 4, 98
FEWEST, MOST = 5, 64  # frames from which a background is estimated

# Score above which a frame is contact. Measured on real frames for gelsight_mini (with and without dots), gelslim and
# gelsight; 9dtact's is set below its one light press; the other sensors have the default, which nothing has tested.
DEFAULT_THRESHOLD = 6.5
THRESHOLDS: Mapping[str, float] = {"gelsight_mini": 6.5, "gelslim": 6.5, "gelsight": 6.5, "9dtact": 4.0}


@dataclass(frozen=True, eq=False)
class ContactScores:
    """Scores f32 (rows,), NaN where there is none; `reasons` (rows,) says where the background is from, or why not."""

    score: np.ndarray
    reasons: np.ndarray

    @property
    def counts(self) -> dict[str, int]:
        """Rows by reason."""
        return dict(Counter(self.reasons.tolist()))


@dataclass(frozen=True)
class ContactReport:
    """Rows with contact, without, unknown; how many were dropped; how many kept the mark that the manifest gives; rows
    by where their background is from."""

    rows: int
    contact: int
    free: int
    unknown: int
    dropped: int
    kept: int
    backgrounds: dict[str, int]
    thresholds: dict[str, float]

    def lines(self) -> list[str]:
        """The report as lines of text."""
        limits = ", ".join(f"{sensor} {limit:g}" for sensor, limit in self.thresholds.items())
        kept = f"; {self.kept:,} rows keep the label.contact that they had" if self.kept else ""
        return [
            f"{self.rows:,} rows: contact {self.contact:,}, no contact {self.free:,}, unknown {self.unknown:,}; "
            f"dropped {self.dropped:,}",
            "background: " + ", ".join(f"{reason} {count:,}" for reason, count in self.backgrounds.items()),
            f"contact is a score above: {limits}{kept}",
        ]


def difference(frame: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Colour difference f32 (h, w) of two pictures RGB u8 (h, w, 3) from `prepare`, without dots, tint and noise."""
    change = cv2.subtract(frame, background, dtype=cv2.CV_32F)
    change -= np.median(change[::2, ::2], axis=(0, 1))  # every other pixel is enough for a median
    red, green, blue = cv2.split(np.abs(cv2.GaussianBlur(change, (0, 0), BLUR)))
    return cv2.max(cv2.max(red, green), blue)


def prepare(picture: np.ndarray) -> np.ndarray:
    """A picture RGB u8 (h, w, 3) scaled to LONG_SIDE, its dark dots and thin dark lines closed."""
    return _close(_scale(picture))


def contact_scores(manifest: Manifest, rows: np.ndarray | None = None, *, workers: int = 2) -> ContactScores:
    """The score of every row, or of `rows` (the others are NaN, "not asked for"); frames are read by `workers` threads.

    A frame or background that cannot be read gives NaN and its reason; nothing is raised for one file.
    """
    if workers < 1:
        raise UserError(f"--threads (workers) must be at least 1, not {workers}")
    asked = np.arange(len(manifest)) if rows is None else np.asarray(rows)
    score = np.full(len(manifest), np.nan, np.float32)
    reasons = np.full(len(manifest), "not asked for", dtype=object)
    given = manifest.present("background_path")
    given_rows = asked[given[asked]]
    with ThreadPoolExecutor(workers) as pool:
        background = lru_cache(256)(_prepared_file)
        for row, value, reason in _map(pool, partial(_from_file, manifest, background), given_rows):
            score[row], reasons[row] = value, reason
        for group in _groups(manifest, asked[~given[asked]]):
            estimate = _estimate(manifest, group, pool)
            if estimate is None:
                reasons[group] = f"none: no background and fewer than {FEWEST} frames to estimate it from"
                continue
            for row, value, reason in _map(pool, partial(_from_estimate, manifest, estimate), group):
                score[row], reasons[row] = value, reason
    return ContactScores(score, reasons)


def mark_contact(
    manifest: Manifest,
    scores: ContactScores,
    *,
    thresholds: Mapping[str, float] | None = None,
    share: float = 0.0,
    drop: bool = False,
) -> tuple[Manifest, ContactReport]:
    """`manifest` with `label.contact_score` and `label.contact` (1, 0 or null where unknown), and what was found.

    A `label.contact` that the dataset gives is kept; a score column that is there is kept as `<name>_given`.
    `thresholds` replaces entries of THRESHOLDS. `share`: contact has at least this share of the highest score in its
    sequence too; what is less is the making and the breaking of contact. `drop` leaves out the frames without contact,
    but never the split `background` nor a frame of which nothing is known.
    """
    limits, given, score = limits_of(manifest, thresholds, share), known_contact(manifest), scores.score
    contact = np.where(np.isnan(score), np.nan, (score > limits) & (score >= share * _highest(manifest, score)))
    background = np.asarray(manifest.table["split"].to_pylist(), object) == "background"
    contact[background] = 0  # what the split says
    contact = np.where(np.isnan(given), contact, given > 0)
    free = contact == 0
    table, name, kept = manifest.table, "label.contact_score", "label.contact_score_given"
    if name in table.column_names:
        table = table.select([one for one in table.column_names if one != kept]).append_column(kept, table[name])
    marked = replace_column(replace(manifest, table=table), name, pa.array(score, pa.float32(), mask=np.isnan(score)))
    column = pa.array(np.nan_to_num(contact).astype(np.int64), pa.int64(), mask=np.isnan(contact))
    marked = replace_column(marked, "label.contact", column)
    stays = np.ones(len(manifest), bool)
    if drop:
        stays = ~free | background
    if not stays.any():
        raise UserError("every frame is without contact by these thresholds; nothing would be left")
    used = dict(sorted(zip(manifest.table["sensor"].to_pylist(), limits.tolist(), strict=True)))
    unknown = int(np.isnan(contact).sum())
    report = ContactReport(len(manifest), int((contact == 1).sum()), int(free.sum()), unknown, int((~stays).sum()),
                           int(np.isfinite(given).sum()), scores.counts, used)  # fmt: skip
    return select_rows(marked, np.flatnonzero(stays)), report


def limits_of(manifest: Manifest, thresholds: Mapping[str, float] | None, share: float) -> np.ndarray:
    """The threshold of every row, f64. Raises UserError for what `mark_contact` cannot use, `share` included."""
    if not 0 <= share <= 1:
        raise UserError(f"--share is a part of the highest score of a sequence, 0 to 1, not {share:g}")
    table = {**THRESHOLDS, **(thresholds or {})}
    wrong = [name for name in thresholds or {} if name not in manifest.table["sensor"].to_pylist()]
    if wrong:
        raise UserError(f"a threshold is given for the sensor {wrong[0]!r}, which the manifest does not have")
    if strange := [name for name, least in table.items() if not np.isfinite(least)]:
        raise UserError(f"the threshold of {strange[0]} must be a number, not {table[strange[0]]}")
    return np.array([table.get(name, DEFAULT_THRESHOLD) for name in manifest.table["sensor"].to_pylist()])


def _highest(manifest: Manifest, score: np.ndarray) -> np.ndarray:
    """The highest score in the sequence of every row, f64 (rows,)."""
    codes = manifest.codes("sequence", own=True)
    best = np.zeros(codes.max() + 1)
    np.fmax.at(best, codes, score)
    return np.asarray(best[codes])


def _scale(picture: np.ndarray) -> np.ndarray:
    height, width = picture.shape[:2]
    shrink = LONG_SIDE / max(height, width)
    size = max(1, round(width * shrink)), max(1, round(height * shrink))
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA if shrink < 1 else cv2.INTER_LINEAR)


def _close(picture: np.ndarray) -> np.ndarray:
    return cv2.morphologyEx(picture, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (DOT, DOT)))


def known_contact(manifest: Manifest) -> np.ndarray:
    """`label.contact` of every row as f64 (rows,), NaN where it is not known. Raises UserError for another word."""
    words = {"true": 1.0, "false": 0.0}
    found = np.full(len(manifest), np.nan)
    if "label.contact" not in manifest.table.column_names:
        return found
    for row, value in enumerate(manifest.table["label.contact"].to_pylist()):
        word = "" if value is None else str(value).strip().lower()
        if not word:  # an empty cell of a CSV
            continue
        try:
            found[row] = words[word] if word in words else float(word)
        except ValueError:
            what = f"column 'label.contact' must be a number, true or false, is {value!r}"
            raise UserError(f"{manifest.where(row)}: {what}") from None
    return found


def _score(frame: np.ndarray, background: np.ndarray) -> float:
    """How far a frame is from the untouched gel, 0 to 255; both from `prepare`."""
    if max(abs(a - b) for a, b in zip(frame.shape, background.shape, strict=True)) > 2:
        raise ValueError("its background has other proportions")
    if frame.shape != background.shape:
        background = cv2.resize(background, frame.shape[1::-1])
    inner = difference(frame, background)[EDGE:-EDGE, EDGE:-EDGE]
    if not inner.size:
        raise ValueError("it is too thin a strip")
    return float(np.percentile(inner, PERCENTILE))


def _prepared_file(path: Path) -> np.ndarray:
    return prepare(decode(path))


def _from_file(manifest: Manifest, background: Callable[[Path], np.ndarray], row: int) -> Scored:
    try:
        frame = _prepared_file(manifest.file(row))
        return row, _score(frame, background(manifest.file(row, "background_path"))), "given"
    except (UserError, ValueError) as error:
        return row, np.nan, _why(error)


def _from_estimate(manifest: Manifest, background: np.ndarray, row: int) -> Scored:
    try:
        return row, _score(_prepared_file(manifest.file(row)), background), "estimated"
    except (UserError, ValueError) as error:
        return row, np.nan, _why(error)


def _why(error: Exception) -> str:
    return "none: the frame or its background cannot be read" if isinstance(error, UserError) else f"none: {error}"


def _groups(manifest: Manifest, rows: np.ndarray) -> Iterator[np.ndarray]:
    """`rows` by unit of one dataset and sensor where a unit is named, else by sequence; each in row order."""
    unit, sequence = manifest.codes("unit", own=True), manifest.codes("sequence", own=True)
    dataset, sensor = manifest.codes("dataset"), manifest.codes("sensor")
    no_unit = unit < 0
    key = np.stack([no_unit, np.where(no_unit, sequence, unit), np.where(no_unit, 0, dataset), sensor], 1)[rows]
    if len(rows):
        _, groups = np.unique(key, axis=0, return_inverse=True)
        order = np.argsort(groups.ravel(), kind="stable")
        yield from np.split(rows[order], np.flatnonzero(np.diff(groups.ravel()[order])) + 1)


def _estimate(manifest: Manifest, group: np.ndarray, pool: ThreadPoolExecutor) -> np.ndarray | None:
    """The untouched gel of a group, prepared; None when too few of its frames can be read.

    Rows of the split `background` are the untouched gel, so where the group has some no others are needed.
    """
    free = group[np.asarray(pc.equal(manifest.table["split"].take(group), "background"))]
    if len(free):
        group = free
    chosen = group[np.unique(np.linspace(0, len(group) - 1, MOST).astype(int))]
    pictures = [one for one in pool.map(partial(_readable, manifest), chosen) if one is not None]
    pictures = [one for one in pictures if min(one.shape[:2]) > 2 * EDGE]
    shapes = Counter(one.shape for one in pictures)
    if not shapes:
        return None
    pictures = [one for one in pictures if one.shape == shapes.most_common(1)[0][0]]
    return estimate_background(np.stack(pictures)) if len(pictures) >= (1 if len(free) else FEWEST) else None


def _readable(manifest: Manifest, row: int) -> np.ndarray | None:
    try:
        return _prepared_file(manifest.file(row))
    except UserError:
        return None


def estimate_background(pictures: np.ndarray) -> np.ndarray:
    """The untouched gel u8 (h, w, 3) in pictures u8 (n, h, w, 3): the median of the quarter nearest to their median."""
    middle = np.median(pictures, axis=0).astype(np.uint8)
    far = [_score(one, middle) for one in pictures]  # a mean would sort by noise: a press is small
    near = np.argsort(far, kind="stable")[: max(3, len(pictures) // 4)]
    return np.median(pictures[near], axis=0).astype(np.uint8)


def _map(pool: ThreadPoolExecutor, work: Callable[[int], Scored], rows: np.ndarray) -> Iterator[Scored]:
    """`work` over `rows` in blocks, so that millions of rows never wait in memory."""
    for at in range(0, len(rows), 1024):
        yield from pool.map(work, rows[at : at + 1024].tolist())
