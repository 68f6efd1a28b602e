"""Samples: the frames and RGB image of a row, augmented for training or resized for evaluation.

Bad samples are errors, or are replaced or left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from anytouch_jax.batch import TouchBatch
from anytouch_jax.config import Config
from anytouch_jax.data import transforms
from anytouch_jax.data.background.rule import ADVICE, Backgrounds
from anytouch_jax.data.images import decode
from anytouch_jax.data.loading.threads import BatchJobs, prefetch_batches
from anytouch_jax.data.manifest.manifest import Manifest, sensor_rows
from anytouch_jax.errors import UserError

TRIES = 20  # bad samples in a row before a slot gives up
NAMED = 5  # bad samples that are named where bad samples are skipped
# tags of the random streams of replacements and of subtracted backgrounds
_REPLACE = 51
_SUBTRACT = 52
_SEEDS = 2**63  # numpy's generators take no negative seeds
_BACKGROUNDS = 256  # that a reader keeps

# Makes an array of a frame, and of its background or None.
Prepare = Callable[[np.ndarray, np.ndarray | None], np.ndarray]
Shape = tuple[int, ...]


class SampleError(UserError):
    """A sample that cannot be used.

    The message names the row, its manifest, the file and the reason.
    """


class _Loaded(NamedTuple):
    """An image, and the shape of its file. They differ if it was resized on the way."""

    image: np.ndarray
    shape: Shape


@dataclass(frozen=True)
class SampleReader:
    """Reads samples at the model's size, augmented as the config says.

    The first frames are kept in memory, up to `data.cache` MB.

    Attributes:
        manifest: The frames.
        config: Of the run.
        backgrounds: The backgrounds, by default those of the rule if they are subtracted.
    """

    manifest: Manifest
    config: Config
    backgrounds: Backgrounds | None = None
    _cache: dict[Path, _Loaded] = field(default_factory=dict, repr=False, compare=False)

    def __post_init__(self) -> None:
        if self.backgrounds is None and self.config.data.background != "keep":
            object.__setattr__(self, "backgrounds", Backgrounds(self.manifest))

    def touch(
        self,
        rows: np.ndarray,
        epoch: int | None,
        out: np.ndarray | None = None,
        prepare: Prepare | None = None,
    ) -> np.ndarray:
        """Return the frames of a window of rows, u8 (T, size, size, 3).

        Args:
            rows: i64 (T,). The last one seeds the augmentation of the clip.
            epoch: The pass over the row; None for no augmentation.
            out: They are written into it once all could be read.
            prepare: Replaces resizing and subtraction.

        Raises:
            SampleError: For a frame or a background that cannot be read, and a missing one.
        """
        row = int(rows[-1])
        size = self.config.model.image_size
        data = self.config.data
        augments = epoch is not None and bool(data.flip or any(data.affine) or any(data.jitter))
        gel = None
        if data.background != "keep" and self.backgrounds is not None:
            gel = self.backgrounds(row)
        subtracts = self._subtracts(row, epoch, gel)
        # In training, frames are resized once and kept. But a background is subtracted at the
        # original size, as in evaluation, unless both are augmented first.
        resizes = epoch is not None and (augments or not subtracts)
        load = self._resized if resizes else self._whole
        frames = [self._load(one, "path", load) for one in rows]
        background = None
        if subtracts:
            background = self._background(row, gel, load if resizes else self._kept_background)
            self._check_proportions(row, frames[0], background)
        images = [frame.image for frame in frames]
        gel_image = None if background is None else background.image
        if prepare is not None:
            return np.stack([prepare(image, gel_image) for image in images])
        if epoch is None or not augments:
            if gel_image is not None:
                images = transforms.subtract_background(images, gel_image)
            return transforms.touch_evaluation(images, size, out)
        rng = transforms.augmentation_rng(self.config.run.seed, epoch, row, transforms.TOUCH)
        if gel_image is None:
            return transforms.touch_transform(images, size, rng, data, out)
        # The background is augmented with the frames. Otherwise the change of brightness would be
        # stronger than the contact.
        *augmented, gel_image = transforms.touch_transform([*images, gel_image], size, rng, data)
        return np.stack(transforms.subtract_background(augmented, gel_image), out=out)

    def _subtracts(self, row: int, epoch: int | None, gel: np.ndarray | None) -> bool:
        """Return whether the background of a row is subtracted.

        "either" draws it in training, and always does it in evaluation.
        """
        if self.config.data.background != "either":
            return self.config.data.background == "subtract"
        if gel is None and self.manifest.value(row, "background_path") is None:
            return False
        if epoch is None:
            return True
        rng = np.random.default_rng([self.config.run.seed, epoch, row, _SUBTRACT])
        return bool(rng.random() < 0.5)

    def _background(
        self, row: int, gel: np.ndarray | None, load: Callable[[Path], _Loaded]
    ) -> _Loaded:
        """Return the background of a row: that of its sensor instance, else its stored image."""
        if gel is not None:
            return _Loaded(gel, gel.shape)
        if self.manifest.value(row, "background_path") is None:
            raise SampleError(
                f"{self.manifest.where(row)} has no image of the untouched gel. {ADVICE}"
            )
        return self._load(row, "background_path", load)

    def _check_proportions(self, row: int, frame: _Loaded, background: _Loaded) -> None:
        try:
            transforms.check_proportions(frame.shape, background.shape)
        except UserError as error:
            raise SampleError(f"{self.manifest.where(row)}: {error}") from None

    def vision(self, row: int, epoch: int | None) -> np.ndarray:
        """Return the RGB image of a row, u8 (size, size, 3), not augmented if `epoch` is None."""
        size = self.config.model.image_size
        image = read_image(self.manifest, row, "image_path")
        if epoch is None:
            return transforms.vision_evaluation(image, size)
        rng = transforms.augmentation_rng(self.config.run.seed, epoch, int(row), transforms.VISION)
        return transforms.vision_transform(image, size, rng, self.config.data.rotation)

    def _load(self, row: int, column: str, load: Callable[[Path], _Loaded]) -> _Loaded:
        try:
            return load(self.manifest.file(row, column))
        except UserError as error:
            raise _named(self.manifest, row, column, error) from None

    def _whole(self, file: Path) -> _Loaded:
        """Return an image at its own size."""
        image = decode(file)
        return _Loaded(image, image.shape)

    @cached_property
    def _kept_background(self) -> Callable[[Path], _Loaded]:
        """`_whole` with a cache of this reader's lifetime: many frames share a background."""
        return lru_cache(_BACKGROUNDS)(self._whole)

    def _resized(self, file: Path) -> _Loaded:
        """Return an image at the model's size, read-only, from the cache if it is there."""
        known = self._cache.get(file)
        if known is not None:
            return known
        decoded = decode(file)
        image = transforms.touch_evaluation([decoded], self.config.model.image_size)[0]
        image.flags.writeable = False
        loaded = _Loaded(image, decoded.shape)
        # All images of the cache have one size.
        if (len(self._cache) + 1) * image.nbytes <= self.config.data.cache * 1_000_000:
            self._cache[file] = loaded
        return loaded


def read_image(
    manifest: Manifest,
    row: int,
    column: str = "path",
    load: Callable[[Path], np.ndarray] | None = None,
) -> np.ndarray:
    """Return the image in a path column, RGB u8 (h, w, 3).

    Args:
        manifest: The frames.
        row: The row.
        column: The column.
        load: Reads a file, by default `decode`.

    Raises:
        SampleError: With its place.
    """
    try:
        return (load or decode)(manifest.file(row, column))
    except UserError as error:
        raise _named(manifest, row, column, error) from None


def _named(manifest: Manifest, row: int, column: str, error: UserError) -> SampleError:
    return SampleError(f"{manifest.where(row)}, column {column!r}: {error}")


def fill_slot(
    write: Callable[[int, int], None],
    size: int,
    step: int,
    slot: int,
    config: Config,
    index: int,
    epoch: int,
    skipped: Callable[[str], None] = lambda _: None,
) -> int:
    """Write a sample into a slot, and return how many were skipped.

    With `data.on_bad_sample` "skip" a bad sample is replaced by one drawn from (seed, step, slot,
    attempt), which does not depend on other slots.

    Args:
        write: `write(index, epoch)` writes a sample.
        size: Number of samples to draw from.
        step: The step.
        slot: The slot.
        config: Of the run.
        index: The sample.
        epoch: The pass over it.
        skipped: Gets the error of each bad sample.

    Raises:
        SampleError: At once with "error", else after TRIES bad samples in a row.
    """
    for attempt in range(TRIES):
        try:
            write(index, epoch)
            return attempt
        except SampleError as error:
            if config.data.on_bad_sample == "error":
                raise
            last = error
            skipped(str(error))
        rng = np.random.default_rng([config.run.seed % _SEEDS, _REPLACE, step, slot, attempt])
        index = int(rng.integers(size))
    raise SampleError(
        f"{TRIES} samples in a row cannot be read at step {step}; the last one is {last}; "
        "check the data with `anytouch data verify`"
    )


def evaluation(  # noqa: PLR0913, for callers that name them
    manifest: Manifest,
    rows: np.ndarray,
    config: Config,
    kind: Literal["still", "clip"] = "still",
    *,
    frames: int | None = None,
    unknown: Literal["error", "universal"] = "error",
    prepare: Prepare | None = None,
    like: np.ndarray | None = None,
    skipped: list[str] | None = None,
    backgrounds: Backgrounds | None = None,
) -> Iterator[tuple[np.ndarray, TouchBatch[np.ndarray]]]:
    """Yield (row ids i64 (n,), TouchBatch of B rows) over rows in order, the same bytes every time.

    B is `data.batch_size`, and only the first n rows of a batch are valid. With
    `data.on_bad_sample` "skip" bad rows are left out.

    Args:
        manifest: The frames.
        rows: Row ids.
        config: Of the model.
        kind: Stills have T = 1; clips are the frames that end at each row.
        frames: Of a clip, by default `model.frames`.
        unknown: "universal" gives unknown sensors the universal tokens.
        prepare: Makes an array of a frame u8 (h, w, 3) and of its background or None.
        like: An array of the shape and type that `prepare` returns.
        skipped: Gets a sentence for each of the first NAMED rows that are left out.
        backgrounds: The backgrounds, by default those of the rule if they are subtracted.

    Raises:
        ManifestError: For an unknown sensor.
        SampleError: For a bad row.
        UserError: For a row that ends no clip, and for one of a force field.
    """
    rows = np.asarray(rows, np.int64)
    if kind == "still":
        windows = rows[:, None]
    else:
        windows = _clips_ending_at(manifest, rows, frames or config.model.frames)
    sensor, _ = sensor_rows(manifest, config.model, rows, unknown=unknown)
    fields = rows[sensor[rows] < 0]
    if fields.size:
        row = int(fields[0])
        raise UserError(
            f"{manifest.where(row)}: sensor {manifest.value(row, 'sensor')!r} measures a force "
            "field and has no images; leave it out"
        )
    side = config.model.image_size
    data = config.data
    reader = SampleReader(manifest, config, backgrounds)
    blank = np.zeros((side, side, 3), np.uint8) if like is None else like
    named: list[str] = [] if skipped is None else skipped

    def write(clip: np.ndarray, is_good: np.ndarray, start: int, slot: int) -> int:
        try:
            clip[slot] = reader.touch(windows[start + slot], None, prepare=prepare)
        except SampleError as error:
            if data.on_bad_sample == "error":
                raise
            if len(named) < NAMED:
                named.append(str(error))
            is_good[slot] = False
        return 0

    def plan(start: int) -> BatchJobs[tuple[TouchBatch[np.ndarray], np.ndarray]]:
        chosen = windows[start : start + data.batch_size]
        clip = np.zeros((data.batch_size, chosen.shape[1], *blank.shape), blank.dtype)
        batch = TouchBatch(clip, np.zeros(data.batch_size, np.int32))
        batch.sensor[: len(chosen)] = sensor[chosen[:, -1]]
        is_good = np.ones(len(chosen), bool)
        jobs = [partial(write, clip, is_good, start, slot) for slot in range(len(chosen))]
        return BatchJobs((batch, is_good), jobs)

    def batches() -> Iterator[tuple[np.ndarray, TouchBatch[np.ndarray]]]:
        starts = range(0, len(rows), data.batch_size)
        filled = prefetch_batches(plan, starts, data.threads, data.prefetch)
        for start, (batch, is_good), _ in filled:
            good = np.flatnonzero(is_good)
            if good.size:
                yield rows[start + good], _packed(batch, good)

    return batches()  # so that mistakes are raised by the call


def _packed(batch: TouchBatch[np.ndarray], good: np.ndarray) -> TouchBatch[np.ndarray]:
    """Return a batch with its good rows at the front; the last of these fills the rest.

    A blank row could give NaN, and some checks look at whole batches.
    """
    missing = len(batch.sensor) - good.size
    if not missing:
        return batch
    order = np.concatenate([good, np.repeat(good[-1:], missing)])
    return TouchBatch(batch.clip[order], batch.sensor[order])


def _clips_ending_at(manifest: Manifest, rows: np.ndarray, length: int) -> np.ndarray:
    """Return the clips of `length` frames that end at rows, i64 (rows, length).

    Raises UserError for a row that ends none.
    """
    clips = manifest.clips(length)
    if not rows.size:
        return np.empty((0, length), np.int64)
    # clips are ordered by their last rows
    ends = clips[:, -1]
    at = np.minimum(np.searchsorted(ends, rows), max(len(clips) - 1, 0))
    is_end = ends[at] == rows if len(clips) else np.zeros(len(rows), bool)
    if not is_end.all():
        row = int(rows[~is_end][0])
        others = np.count_nonzero(~is_end) - 1
        raise UserError(
            f"{manifest.where(row)} does not end a clip of {length} frames (nor do {others} other "
            "rows); choose rows by Manifest.clips, or use stills"
        )
    return clips[at]
