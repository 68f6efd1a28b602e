"""Photometric models of camera sensors, fitted to colour changes: polynomials in surface normal and image position.

A model is a `Photometry` of `sim.sensing.sensors`. GelSlim and DuraGel are a few lights each, set by eye.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.sim.sensing.sensors import POWERS, Photometry

Array = npt.NDArray[Any]
RGB = tuple[float, float, float]

PLACES = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # powers of (u, v), the position in the image
HALO_PLACES = PLACES[:3]
HALO = 3  # features of the halo: its slope along x, along y, and its depth
DARKER = (-0.36, -0.36, -0.34)  # change of a 9DTact's image for each mm of depth


@dataclass(frozen=True)
class Light:
    """One light of a camera sensor."""

    place: tuple[float, float]  # in the image (columns, rows); -1..1 is the field
    colour: RGB
    reach: float = 1.0  # of its glow, in half fields
    height: float = 0.6  # over the surface, relative to its distance; low lights shade strongly
    contrast: float = 1.0  # brightness of tilted paint
    flat: float = 1.0  # brightness of flat paint


@dataclass(frozen=True)
class Lights:
    """The look of a camera sensor made of lights."""

    ambient: RGB  # colour of the untouched skin where no light reaches
    lights: tuple[Light, ...]
    shadow: float = 0.3  # how strongly the far side of a whole dent darkens, relative to surface shading


LIGHTS = {
    "gelslim": Lights((0.20, 0.32, 0.38), (
        Light((-0.70, 0.35), (0.08, 0.48, 0.24), reach=0.6, height=0.3, contrast=2.6),
        Light((0.25, -0.85), (0.02, 0.16, 0.54), reach=0.7, height=0.3, contrast=2.6),
        Light((0.35, 0.95), (0.66, 0.10, 0.22), reach=0.6, height=0.3, contrast=2.8),
        Light((1.10, 0.20), (0.16, 0.10, 0.20), reach=0.8, height=0.3, contrast=2.6, flat=0.0),
    )),
    "duragel": Lights((0.20, 0.17, 0.24), (
        Light((-1.05, 0.0), (0.40, 0.12, 0.30), reach=1.0, height=0.5, contrast=1.8),
        Light((1.05, -0.1), (0.06, 0.32, 0.36), reach=1.0, height=0.5, contrast=1.8),
        Light((0.0, 1.05), (0.36, 0.30, 0.06), reach=0.9, height=0.5, contrast=1.8),
    )),
}  # fmt: skip


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


def shade(lights: Lights, nx: Array, ny: Array, u: Array, v: Array, *, flat_only: bool = False) -> Array:
    """Return the light (N, 3) from paint with tilt (nx, ny) (slope over length of the normal) at places (u, v).

    Each light follows Lambert's law. A light is a bar of lamps along an edge, so its direction turns over the image by
    a third of that of a point light. Its glow is a Gaussian of the distance to its middle, wider on flanks than on flat
    skin. `flat_only` weights the lights as in the untouched image.
    """
    nz = np.sqrt(np.maximum(1 - nx**2 - ny**2, 0))
    total = np.zeros((len(nx), 3))
    for light in lights.lights:
        distance = np.hypot(light.place[0] - u, light.place[1] - v)
        reach = light.reach * (1.0 if flat_only else 1.6)
        glow = np.exp(-(distance**2) / (2 * reach**2))
        x, y, z = light.place[0] - u / 3, light.place[1] - v / 3, 1.2 * light.height
        # The dent bulges toward the camera: its normal is (-slope, 1), and the side facing a light is bright.
        facing = (nz * z - nx * x - ny * y) / np.sqrt(x**2 + y**2 + z**2)
        weight = light.flat if flat_only else light.contrast * np.maximum(facing, 0)
        total += (glow * weight)[:, None] * np.asarray(light.colour)
    return total


def soft_shadow(lights: Lights) -> Array:
    """Return halo coefficients (3, 3, 3): a slope of the whole dent that faces away from a light loses its colour."""
    halo = np.zeros((HALO, len(HALO_PLACES), 3), np.float32)
    for light in lights.lights:
        toward = np.asarray(light.place) / np.hypot(*light.place)
        halo[:2, 0] -= lights.shadow * light.contrast * toward[:, None] * np.asarray(light.colour)
    return halo


def lit(lights: Lights) -> Photometry:
    """Return the model of lights."""
    return fit_shading(partial(shade, lights))._replace(halo=soft_shadow(lights))


def untouched(lights: Lights, field: tuple[float, float]) -> Array:
    """Return the untouched image (1, h, w, 3) f32 in 0..1 of a `field` (height, width), 30 pixels on its short side."""
    height, width = (round(30 * side / min(field)) for side in field)
    u, v = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    flat = np.zeros_like(u).ravel()
    base = np.asarray(lights.ambient) + shade(lights, flat, flat, u.ravel(), v.ravel(), flat_only=True)
    return np.clip(base, 0, 1).reshape(1, height, width, 3).astype(np.float32)


def darkening() -> Photometry:
    """Return the model of a 9DTact: black paint comes nearer under clear gel, and light is lost on its way."""
    halo = np.zeros((3, 3, 3), np.float32)
    halo[2, 0] = DARKER
    widest = np.array([9.0, 9.0, 1.2], np.float32)
    return assemble(np.zeros((120, 3)), 0.95)._replace(halo=halo, widest=widest)
