"""Samples: the frames, photograph and caption of a row, augmented; bad samples are errors, or are replaced."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np

from anytouch_jax.config import Config
from anytouch_jax.data import transforms
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.errors import UserError

TRIES = 20  # bad samples in a row before a slot gives up
NAMED = 5  # bad samples that are named where bad samples are skipped
_REPLACE, _SUBTRACT = 51, 52  # tags of the random streams of replacements and of subtracted backgrounds


Prepare = Callable[[np.ndarray, np.ndarray | None], np.ndarray]  # a frame, and its background or None


class SampleError(UserError):
    """A sample that cannot be used; the message names the row, its manifest, the file and the reason."""


@dataclass(frozen=True)
class SampleReader:
    """Reads samples of `manifest` at the model's size, augmented by the settings of `config`.

    The first resized frames that fit into `data.cache` MB stay in memory, so a small data set is read once. The
    samples do not depend on it.
    """

    manifest: Manifest
    config: Config
    _cache: dict[Path, np.ndarray] = field(default_factory=dict, repr=False, compare=False)

    def touch(
        self, rows: np.ndarray, epoch: int | None, out: np.ndarray | None = None, prepare: Prepare | None = None
    ) -> np.ndarray:
        """Return the frames of a window of rows, u8 (T, size, size, 3); `epoch` None means no augmentation.

        They are written into `out` once all frames could be read, else into a new array. The last row seeds the
        augmentation of the whole clip. A background that is subtracted is augmented too: otherwise the change of
        brightness would be stronger than the contact. `prepare` (without augmentation) replaces both resizing and
        subtraction. Raises SampleError.
        """
        size, data = self.config.model.image_size, self.config.data
        plain = epoch is None or not (data.flip or any(data.affine) or any(data.jitter))
        # Frames are resized once and cached, unless the background is subtracted at their original size.
        subtracts = self._subtracts(int(rows[-1]), epoch)
        load = None if epoch is None or (plain and subtracts) else self._resized
        frames = [read_image(self.manifest, row, load=load) for row in rows]
        background = None
        if subtracts:
            if self.manifest.value(rows[-1], "background_path") is None:
                raise SampleError(
                    f"{self.manifest.where(rows[-1])} has no background_path, which --data.background subtract "
                    "requires; add one, or pass --data.background keep"
                )
            background = read_image(self.manifest, rows[-1], "background_path", load or self._decode_background)
        if prepare is not None:
            return np.stack([prepare(frame, background) for frame in frames])
        if epoch is None or plain:
            return transforms.touch_evaluation(
                frames if background is None else transforms.subtract_background(frames, background), size, out
            )
        rng = transforms.augmentation_rng(self.config.run.seed, epoch, int(rows[-1]), transforms.TOUCH)
        if background is None:
            return transforms.touch_transform(frames, size, rng, data, out)
        *augmented, background = transforms.touch_transform([*frames, background], size, rng, data)
        return np.stack(transforms.subtract_background(augmented, background), out=out)

    def _subtracts(self, row: int, epoch: int | None) -> bool:
        """Return whether the background of a row is subtracted. "either" draws it, and always does in evaluation."""
        if self.config.data.background != "either":
            return self.config.data.background == "subtract"
        if self.manifest.value(row, "background_path") is None:
            return False
        return epoch is None or bool(
            np.random.default_rng([self.config.run.seed, epoch, row, _SUBTRACT]).random() < 0.5
        )

    def vision(self, row: int, epoch: int | None) -> np.ndarray:
        """Return the photograph of a row, u8 (size, size, 3); `epoch` None means no augmentation."""
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

    def _resized(self, file: Path) -> np.ndarray:
        """Return an image at the model's size, read-only, from the cache if it is there."""
        image = self._cache.get(file)
        if image is None:
            image = transforms.touch_evaluation([decode(file)], self.config.model.image_size)[0]
            image.flags.writeable = False
            if (len(self._cache) + 1) * image.nbytes <= self.config.data.cache * 1_000_000:
                self._cache[file] = image
        return image


def read_image(
    manifest: Manifest, row: int, column: str = "path", load: Callable[[Path], np.ndarray] | None = None
) -> np.ndarray:
    """Return the image in a path column of a row, RGB u8 (h, w, 3), by `load` (default: `decode`).

    Raises SampleError, which names the row and the column.
    """
    try:
        return (load or decode)(manifest.file(row, column))
    except UserError as error:
        raise SampleError(f"{manifest.where(row)}, column {column!r}: {error}") from None


def fill_slot(
    write: Callable[[int, int], None], size: int, step: int, slot: int, config: Config, index: int, epoch: int,
    skipped: Callable[[str], None] = lambda _: None,
) -> int:  # fmt: skip
    """Write sample `index` of `size` into a slot by `write(index, epoch)`, and return how many were skipped.

    With `data.on_bad_sample` "skip" a bad sample is replaced by another of the same `size`, drawn from (seed, step,
    slot, attempt). Then `skipped` gets its error. Raises SampleError: at once with "error", else after TRIES bad
    samples in a row.
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
