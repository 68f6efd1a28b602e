"""Photometric model of camera sensors: a colour change as a polynomial in surface normal and image position.

The colour of diffuse paint under a few fixed lights is a low-order polynomial of its normal (spherical harmonics, Basri
and Jacobs 2003). Its coefficients drift slowly over the image. So a few hundred numbers for a sensor replace a table
over gradient bins (Taxim, Si and Yuan 2022). They are cheap to fit, smooth, bounded, and exactly zero without contact.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

DEGREE = 5  # of the polynomial in the normal, without its constant
POWERS = tuple((total - j, j) for total in range(1, DEGREE + 1) for j in range(total + 1))
PLACES = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # powers of (u, v), the position in the image
HALO_PLACES = PLACES[:3]
HALO = 3  # features of the halo: its slope along x, along y, and its depth


class Photometry(NamedTuple):
    """The change of one sensor's image with the tilt of its surface. Colours are RGB in 0..1."""

    normal: jax.Array | Array  # (20, 6, 3), a colour for every power of the normal and of the position
    halo: jax.Array | Array  # (3, 3, 3), soft shadow and light bleed, on slope and depth (1/mm) of the blurred dent
    steepest: float | jax.Array  # largest sine of the tilt in the fit; steeper surfaces look like this one
    widest: jax.Array | Array  # (3,), the same for the halo: a deep press all over is dark, but not black


def tilt(slope_x: jax.Array, slope_y: jax.Array, steepest: float | jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return slopes (mm/mm) over the length of their normal, which are sines of the tilt, cut to length `steepest`."""
    square = slope_x**2 + slope_y**2
    scale = jnp.minimum(jax.lax.rsqrt(1.0 + square), steepest * jax.lax.rsqrt(jnp.maximum(square, 1e-12)))
    return slope_x * scale, slope_y * scale


def colour_change(normal: jax.Array, nx: jax.Array, ny: jax.Array, u: jax.Array, v: jax.Array) -> jax.Array:
    """Return the change (H, W) of one colour channel, 0..1, of a surface with `tilt` (nx, ny) (H, W).

    `normal` (20, 6) is that channel of `Photometry.normal`, and `u` (W,) and `v` (H,) are places in -1..1. It is
    Horner's scheme in nx over Horner's scheme in ny. Every coefficient is a quadric of the place.
    """
    index, u, v = {power: k for k, power in enumerate(POWERS)}, u[None, :], v[:, None]

    def coefficient(i: int, j: int) -> jax.Array:
        c0, cu, cv, cuu, cuv, cvv = normal[index[i, j]]
        return (c0 + v * (cv + v * cvv)) + u * ((cu + v * cuv) + u * cuu)

    total = coefficient(DEGREE, 0)
    for i in range(DEGREE - 1, -1, -1):
        inner = coefficient(i, DEGREE - i)
        for j in range(DEGREE - i - 1, -1, -1):
            inner = inner * ny + (coefficient(i, j) if (i, j) != (0, 0) else 0.0)
        total = total * nx + inner
    return total


def halo_change(halo: jax.Array, features: tuple[jax.Array, ...], u: jax.Array, v: jax.Array) -> jax.Array:
    """Return the change (H, W) of one channel from slope x, slope y and depth (each (H, W)) of the blurred dent.

    `halo` (3, 3) is that channel of `Photometry.halo`.
    """
    terms = [
        feature * (halo[k, 0] + u[None, :] * halo[k, 1] + v[:, None] * halo[k, 2]) for k, feature in enumerate(features)
    ]
    return terms[0] + terms[1] + terms[2]


def design(nx: Array, ny: Array, u: Array, v: Array, halo: Array | None = None) -> Array:
    """Return the rows of the least squares problem, f64 (N, 120), or (N, 129) with halo features (N, 3)."""
    normal = np.stack([nx**i * ny**j for i, j in POWERS], -1)
    place = np.stack([u**i * v**j for i, j in PLACES], -1)
    columns = (normal[:, :, None] * place[:, None, :]).reshape(len(nx), -1)
    if halo is None:
        return columns
    return np.concatenate([columns, (halo[:, :, None] * place[:, None, :3]).reshape(len(nx), -1)], axis=1)


def ridge(rows: Array, colours: Array, penalty: float = 1e-6, halo_penalty: float = 1e-2) -> Array:
    """Return the ridge coefficients (columns, 3) of `design` rows, with a penalty on scaled coefficients.

    The halo's penalty is stronger. Inside a dent it nearly copies the normal's linear terms, and the two must not grow
    against each other.
    """
    gram = rows.T @ rows / len(rows)
    scale = np.sqrt(np.diag(gram)) + 1e-12
    penalties = np.full(len(gram), penalty)
    penalties[len(POWERS) * len(PLACES) :] = halo_penalty
    scaled = gram / scale[:, None] / scale[None, :] + np.diag(penalties)
    return np.asarray(np.linalg.solve(scaled, (rows.T @ colours / len(rows)) / scale[:, None]) / scale[:, None])


def assemble(coefficients: Array, steepest: float, widest: Array | None = None) -> Photometry:
    """Return a `Photometry` f32 from the coefficients of `design`. Without halo columns its halo is zero."""
    count = len(POWERS) * len(PLACES)
    normal = coefficients[:count].reshape(len(POWERS), len(PLACES), 3)
    halo = np.zeros((HALO, len(HALO_PLACES), 3))
    if len(coefficients) > count:
        halo = coefficients[count:].reshape(HALO, len(HALO_PLACES), 3)
    widest = np.full(HALO, np.inf) if widest is None else widest
    return Photometry(normal.astype(np.float32), halo.astype(np.float32), float(steepest), widest.astype(np.float32))


def fit_shading(shading: Callable[[Array, Array, Array, Array], Array]) -> Photometry:
    """Fit the polynomial to `shading(nx, ny, u, v) -> (N, 3)` minus its flat value, on a grid of normals and places."""
    steepest = 0.95
    side = np.linspace(-steepest, steepest, 21)
    place = np.linspace(-1, 1, 7)
    nx, ny, u, v = (a.ravel() for a in np.meshgrid(side, side, place, place, indexing="ij"))
    inside = nx**2 + ny**2 <= steepest**2
    nx, ny, u, v = nx[inside], ny[inside], u[inside], v[inside]
    change = shading(nx, ny, u, v) - shading(0 * nx, 0 * ny, u, v)
    return assemble(ridge(design(nx, ny, u, v), change, 1e-7), steepest)
