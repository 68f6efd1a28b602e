"""Raised letters: strokes in a unit box, and the distance to them."""

from __future__ import annotations

import math
from itertools import pairwise

from anytouch_jax.sim.world.textures import Array, namespace

Point = tuple[float, float]
Line = tuple[Point, ...]


def _arc(centre: Point, radius: Point, start: float, stop: float, pieces: int) -> Line:
    """A polygon along an ellipse; angles in degrees, 0 to the right, growing downwards."""
    angles = [math.radians(start + (stop - start) * i / pieces) for i in range(pieces + 1)]
    return tuple((centre[0] + radius[0] * math.cos(a), centre[1] + radius[1] * math.sin(a)) for a in angles)


# Lines in a box of height 1 (x right, y down, the origin in the middle).
STROKES: dict[str, tuple[Line, ...]] = {
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


def distance(letter: str, x: Array, y: Array) -> Array:
    """Distance to the nearest stroke of a letter of height 1; `x`, `y` in letter heights."""
    xp = namespace(x)
    nearest = 0.0 * x + 4.0
    for line in STROKES[letter]:
        for (ax, ay), (bx, by) in pairwise(line):
            dx, dy = bx - ax, by - ay
            share = xp.clip(((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy), 0, 1)
            nearest = xp.minimum(nearest, (x - ax - share * dx) ** 2 + (y - ay - share * dy) ** 2)
    return xp.sqrt(nearest)
