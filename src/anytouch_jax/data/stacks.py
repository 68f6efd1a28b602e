"""Stacks of frames: a recording in one .npy or .npz file."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.data.images import ImageError, to_rgb
from anytouch_jax.files import placeholder, read_arrays

Array = npt.NDArray[Any]
_CHANNELS = (1, 3, 4)


def read_stack(path: str | Path) -> Array | None:
    """Return the frames (T, h, w) or (T, h, w, channels) of a .npy or .npz file.

    Channels may come first in the file. It is None for another file, and for one image in a .npy.
    Frames of a .npy are read when they are used. Raises ImageError for a file without frames or
    with several arrays of them.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in (".npy", ".npz") or not path.is_file():
        return None
    if kind := placeholder(path):
        raise ImageError(f"{path} is {kind}")
    if suffix == ".npz":
        return _stack_of_npz(path)
    try:
        frames: Array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise ImageError(f"{path} cannot be read: {error}") from None
    if _is_stack(frames):
        return _channels_last(frames)
    return None


def _stack_of_npz(path: Path) -> Array:
    """Return the only array of frames in a .npz file, or its only image as a stack of one."""
    try:
        shapes = read_arrays(path, only=lambda _: False)
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise ImageError(f"{path} cannot be read: {error}") from None
    if {"features", "rows"} <= shapes.keys():
        raise ImageError(f"{path} contains features, not frames; name the frames that they are of")
    names = [name for name, array in shapes.items() if _is_stack(array)]
    if not names:
        names = [name for name, array in shapes.items() if _is_image(array)]
    if len(names) != 1:
        held = ", ".join(f"{name} {array.shape}" for name, array in shapes.items()) or "nothing"
        found = "no array" if not names else f"{len(names)} arrays"
        raise ImageError(
            f"{path} has {found} of frames (frames, height, width, 3): it holds {held}. Save one "
            "of them as .npy"
        )
    (name,) = names
    try:
        frames = read_arrays(path, only=name.__eq__)[name]
    except (OSError, ValueError) as error:
        raise ImageError(f"{path} cannot be read: {error}") from None
    return _channels_last(frames) if _is_stack(frames) else frames[None]


def _channels_last(frames: Array) -> Array:
    if frames.ndim == 4 and frames.shape[-1] not in _CHANNELS:
        return np.moveaxis(frames, 1, -1)
    return frames


def stacked_frames(frames: Array, path: str | Path) -> Iterator[Array]:
    """Yield the frames of a stack as RGB u8 (h, w, 3); `path` is for errors. Raises ImageError."""
    for number, frame in enumerate(frames):
        yield to_rgb(np.asarray(frame), f"frame {number} of {path}")


def _is_stack(array: Array) -> bool:
    """Whether an array is frames (T, h, w), or with channels last or first."""
    if not _is_pixels(array):
        return False
    if array.ndim == 4:
        return array.shape[-1] in _CHANNELS or array.shape[1] in _CHANNELS
    # (h, w, 3) is one image.
    return array.ndim == 3 and array.shape[-1] not in _CHANNELS


def _is_image(array: Array) -> bool:
    """Whether an array is one image (h, w), or (h, w, channels)."""
    has_channels = array.ndim == 3 and array.shape[-1] in _CHANNELS
    return _is_pixels(array) and (has_channels or array.ndim == 2)


def _is_pixels(array: Array) -> bool:
    return array.dtype.kind in "uf" and min(array.shape, default=0) > 0
