"""Primitives: the untextured forms of objects as height maps.

A primitive takes its parameters and `x`, `y` mm of equal shape in the object's frame, touched side up. It returns
heights z in mm between 0 and `floor(form)`, where the table is. Rims are rounded, so slopes stay finite.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Protocol

from anytouch_jax.sim.world.textures import Array, namespace

PLATE = 5.0  # mm, the thickness of flat parts
STROKE_RISE = 0.8  # mm, height of letters over their plate
TIP = 0.25  # mm, radius within which a cone is round
_STEEP = 2.5  # steepest slope that a height map of 0.1 mm shows without steps


class PrimitiveParameters(Protocol):
    """The fields of a shape that primitives read."""

    @property
    def primitive(self) -> str: ...
    @property
    def size(self) -> float: ...
    @property
    def letter(self) -> str: ...


def _round_rim(t: Array, radius: float) -> Array:
    """Return the drop over a rim of `radius`: 0 up to t = 0, a quarter circle, then a straight steep side."""
    xp = namespace(t)
    end = radius * _STEEP / math.hypot(1, _STEEP)
    inner = xp.clip(t, 0, end)
    return xp.sqrt(radius * radius - inner * inner) - radius - _STEEP * xp.clip(t - end, 0, math.inf)


def _dome(square: Array, radius: float) -> Array:
    return namespace(square).sqrt(namespace(square).clip(radius * radius - square, 0, math.inf)) - radius


def _sphere(form: PrimitiveParameters, x: Array, y: Array) -> Array:
    """The upper half of a ball of radius `size`."""
    return _dome(x * x + y * y, form.size)


def _cylinder(form: PrimitiveParameters, x: Array, y: Array) -> Array:
    """A lying rod of radius `size` along y, without ends."""
    return _dome(x * x + 0.0 * y, form.size)


def _edge(form: PrimitiveParameters, x: Array, y: Array) -> Array:
    """A plate over x < 0 that ends along y with a rim of radius `size`, level up to x = -size."""
    return _round_rim(namespace(x).clip(x + form.size, 0, math.inf) + 0.0 * y, form.size)


def _corner(form: PrimitiveParameters, x: Array, y: Array) -> Array:
    """A plate over x < 0, y < 0 whose rims and corner have radius `size`."""
    xp = namespace(x)
    return _round_rim(xp.hypot(xp.clip(x + form.size, 0, math.inf), xp.clip(y + form.size, 0, math.inf)), form.size)


def _cone(form: PrimitiveParameters, x: Array, y: Array) -> Array:
    """A tip of 4 mm height over a base of radius `size`; the tip's radius of curvature is a 16th of it."""
    slope = 4.0 / form.size
    return -slope * (namespace(x).sqrt(x * x + y * y + TIP * TIP) - TIP)


def _ring(form: PrimitiveParameters, x: Array, y: Array) -> Array:
    """The upper half of a lying ring: `size` from its centre to the middle of a round bar of radius 0.3 size."""
    return _dome((namespace(x).hypot(x, y) - form.size) ** 2, 0.3 * form.size)


def _flat(form: PrimitiveParameters, x: Array, y: Array) -> Array:
    """A round stamp with a flat face of radius `size`, its rim rounded by at most 0.5 mm within it."""
    rim = min(0.5, form.size / 2)
    return _round_rim(namespace(x).clip(namespace(x).hypot(x, y) - form.size + rim, 0, math.inf), rim)


def thread_pitch(size: float) -> float:
    """Return the pitch in mm of a screw of radius `size`, as on coarse metric screws."""
    return min(max(0.32 * size, 0.9), 2.4)


def _screw(form: PrimitiveParameters, x: Array, y: Array) -> Array:
    """A lying threaded rod of radius `size` along y; the thread winds, so its ridges lean."""
    xp, pitch = namespace(x), thread_pitch(form.size)
    turn = xp.arcsin(xp.clip(x / form.size, -1, 1)) / (2 * math.pi)
    wave = xp.cos(2 * math.pi * (y / pitch - turn))
    return _dome(x * x + 0.0 * y, form.size) - 0.5 * pitch * (0.5 - 0.5 / math.tanh(1.0) * xp.tanh(wave))


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


def _letters(form: PrimitiveParameters, x: Array, y: Array) -> Array:
    """A raised letter of height `size` on a plate `STROKE_RISE` below, strokes 0.16 size wide."""
    xp, half = namespace(x), 0.08 * form.size
    d = _distance(form.letter, x / form.size, y / form.size) * form.size
    rim = min(0.35, half)
    side = _round_rim(xp.clip(d - half + rim, 0, math.inf), rim)
    return STROKE_RISE * xp.tanh(side / STROKE_RISE)


PRIMITIVES: dict[str, Callable[[PrimitiveParameters, Array, Array], Array]] = {
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


def floor(form: PrimitiveParameters) -> float:
    """Return the height of the table in mm, relative to the highest place."""
    drop = {"sphere": form.size, "cylinder": form.size, "screw": form.size, "ring": 0.3 * form.size, "cone": 4.0}
    return -drop.get(form.primitive, PLATE)
