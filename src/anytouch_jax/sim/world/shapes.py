"""Surfaces of objects in millimetres: a primitive, a texture on it, and the grain of its material.

A texture takes (u, v, pitch, seed) and returns heights from 0 (lowest) to 1 (highest). `u`, `v` are
mm on the unrolled surface, of equal shape or an open grid of (1, W) and (H, 1). `pitch` mm is the
repeat, or the size of a bump in a random texture. `seed` draws random textures and shifts repeating
ones. Numpy arrays return numpy, JAX arrays JAX.
"""

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass
from itertools import pairwise
from types import ModuleType
from typing import Annotated, Any

import numpy as np

from anytouch_jax.config.parsing import Above0, NotNegative, Range, check
from anytouch_jax.errors import UserError

Array = Any  # numpy's or JAX's
Texture = Callable[[Array, Array, float, int], Array]

SAND_LENGTH = 0.35  # pitches, at which the autocorrelation is 1/e
# The autocorrelation of normal_cdf of a Gaussian field is 6/pi asin(rho/2); with rho =
# exp(-r^2/l^2) it is 1/e here.
_FALL = math.sqrt(-math.log(2 * math.sin(math.pi / (6 * math.e))))


def namespace(x: Array) -> ModuleType:
    """Return the array library of `x`, numpy or jax.numpy."""
    library: ModuleType = x.__array_namespace__()
    return library


def gaussian_field(
    u: Array, v: Array, length: tuple[float, float], seed: int, terms: int = 40
) -> Array:
    """Return a random field of mean 0 and standard deviation 1.

    Its autocorrelation is exp(-(du / l_u)^2 - (dv / l_v)^2). The field is a sum of
    cosines. The radii of their wave vectors are quantiles, so few terms follow the spectrum, and no
    wave is shorter than 1.6 lengths. An open grid costs one matrix product.

    Args:
        u: places along x, mm.
        v: places along y, mm, of the shape of `u`, or (H, 1) beside `u` (W,).
        length: correlation lengths (l_u, l_v), mm.
        seed: of the phases.
        terms: cosines in the sum.
    """
    rng = np.random.default_rng([seed, terms])
    radius = np.sqrt(-2 * np.log1p(-(np.arange(terms) + 0.5) / terms))
    # Angles in even steps, permuted: independent angles would give few terms a preferred direction.
    angle = math.pi * (rng.permutation(terms) + rng.random(terms)) / terms
    ku = radius * np.cos(angle) * math.sqrt(2) / length[0]
    kv = radius * np.sin(angle) * math.sqrt(2) / length[1]
    phase = rng.uniform(0, 2 * math.pi, terms)
    xp = namespace(u)
    scale = math.sqrt(2 / terms)
    if u.shape == v.shape:
        total = 0.0 * u
        for a, b, c in zip(ku.tolist(), kv.tolist(), phase.tolist(), strict=True):
            total = total + xp.cos(a * u + (b * v + c))
        return scale * total
    # cos(a + b) = cos a cos b - sin a sin b, with a along one axis (terms, W), b along the other.
    across = xp.asarray(ku[:, None], u.dtype) * u + xp.asarray(phase[:, None], u.dtype)
    along = v * xp.asarray(kv[None, :], v.dtype)  # (H, terms)
    return scale * (xp.cos(along) @ xp.cos(across) - xp.sin(along) @ xp.sin(across))


def normal_cdf(n: Array) -> Array:
    """Return the normal distribution function to 3e-4.

    It makes a Gaussian field uniform in 0 to 1.
    """
    return 0.5 + 0.5 * namespace(n).tanh(0.7978845608 * (n + 0.044715 * n * n * n))


def warp(u: Array, v: Array, pitch: float, amount: float, seed: int) -> tuple[Array, Array]:
    """Displace the places by `amount` pitches (RMS) over some five pitches.

    No real pattern is quite regular.

    Args:
        u: places along x, mm.
        v: places along y, mm.
        pitch: of the pattern, mm.
        amount: RMS of the displacement, in pitches.
        seed: of the displacement.
    """
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
    xp = namespace(u)
    # The hyperbolic tangent flattens tops and valleys. 0 * v gives the shape of both places.
    return 0.5 + 0.5 / math.tanh(1.3) * xp.tanh(1.3 * xp.cos(2 * math.pi * s)) + 0.0 * v


def _grid(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Two crossing families of raised lines, as on a waffle."""
    s, t = _shift(u, v, pitch, seed)
    xp = namespace(u)
    width = 0.45
    line_s, line_t = (xp.exp(-((xp.sin(math.pi * a) / width) ** 2)) for a in (s, t))
    return 1 - (1 - line_s) * (1 - line_t)


def _dots(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Round bumps on a hexagonal lattice, a pitch apart."""
    s, t = _shift(u, v, pitch, seed)
    xp = namespace(u)
    tall = math.sqrt(3.0)
    radius = 0.42
    total = 0.0 * (u + v)
    # the hexagonal lattice is two rectangular ones
    for offset in (0.0, 0.5):
        ds = s + offset - xp.round(s + offset)
        dt = t / tall + offset - xp.round(t / tall + offset)
        total = total + _bump((ds * ds + (tall * dt) ** 2) / radius**2)
    return total


def _weave(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Plain weave: strands a pitch apart that pass over and under each other."""
    s, t = _shift(u, v, pitch, seed)
    xp = namespace(u)
    i = xp.round(s)
    j = xp.round(t)
    over, under = (xp.tanh(xp.cos(math.pi * a)) * (0.5 / math.tanh(1)) for a in (t + i, s + j))
    # both strands are round and low at their borders
    across = (2 * (s - i)) ** 2
    along = (2 * (t - j)) ** 2
    warp = over - 1.4 * across * (0.4 + 0.6 * across)
    weft = -under - 1.4 * along * (0.4 + 0.6 * along)
    return xp.clip((_larger(warp, weft, 0.1) + 1.36) / 1.87, 0, 1)


def _knit(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Stockinette: columns of stitches, each a V of two slanted loops, a pitch wide."""
    s, t = _shift(u, v, pitch, seed)
    # rows are 0.75 pitches high, legs lean 0.5 radians
    xp = namespace(u)
    row = 0.75
    remat = 0.5
    fold = xp.abs(s - xp.round(s)) - 0.26  # both legs of a V at once
    r = t / row
    r = r - xp.round(r)
    total = 0.0 * (u + v)
    for offset in (-1.0, 0.0, 1.0):
        along = (r + offset) * row
        a = math.cos(remat) * along + math.sin(remat) * fold
        b = math.cos(remat) * fold - math.sin(remat) * along
        total = _larger(total, _bump((a / 0.62) ** 2 + (b / 0.25) ** 2), 0.06)
    return xp.clip((total - 0.06) / 0.9, 0, 1)


def _bark(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Bark-like plates along v.

    RMS 0.31, autocorrelation 1/e at 0.27 and 1.03 pitches along u and v.
    """
    n = gaussian_field(u, v, (0.55 * pitch, 2.2 * pitch), seed + 3, terms=28)
    plate = gaussian_field(u, v, (0.8 * pitch, 1.6 * pitch), seed + 4, terms=16)
    furrow = 1 - namespace(u).exp(-((n / 0.55) ** 2))
    return furrow * (0.65 + 0.35 * normal_cdf(plate))


def _sand(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Heights uniform in 0 to 1 (RMS 12**-0.5), autocorrelation 1/e at `SAND_LENGTH` pitches."""
    length = SAND_LENGTH * pitch / _FALL
    return normal_cdf(gaussian_field(u, v, (length, length), seed + 5))


TEXTURES: dict[str, Texture] = {
    "smooth": _smooth,
    "weave": _weave,
    "knit": _knit,
    "ridges": _ridges,
    "grid": _grid,
    "dots": _dots,
    "bark": _bark,
    "sand": _sand,
}


def _streaks(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Fine lines along v, as wood's fibres or brushed metal."""
    return normal_cdf(gaussian_field(u, v, (0.4 * pitch, 6 * pitch), seed + 6, terms=20))


def _pores(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """A level surface with scattered small pits, as cork or foam."""
    field = gaussian_field(u, v, (0.5 * pitch, 0.5 * pitch), seed + 7, terms=24)
    return 1 - normal_cdf(2.5 * (field - 0.9))


def _pebbles(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """Small cushions between fine creases, as leather."""
    field = gaussian_field(u, v, (0.6 * pitch, 0.6 * pitch), seed + 8, terms=24)
    return 1 - namespace(u).exp(-((field / 0.5) ** 2))


def _grit(u: Array, v: Array, pitch: float, seed: int) -> Array:
    """An even fine roughness, as stone."""
    return normal_cdf(gaussian_field(u, v, (0.4 * pitch, 0.4 * pitch), seed + 9, terms=24))


GRAINS: dict[str, Texture] = {
    "none": _smooth,
    "threads": _weave,
    "streaks": _streaks,
    "pores": _pores,
    "pebbles": _pebbles,
    "grit": _grit,
}

PLATE = 5.0  # mm, the thickness of flat parts
STROKE_RISE = 0.8  # mm, height of letters over their plate
TIP = 0.25  # mm, radius within which a cone is round
_STEEP = 2.5  # steepest slope that a height map of 0.1 mm shows without steps


@dataclass(frozen=True)
class Shape:
    """A touchable surface. Lengths are in mm, angles in radians.

    `size` is the radius of a sphere, cylinder, screw, ring, flat face or cone's base, the rim's
    radius of an edge or corner, or the height of a letter. The texture is between 0 and
    -`texture_depth` under the primitive, rotated by `texture_angle`. `irregularity` bends a
    repeating texture by this fraction of its pitch. The `grain` is a second, finer texture. Raises
    UserError for an unknown name, a size or pitch of 0 or less, or a negative depth.
    """

    primitive: str
    texture: str = "smooth"
    size: Above0[float] = 6.0
    texture_pitch: Above0[float] = 1.5
    texture_depth: NotNegative[float] = 0.25
    seed: NotNegative[int] = 0
    texture_angle: Annotated[float, Range(-1e9, 1e9, "a finite number of radians")] = 0.0
    irregularity: NotNegative[float] = 0.0
    grain: str = "none"
    grain_pitch: Above0[float] = 0.8
    grain_depth: NotNegative[float] = 0.0
    letter: str = "A"

    def __post_init__(self) -> None:
        tables: tuple[tuple[str, Collection[str]], ...] = (
            ("primitive", PRIMITIVES),
            ("texture", TEXTURES),
            ("grain", GRAINS),
            ("letter", STROKES),
        )
        for field, table in tables:
            name = getattr(self, field)
            if name not in table:
                raise UserError(f"there is no {field} {name!r}; choose one of {', '.join(table)}")
        check(self)


def base(shape: Shape, x: Array, y: Array) -> Array:
    """Return heights in mm of the primitive at `x`, `y` mm.

    They are 0 at its highest place, and go down to the table.
    """
    return namespace(x).clip(PRIMITIVES[shape.primitive](shape, x, y), floor(shape), 0)


def unroll(shape: Shape, x: Array, y: Array) -> tuple[Array, Array]:
    """Return places (u, v) in mm on the flattened surface, in the frame of the texture."""
    xp = namespace(x)
    r = shape.size
    if shape.primitive in ("cylinder", "screw"):
        x = r * xp.arcsin(xp.clip(x / r, -1, 1))
    elif shape.primitive == "sphere":
        # The way over the ball, over the way in the plane, is arcsin(a) / a.
        away = xp.clip(xp.hypot(x, y) / r, 1e-6, 1)
        stretch = xp.arcsin(away) / away
        x = x * stretch
        y = y * stretch
    c = math.cos(shape.texture_angle)
    s = math.sin(shape.texture_angle)
    return c * x + s * y, c * y - s * x


def layers(shape: Shape, u: Array, v: Array) -> tuple[Array, Array]:
    """Return texture and grain at the unrolled places `u`, `v` mm, from 0 (low) to 1 (high)."""
    if shape.texture in ("bark", "sand"):
        # random already
        s = u
        t = v
    else:
        s, t = warp(u, v, shape.texture_pitch, shape.irregularity, shape.seed)
    texture = TEXTURES[shape.texture](s, t, shape.texture_pitch, shape.seed)
    return texture, GRAINS[shape.grain](u, v, shape.grain_pitch, shape.seed + 100)


def height(shape: Shape, x: Array, y: Array) -> Array:
    """Return heights mm toward the gel at `x`, `y` mm in the object's frame.

    `x` and `y` are numpy or JAX arrays of one shape. The highest place of the primitive is 0, and
    texture and grain only lower it.
    """
    x = _floating(x)
    y = _floating(y)
    z = base(shape, x, y)
    textured = shape.texture != "smooth" and shape.texture_depth > 0
    grained = shape.grain != "none" and shape.grain_depth > 0
    if not (textured or grained):
        return z
    texture, grain = layers(shape, *unroll(shape, x, y))
    if textured:
        z = z - shape.texture_depth * (1 - texture)
    if grained:
        return z - shape.grain_depth * (1 - grain)
    return z


def _floating(x: Array) -> Array:
    x = x if hasattr(x, "__array_namespace__") else np.asarray(x)
    if x.dtype in (np.float32, np.float64):
        return x
    return x.astype(np.float32)


def relief(shape: Shape, pixels: int, pitch: float) -> np.ndarray:
    """Return heights (pixels, pixels) f32 mm, `pitch` mm apart, around the object's origin."""
    axis = ((np.arange(pixels) - (pixels - 1) / 2) * pitch).astype(np.float32)
    x, y = np.meshgrid(axis, axis)
    return np.asarray(height(shape, x, y), np.float32)


def _round_rim(t: Array, radius: float) -> Array:
    """Return the drop over a rim: 0 up to t = 0, a part of a circle, then a straight steep side."""
    xp = namespace(t)
    # Where the circle has the slope of the side.
    end = radius * _STEEP / math.hypot(1, _STEEP)
    inner = xp.clip(t, 0, end)
    circle = xp.sqrt(radius * radius - inner * inner)
    return circle - radius - _STEEP * xp.clip(t - end, 0, math.inf)


def _dome(square: Array, radius: float) -> Array:
    """Return the drop of a ball at a squared distance from its top."""
    xp = namespace(square)
    return xp.sqrt(xp.clip(radius * radius - square, 0, math.inf)) - radius


def _edge(shape: Shape, x: Array, y: Array) -> Array:
    """A plate over x < 0 that ends along y with a rim of radius `size`, level up to x = -size."""
    return _round_rim(namespace(x).clip(x + shape.size, 0, math.inf) + 0.0 * y, shape.size)


def _corner(shape: Shape, x: Array, y: Array) -> Array:
    """A plate over x < 0, y < 0 whose rims and corner have radius `size`."""
    xp = namespace(x)
    over_x = xp.clip(x + shape.size, 0, math.inf)
    over_y = xp.clip(y + shape.size, 0, math.inf)
    return _round_rim(xp.hypot(over_x, over_y), shape.size)


def _cone(shape: Shape, x: Array, y: Array) -> Array:
    """A tip of 4 mm height over a base of radius `size`.

    The tip's radius of curvature is a 16th of that of the base.
    """
    slope = 4.0 / shape.size
    return -slope * (namespace(x).sqrt(x * x + y * y + TIP * TIP) - TIP)


def _flat(shape: Shape, x: Array, y: Array) -> Array:
    """A round stamp with a flat face of radius `size`, whose rim is rounded by at most 0.5 mm."""
    xp = namespace(x)
    rim = min(0.5, shape.size / 2)
    return _round_rim(xp.clip(xp.hypot(x, y) - shape.size + rim, 0, math.inf), rim)


def thread_pitch(size: float) -> float:
    """Return the pitch in mm of a screw of radius `size`, as on coarse metric screws."""
    return min(max(0.32 * size, 0.9), 2.4)


def _screw(shape: Shape, x: Array, y: Array) -> Array:
    """A lying threaded rod of radius `size` along y; the thread winds, so its ridges lean."""
    xp = namespace(x)
    pitch = thread_pitch(shape.size)
    turn = xp.arcsin(xp.clip(x / shape.size, -1, 1)) / (2 * math.pi)
    wave = xp.cos(2 * math.pi * (y / pitch - turn))
    groove = 0.5 - 0.5 / math.tanh(1.0) * xp.tanh(wave)
    return _dome(x * x + 0.0 * y, shape.size) - 0.5 * pitch * groove


_Point = tuple[float, float]
_Line = tuple[_Point, ...]


def _arc(centre: _Point, radius: _Point, start: float, stop: float, pieces: int) -> _Line:
    """Return a polygon along an ellipse.

    Angles are in degrees, 0 to the right and growing downwards.
    """
    angles = [math.radians(start + (stop - start) * i / pieces) for i in range(pieces + 1)]
    return tuple(
        (centre[0] + radius[0] * math.cos(a), centre[1] + radius[1] * math.sin(a)) for a in angles
    )


# Lines in a box of height 1 (x right, y down, the origin in the middle).
STROKES: dict[str, tuple[_Line, ...]] = {
    "A": (((-0.36, 0.5), (0.0, -0.5), (0.36, 0.5)), ((-0.22, 0.14), (0.22, 0.14))),
    "C": (_arc((0.05, 0.0), (0.4, 0.5), -50, -310, 10),),
    "E": (((0.3, -0.5), (-0.3, -0.5), (-0.3, 0.5), (0.3, 0.5)), ((-0.3, 0.0), (0.22, 0.0))),
    "H": (((-0.32, -0.5), (-0.32, 0.5)), ((0.32, -0.5), (0.32, 0.5)), ((-0.32, 0.0), (0.32, 0.0))),
    "K": (((-0.3, -0.5), (-0.3, 0.5)), ((0.33, -0.5), (-0.3, 0.08)), ((-0.08, -0.1), (0.36, 0.5))),
    "L": (((-0.26, -0.5), (-0.26, 0.5), (0.32, 0.5)),),
    "O": (_arc((0.0, 0.0), (0.4, 0.5), 0, 360, 14),),
    "P": (
        ((-0.28, 0.5), (-0.28, -0.5), (0.05, -0.5)),
        _arc((0.05, -0.22), (0.27, 0.28), -90, 90, 6),
        ((0.05, 0.06), (-0.28, 0.06)),
    ),
    "S": (
        _arc((0.0, -0.24), (0.29, 0.26), -20, -270, 8),
        _arc((0.0, 0.26), (0.31, 0.24), -90, 160, 8),
    ),
    "T": (((-0.36, -0.5), (0.36, -0.5)), ((0.0, -0.5), (0.0, 0.5))),
    "U": (
        ((-0.32, -0.5), (-0.32, 0.18)),
        _arc((0.0, 0.18), (0.32, 0.32), 180, 0, 8),
        ((0.32, 0.18), (0.32, -0.5)),
    ),
    "V": (((-0.36, -0.5), (0.0, 0.5), (0.36, -0.5)),),
    "X": (((-0.34, -0.5), (0.34, 0.5)), ((0.34, -0.5), (-0.34, 0.5))),
    "Z": (((-0.32, -0.5), (0.32, -0.5), (-0.32, 0.5), (0.32, 0.5)),),
}


def _distance(letter: str, x: Array, y: Array) -> Array:
    """Return the distance to the nearest stroke of a letter, all in letter heights."""
    xp = namespace(x)
    nearest = 0.0 * x + 4.0
    for line in STROKES[letter]:
        for (ax, ay), (bx, by) in pairwise(line):
            dx = bx - ax
            dy = by - ay
            fraction = xp.clip(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy), 0, 1)
            nearest = xp.minimum(
                nearest, (x - ax - fraction * dx) ** 2 + (y - ay - fraction * dy) ** 2
            )
    return xp.sqrt(nearest)


def _letters(shape: Shape, x: Array, y: Array) -> Array:
    """A raised letter of height `size` on a plate `STROKE_RISE` below, strokes 0.16 size wide."""
    xp = namespace(x)
    half = 0.08 * shape.size
    d = _distance(shape.letter, x / shape.size, y / shape.size) * shape.size
    rim = min(0.35, half)
    side = _round_rim(xp.clip(d - half + rim, 0, math.inf), rim)
    return STROKE_RISE * xp.tanh(side / STROKE_RISE)


def _sphere(shape: Shape, x: Array, y: Array) -> Array:
    """The upper half of a ball."""
    return _dome(x * x + y * y, shape.size)


def _cylinder(shape: Shape, x: Array, y: Array) -> Array:
    """A lying rod along y, without ends."""
    return _dome(x * x + 0.0 * y, shape.size)


def _ring(shape: Shape, x: Array, y: Array) -> Array:
    """The upper half of a lying ring.

    `size` is from its centre to the middle of a round bar of radius 0.3 size.
    """
    return _dome((namespace(x).hypot(x, y) - shape.size) ** 2, 0.3 * shape.size)


PRIMITIVES: dict[str, Callable[[Shape, Array, Array], Array]] = {
    "sphere": _sphere,
    "cylinder": _cylinder,
    "edge": _edge,
    "corner": _corner,
    "cone": _cone,
    "ring": _ring,
    "flat": _flat,
    "screw": _screw,
    "letters": _letters,
}


def floor(shape: Shape) -> float:
    """Return the height of the table in mm, relative to the highest place."""
    drop = {
        "sphere": shape.size,
        "cylinder": shape.size,
        "screw": shape.size,
        "ring": 0.3 * shape.size,
        "cone": 4.0,
    }
    return -drop.get(shape.primitive, PLATE)
