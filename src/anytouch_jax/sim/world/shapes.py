"""Surfaces of objects in millimetres: a primitive, a texture on it, and the fine grain of its material."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated

import numpy as np

from anytouch_jax.config.parsing import Above0, NotNegative, Range, check
from anytouch_jax.errors import UserError
from anytouch_jax.sim.world.textures import GRAINS, TEXTURES, Array, namespace, warp

PLATE = 5.0  # mm, the thickness of flat parts
STROKE_RISE = 0.8  # mm, height of letters over their plate
TIP = 0.25  # mm, radius within which a cone is round
_STEEP = 2.5  # steepest slope that a height map of 0.1 mm shows without steps


@dataclass(frozen=True)
class Shape:
    """A touchable surface. Lengths are in mm, angles in radians.

    `size` is the radius of a sphere, cylinder, screw, ring, flat face or cone's base, the rim's radius of an edge or
    corner, or the height of a letter. The texture is between 0 and -`texture_depth` under the primitive, rotated by
    `texture_angle`. `irregularity` bends a repeating texture by this share of its pitch. The `grain` is a second, finer
    texture. Raises UserError for an unknown name, a size or pitch of 0 or less, or a negative depth.
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
            ("primitive", PRIMITIVES), ("texture", TEXTURES), ("grain", GRAINS), ("letter", STROKES),
        )  # fmt: skip
        for field, table in tables:
            name = getattr(self, field)
            if name not in table:
                raise UserError(f"there is no {field} {name!r}; choose one of {', '.join(table)}")
        check(self)


def base(shape: Shape, x: Array, y: Array) -> Array:
    """Return heights in mm of the primitive at `x`, `y` mm, from 0 at its highest place down to the table."""
    return namespace(x).clip(PRIMITIVES[shape.primitive](shape, x, y), floor(shape), 0)


def unroll(shape: Shape, x: Array, y: Array) -> tuple[Array, Array]:
    """Return places (u, v) in mm on the flattened surface, in the frame of the texture."""
    xp, r = namespace(x), shape.size
    if shape.primitive in ("cylinder", "screw"):
        x = r * xp.arcsin(xp.clip(x / r, -1, 1))
    elif shape.primitive == "sphere":
        away = xp.clip(xp.hypot(x, y) / r, 1e-6, 1)
        stretch = xp.arcsin(away) / away
        x, y = x * stretch, y * stretch
    c, s = math.cos(shape.texture_angle), math.sin(shape.texture_angle)
    return c * x + s * y, c * y - s * x


def layers(shape: Shape, u: Array, v: Array) -> tuple[Array, Array]:
    """Return texture and grain at the unrolled places `u`, `v` mm, each from 0 (low) to 1 (high)."""
    if shape.texture in ("bark", "sand"):
        s, t = u, v  # random already
    else:
        s, t = warp(u, v, shape.texture_pitch, shape.irregularity, shape.seed)
    texture = TEXTURES[shape.texture](s, t, shape.texture_pitch, shape.seed)
    return texture, GRAINS[shape.grain](u, v, shape.grain_pitch, shape.seed + 100)


def height(shape: Shape, x: Array, y: Array) -> Array:
    """Return heights z mm toward the gel at `x`, `y` mm in the object's frame, numpy or JAX arrays of one shape.

    The highest place of the primitive is 0, and texture and grain only lower it. Float32, or float64 for such inputs.
    Raises UserError if the shapes of `x` and `y` differ.
    """
    x, y = _floating(x), _floating(y)
    if x.shape != y.shape:
        raise UserError(f"x and y must have one shape, not {x.shape} and {y.shape}")
    z = base(shape, x, y)
    textured = shape.texture != "smooth" and shape.texture_depth > 0
    grained = shape.grain != "none" and shape.grain_depth > 0
    if not (textured or grained):
        return z
    texture, grain = layers(shape, *unroll(shape, x, y))
    if textured:
        z = z - shape.texture_depth * (1 - texture)
    return z - shape.grain_depth * (1 - grain) if grained else z


def _floating(x: Array) -> Array:
    x = x if hasattr(x, "__array_namespace__") else np.asarray(x)
    return x if x.dtype in (np.float32, np.float64) else x.astype(np.float32)


def relief(shape: Shape, pixels: int, pitch: float) -> np.ndarray:
    """Return heights (pixels, pixels) f32 mm with `pitch` mm between pixels. The object's origin is in the centre.

    Raises UserError without pixels, or for a pitch of 0 or less.
    """
    if pixels < 1 or not (math.isfinite(pitch) and pitch > 0):
        raise UserError(f"a raster needs at least one pixel and a pitch above 0 mm, not {pixels} and {pitch}")
    axis = ((np.arange(pixels) - (pixels - 1) / 2) * pitch).astype(np.float32)
    x, y = np.meshgrid(axis, axis)
    return np.asarray(height(shape, x, y), np.float32)


def _round_rim(t: Array, radius: float) -> Array:
    """Return the drop over a rim of `radius`: 0 up to t = 0, a quarter circle, then a straight steep side."""
    xp = namespace(t)
    end = radius * _STEEP / math.hypot(1, _STEEP)
    inner = xp.clip(t, 0, end)
    return xp.sqrt(radius * radius - inner * inner) - radius - _STEEP * xp.clip(t - end, 0, math.inf)


def _dome(square: Array, radius: float) -> Array:
    return namespace(square).sqrt(namespace(square).clip(radius * radius - square, 0, math.inf)) - radius


def _sphere(shape: Shape, x: Array, y: Array) -> Array:
    """The upper half of a ball of radius `size`."""
    return _dome(x * x + y * y, shape.size)


def _cylinder(shape: Shape, x: Array, y: Array) -> Array:
    """A lying rod of radius `size` along y, without ends."""
    return _dome(x * x + 0.0 * y, shape.size)


def _edge(shape: Shape, x: Array, y: Array) -> Array:
    """A plate over x < 0 that ends along y with a rim of radius `size`, level up to x = -size."""
    return _round_rim(namespace(x).clip(x + shape.size, 0, math.inf) + 0.0 * y, shape.size)


def _corner(shape: Shape, x: Array, y: Array) -> Array:
    """A plate over x < 0, y < 0 whose rims and corner have radius `size`."""
    xp = namespace(x)
    return _round_rim(xp.hypot(xp.clip(x + shape.size, 0, math.inf), xp.clip(y + shape.size, 0, math.inf)), shape.size)


def _cone(shape: Shape, x: Array, y: Array) -> Array:
    """A tip of 4 mm height over a base of radius `size`; the tip's radius of curvature is a 16th of it."""
    slope = 4.0 / shape.size
    return -slope * (namespace(x).sqrt(x * x + y * y + TIP * TIP) - TIP)


def _ring(shape: Shape, x: Array, y: Array) -> Array:
    """The upper half of a lying ring: `size` from its centre to the middle of a round bar of radius 0.3 size."""
    return _dome((namespace(x).hypot(x, y) - shape.size) ** 2, 0.3 * shape.size)


def _flat(shape: Shape, x: Array, y: Array) -> Array:
    """A round stamp with a flat face of radius `size`, its rim rounded by at most 0.5 mm within it."""
    rim = min(0.5, shape.size / 2)
    return _round_rim(namespace(x).clip(namespace(x).hypot(x, y) - shape.size + rim, 0, math.inf), rim)


def thread_pitch(size: float) -> float:
    """Return the pitch in mm of a screw of radius `size`, as on coarse metric screws."""
    return min(max(0.32 * size, 0.9), 2.4)


def _screw(shape: Shape, x: Array, y: Array) -> Array:
    """A lying threaded rod of radius `size` along y; the thread winds, so its ridges lean."""
    xp, pitch = namespace(x), thread_pitch(shape.size)
    turn = xp.arcsin(xp.clip(x / shape.size, -1, 1)) / (2 * math.pi)
    wave = xp.cos(2 * math.pi * (y / pitch - turn))
    return _dome(x * x + 0.0 * y, shape.size) - 0.5 * pitch * (0.5 - 0.5 / math.tanh(1.0) * xp.tanh(wave))


_Point = tuple[float, float]
_Line = tuple[_Point, ...]


def _arc(centre: _Point, radius: _Point, start: float, stop: float, pieces: int) -> _Line:
    """Return a polygon along an ellipse. Angles are in degrees, 0 to the right and growing downwards."""
    angles = [math.radians(start + (stop - start) * i / pieces) for i in range(pieces + 1)]
    return tuple((centre[0] + radius[0] * math.cos(a), centre[1] + radius[1] * math.sin(a)) for a in angles)


# Lines in a box of height 1 (x right, y down, the origin in the middle).
STROKES: dict[str, tuple[_Line, ...]] = {
    "A": (((-0.36, 0.5), (0.0, -0.5), (0.36, 0.5)), ((-0.22, 0.14), (0.22, 0.14))),
    "C": (_arc((0.05, 0.0), (0.4, 0.5), -50, -310, 10),),
    "E": (((0.3, -0.5), (-0.3, -0.5), (-0.3, 0.5), (0.3, 0.5)), ((-0.3, 0.0), (0.22, 0.0))),
    "H": (((-0.32, -0.5), (-0.32, 0.5)), ((0.32, -0.5), (0.32, 0.5)), ((-0.32, 0.0), (0.32, 0.0))),
    "K": (((-0.3, -0.5), (-0.3, 0.5)), ((0.33, -0.5), (-0.3, 0.08)), ((-0.08, -0.1), (0.36, 0.5))),
    "L": (((-0.26, -0.5), (-0.26, 0.5), (0.32, 0.5)),),
    "O": (_arc((0.0, 0.0), (0.4, 0.5), 0, 360, 14),),
    "P": (((-0.28, 0.5), (-0.28, -0.5), (0.05, -0.5)), _arc((0.05, -0.22), (0.27, 0.28), -90, 90, 6),
          ((0.05, 0.06), (-0.28, 0.06))),
    "S": (_arc((0.0, -0.24), (0.29, 0.26), -20, -270, 8), _arc((0.0, 0.26), (0.31, 0.24), -90, 160, 8)),
    "T": (((-0.36, -0.5), (0.36, -0.5)), ((0.0, -0.5), (0.0, 0.5))),
    "U": (((-0.32, -0.5), (-0.32, 0.18)), _arc((0.0, 0.18), (0.32, 0.32), 180, 0, 8), ((0.32, 0.18), (0.32, -0.5))),
    "V": (((-0.36, -0.5), (0.0, 0.5), (0.36, -0.5)),),
    "X": (((-0.34, -0.5), (0.34, 0.5)), ((0.34, -0.5), (-0.34, 0.5))),
    "Z": (((-0.32, -0.5), (0.32, -0.5), (-0.32, 0.5), (0.32, 0.5)),),
}  # fmt: skip


def _distance(letter: str, x: Array, y: Array) -> Array:
    """Return the distance to the nearest stroke of a letter of height 1; `x`, `y` in letter heights."""
    xp = namespace(x)
    nearest = 0.0 * x + 4.0
    for line in STROKES[letter]:
        for (ax, ay), (bx, by) in pairwise(line):
            dx, dy = bx - ax, by - ay
            share = xp.clip(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy), 0, 1)
            nearest = xp.minimum(nearest, (x - ax - share * dx) ** 2 + (y - ay - share * dy) ** 2)
    return xp.sqrt(nearest)


def _letters(shape: Shape, x: Array, y: Array) -> Array:
    """A raised letter of height `size` on a plate `STROKE_RISE` below, strokes 0.16 size wide."""
    xp, half = namespace(x), 0.08 * shape.size
    d = _distance(shape.letter, x / shape.size, y / shape.size) * shape.size
    rim = min(0.35, half)
    side = _round_rim(xp.clip(d - half + rim, 0, math.inf), rim)
    return STROKE_RISE * xp.tanh(side / STROKE_RISE)


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
    drop = {"sphere": shape.size, "cylinder": shape.size, "screw": shape.size, "ring": 0.3 * shape.size, "cone": 4.0}
    return -drop.get(shape.primitive, PLATE)
