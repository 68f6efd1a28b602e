"""Position tables for another image size: bicubic, in numpy."""

from __future__ import annotations

import math

import numpy as np

_A = -0.75  # the constant of torch's bicubic; jax.image and PIL use -0.5


def resize_position(table: np.ndarray, rows: int) -> np.ndarray:
    """A (1 + M, D) table of a square grid resized to (`rows`, D); row 0, the class token's, is kept.

    Equal to torch's `interpolate(mode="bicubic", align_corners=False, antialias=False)`, computed in float64.
    Raises ValueError when either grid is not square.
    """
    old, new = math.isqrt(len(table) - 1), math.isqrt(rows - 1)
    if old**2 != len(table) - 1 or new**2 != rows - 1 or not old or not new:
        raise ValueError(f"a position table of {len(table)} rows cannot become {rows}: the grids must be square")
    weights = _bicubic(old, new)
    grid = table[1:].astype(np.float64).reshape(old, old, -1)
    grid = np.einsum("ij,jkd->ikd", weights, grid)
    grid = np.einsum("kl,ild->ikd", weights, grid)
    return np.concatenate([table[:1], grid.reshape(new * new, -1).astype(table.dtype)])


def _bicubic(old: int, new: int) -> np.ndarray:
    """(new, old) matrix of the four-tap cubic filter; taps beyond the border fall on the border."""
    centre = (np.arange(new) + 0.5) * old / new - 0.5
    base = np.floor(centre).astype(int)
    matrix = np.zeros((new, old))
    for tap in range(-1, 3):
        distance = np.abs(centre - (base + tap))
        near = ((_A + 2) * distance - (_A + 3)) * distance**2 + 1
        far = _A * (((distance - 5) * distance + 8) * distance - 4)
        weight = np.where(distance <= 1, near, far)
        np.add.at(matrix, (np.arange(new), np.clip(base + tap, 0, old - 1)), weight)
    return matrix
