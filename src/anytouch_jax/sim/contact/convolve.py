"""Zero-padded convolution of (H, W) fields with kernels that are even, or odd, in both directions."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

# Up to this many pixels a side four matrix products are faster than two FFTs (measured: twice at 112, on two cores).
MATMUL_LIMIT = 144


@dataclass(frozen=True)
class Plan:
    """Transforms of (rows, columns) fields, padded so that a convolution does not wrap around.

    A transform is the usual complex one, or for small even sizes a real (2, 2, KH, KW) array: the cosine and sine sums
    of the parts even and odd about the centre in x and in y, which a symmetric kernel does not mix.
    """

    rows: int
    columns: int

    @property
    def padded(self) -> tuple[int, int]:
        return _smooth(2 * self.rows - 1), _smooth(2 * self.columns - 1)

    @property
    def matmul(self) -> bool:
        return max(self.rows, self.columns) <= MATMUL_LIMIT and self.rows % 2 == 0 and self.columns % 2 == 0

    def forward(self, field: Array) -> Array:
        if not self.matmul:
            return jnp.fft.rfft2(field, self.padded)
        y, x = _waves(self.rows, self.padded[0], field.dtype), _waves(self.columns, self.padded[1], field.dtype)
        parts = _split(_split(field, 0), 2)
        return _einsum("xlj,xykj->xykl", x, _einsum("yki,xyij->xykj", y, parts))

    def inverse(self, transform: Array) -> Array:
        if not self.matmul:
            return jnp.fft.irfft2(transform, self.padded)[: self.rows, : self.columns]
        y, x = _waves(self.rows, self.padded[0], transform.dtype), _waves(self.columns, self.padded[1], transform.dtype)
        parts = _einsum("yki,xykj->xyij", y, _einsum("xlj,xykl->xykj", x, transform))
        return _join(_join(parts, 2), 0)

    def even(self, transform: Array, spectrum: Array) -> Array:
        """The transform of a field's convolution with a kernel that is even in x and in y."""
        return transform * (_lifted(spectrum) if self.matmul else _unfold(spectrum, self.padded[0], 1, jnp))

    def odd(self, transform: Array, spectrum: Array) -> Array:
        """The transform of a field's convolution with a kernel that is odd in x and in y."""
        if not self.matmul:
            return transform * _unfold(spectrum, self.padded[0], -1, jnp)
        sign = jnp.array([[-1, 1], [1, -1]], transform.dtype)[:, :, None, None]  # sin(a - b), twice, and i squared
        return sign * transform[::-1, ::-1] * _lifted(spectrum)

    def spectrum(self, quadrant: Any, parity: int = 1, xp: ModuleType = np) -> Any:
        """Spectrum of a kernel from its (rows, columns) coefficients at offsets >= 0; on the host by default."""
        (high, wide), rows, columns = self.padded, self.rows, self.columns
        half = xp.pad(quadrant, ((0, high // 2 + 1 - rows), (0, wide // 2 + 1 - columns)))
        whole = _unfold(_unfold(half, high, parity, xp).T, wide, parity, xp).T
        found = xp.fft.rfft2(whole).real[: high // 2 + 1]
        if not self.matmul:
            return found
        y, x = np.full(high // 2 + 1, 2.0), np.full(wide // 2 + 1, 2.0)
        y[[0, -1]] = x[[0, -1]] = 1.0
        return found * xp.asarray(np.outer(y, x) / (high * wide), found.dtype)


def _smooth(least: int) -> int:
    """The first even size from `least` on whose only factors are 2, 3, 5 and 7."""
    size = least + least % 2
    while functools.reduce(_without, (2, 3, 5, 7), size) > 1:
        size += 2
    return size


def _without(size: int, factor: int) -> int:
    while size % factor == 0:
        size //= factor
    return size


@functools.lru_cache(maxsize=64)
def _wave_table(size: int, padded: int) -> npt.NDArray[np.float64]:
    angle = 2 * np.pi / padded * np.outer(np.arange(padded // 2 + 1), np.arange(size // 2) + 0.5)
    return np.stack([np.cos(angle), np.sin(angle)])


def _waves(size: int, padded: int, dtype: Any) -> Array:
    return jnp.asarray(_wave_table(size, padded), dtype)


def _einsum(formula: str, a: Array, b: Array) -> Array:
    return jnp.einsum(formula, a, b, precision=jax.lax.Precision.HIGHEST)  # accelerators would cut float32 to 10 bits


def _split(field: Array, axis: int) -> Array:
    """Parts even and odd about the centre of `axis`, as functions of the distance to it, stacked in front."""
    left, right = jnp.split(field, 2, axis)
    left = jnp.flip(left, axis)
    return jnp.stack([right + left, right - left])


def _join(parts: Array, axis: int) -> Array:
    """The inverse of `_split` (twice its size): parts (2, ...) -> ..., concatenated along `axis`."""
    even, odd = parts[0], parts[1]
    return jnp.concatenate([jnp.flip(even - odd, axis), even + odd], axis)


def _lifted(spectrum: Array) -> Array:
    return spectrum[None, None]


def _unfold(half: Any, size: int, parity: int, xp: ModuleType) -> Any:
    """Rows 0 .. size/2 -> all `size` rows in the order of the FFT."""
    return xp.concatenate([half, parity * half[1 : size // 2][::-1]], 0)
