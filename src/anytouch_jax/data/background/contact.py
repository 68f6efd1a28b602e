"""Contact filter: which frames are touched, by difference from the background image (AnyTouch,
appendix A.1).

The score of a frame is the 98th percentile of its colour difference (0 to 255) from the untouched
gel, in an image of 160 pixels on its long side. Marker dots, which shear moves, are closed in both
images if the gel has them. A change of light is subtracted as a plane for each colour.

The untouched gel of a row is its `background_path`, the rows of split `background` of its unit (or
else sequence), or a picture that the user names. Otherwise it is estimated from the frames of its
recording, and compared with the estimates of other recordings of the unit. Where these are
undecided, it is the median of the unit's frames, if that is free.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax.data.background.estimate import (
    DIFFERENT,
    EDGE,
    UntouchedGel,
    estimate_untouched_gel,
    gel_of_unit,
    median_gel,
    scale_picture,
)
from anytouch_jax.data.background.rule import UnitGels
from anytouch_jax.data.images import ImageError, decode, encode
from anytouch_jax.data.manifest.manifest import Manifest, group_rows, replace_column, select_rows
from anytouch_jax.data.manifest.schema import shown
from anytouch_jax.datasets.scan import EXAMPLES
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write
from anytouch_jax.sensors import RECORDS

# of a recording, and of a unit, from which the untouched gel is estimated
_MAX_FRAMES = 48
_MAX_RECORDINGS = 48
_MANY = 3  # recordings of a unit whose median shows where nothing presses
_MAX_FAULTS = 1000  # a million broken pictures must not fill the memory
_Scored = tuple[int, float, str]  # row, score, reason
_Pictures = Callable[[np.ndarray], list[np.ndarray]]  # some frames of rows

# Score above which a frame is contact, where it was measured. The default of the other sensors is
# untested.
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
_CONTACT_WORDS = {"true": 1.0, "false": 0.0, "none": np.nan, "": np.nan}
# of contact_sheet
TILE = 120
PER_ROW = 10


@dataclass(frozen=True, eq=False)
class ContactScores:
    """Scores f32 (rows,), NaN if unknown.

    `reasons` (rows,) names the source of the background, or why it failed.

    `recordings` have no background picture, and for `decided` of them the untouched gel was
    estimated. `gels` holds the rows without a background picture whose untouched gel was given
    otherwise or estimated. `faults` holds a sentence for each of the first rows whose pictures
    cannot be used.
    """

    score: np.ndarray
    reasons: np.ndarray
    recordings: int = 0
    decided: int = 0
    gels: tuple[tuple[np.ndarray, UntouchedGel], ...] = ()
    faults: tuple[str, ...] = ()

    @property
    def counts(self) -> dict[str, int]:
        """Rows by reason."""
        return dict(Counter(self.reasons.tolist()))


@dataclass(frozen=True)
class ContactReport:
    """Numbers of rows by result, of rows dropped, and of rows labelled before, with the scores and
    thresholds.
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
        limits = ", ".join(f"{sensor} {limit:g}" for sensor, limit in self.thresholds.items())
        labelled = (
            f"; {self.labelled:,} rows keep the label.contact that they had"
            if self.labelled
            else ""
        )
        lines = [
            f"{len(self.scores.score):,} rows: contact {self.contact:,}, no contact {self.free:,}, "
            f"unknown {self.unknown:,}; dropped {self.dropped:,}",
            "background: "
            + ", ".join(f"{reason} {count:,}" for reason, count in self.scores.counts.items()),
        ]
        if faults := self.scores.faults:
            more = ["  (and more: `anytouch data verify` names them)"] * (len(faults) > EXAMPLES)
            lines += [
                "pictures that cannot be used:",
                *(f"  {fault}" for fault in faults[:EXAMPLES]),
                *more,
            ]
        if all_of := self.scores.recordings:
            decided = self.scores.decided
            lines += [
                f"untouched gel estimated for {decided:,} of {all_of:,} recordings "
                f"({decided / all_of:.0%})"
            ]
            if decided < all_of:
                lines[-1] += (
                    ". The labels of the others stay empty. To decide them, pass --background with "
                    "a picture of the "
                    "untouched gel"
                )
        return [*lines, f"contact is a score above: {limits}{labelled}"]


@dataclass(frozen=True)
class ContactQuality:
    """The filter compared with a reference column: precision and recall of contact, NaN without any
    contact.

    `rows` were compared. `positives` have contact by the reference, `predicted` by the filter,
    `hits` by both. `correlation` is Pearson's, of score and reference. `parts` holds (rows,
    precision, recall) by sensor and by source of the background.
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
        return [
            f"contact by {self.reference} > {self.above:g} on {self.positives:,} of {self.rows:,} "
            "rows "
            f"({self.skipped:,} without reference or score): precision {self.precision:.3f}, "
            f"recall {self.recall:.3f}, "
            f"correlation {self.correlation:.3f}",
            *(
                f"  {name}: {rows:,} rows, precision {precision:.3f}, recall {recall:.3f}"
                for name, (rows, precision, recall) in self.parts.items()
            ),
        ]


def contact_scores(
    manifest: Manifest,
    rows: np.ndarray | None = None,
    *,
    backgrounds: Mapping[str, UntouchedGel] | None = None,
    gels: UnitGels | None = None,
    workers: int = 2,
) -> ContactScores:
    """Return the score of every row, or of `rows` only. Frames are read by `workers` threads.

    `backgrounds` are pictures from `read_backgrounds` for rows without one. With `gels`, the
    pictures of the rule in `data.gels` serve all rows. A frame or background that cannot be read,
    or an untouched gel that cannot be decided, gives the score NaN and a reason. It raises nothing.
    """
    if workers < 1:
        raise UserError(f"--threads (workers) must be at least 1, not {workers}")
    rows = np.arange(len(manifest)) if rows is None else np.asarray(rows)
    score = np.full(len(manifest), np.nan, np.float32)
    reasons = np.full(len(manifest), "not asked for", dtype=object)
    has_background = manifest.present("background_path")[rows]
    recordings = decided = 0
    found: list[tuple[np.ndarray, UntouchedGel]] = []
    faults: dict[int, str] = {}
    with ThreadPoolExecutor(workers) as pool:
        pictures = partial(_pictures, manifest, pool, faults)

        def assign(score_row: Callable[[int], _Scored], some: np.ndarray) -> None:
            # millions of rows must not wait in memory
            for start in range(0, len(some), 1024):
                for row, value, reason in pool.map(score_row, some[start : start + 1024].tolist()):
                    score[row] = value
                    reasons[row] = reason

        if gels is not None:
            has_background = gels.has(rows)
            reasons[rows[~has_background]] = "none: no picture of the untouched gel"
        gel_of_row: Any = (gels or UnitGels(manifest)).shared(UntouchedGel)
        assign(partial(_score_row, manifest, faults, gel_of_row, "given"), rows[has_background])
        for group in _groups(manifest, rows[~has_background]) if gels is None else ():
            gel, source = _gel_of_group(manifest, group, pictures, backgrounds or {})
            if gel is not None:
                found.append((group, gel))
                assign(partial(_score_row, manifest, faults, gel, source), group)
                continue
            for recording, gel, source in _estimates(manifest, group, pictures):
                recordings += 1
                decided += gel is not None
                if gel is None:
                    reasons[recording] = f"none: {source}"
                else:
                    found.append((recording, gel))
                    assign(partial(_score_row, manifest, faults, gel, source), recording)
    sentences = tuple(
        f"{manifest.where(row)}: {faults[row]}" for row in sorted(faults)[: EXAMPLES + 1]
    )
    return ContactScores(score, reasons, recordings, decided, tuple(found), sentences)


def store_backgrounds(manifest: Manifest, scores: ContactScores, folder: Path) -> Manifest:
    """Write the estimated gels as PNG, and return the manifest with them as background_path.

    Raises OSError.
    """
    cells = manifest.column("background_path").to_pylist()
    is_free = manifest.text_column("split") == "background"
    for rows, gel in scores.gels:
        name = folder / f"{sha256(gel.picture.tobytes()).hexdigest()[:16]}.png"
        atomic_write(name, encode(gel.picture))
        for row in rows[~is_free[rows]].tolist():
            cells[row] = Path(
                os.path.relpath(name, manifest.files[manifest.source[row]].parent)
            ).as_posix()
    return replace_column(manifest, "background_path", cells)


def read_backgrounds(manifest: Manifest, words: Sequence[str]) -> dict[str, UntouchedGel]:
    """Return the pictures of --background, FILE (unit "") or UNIT=FILE words, by unit.

    Raises UserError.
    """
    waiting = np.flatnonzero(~manifest.present("background_path"))
    units = manifest.text_column("unit")
    sensors = manifest.codes("sensor")
    gels: dict[str, UntouchedGel] = {}
    for word in words:
        is_file = "=" not in word or (len(words) == 1 and Path(word).exists())
        unit, _, file = ("", "", word) if is_file else word.partition("=")
        if unit in gels or (not unit and len(words) > 1):
            raise UserError(
                f"--background {word}: give one picture for all recordings, or one UNIT=FILE for "
                "each unit"
            )
        gel = gels[unit] = UntouchedGel(decode(Path(file).expanduser()))
        rows = waiting[units[waiting] == unit] if unit else waiting
        if not len(rows):
            kind = f"of unit {unit} " if unit else ""
            raise UserError(
                f"--background {word}: the manifest has no row {kind}without a background picture"
            )
        for row in rows[np.unique(sensors[rows], return_index=True)[1]]:
            picture = _load_or_none(manifest, {}, row)
            try:
                if picture is not None:
                    gel.score(picture)
            except ValueError:
                raise UserError(
                    f"--background {file} has other proportions than {manifest.where(int(row))}. "
                    "Pass a picture of the same camera and cut, or name the unit as in UNIT=FILE."
                ) from None
    return gels


def _score_row(
    manifest: Manifest,
    faults: dict[int, str],
    gel: UntouchedGel | Callable[[int], UntouchedGel],
    source: str,
    row: int,
) -> _Scored:
    try:
        frame = decode(manifest.file(row))
        return row, (gel if isinstance(gel, UntouchedGel) else gel(row)).score(frame), source
    except (UserError, ValueError) as error:
        is_read = not isinstance(error, UserError)
        if len(faults) < _MAX_FAULTS:
            faults[row] = (
                f"{shown(manifest.value(row, 'path'))}: {error}" if is_read else str(error)
            )
        return (
            row,
            np.nan,
            f"none: {error if is_read else 'the frame or its background cannot be read'}",
        )


def _groups(manifest: Manifest, rows: np.ndarray) -> list[np.ndarray]:
    """Return `rows` by unit of one dataset and sensor if a unit is named, else by sequence, each in
    row order.
    """
    unit = manifest.codes("unit", own=True)
    sequence = manifest.codes("sequence", own=True)
    no_unit = unit < 0
    dataset = manifest.codes("dataset")
    keys = [
        no_unit,
        np.where(no_unit, sequence, unit),
        np.where(no_unit, 0, dataset),
        manifest.codes("sensor"),
    ]
    return group_rows(rows, np.stack(keys, 1)[rows])


def _gel_of_group(
    manifest: Manifest,
    group: np.ndarray,
    pictures: _Pictures,
    backgrounds: Mapping[str, UntouchedGel],
) -> tuple[UntouchedGel | None, str]:
    """Return the untouched gel by rows of the split `background`, or else by `backgrounds`."""
    free = group[np.asarray(pc.equal(manifest.table["split"].take(group), "background"))]
    if frames := pictures(free):
        return UntouchedGel(np.median(frames, axis=0).astype(np.uint8)), "rows of split background"
    unit = manifest.column("unit")[int(group[0])].as_py()
    return backgrounds.get(unit or "", backgrounds.get("")), "--background"


def _estimates(
    manifest: Manifest, group: np.ndarray, pictures: _Pictures
) -> Iterator[tuple[np.ndarray, UntouchedGel | None, str]]:
    """Yield rows, untouched gel and reason of each recording; stills are one, and others of the
    unit decide too.
    """

    def estimate(rows: np.ndarray) -> tuple[UntouchedGel | None, str, tuple[int, ...]]:
        frames = pictures(rows)
        return *estimate_untouched_gel(frames), frames[0].shape if frames else ()

    sequence = manifest.codes("sequence", own=True)[group]
    _, number, frames = np.unique(sequence, return_inverse=True, return_counts=True)
    recordings = group_rows(group, np.where(frames[number] < 3, -2, sequence))
    voters = spread(np.arange(len(recordings)), _MAX_RECORDINGS).tolist()
    estimates = {voter: estimate(recordings[voter]) for voter in voters}
    by_shape: dict[tuple[int, ...], list[UntouchedGel]] = {}
    for gel, _, shape in estimates.values():
        by_shape.setdefault(shape, []).extend([] if gel is None else [gel])
    common = {shape: gel_of_unit(gels) for shape, gels in by_shape.items()}
    usual = median_gel(pictures(group)) if len(recordings) >= _MANY else None
    for place, recording in enumerate(recordings):
        gel, reason, shape = estimates.get(place) or estimate(recording)
        agreed = common.get(shape)
        rivals = by_shape.get(shape, []) if agreed is None else [agreed]
        if gel is None and agreed is not None:
            yield recording, agreed, "estimated from other recordings of the unit"
        elif gel is not None and any(rival.score(gel.picture) >= DIFFERENT for rival in rivals):
            yield recording, None, "recordings of its unit show different untouched gels"
        elif gel is None and usual is not None and usual.picture.shape == shape:
            yield recording, usual, "the median of the unit"
        else:
            yield recording, gel, reason


def _pictures(
    manifest: Manifest, pool: ThreadPoolExecutor, faults: dict[int, str], rows: np.ndarray
) -> list[np.ndarray]:
    """Return at most _MAX_FRAMES evenly spaced frames from `scale_picture`, those of the most
    common shape.
    """
    loaded = pool.map(partial(_load_or_none, manifest, faults), spread(rows, _MAX_FRAMES).tolist())
    pictures = [
        picture
        for picture in loaded
        if picture is not None and min(picture.shape[:2]) > 2 * EDGE + 2
    ]
    shapes = Counter(picture.shape for picture in pictures)
    return [picture for picture in pictures if picture.shape == shapes.most_common(1)[0][0]]


def _load_or_none(manifest: Manifest, faults: dict[int, str], row: int) -> np.ndarray | None:
    try:
        return scale_picture(decode(manifest.file(row)))
    except UserError as error:
        if len(faults) < _MAX_FAULTS:
            faults[row] = str(error)
        return None


def mark_contact(
    manifest: Manifest,
    scores: ContactScores,
    *,
    thresholds: Mapping[str, float] | None = None,
    share: float = 0.0,
    drop: bool = False,
) -> tuple[Manifest, ContactReport]:
    """Return the manifest with `label.contact_score` and `label.contact` (1, 0 or null if unknown),
    and a report.

    An existing `label.contact` is kept. An existing score column is renamed to `<name>_given`.
    `thresholds` replaces entries of THRESHOLDS. With `share`, contact also needs this share of the
    highest score of its sequence, which excludes the start and the end of contact. `drop` removes
    frames without contact, but never the split `background` nor frames of unknown contact. Raises
    UserError if nothing would be left.
    """
    limits = threshold_of_rows(manifest, thresholds, share)
    known = known_contact(manifest)
    score = scores.score
    sequence = manifest.codes("sequence", own=True)
    highest = np.zeros(sequence.max() + 1)
    np.fmax.at(highest, sequence, score)
    contact = np.where(
        np.isnan(score), np.nan, (score > limits) & (score >= share * highest[sequence])
    )
    background = manifest.text_column("split") == "background"
    contact[background] = 0
    contact = np.where(np.isnan(known), contact, known > 0)
    free = contact == 0
    table = manifest.table
    name = "label.contact_score"
    renamed = "label.contact_score_given"
    if name in table.column_names:
        table = table.select([column for column in table.column_names if column != renamed])
        table = table.append_column(renamed, table[name])
    marked = replace_column(
        replace(manifest, table=table), name, pa.array(score, pa.float32(), mask=np.isnan(score))
    )
    column = pa.array(np.nan_to_num(contact).astype(np.int64), pa.int64(), mask=np.isnan(contact))
    marked = replace_column(marked, "label.contact", column)
    stays = ~free | background if drop else np.ones(len(manifest), bool)
    if not stays.any():
        raise UserError(
            "every frame is without contact by these thresholds; nothing would be left. "
            "Lower --threshold or --share, or leave out --drop"
        )
    used = dict(sorted(zip(manifest.table["sensor"].to_pylist(), limits.tolist(), strict=True)))
    masks = {
        "contact": contact == 1,
        "free": free,
        "unknown": np.isnan(contact),
        "dropped": ~stays,
        "labelled": np.isfinite(known),
    }
    report = ContactReport(
        scores, thresholds=used, **{name: int(mask.sum()) for name, mask in masks.items()}
    )
    return select_rows(marked, np.flatnonzero(stays)), report


def threshold_of_rows(
    manifest: Manifest, thresholds: Mapping[str, float] | None, share: float
) -> np.ndarray:
    """Return the threshold of every row, f64.

    Raises UserError for thresholds or a `share` that cannot be used.
    """
    if not 0 <= share <= 1:
        raise UserError(
            f"--share is a part of the highest score of a sequence, 0 to 1, not {share:g}"
        )
    table = {**THRESHOLDS, **(thresholds or {})}
    sensors = manifest.table["sensor"].to_pylist()
    for name in thresholds or {}:
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
    cells = (
        manifest.table["label.contact"].to_pylist()
        if "label.contact" in manifest.table.column_names
        else []
    )
    for row, value in enumerate(cells):
        word = str(value).strip().lower()
        try:
            contact[row] = _CONTACT_WORDS[word] if word in _CONTACT_WORDS else float(word)
        except ValueError:
            message = f"column 'label.contact' must be a number, true or false, is {shown(value)}"
            raise UserError(f"{manifest.where(row)}: {message}") from None
    return contact


def reference_contact(
    manifest: Manifest, reference: str | None = None
) -> tuple[str, npt.NDArray[np.float64]]:
    """Return the column that reports contact (default: first of REFERENCES) and its numbers.

    Raises UserError.
    """
    columns = manifest.table.column_names
    name = reference or next((column for column in REFERENCES if column in columns), None)
    if name is None or name not in columns:
        raise UserError(
            f"the manifest has no column {name or ' or '.join(REFERENCES)} to compare the contact "
            "filter with; "
            "name one with --reference"
        )
    return name, known_contact(manifest) if name == "label.contact" else manifest.number_column(
        name
    )


def contact_quality(
    manifest: Manifest,
    scores: ContactScores,
    *,
    reference: str | None = None,
    above: float | None = None,
    thresholds: Mapping[str, float] | None = None,
) -> ContactQuality:
    """Compare the filter with column `reference` > `above` (default: the first existing one of
    REFERENCES).

    Rows with a value and a score are compared, except the split `background`. `thresholds` replaces
    entries of THRESHOLDS. Raises UserError if there is no such column or row.
    """
    name, truth = reference_contact(manifest, reference)
    limit = REFERENCES.get(name, 0.0) if above is None else above
    relevant = manifest.text_column("split") != "background"
    used = np.flatnonzero(relevant & ~np.isnan(truth) & ~np.isnan(scores.score))
    if not used.size:
        raise UserError(
            f"no row has both a value in {name} and a score; name another column with --reference, "
            "or give a picture "
            "of the untouched gel with --background"
        )
    score = scores.score[used]
    sources = scores.reasons[used]
    sensors = manifest.text_column("sensor")[used]
    predicted = score > threshold_of_rows(manifest, thresholds, 0.0)[used]
    positive = truth[used] > limit

    def figures(members: np.ndarray) -> tuple[int, float, float]:
        hits, found, real = (
            int(part[members].sum()) for part in (positive & predicted, predicted, positive)
        )
        return (
            int(members.sum()),
            hits / found if found else np.nan,
            hits / real if real else np.nan,
        )

    parts = {f"sensor {sensor}": figures(sensors == sensor) for sensor in sorted(set(sensors))}
    parts |= {f"background {source}": figures(sources == source) for source in sorted(set(sources))}
    constant = len(used) < 2 or np.ptp(score) == 0 or np.ptp(truth[used]) == 0
    correlation = np.nan if constant else float(np.corrcoef(score, truth[used])[0, 1])
    rows, precision, recall = figures(np.ones(len(used), bool))
    return ContactQuality(
        name,
        limit,
        rows,
        int(relevant.sum()) - rows,
        int(positive.sum()),
        int(predicted.sum()),
        int((positive & predicted).sum()),
        precision,
        recall,
        correlation,
        parts,
    )


def contact_sheet(
    manifest: Manifest,
    scores: ContactScores,
    path: str | Path,
    *,
    thresholds: Mapping[str, float] | None = None,
    rows: int = 4,
) -> Path:
    """Write a PNG with `rows` rows of frames without contact (red) and as many with contact
    (green), by rising score.

    Frames are spread evenly over the scores of each side, so the doubtful ones are next to each
    other. Raises UserError if no row has a score.
    """
    is_scored = ~np.isnan(scores.score) & (manifest.text_column("split") != "background")
    if not is_scored.any():
        raise UserError(
            "no frame has a contact score, so there is nothing to show; leave out --picture"
        )
    contact = scores.score > threshold_of_rows(manifest, thresholds, 0.0)
    bands = []
    for title, members, colour in (
        ("no contact", ~contact, (60, 60, 230)),
        ("contact", contact, (80, 180, 60)),
    ):
        side = np.flatnonzero(is_scored & members)
        chosen = spread(side[np.argsort(scores.score[side], kind="stable")], rows * PER_ROW)
        tiles = [_tile(manifest, row, float(scores.score[row]), colour) for row in chosen]
        tiles += [np.full((TILE, TILE, 3), 255, np.uint8)] * (-len(tiles) % PER_ROW)
        head = np.full((28, TILE * PER_ROW, 3), 255, np.uint8)
        _write(head, f"{title}: {len(side)} frames", (6, 20), 0.55, colour)
        bands += [
            head,
            *(np.hstack(tiles[start : start + PER_ROW]) for start in range(0, len(tiles), PER_ROW)),
        ]
    atomic_write(path, cv2.imencode(".png", np.vstack(bands))[1].tobytes())
    return Path(path)


def _tile(manifest: Manifest, row: int, score: float, colour: tuple[int, int, int]) -> np.ndarray:
    """Return a square BGR tile with the frame, its score and a coloured border."""
    tile = np.full((TILE, TILE, 3), 255, np.uint8)
    try:
        image = decode(manifest.file(row))[..., ::-1]
    except ImageError:
        return tile
    image = scale_picture(image, TILE - 20)
    height, width = image.shape[:2]
    left = (TILE - width) // 2
    tile[2 : 2 + height, left : left + width] = image
    cv2.rectangle(tile, (left - 1, 1), (left + width, 2 + height), colour, 1)
    _write(tile, f"{score:.1f}", (left, height + 16), 0.4, (0, 0, 0))
    return tile


def _write(
    picture: np.ndarray, text: str, at: tuple[int, int], size: float, colour: tuple[int, int, int]
) -> None:
    cv2.putText(picture, text, at, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


def spread(items: np.ndarray, most: int) -> np.ndarray:
    """Return at most `most` evenly spread ones of `items` (n,)."""
    if len(items):
        return items[np.unique(np.linspace(0, len(items) - 1, most).astype(int))]
    return items
