"""Pixels of any file as RGB uint8, and the limits on their size."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from anytouch_jax.errors import UserError

MAX_PIXELS = 1 << 26  # a small file can declare an image that would fill the memory
MAX_ASPECT = 100  # a longer strip would fill the memory when its short side is resized


class ImageError(UserError):
    """An image or a video that cannot be used; the message names the file."""


def to_rgb(pixels: np.ndarray, path: str | Path) -> np.ndarray:
    """Return pixels as RGB u8 (h, w, 3).

    Grey becomes RGB, an alpha channel is dropped, 16 bits are scaled to 8, and floats are taken as
    0..1.

    Args:
        pixels: (h, w) or (h, w, c) with 1, 3 (RGB) or 4 channels.
        path: What errors call it.

    Raises:
        ImageError: For another shape or type, an image that is too large or a strip, and floats
            that are NaN or outside 0..1.
    """
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    check_shape(pixels.shape, path)
    # the byte order of the machine, for a .npy of another
    pixels = pixels[..., :3].astype(pixels.dtype.newbyteorder("="), copy=False)
    if pixels.dtype == np.uint16:
        # 257 = 65535 / 255, and half of it rounds
        pixels = ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
    elif np.issubdtype(pixels.dtype, np.floating):
        _check_range(pixels, path)
        pixels = np.rint(pixels.astype(np.float32) * 255).astype(np.uint8)
    elif pixels.dtype != np.uint8:
        raise ImageError(
            f"{path} has pixels of type {pixels.dtype}; use uint8, uint16 or floats in 0..1, for a "
            "list np.asarray(frame, np.uint8)"
        )
    if pixels.shape[2] == 1:
        pixels = np.repeat(pixels, 3, axis=2)
    return np.ascontiguousarray(pixels)


def check_shape(shape: tuple[int, ...], path: str | Path) -> None:
    """Raise ImageError unless a shape is that of an image (h, w, c) of a usable size."""
    if len(shape) != 3 or shape[2] not in (1, 3, 4) or 0 in shape:
        raise ImageError(
            f"{path} has shape {shape}; an image is (height, width) with 1, 3 or 4 channels"
        )
    height, width = shape[:2]
    if height * width > MAX_PIXELS:
        raise ImageError(
            f"{path} has {width} x {height} pixels, more than the limit of {MAX_PIXELS}"
        )
    if max(height, width) > MAX_ASPECT * min(height, width):
        raise ImageError(f"{path} has {width} x {height} pixels: that is a strip, not an image")


def _check_range(pixels: np.ndarray, path: str | Path) -> None:
    """Raise ImageError for floats that are NaN or outside 0..1."""
    low = float(pixels.min())
    high = float(pixels.max())
    if np.isnan(low):
        raise ImageError(f"{path} has NaN pixels")
    if low < 0 or high > 1:
        advice = "divide them by 255" if low >= 0 and high <= 255 else "scale them first"
        raise ImageError(
            f"{path} has float pixels in {low:g}..{high:g}; floats must lie in 0..1: {advice}"
        )
