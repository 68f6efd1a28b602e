"""Contact scores of a manifest: how far each frame differs from its background image.

AnyTouch filters its data by contact (appendix A.1). The score of a frame is the 98th percentile of
its colour difference (0 to 255) from the untouched gel, in an image of 160 pixels on its long side.
Marker dots, which shear moves, are closed in both images if the gel has them. A change of light is
subtracted as a plane for each colour.

The background of a row is its `background_path`, the rows of split `background` of its sensor
instance (or else sequence), or an image that the user names. Otherwise it is estimated from the
frames of its recording, and compared with the estimates of other recordings of the instance. Where
these are undecided, it is the median of the instance's frames, if that is free.

This is stricter than the rule of `rule.py`: there a doubtful background is better than none, while
here a frame without a sure background gets no label.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow.compute as pc

from anytouch_jax.data.background.estimate import (
    DIFFERENT,
    EDGE,
    UntouchedBackground,
    background_of_unit,
    estimate_background_image,
    median_background,
    scale_image,
)
from anytouch_jax.data.background.rule import Backgrounds
from anytouch_jax.data.images import decode, encode
from anytouch_jax.data.manifest.manifest import Manifest, group_rows, replace_column
from anytouch_jax.data.manifest.schema import EXAMPLES, shown
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write

# of a recording, and of an instance, from which the background is estimated
_MAX_FRAMES = 48
_MAX_RECORDINGS = 48
_MANY = 3  # recordings of an instance whose median shows where nothing presses
_FEWEST_FRAMES = 3  # of a recording; shorter ones are stills, which are estimated together
_STILLS = -2  # a sequence code that no sequence has
_MAX_FAULTS = 1000  # a million broken images must not fill the memory
_AT_ONCE = 1024  # rows that wait for a thread: millions of rows must not wait in memory


@dataclass(frozen=True, eq=False)
class ContactScores:
    """The scores of the rows of a manifest, and where their backgrounds are from.

    Attributes:
        score: f32 (rows,), NaN if unknown.
        reasons: (rows,), the source of the background, or why it failed.
        recordings: Number of recordings without a background image.
        decided: For how many of these the background was estimated.
        backgrounds: Rows without a background image whose background was given otherwise or
            estimated, with it.
        faults: A sentence for each of the first rows whose images cannot be used.
    """

    score: np.ndarray
    reasons: np.ndarray
    recordings: int = 0
    decided: int = 0
    backgrounds: tuple[tuple[np.ndarray, UntouchedBackground], ...] = ()
    faults: tuple[str, ...] = ()

    @property
    def counts(self) -> dict[str, int]:
        """Rows by reason."""
        return dict(Counter(self.reasons.tolist()))


def contact_scores(
    manifest: Manifest,
    rows: np.ndarray | None = None,
    *,
    backgrounds: Mapping[str, UntouchedBackground] | None = None,
    served: Backgrounds | None = None,
    workers: int = 2,
) -> ContactScores:
    """Return the score of every row, or of some.

    A frame or background that cannot be read, or a background that cannot be decided, gives the
    score NaN and a reason. It raises nothing.

    Args:
        manifest: The frames.
        rows: Row ids, by default all.
        backgrounds: Images from `read_backgrounds` for rows without one.
        served: Serve all rows by the rule of `rule.py`, instead of estimates by recording.
        workers: Threads that read images.
    """
    if workers < 1:
        raise UserError(f"--threads (workers) must be at least 1, not {workers}")
    rows = np.arange(len(manifest)) if rows is None else np.asarray(rows)
    with ThreadPoolExecutor(workers) as pool:
        scorer = _Scorer(manifest, pool)
        if served is not None:
            has_background = served.has(rows)
            scorer.refuse(rows[~has_background], "none: no image of the untouched gel")
            scorer.score_given(served, rows[has_background])
        else:
            has_background = manifest.present("background_path")[rows]
            scorer.score_given(Backgrounds(manifest), rows[has_background])
            for group in _groups(manifest, rows[~has_background]):
                scorer.score_group(group, backgrounds or {})
    return scorer.result()


class _Estimate(NamedTuple):
    """The background of one recording, or None and why; `shape` is () if no frame can be read."""

    gel: UntouchedBackground | None
    reason: str
    shape: tuple[int, ...]


class _Scorer:
    """Scores of rows as they are found, by the threads of `pool`."""

    def __init__(self, manifest: Manifest, pool: ThreadPoolExecutor) -> None:
        self._manifest = manifest
        self._pool = pool
        self._score = np.full(len(manifest), np.nan, np.float32)
        self._reasons = np.full(len(manifest), "not asked for", dtype=object)
        self._recordings = 0
        self._decided = 0
        self._found: list[tuple[np.ndarray, UntouchedBackground]] = []
        self._faults: dict[int, str] = {}

    def result(self) -> ContactScores:
        """Return what was found."""
        # one more than is shown, which tells that there are more
        first = sorted(self._faults)[: EXAMPLES + 1]
        sentences = tuple(f"{self._manifest.where(row)}: {self._faults[row]}" for row in first)
        return ContactScores(
            self._score,
            self._reasons,
            self._recordings,
            self._decided,
            tuple(self._found),
            sentences,
        )

    def refuse(self, rows: np.ndarray, reason: str) -> None:
        """Give rows no score."""
        self._reasons[rows] = reason

    def score_given(self, served: Backgrounds, rows: np.ndarray) -> None:
        """Score rows that have a background by the rule."""
        gel_of_row = served.shared(UntouchedBackground)
        self._assign(lambda row: self._score_row(gel_of_row, "given", row), rows)

    def score_group(
        self, group: np.ndarray, backgrounds: Mapping[str, UntouchedBackground]
    ) -> None:
        """Score the rows of one sensor instance that have no background image."""
        gel, source = self._gel_of_group(group, backgrounds)
        if gel is not None:
            self._score_by(gel, source, group)
            return
        for recording, estimated, source in self._estimates(group):
            self._recordings += 1
            if estimated is None:
                self.refuse(recording, f"none: {source}")
            else:
                self._decided += 1
                self._score_by(estimated, source, recording)

    def _score_by(self, gel: UntouchedBackground, source: str, rows: np.ndarray) -> None:
        self._found.append((rows, gel))
        self._assign(lambda row: self._score_row(lambda _: gel, source, row), rows)

    def _assign(self, score: Callable[[int], tuple[float, str]], rows: np.ndarray) -> None:
        for start in range(0, len(rows), _AT_ONCE):
            some = rows[start : start + _AT_ONCE].tolist()
            for row, (value, reason) in zip(some, self._pool.map(score, some), strict=True):
                self._score[row] = value
                self._reasons[row] = reason

    def _score_row(
        self, gel_of_row: Callable[[int], UntouchedBackground | None], source: str, row: int
    ) -> tuple[float, str]:
        try:
            frame = decode(self._manifest.file(row))
            gel = gel_of_row(row)
            assert gel is not None
            return gel.score(frame), source
        except UserError as error:
            self._note(row, str(error))
            return np.nan, "none: the frame or its background cannot be read"
        except ValueError as error:  # of another shape than its background
            self._note(row, f"{shown(self._manifest.value(row, 'path'))}: {error}")
            return np.nan, f"none: {error}"

    def _note(self, row: int, sentence: str) -> None:
        if len(self._faults) < _MAX_FAULTS:
            self._faults[row] = sentence

    def _gel_of_group(
        self, group: np.ndarray, backgrounds: Mapping[str, UntouchedBackground]
    ) -> tuple[UntouchedBackground | None, str]:
        """Return the background by rows of the split `background`, or else by `backgrounds`."""
        split = self._manifest.table["split"].take(group)
        free = group[np.asarray(pc.equal(split, "background"))]
        frames = self._images(free)
        if frames:
            gel = UntouchedBackground(np.median(frames, axis=0).astype(np.uint8))
            return gel, "rows of split background"
        unit = self._manifest.column("unit")[int(group[0])].as_py() or ""
        # "" is the image for all
        return backgrounds.get(unit, backgrounds.get("")), "--background"

    def _estimates(
        self, group: np.ndarray
    ) -> Iterator[tuple[np.ndarray, UntouchedBackground | None, str]]:
        """Yield rows, background and reason of each recording of an instance.

        Stills are one recording. Other recordings of the instance decide too: a press that is held
        for a whole recording looks like a gel of its own.
        """
        sequence = self._manifest.codes("sequence", own=True)[group]
        _, number, frames = np.unique(sequence, return_inverse=True, return_counts=True)
        recording_of = np.where(frames[number] < _FEWEST_FRAMES, _STILLS, sequence)
        recordings = group_rows(group, recording_of)
        voters = spread(np.arange(len(recordings)), _MAX_RECORDINGS).tolist()
        estimates = {voter: self._estimate(recordings[voter]) for voter in voters}
        by_shape: dict[tuple[int, ...], list[UntouchedBackground]] = {}
        for one in estimates.values():
            known = by_shape.setdefault(one.shape, [])
            if one.gel is not None:
                known.append(one.gel)
        common = {shape: background_of_unit(backgrounds) for shape, backgrounds in by_shape.items()}
        usual = median_background(self._images(group)) if len(recordings) >= _MANY else None
        for place, recording in enumerate(recordings):
            gel, reason, shape = estimates.get(place) or self._estimate(recording)
            agreed = common.get(shape)
            negatives = by_shape.get(shape, []) if agreed is None else [agreed]
            if gel is None and agreed is not None:
                yield recording, agreed, "estimated from other recordings of the unit"
            elif gel is not None and any(one.score(gel.image) >= DIFFERENT for one in negatives):
                yield recording, None, "recordings of its unit show different untouched gels"
            elif gel is None and usual is not None and usual.image.shape == shape:
                yield recording, usual, "the median of the unit"
            else:
                yield recording, gel, reason

    def _estimate(self, rows: np.ndarray) -> _Estimate:
        frames = self._images(rows)
        gel, reason = estimate_background_image(frames)
        shape = frames[0].shape if frames else ()
        return _Estimate(gel, reason, shape)

    def _images(self, rows: np.ndarray) -> list[np.ndarray]:
        """Return at most _MAX_FRAMES evenly spaced scaled frames, those of the commonest shape."""
        loaded = self._pool.map(self._load_or_none, spread(rows, _MAX_FRAMES).tolist())
        images = [
            image for image in loaded if image is not None and min(image.shape[:2]) > 2 * EDGE + 2
        ]
        if not images:
            return []
        shapes = Counter(image.shape for image in images)
        commonest = shapes.most_common(1)[0][0]
        return [image for image in images if image.shape == commonest]

    def _load_or_none(self, row: int) -> np.ndarray | None:
        try:
            return scale_image(decode(self._manifest.file(row)))
        except UserError as error:
            self._note(row, str(error))
            return None


def _groups(manifest: Manifest, rows: np.ndarray) -> list[np.ndarray]:
    """Return `rows` by sensor instance, each in row order.

    An instance is the unit of one dataset and sensor if a unit is named, else the sequence.
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


def store_backgrounds(manifest: Manifest, scores: ContactScores, folder: Path) -> Manifest:
    """Write the backgrounds that were found as PNG, and return the manifest with their paths.

    Raises OSError.
    """
    cells = manifest.column("background_path").to_pylist()
    is_free = manifest.text_column("split") == "background"
    for rows, gel in scores.backgrounds:
        # by content, so that a second run writes the same files
        name = folder / f"{sha256(gel.image.tobytes()).hexdigest()[:16]}.png"
        atomic_write(name, encode(gel.image))
        for row in rows[~is_free[rows]].tolist():
            root = manifest.files[manifest.source[row]].parent
            cells[row] = Path(os.path.relpath(name, root)).as_posix()
    return replace_column(manifest, "background_path", cells)


def read_backgrounds(manifest: Manifest, words: Sequence[str]) -> dict[str, UntouchedBackground]:
    """Return the images of --background, FILE (unit "") or UNIT=FILE words, by unit.

    Raises UserError.
    """
    waiting = np.flatnonzero(~manifest.present("background_path"))
    units = manifest.text_column("unit")
    backgrounds: dict[str, UntouchedBackground] = {}
    for word in words:
        # a file may have = in its name
        is_file = "=" not in word or (len(words) == 1 and Path(word).exists())
        unit, _, file = ("", "", word) if is_file else word.partition("=")
        if unit in backgrounds or (not unit and len(words) > 1):
            raise UserError(
                f"--background {word}: give one image for all recordings, or one UNIT=FILE for "
                "each unit"
            )
        backgrounds[unit] = UntouchedBackground(decode(Path(file).expanduser()))
        rows = waiting[units[waiting] == unit] if unit else waiting
        if not len(rows):
            kind = f"of unit {unit} " if unit else ""
            raise UserError(
                f"--background {word}: the manifest has no row {kind}without a background image"
            )
        _check_shape(manifest, rows, backgrounds[unit], file)
    return backgrounds


def _check_shape(manifest: Manifest, rows: np.ndarray, gel: UntouchedBackground, file: str) -> None:
    """Raise UserError unless the background fits the first of these rows of each sensor."""
    sensors = manifest.codes("sensor")
    _, first = np.unique(sensors[rows], return_index=True)
    for row in rows[first].tolist():
        try:
            image = decode(manifest.file(row))
        except UserError:  # the score of this row says so
            continue
        try:
            gel.score(scale_image(image))
        except ValueError:
            raise UserError(
                f"--background {file} has other proportions than {manifest.where(row)}. "
                "Pass an image of the same camera and cut, or name the unit as in UNIT=FILE."
            ) from None


def spread(items: np.ndarray, most: int) -> np.ndarray:
    """Return at most `most` evenly spread ones of `items` (n,)."""
    if not len(items):
        return items
    return items[np.unique(np.linspace(0, len(items) - 1, most).astype(int))]
