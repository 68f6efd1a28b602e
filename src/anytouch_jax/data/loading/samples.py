"""Samples: the frames and photograph of a row, augmented, or resized in batches of given rows for
evaluation.

Bad samples are errors, or are replaced or left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from pathlib import Path
from typing import Literal

import numpy as np

from anytouch_jax.batch import TouchBatch
from anytouch_jax.config import Config
from anytouch_jax.data import transforms
from anytouch_jax.data.background.rule import ADVICE, UnitGels
from anytouch_jax.data.images import decode
from anytouch_jax.data.loading.threads import BatchJobs, prefetch_batches
from anytouch_jax.data.manifest.manifest import Manifest, sensor_rows
from anytouch_jax.errors import UserError

TRIES = 20  # bad samples in a row before a slot gives up
NAMED = 5  # bad samples that are named where bad samples are skipped
# tags of the random streams of replacements and of subtracted backgrounds
_REPLACE = 51
_SUBTRACT = 52


# a frame, and its background or None
Prepare = Callable[[np.ndarray, np.ndarray | None], np.ndarray]


class SampleError(UserError):
    """A sample that cannot be used; the message names the row, its manifest, the file and the
    reason.
    """


@dataclass(frozen=True)
class SampleReader:
    """Reads samples of `manifest` at the model's size, augmented as `config` says; the first frames
    are cached.
    """

    manifest: Manifest
    config: Config
    gels: UnitGels | None = None
    _cache: dict[Path, tuple[np.ndarray, tuple[int, ...]]] = field(
        default_factory=dict, repr=False, compare=False
    )

    def __post_init__(self) -> None:
        if self.gels is None and self.config.data.background != "keep":
            object.__setattr__(self, "gels", UnitGels(self.manifest))

    def touch(
        self,
        rows: np.ndarray,
        epoch: int | None,
        out: np.ndarray | None = None,
        prepare: Prepare | None = None,
    ) -> np.ndarray:
        """Return the frames of a window of rows, u8 (T, size, size, 3), not augmented if `epoch` is
        None.

        They are written into `out` once all could be read. The last row seeds the augmentation of
        the clip. A background that is subtracted is augmented too: else the change of brightness
        would be stronger than the contact. `prepare` replaces resizing and subtraction. Raises
        SampleError.
        """
        size = self.config.model.image_size
        data = self.config.data
        plain = epoch is None or not (data.flip or any(data.affine) or any(data.jitter))
        # Frames are resized once and cached, unless the background is subtracted at their original
        # size.
        gel = None if data.background == "keep" or self.gels is None else self.gels(int(rows[-1]))
        subtracts = self._subtracts(int(rows[-1]), epoch, gel)
        shapes: list[tuple[int, ...]] = []  # before resizing
        load = (
            None
            if epoch is None or (plain and subtracts)
            else partial(self._resized, shapes=shapes)
        )
        frames = [read_image(self.manifest, row, load=load) for row in rows]
        background = gel if subtracts else None
        if subtracts and gel is None:
            if self.manifest.value(rows[-1], "background_path") is None:
                raise SampleError(
                    f"{self.manifest.where(rows[-1])} has no picture of the untouched gel. {ADVICE}"
                )
            background = read_image(
                self.manifest, rows[-1], "background_path", load or self._decode_background
            )
        if background is not None:
            resized = shapes[len(rows) :]  # of a background that was read
            try:
                transforms.check_proportions(
                    (shapes or [frames[0].shape])[0], (resized or [background.shape])[0]
                )
            except UserError as error:
                raise SampleError(f"{self.manifest.where(rows[-1])}: {error}") from None
        if prepare is not None:
            return np.stack([prepare(frame, background) for frame in frames])
        if epoch is None or plain:
            return transforms.touch_evaluation(
                frames
                if background is None
                else transforms.subtract_background(frames, background),
                size,
                out,
            )
        rng = transforms.augmentation_rng(
            self.config.run.seed, epoch, int(rows[-1]), transforms.TOUCH
        )
        if background is None:
            return transforms.touch_transform(frames, size, rng, data, out)
        *augmented, background = transforms.touch_transform([*frames, background], size, rng, data)
        return np.stack(transforms.subtract_background(augmented, background), out=out)

    def _subtracts(self, row: int, epoch: int | None, gel: np.ndarray | None) -> bool:
        """Return whether the background of a row is subtracted.

        "either" draws it, and always does in evaluation.
        """
        if self.config.data.background != "either":
            return self.config.data.background == "subtract"
        if gel is None and self.manifest.value(row, "background_path") is None:
            return False
        seed = self.config.run.seed
        return epoch is None or bool(
            np.random.default_rng([seed, epoch, row, _SUBTRACT]).random() < 0.5
        )

    def vision(self, row: int, epoch: int | None) -> np.ndarray:
        """Return the photograph of a row, u8 (size, size, 3); `epoch` None means no
        augmentation.
        """
        size = self.config.model.image_size
        image = read_image(self.manifest, row, "image_path")
        if epoch is None:
            return transforms.vision_evaluation(image, size)
        rng = transforms.augmentation_rng(self.config.run.seed, epoch, int(row), transforms.VISION)
        return transforms.vision_transform(image, size, rng, self.config.data.rotation)

    @cached_property
    def _decode_background(self) -> Callable[[Path], np.ndarray]:
        """`decode` with a cache of this reader's lifetime: many frames share a background."""
        return lru_cache(256)(decode)

    def _resized(self, file: Path, shapes: list[tuple[int, ...]]) -> np.ndarray:
        """Return an image at the model's size, read-only, from the cache if it is there.

        Its shape goes to `shapes`.
        """
        image, shape = self._cache.get(file, (None, ()))
        if image is None:
            decoded = decode(file)
            image = transforms.touch_evaluation([decoded], self.config.model.image_size)[0]
            shape = decoded.shape
            image.flags.writeable = False
            if (len(self._cache) + 1) * image.nbytes <= self.config.data.cache * 1_000_000:
                self._cache[file] = image, shape
        shapes.append(shape)
        return image


def read_image(
    manifest: Manifest,
    row: int,
    column: str = "path",
    load: Callable[[Path], np.ndarray] | None = None,
) -> np.ndarray:
    """Return the image in a path column, RGB u8 (h, w, 3), by `load` (`decode`).

    Raises SampleError with its place.
    """
    try:
        return (load or decode)(manifest.file(row, column))
    except UserError as error:
        raise SampleError(f"{manifest.where(row)}, column {column!r}: {error}") from None


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
    """Write sample `index` of `size` into a slot by `write(index, epoch)`, and return how many were
    skipped.

    With "skip" a bad sample is replaced by one drawn from (seed, step, slot, attempt), and
    `skipped` gets its error. Raises SampleError at once with "error", else after TRIES bad samples
    in a row.
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
        rng = np.random.default_rng([config.run.seed % 2**63, _REPLACE, step, slot, attempt])
        index = int(rng.integers(size))
    raise SampleError(
        f"{TRIES} samples in a row cannot be read at step {step}; the last one is {last}; "
        "check the data with `anytouch data verify`"
    )


def evaluation(
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
    gels: UnitGels | None = None,
) -> Iterator[tuple[np.ndarray, TouchBatch]]:
    """Yield (row ids i64 (n,), TouchBatch of B rows) over `rows` in order, with the same bytes
    every time.

    Stills have T = 1; clips are the `frames` (default `model.frames`) frames that end at each row.
    B is `data.batch_size`, and only the first n rows of a batch are valid. With
    `data.on_bad_sample` "skip" bad rows are left out, and `skipped` gets a sentence for the first
    NAMED. `unknown` "universal" gives unknown sensors the universal tokens. `prepare` makes an
    array like `like` from a frame u8 (h, w, 3) and its background or None. `gels` are the untouched
    gels, by default those of `data.gels`. Raises ManifestError for an unknown sensor, SampleError,
    and UserError for a row that ends no clip.
    """
    rows = np.asarray(rows, np.int64)
    windows = (
        rows[:, None]
        if kind == "still"
        else _clips_ending_at(manifest, rows, frames or config.model.frames)
    )
    sensor, _ = sensor_rows(manifest, config.model, rows, unknown=unknown)
    if rows.size and (sensor[rows] < 0).any():
        row = int(rows[sensor[rows] < 0][0])
        place = manifest.where(row)
        name = manifest.value(row, "sensor")
        raise UserError(
            f"{place}: sensor {name!r} measures a force field and has no images; leave it out"
        )
    side = config.model.image_size
    data = config.data
    reader = SampleReader(manifest, config, gels)
    blank = np.zeros((side, side, 3), np.uint8) if like is None else like
    named = [] if skipped is None else skipped

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

    def plan(start: int) -> BatchJobs[tuple[TouchBatch, np.ndarray]]:
        chosen = windows[start : start + data.batch_size]
        clip = np.zeros((data.batch_size, chosen.shape[1], *blank.shape), blank.dtype)
        batch = TouchBatch(clip, np.zeros(data.batch_size, np.int32))
        is_good = np.ones(len(chosen), bool)
        batch.sensor[: len(chosen)] = sensor[chosen[:, -1]]
        return BatchJobs(
            (batch, is_good),
            [partial(write, clip, is_good, start, slot) for slot in range(len(chosen))],
        )

    def batches() -> Iterator[tuple[np.ndarray, TouchBatch]]:
        starts = range(0, len(rows), data.batch_size)
        for start, (batch, is_good), _ in prefetch_batches(
            plan, starts, data.threads, data.prefetch
        ):
            good = np.flatnonzero(is_good)
            if (
                good.size and good.size < data.batch_size
            ):  # move the good rows to the front and repeat the last one
                order = np.concatenate([good, np.repeat(good[-1:], data.batch_size - good.size)])
                batch = TouchBatch(batch.clip[order], batch.sensor[order])
            if good.size:
                yield rows[start + good], batch

    return batches()  # so that mistakes are raised by the call


def _clips_ending_at(manifest: Manifest, rows: np.ndarray, length: int) -> np.ndarray:
    clips = manifest.clips(length)
    if not rows.size:
        return np.empty((0, length), np.int64)
    at = np.minimum(np.searchsorted(clips[:, -1], rows), max(len(clips) - 1, 0))
    is_end = clips[at, -1] == rows if len(clips) else np.zeros(len(rows), bool)
    if not is_end.all():
        row = int(rows[~is_end][0])
        others = np.count_nonzero(~is_end) - 1
        raise UserError(
            f"{manifest.where(row)} does not end a clip of {length} frames (nor do {others} other "
            "rows); "
            "choose rows by Manifest.clips, or use stills"
        )
    return clips[at]
