"""The bare forms of objects as height maps: highest at 0 mm, no texture, rims rounded so that slopes stay finite.

A primitive takes (form, x, y): `x`, `y` mm in the object's frame, of equal shape, the touched side up; it gives
heights z <= 0 in mm, never below `floor(form)`, where the table is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Protocol

from anytouch_jax.sim.world import letters as strokes
from anytouch_jax.sim.world.textures import Array, namespace

PLATE = 5.0  # mm, the thickness of flat parts
STROKE_RISE = 0.8  # mm, how far letters stand out of their plate
TIP = 0.25  # mm, how far from the tip a cone starts to be round
_STEEP = 2.5  # the steepest side that a height map of 0.1 mm shows without steps


class Form(Protocol):
    """What a primitive reads of a shape."""

    @property
    def primitive(self) -> str: ...
    @property
    def size(self) -> float: ...
    @property
    def letter(self) -> str: ...


def _round_rim(t: Array, radius: float) -> Array:
    """The fall over a rim of `radius`: 0 up to t = 0, a quarter circle, then a straight steep side."""
    xp = namespace(t)
    end = radius * _STEEP / math.hypot(1, _STEEP)
    inner = xp.clip(t, 0, end)
    return xp.sqrt(radius * radius - inner * inner) - radius - _STEEP * xp.clip(t - end, 0, math.inf)


def _dome(square: Array, radius: float) -> Array:
    return namespace(square).sqrt(namespace(square).clip(radius * radius - square, 0, math.inf)) - radius


def sphere(form: Form, x: Array, y: Array) -> Array:
    """The upper half of a ball of radius `size`."""
    return _dome(x * x + y * y, form.size)


def cylinder(form: Form, x: Array, y: Array) -> Array:
    """A lying rod of radius `size` along y, without ends."""
    return _dome(x * x + 0.0 * y, form.size)


def edge(form: Form, x: Array, y: Array) -> Array:
    """A plate over x < 0 that ends along y with a rim of radius `size`, level up to x = -size."""
    return _round_rim(namespace(x).clip(x + form.size, 0, math.inf) + 0.0 * y, form.size)


def corner(form: Form, x: Array, y: Array) -> Array:
    """A plate over x < 0, y < 0 whose rims and corner have radius `size`."""
    xp = namespace(x)
    return _round_rim(xp.hypot(xp.clip(x + form.size, 0, math.inf), xp.clip(y + form.size, 0, math.inf)), form.size)


def cone(form: Form, x: Array, y: Array) -> Array:
    """A tip of 4 mm height over a base of radius `size`; the tip's radius of curvature is a 16th of it."""
    slope = 4.0 / form.size
    return -slope * (namespace(x).sqrt(x * x + y * y + TIP * TIP) - TIP)


def ring(form: Form, x: Array, y: Array) -> Array:
    """The upper half of a lying ring: `size` from its centre to the middle of a round bar of radius 0.3 size."""
    return _dome((namespace(x).hypot(x, y) - form.size) ** 2, 0.3 * form.size)


def flat(form: Form, x: Array, y: Array) -> Array:
    """A round stamp with a flat face of radius `size`, its rim rounded by at most 0.5 mm within it."""
    rim = min(0.5, form.size / 2)
    return _round_rim(namespace(x).clip(namespace(x).hypot(x, y) - form.size + rim, 0, math.inf), rim)


def thread_pitch(size: float) -> float:
    """The thread's pitch in mm of a screw of radius `size`, as on coarse metric screws."""
    return min(max(0.32 * size, 0.9), 2.4)


def screw(form: Form, x: Array, y: Array) -> Array:
    """A lying threaded rod of radius `size` along y; the thread winds, so its ridges lean."""
    xp, pitch = namespace(x), thread_pitch(form.size)
    turn = xp.arcsin(xp.clip(x / form.size, -1, 1)) / (2 * math.pi)
    wave = xp.cos(2 * math.pi * (y / pitch - turn))
    return _dome(x * x + 0.0 * y, form.size) - 0.5 * pitch * (0.5 - 0.5 / math.tanh(1.0) * xp.tanh(wave))


def letters(form: Form, x: Array, y: Array) -> Array:
    """A raised letter of height `size` on a plate `STROKE_RISE` below, strokes 0.16 size wide."""
    xp, half = namespace(x), 0.08 * form.size
    d = strokes.distance(form.letter, x / form.size, y / form.size) * form.size
    rim = min(0.35, half)
    side = _round_rim(xp.clip(d - half + rim, 0, math.inf), rim)
    return STROKE_RISE * xp.tanh(side / STROKE_RISE)


PRIMITIVES: dict[str, Callable[[Form, Array, Array], Array]] = {
    "sphere": sphere,
    "cylinder": cylinder,
    "edge": edge,
    "corner": corner,
    "cone": cone,
    "ring": ring,
    "flat": flat,
    "screw": screw,
    "letters": letters,
}


def floor(form: Form) -> float:
    """The height of the table in mm below the highest place."""
    drop = {"sphere": form.size, "cylinder": form.size, "screw": form.size, "ring": 0.3 * form.size, "cone": 4.0}
    return -drop.get(form.primitive, PLATE)
