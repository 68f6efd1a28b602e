"""The photometric model of every camera sensor: a colour change as a polynomial in surface normal and image position.

A membrane of diffuse paint under a few fixed lights answers a tilt of its surface with a low-order polynomial of the
normal (the argument of spherical harmonics, Basri and Jacobs 2003), whose coefficients drift slowly over the image.
So a few hundred numbers a sensor replace a table over gradient bins (Taxim, Si and Yuan 2022): cheap to fit, smooth,
bounded, and exactly zero where nothing is touched.
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
    """How one sensor's image changes with the tilt of its surface; colours are 0..1, RGB.

    `normal` (20, 6, 3): for every power of the normal (`POWERS`) and of the position (`PLACES`) a colour.
    `halo` (3, 3, 3): the soft shadow and light bleed round a dent, on slope and depth (1/mm) of the blurred dent.
    `steepest`: largest sine of the tilt that the fit has seen; steeper surfaces look like this one. `widest` (3,): the
    same for the features of the halo: a gel pressed deeply all over is darker than a ball's dent, but not black.
    """

    normal: jax.Array | Array
    halo: jax.Array | Array
    steepest: float | jax.Array
    widest: jax.Array | Array


def tilt(slope_x: jax.Array, slope_y: jax.Array, steepest: float | jax.Array) -> tuple[jax.Array, jax.Array]:
    """Slopes (mm/mm) over the length of the normal they belong to, i.e. sines of the tilt; cut to length `steepest`."""
    square = slope_x**2 + slope_y**2
    scale = jnp.minimum(jax.lax.rsqrt(1.0 + square), steepest * jax.lax.rsqrt(jnp.maximum(square, 1e-12)))
    return slope_x * scale, slope_y * scale


def colour_change(normal: jax.Array, nx: jax.Array, ny: jax.Array, u: jax.Array, v: jax.Array) -> jax.Array:
    """Change (H, W) of one colour channel, 0..1, of a surface with `tilt` (nx, ny) (H, W).

    `normal` (20, 6) is that channel of `Photometry.normal`; `u` (W,) and `v` (H,) are places in -1..1. Horner's scheme
    in nx over Horner's scheme in ny; every coefficient is a quadric of the place.
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
    """Change (H, W) of one channel from slope x, slope y and depth (each (H, W)) of the blurred dent.

    `halo` (3, 3) is that channel of `Photometry.halo`.
    """
    terms = [
        feature * (halo[k, 0] + u[None, :] * halo[k, 1] + v[:, None] * halo[k, 2]) for k, feature in enumerate(features)
    ]
    return terms[0] + terms[1] + terms[2]


def design(nx: Array, ny: Array, u: Array, v: Array, halo: Array | None = None) -> Array:
    """The rows of the least squares problem, f64 (N, 120) or (N, 129) with halo features (N, 3); all inputs (N,)."""
    normal = np.stack([nx**i * ny**j for i, j in POWERS], -1)
    place = np.stack([u**i * v**j for i, j in PLACES], -1)
    columns = (normal[:, :, None] * place[:, None, :]).reshape(len(nx), -1)
    if halo is None:
        return columns
    return np.concatenate([columns, (halo[:, :, None] * place[:, None, :3]).reshape(len(nx), -1)], axis=1)


def ridge(rows: Array, colours: Array, penalty: float = 1e-6, halo_penalty: float = 1e-2) -> Array:
    """Coefficients (columns, 3) of `design` rows: least mean square error plus a penalty on scaled coefficients.

    The halo's penalty is the stronger one: inside a dent it is nearly a copy of the normal's linear terms, and the two
    must not grow against each other.
    """
    gram = rows.T @ rows / len(rows)
    scale = np.sqrt(np.diag(gram)) + 1e-12
    penalties = np.full(len(gram), penalty)
    penalties[len(POWERS) * len(PLACES) :] = halo_penalty
    scaled = gram / scale[:, None] / scale[None, :] + np.diag(penalties)
    return np.asarray(np.linalg.solve(scaled, (rows.T @ colours / len(rows)) / scale[:, None]) / scale[:, None])


def assemble(coefficients: Array, steepest: float, widest: Array | None = None) -> Photometry:
    """A `Photometry` from the columns of `design`; without halo columns its halo is zero. Rounded to f32."""
    count = len(POWERS) * len(PLACES)
    normal = coefficients[:count].reshape(len(POWERS), len(PLACES), 3)
    halo = np.zeros((HALO, len(HALO_PLACES), 3))
    if len(coefficients) > count:
        halo = coefficients[count:].reshape(HALO, len(HALO_PLACES), 3)
    widest = np.full(HALO, np.inf) if widest is None else widest
    return Photometry(normal.astype(np.float32), halo.astype(np.float32), float(steepest), widest.astype(np.float32))


def fit_shading(shading: Callable[[Array, Array, Array, Array], Array]) -> Photometry:
    """The polynomial nearest to `shading(nx, ny, u, v) -> (N, 3)`, on a grid of normals and places, minus flat."""
    steepest = 0.95
    side = np.linspace(-steepest, steepest, 21)
    place = np.linspace(-1, 1, 7)
    nx, ny, u, v = (a.ravel() for a in np.meshgrid(side, side, place, place, indexing="ij"))
    inside = nx**2 + ny**2 <= steepest**2
    nx, ny, u, v = nx[inside], ny[inside], u[inside], v[inside]
    change = shading(nx, ny, u, v) - shading(0 * nx, 0 * ny, u, v)
    return assemble(ridge(design(nx, ny, u, v), change, 1e-7), steepest)
