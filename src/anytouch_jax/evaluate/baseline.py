"""The reference point without any learning: raw pixels."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from sklearn.decomposition import PCA

from anytouch_jax.data.loading.samples import read_image
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.errors import UserError

Array = npt.NDArray[Any]
Size = tuple[int, int]  # rows, columns
RAW_SIZE = (240, 320)  # of a picture before `row_pixels` averages it down
SMALL = (24, 32)


def raw_pixels(frame: Array, background: Array | None, size: Size = SMALL) -> Array:
    """Pixels, in colour, and their difference from the background, both averaged down to `size`.

    `frame`, `background`: u8 RGB (h, w, 3) -> f32 (2 * rows * columns * 3), in 0..1. The difference is 0 without a
    background. Raises UserError when shapes do not match.
    """
    if frame.ndim != 3 or frame.shape[-1] != 3 or (background is not None and frame.shape != background.shape):
        others = "" if background is None else f" and background {background.shape}"
        raise UserError(f"frame {frame.shape}{others} must be of one shape (h, w, 3)")
    seen = _small(frame, size)
    return np.concatenate([seen, np.zeros_like(seen) if background is None else seen - _small(background, size)])


def row_pixels(table: Manifest, row: int, grounds: dict[Path, Array]) -> Array:
    """`raw_pixels` of a row of a manifest, f32 (2 * 2304,); `grounds` keeps backgrounds, which many rows share.

    Raises SampleError, which names row and file.
    """
    frame, ground = _same_size(read_image(table, row)), None
    if table.value(row, "background_path") is not None:
        file = table.file(row, "background_path")
        if file not in grounds:
            if len(grounds) >= 256:  # 230 kB each
                grounds.clear()
            grounds[file] = _same_size(read_image(table, row, "background_path"))
        ground = grounds[file]
    return raw_pixels(frame, ground)


def background_difference(table: Manifest, rows: Array, size: Size = SMALL) -> Array:
    """Frame minus background in RGB, averaged down to `size`: f32 (n, 3 * rows * columns) in -1..1.

    Raises UserError that names the row without a background, or whose background has other proportions.
    """
    behind: dict[Path, tuple[Array, float]] = {}
    found = np.zeros((len(rows), size[0] * size[1] * 3), np.float32)
    for place, row in enumerate(map(int, rows)):
        if table.value(row, "background_path") is None:
            raise UserError(f"{table.where(row)} has no background_path; give one, or leave this baseline out")
        file = table.file(row, "background_path")
        if file not in behind:
            gel = read_image(table, row, "background_path")
            behind[file] = _small(gel, size), gel.shape[1] / gel.shape[0]
        frame, (small, proportion) = read_image(table, row), behind[file]
        if abs(frame.shape[1] / frame.shape[0] / proportion - 1) > 0.05:
            raise UserError(f"{table.where(row)}: its background_path has other proportions than the frame")
        found[place] = _small(frame, size) - small
    return found


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


def _same_size(image: Array) -> Array:
    if image.shape[:2] == RAW_SIZE:
        return image
    return np.asarray(cv2.resize(image, RAW_SIZE[::-1], interpolation=cv2.INTER_AREA))


def _small(image: Array, size: Size) -> Array:
    """Area averages, f32 (rows * columns * 3) in 0..1, of a picture u8 (h, w, 3)."""
    return cv2.resize(image.astype(np.float32) / 255, size[::-1], interpolation=cv2.INTER_AREA).ravel()
