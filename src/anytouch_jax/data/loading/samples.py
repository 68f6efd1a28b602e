"""One sample at a time: a row's frames, picture and caption, augmented; bad ones named, or replaced and counted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from anytouch_jax.config import Config
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.transforms import (
    TOUCH,
    VISION,
    augmentation_rng,
    subtract_background,
    touch_evaluation,
    touch_transform,
    vision_evaluation,
    vision_transform,
)
from anytouch_jax.errors import UserError

TRIES = 20  # bad samples in a row before a slot gives up
_REPLACE = 51


class SampleError(UserError):
    """A sample that cannot be used; the message names the row, its manifest, the file and the reason."""


@dataclass(frozen=True)
class SampleReader:
    """Reads samples of `manifest` at the model's size, augmented as `config` says.

    Frames are kept in memory as they are after resizing, the first that fit into `data.cache` MB: a small data set is
    read once, not once an epoch. What a sample holds does not depend on it.
    """

    manifest: Manifest
    config: Config
    _kept: dict[Path, np.ndarray] = field(default_factory=dict, repr=False, compare=False)

    def touch(self, rows: np.ndarray, epoch: int | None, out: np.ndarray | None = None) -> np.ndarray:
        """The frames of a window of rows as u8 (T, size, size, 3); `epoch` None means no augmentation.

        They are written into `out`, once all could be read, or into a new array. The last row decides the augmentation
        of the whole clip. Where the untouched gel is taken off, its picture is augmented too, as another light would
        change both: a change of brightness alone would outshine the contact. Raises SampleError.
        """
        size, data = self.config.model.image_size, self.config.data
        plain = epoch is None or not (data.flip or any(data.affine) or any(data.jitter))
        # Nothing but the size: frames are resized once, unless the gel is to be taken off frames as they are.
        how = None if epoch is None or (plain and data.background == "subtract") else self._resized
        frames = [read_image(self.manifest, row, how=how) for row in rows]
        gel = self._background(int(rows[-1]), how or self._gel) if data.background == "subtract" else None
        if epoch is None or plain:
            return touch_evaluation(frames if gel is None else subtract_background(frames, gel), size, out)
        rng = augmentation_rng(self.config.run.seed, epoch, int(rows[-1]), TOUCH)
        if gel is None:
            return touch_transform(frames, size, rng, data, out)
        *seen, bare = touch_transform([*frames, gel], size, rng, data)
        return np.stack(subtract_background(seen, bare), out=out)

    def vision(self, row: int, epoch: int | None) -> np.ndarray:
        """The picture of a row's object as u8 (size, size, 3); `epoch` None means no augmentation."""
        size = self.config.model.image_size
        picture = read_image(self.manifest, row, "image_path")
        if epoch is None:
            return vision_evaluation(picture, size)
        rng = augmentation_rng(self.config.run.seed, epoch, int(row), VISION)
        return vision_transform(picture, size, rng, self.config.data.rotation)

    def caption(self, row: int) -> str:
        """The caption of a row."""
        return str(self.manifest.value(row, "text"))

    @cached_property
    def _gel(self) -> Callable[[Path], np.ndarray]:
        """Reads the untouched gel, one for many frames; nobody writes into it. Not kept longer than the reader: the
        file may be replaced."""
        return lru_cache(256)(decode)

    def _resized(self, file: Path) -> np.ndarray:
        """The picture of a file at the model's size, read-only; `touch_transform` finds nothing to resize any more."""
        found = self._kept.get(file)
        if found is None:
            size = self.config.model.image_size
            found = touch_evaluation([decode(file)], size)[0]
            found.flags.writeable = False
            if (len(self._kept) + 1) * found.nbytes <= self.config.data.cache * 1_000_000:
                self._kept[file] = found
        return found

    def _background(self, row: int, how: Callable[[Path], np.ndarray]) -> np.ndarray:
        if self.manifest.value(row, "background_path") is None:
            raise SampleError(
                f"{self.manifest.where(row)} has no background_path, which --loader.background subtract takes off; "
                "name one, or train with --loader.background keep"
            )
        return read_image(self.manifest, row, "background_path", how)


def read_image(
    manifest: Manifest, row: int, column: str = "path", how: Callable[[Path], np.ndarray] | None = None
) -> np.ndarray:
    """The picture u8 RGB (h, w, 3) that a column of a row names, decoded by `how`. Raises SampleError, which names the
    row and the column."""
    try:
        return (how or decode)(manifest.file(row, column))
    except UserError as error:
        raise SampleError(f"{manifest.where(row)}, column {column!r}: {error}") from None


def fill_slot(
    write: Callable[[int, int], None], size: int, step: int, slot: int, config: Config, index: int, epoch: int
) -> int:
    """Write sample `index` of `size` into a slot by `write(index, epoch)`; gives back how many were skipped.

    With `data.on_bad_sample` "skip" a bad sample is replaced by another of the same `size` ones, drawn from
    (seed, step, slot, attempt). Raises SampleError: at once with "error", else after TRIES bad ones in a row.
    """
    for attempt in range(TRIES):
        try:
            write(index, epoch)
            return attempt
        except SampleError as error:
            if config.data.on_bad_sample == "error":
                raise
            last = error
        rng = np.random.default_rng([config.run.seed % 2**63, _REPLACE, step, slot, attempt])
        index = int(rng.integers(size))
    raise SampleError(f"{TRIES} samples in a row cannot be read at step {step}; the last one is {last}")
