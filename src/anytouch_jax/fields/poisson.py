"""Surface from its gradient: the least-squares integral, as products of small matrices.

The gradient is on a staggered grid: differences from each pixel to its right neighbour, and to the
one below. The surface whose differences are nearest to them solves Poisson's equation with free
(Neumann) edges. The discrete cosine transform diagonalises it (Simchony, Chellappa and Shao 1990,
"Direct analytical methods for solving Poisson equations"). It leaves one constant open: the mean.
"""

from __future__ import annotations

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

Matrix = npt.NDArray[np.float32]


@lru_cache(maxsize=8)
def transforms(size: int) -> tuple[Matrix, Matrix, Matrix]:
    """Return the cosine transform of values, that of differences, and the squared frequencies.

    The first (size, size) is the orthonormal DCT-II. The second (size, size) maps differences to
    the transform of their divergence; its last column is 0, because behind the last value there
    is none. The third (size,) are the eigenvalues of the second difference with free edges.
    """
    wave, place = np.mgrid[:size, :size]
    cosine = np.sqrt(2 / size) * np.cos(np.pi * wave * (place + 0.5) / size)
    cosine[0] = size**-0.5
    divergence = np.zeros((size, size))
    divergence[:, :-1] = np.diff(cosine, axis=1)
    squared = 2 - 2 * np.cos(np.pi * np.arange(size) / size)
    narrow = (part.astype(np.float32) for part in (cosine, divergence, squared))
    values, differences, frequencies = narrow
    return values, differences, frequencies


@lru_cache(maxsize=8)
def inverse_spectrum(rows: int, columns: int) -> Matrix:
    """Return one over the eigenvalues (rows, columns) of Poisson's equation, 0 for the mean."""
    spectrum = transforms(rows)[2][:, None] + transforms(columns)[2][None]
    spectrum[0, 0] = np.inf
    return np.asarray(1 / spectrum, np.float32)


def differences(surface: Array) -> Array:
    """Return the gradient (B, H, W, 2) of surfaces (B, H, W), along x and y, 0 at the far edges."""
    across = jnp.diff(surface, axis=2, append=surface[:, :, -1:])
    down = jnp.diff(surface, axis=1, append=surface[:, -1:])
    return jnp.stack([across, down], axis=-1)


def integrate(gradient: Array) -> Array:
    """Return the surfaces (B, H, W) of mean 0 whose differences are nearest to `gradient`.

    `gradient` (B, H, W, 2) has differences along x and y. What it says of the last column along x
    and the last row along y is ignored.
    """
    rows, columns = gradient.shape[1:3]
    down, down_divergence, _ = map(jnp.asarray, transforms(rows))
    across, across_divergence, _ = map(jnp.asarray, transforms(columns))
    spectrum = down @ gradient[..., 0] @ across_divergence.T
    spectrum = spectrum + down_divergence @ gradient[..., 1] @ across.T
    spectrum = spectrum * jnp.asarray(inverse_spectrum(rows, columns))[None]
    return down.T @ spectrum @ across


@lru_cache(maxsize=8)
def border(rows: int, columns: int) -> Matrix:
    """Return 1 for the pixels (rows, columns) at the border of an image, and 0 within."""
    ring = np.ones((rows, columns), np.float32)
    ring[1:-1, 1:-1] = 0
    return ring
