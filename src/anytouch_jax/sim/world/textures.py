"""Surface textures as analytic functions of a place: repeating patterns, and random fields with stated statistics.

A texture takes (u, v, pitch, seed) and returns heights from 0 (lowest) to 1 (highest). `u`, `v` are mm on the unrolled
surface, of equal shape or an open grid of (1, W) and (H, 1). `pitch` mm is the repeat, or the size of a bump in a
random texture. `seed` draws random textures and shifts repeating ones. Numpy arrays return numpy, JAX arrays JAX.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

Array = Any  # numpy's or JAX's
Texture = Callable[[Array, Array, float, int], Array]

SAND_LENGTH = 0.35  # pitches, at which the autocorrelation is 1/e
# The autocorrelation of normal_cdf of a Gaussian field is 6/pi asin(rho/2); with rho = exp(-r^2/l^2) it is 1/e here.
_FALL = math.sqrt(-math.log(2 * math.sin(math.pi / (6 * math.e))))


def namespace(x: Array) -> ModuleType:
    """Return the array library of `x`, numpy or jax.numpy."""
    library: ModuleType = x.__array_namespace__()
    return library


def gaussian_field(u: Array, v: Array, length: tuple[float, float], seed: int, terms: int = 40) -> Array:
    """Return a random field of mean 0 and deviation 1 with autocorrelation exp(-(du/l_u)^2 - (dv/l_v)^2).

    `u`, `v` and `length` are in mm. The field is a sum of cosines. The radii of their wave vectors are quantiles, so
    few terms follow the spectrum, and no wave is shorter than 1.6 lengths. An open grid costs one matrix product.
    """
    rng = np.random.default_rng([seed, terms])
    radius = np.sqrt(-2 * np.log1p(-(np.arange(terms) + 0.5) / terms))
    # Angles in even steps, permuted: independent angles would give few terms a preferred direction.
    angle = math.pi * (rng.permutation(terms) + rng.random(terms)) / terms
    ku = radius * np.cos(angle) * math.sqrt(2) / length[0]
    kv = radius * np.sin(angle) * math.sqrt(2) / length[1]
    phase = rng.uniform(0, 2 * math.pi, terms)
    xp, scale = namespace(u), math.sqrt(2 / terms)
    if u.shape == v.shape:
        total = 0.0 * u
        for a, b, c in zip(ku.tolist(), kv.tolist(), phase.tolist(), strict=True):
            total = total + xp.cos(a * u + (b * v + c))
        return scale * total
    across = xp.asarray(ku[:, None], u.dtype) * u + xp.asarray(phase[:, None], u.dtype)  # (terms, W)
    along = v * xp.asarray(kv[None, :], v.dtype)  # (H, terms)
    return scale * (xp.cos(along) @ xp.cos(across) - xp.sin(along) @ xp.sin(across))


def normal_cdf(n: Array) -> Array:
    """Return the normal distribution function to 3e-4, which makes a Gaussian field uniform in 0 to 1."""
    return 0.5 + 0.5 * namespace(n).tanh(0.7978845608 * (n + 0.044715 * n * n * n))


def warp(u: Array, v: Array, pitch: float, amount: float, seed: int) -> tuple[Array, Array]:
    """Displace the places by `amount` pitches (RMS) over some five pitches: no real pattern is quite regular."""
    if amount == 0:
        return u, v
    length = (5 * pitch, 5 * pitch)
    du = gaussian_field(u, v, length, seed + 1, terms=6)
    dv = gaussian_field(u, v, length, seed + 2, terms=6)
    return u + amount * pitch * du, v + amount * pitch * dv


def _shift(u: Array, v: Array, pitch: float, seed: int) -> tuple[Array, Array]:
    """Return places in pitches, with a random phase."""
    du, dv = np.random.default_rng(seed).random(2).tolist()
    return u / pitch + du, v / pitch + dv


def _bump(square: Array) -> Array:
    """Return a smooth bump over a squared distance: 1 at 0, 0 from 1 on."""
    rest = namespace(square).clip(1 - square, 0, 1)
    return rest * rest


def _larger(a: Array, b: Array, soft: float) -> Array:
    """Return the maximum with its crease rounded over `soft`."""
    return 0.5 * (a + b + namespace(a).sqrt((a - b) ** 2 + soft * soft))


def _smooth(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """No texture: 1 everywhere."""
    return 0.0 * (u + v) + 1.0


def _ridges(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Rounded parallel ridges, one a pitch."""
    s, _ = _shift(u, v, pitch, seed)
    return 0.5 + 0.5 / math.tanh(1.3) * namespace(u).tanh(1.3 * namespace(u).cos(2 * math.pi * s)) + 0.0 * v


def _grid(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Two crossing families of raised lines, as on a waffle."""
    s, t = _shift(u, v, pitch, seed)
    xp, width = namespace(u), 0.45
    line_s, line_t = (xp.exp(-((xp.sin(math.pi * a) / width) ** 2)) for a in (s, t))
    return 1 - (1 - line_s) * (1 - line_t)


def _dots(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Round bumps on a hexagonal lattice, a pitch apart."""
    s, t = _shift(u, v, pitch, seed)
    xp, tall, radius = namespace(u), math.sqrt(3.0), 0.42
    total = 0.0 * (u + v)
    for offset in (0.0, 0.5):  # the hexagonal lattice is two rectangular ones
        ds = s + offset - xp.round(s + offset)
        dt = t / tall + offset - xp.round(t / tall + offset)
        total = total + _bump((ds * ds + (tall * dt) ** 2) / radius**2)
    return total


def _weave(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Plain weave: strands a pitch apart that pass over and under each other."""
    s, t = _shift(u, v, pitch, seed)
    xp = namespace(u)
    i, j = xp.round(s), xp.round(t)
    over, under = (xp.tanh(xp.cos(math.pi * a)) * (0.5 / math.tanh(1)) for a in (t + i, s + j))
    across, along = (2 * (s - i)) ** 2, (2 * (t - j)) ** 2  # both strands are round and low at their borders
    warp = over - 1.4 * across * (0.4 + 0.6 * across)
    weft = -under - 1.4 * along * (0.4 + 0.6 * along)
    return xp.clip((_larger(warp, weft, 0.1) + 1.36) / 1.87, 0, 1)


def _knit(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Stockinette: columns of stitches, each a V of two slanted loops, a pitch wide."""
    s, t = _shift(u, v, pitch, seed)
    xp, row, lean = namespace(u), 0.75, 0.5  # rows are 0.75 pitches high, legs lean 0.5 radians
    fold = xp.abs(s - xp.round(s)) - 0.26  # both legs of a V at once
    r = t / row
    r = r - xp.round(r)
    total = 0.0 * (u + v)
    for offset in (-1.0, 0.0, 1.0):
        along = (r + offset) * row
        a = math.cos(lean) * along + math.sin(lean) * fold
        b = math.cos(lean) * fold - math.sin(lean) * along
        total = _larger(total, _bump((a / 0.62) ** 2 + (b / 0.25) ** 2), 0.06)
    return xp.clip((total - 0.06) / 0.9, 0, 1)


def _bark(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Bark-like: plates along v, parted by winding furrows.

    Measured: RMS 0.31, autocorrelation 1/e at 0.27 and 1.03 pitches along u and v.
    """
    n = gaussian_field(u, v, (0.55 * pitch, 2.2 * pitch), seed + 3, terms=28)
    plate = gaussian_field(u, v, (0.8 * pitch, 1.6 * pitch), seed + 4, terms=16)
    furrow = 1 - namespace(u).exp(-((n / 0.55) ** 2))
    return furrow * (0.65 + 0.35 * normal_cdf(plate))


def _sand(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Sand-like: heights uniform in 0 to 1 (RMS 12**-0.5), autocorrelation 1/e at `SAND_LENGTH` pitches."""
    length = SAND_LENGTH * pitch / _FALL
    return normal_cdf(gaussian_field(u, v, (length, length), seed + 5))


TEXTURES: dict[str, Texture] = {
    "smooth": _smooth, "weave": _weave, "knit": _knit, "ridges": _ridges, "grid": _grid, "dots": _dots, "bark": _bark,
    "sand": _sand,
}  # fmt: skip


def _streaks(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Fine lines along v, as wood's fibres or brushed metal."""
    return normal_cdf(gaussian_field(u, v, (0.4 * pitch, 6 * pitch), seed + 6, terms=20))


def _pores(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """A level surface with scattered small pits, as cork or foam."""
    n = gaussian_field(u, v, (0.5 * pitch, 0.5 * pitch), seed + 7, terms=24)
    return 1 - normal_cdf(2.5 * (n - 0.9))


def _pebbles(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Small cushions between fine creases, as leather."""
    n = gaussian_field(u, v, (0.6 * pitch, 0.6 * pitch), seed + 8, terms=24)
    return 1 - namespace(n).exp(-((n / 0.5) ** 2))


def _grit(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """An even fine roughness, as stone."""
    return normal_cdf(gaussian_field(u, v, (0.4 * pitch, 0.4 * pitch), seed + 9, terms=24))


GRAINS: dict[str, Texture] = {
    "none": _smooth,
    "streaks": _streaks,
    "pores": _pores,
    "pebbles": _pebbles,
    "grit": _grit,
    "threads": _weave,
}
