"""The reference point without any learning: raw pixels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from sklearn.decomposition import PCA

from ..config import UserError
from ..data.manifest import Manifest
from ..data.samples import read_picture

Array = npt.NDArray[Any]
RAW_SIZE = (240, 320)  # rows and columns of a picture before it is averaged down
KEPT = 256  # backgrounds in memory, 230 kB each


def raw_pixels(
    frames: Array, backgrounds: Array, has_background: Array | None = None, *, size: tuple[int, int] = (24, 32)
) -> Array:
    """Pixels, in colour, and their difference from the background, both averaged down to `size` (rows, columns).

    `frames`, `backgrounds`: u8 RGB (n, h, w, 3) -> f32 (n, 2 * rows * columns * 3), in 0..1. The difference is 0
    where `has_background` (n,) is false. It may be called in pieces. Raises UserError when shapes do not match.
    """
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.shape != backgrounds.shape:
        raise UserError(f"frames {frames.shape} and backgrounds {backgrounds.shape} must both be (n, h, w, 3)")
    small = _shrink(frames, size)
    change = small - _shrink(backgrounds, size)
    if has_background is not None:
        change[~np.asarray(has_background, bool)] = 0.0
    return np.concatenate([small, change], axis=1)


def row_pixels(table: Manifest, row: int, grounds: dict[Path, Array]) -> Array:
    """`raw_pixels` of a row of a manifest, f32 (2 * 2304,); `grounds` keeps some backgrounds, which many rows share.

    Raises SampleError, which names row and file.
    """
    frame = _same_size(read_picture(table, row))
    has = table.value(row, "background_path") is not None
    ground = np.zeros_like(frame)
    if has:
        file = table.file(row, "background_path")
        if file not in grounds:
            if len(grounds) >= KEPT:
                grounds.clear()
            grounds[file] = _same_size(read_picture(table, row, "background_path"))
        ground = grounds[file]
    return raw_pixels(frame[None], ground[None], np.array([has]))[0]


def _same_size(image: Array) -> Array:
    if image.shape[:2] == RAW_SIZE:
        return image
    return np.asarray(cv2.resize(image, RAW_SIZE[::-1], interpolation=cv2.INTER_AREA))


def reduce(features: Array, train: Array, components: int = 200) -> Array:
    """`features` (n, d) on the first principal components of its `train` (n,) rows, largest variance first.

    With fewer train rows than `components`, as many as there are. Raises UserError without any.
    """
    train = np.asarray(train, bool)
    if not train.any():
        raise UserError("no row is marked as train; the principal components need some")
    count = min(components, int(train.sum()), features.shape[1])
    projection = PCA(count, svd_solver="full").fit(features[train])
    return projection.transform(features).astype(np.float32)


def _shrink(images: Array, size: tuple[int, int]) -> Array:
    """Area averages (n, rows * columns * 3) in 0..1 of u8 images (n, h, w, 3)."""
    count, height, width, colours = images.shape
    rows, columns = _area(height, size[0]), _area(width, size[1])
    lower = rows @ images.reshape(count, height, -1).astype(np.float32)
    small = columns @ lower.reshape(count, size[0], width, colours)
    return np.asarray(small / 255.0, np.float32).reshape(count, -1)


def _area(fine: int, coarse: int) -> Array:
    """(coarse, fine) weights of area averaging: the overlap of each coarse cell with each fine one; rows sum to 1."""
    edges = np.arange(coarse + 1) * (fine / coarse)
    left, right = edges[:-1, None], edges[1:, None]
    cells = np.arange(fine)[None]
    overlap = np.clip(np.minimum(right, cells + 1) - np.maximum(left, cells), 0, None)
    return (overlap / overlap.sum(1, keepdims=True)).astype(np.float32)
