"""Places of a ball of known size in images of its presses, whatever the lights and the gel are.

Inside its contact the gel has the form of the ball, so the normal of the surface is linear in the
place. Its sine of the tilt grows to the rim and falls off outside: this kink is what shows the rim.
Colours are polynomials of the normal (`sensing.sensors.Photometry`), which least squares find for
any places. So only the places are searched (variable projection, Golub and Pereyra 1973).
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares
from threadpoolctl import threadpool_limits

from anytouch_jax.sim.sensing.sensors import POWERS, SENSORS, look

Array = np.ndarray
# The slope outside falls by e in so many radii of the contact, beside what it does on a half-space:
# a gel is a layer. So are slopes of balls that the simulator presses into gels of 1.8 to 4.6 mm.
_LAYER = 2.0
_SIDE = 64  # pixels of the long side of the images that are searched
_WINDOW = 2.2  # of the first radius: the part of an image that is explained
_STEEPEST = 0.97  # sine of the tilt of a rim. Beyond, a ball is pressed in to its middle.
_POWERS = tuple((i - j, j) for i in (1, 2, 3) for j in range(i + 1))
_BLEED = 1.5  # radii of the soft shadow and light around a contact
_USUAL_AT = 0.5  # sine of the tilt up to which the strength of colours is taken
_LEAST = 0.02  # strength of a gel that shows slopes


class Grid(NamedTuple):
    """Places of pixels: mm from the middle, and -1 to 1."""

    x: Array
    y: Array
    u: Array
    v: Array


class Balls(NamedTuple):
    """Presses of a ball that are placed.

    Attributes:
        poses: (N, 3) place x and y from the middle of the image, and radius of the contact, mm.
        explained: fraction of the colour change around the contacts.
        strength: colour change (0 to 1) for a sine of the tilt, root mean square.
    """

    poses: Array
    explained: float
    strength: float


def grid_of(shape: tuple[int, ...], width_mm: float) -> Grid:
    """Return the places of square pixels (h, w) of an image that shows `width_mm`."""
    height, width = shape[:2]
    pixel = width_mm / width
    x, y = np.meshgrid(
        (np.arange(width) + 0.5 - width / 2) * pixel, (np.arange(height) + 0.5 - height / 2) * pixel
    )
    return Grid(x, y, 2 * x / width_mm, 2 * y / (height * pixel))


def slope_of(away: Array, contact: float, radius: float) -> Array:
    """Return the slope of a gel at distances `away` from the middle of a ball, all lengths in mm.

    Outside of the contact it is that of a half-space under a ball (Hertz; Johnson, "Contact
    Mechanics", 1985, eq. 3.42a), cut off as that of a layer.

    Args:
        away: distances.
        contact: radius of the contact.
        radius: that of the ball.
    """
    inside = np.minimum(away, contact)
    slope = inside / np.sqrt(radius**2 - inside**2)
    ratio = np.maximum(away / contact, 1)
    return np.asarray(slope * _outside(ratio))


def _outside(ratio: Array) -> Array:
    """Return the slope over that at the rim, at distances over the radius of the contact."""
    half_space = ratio * np.arcsin(1 / ratio) - np.sqrt(1 - 1 / ratio**2)
    return np.asarray(2 / np.pi * half_space * np.exp(-(ratio - 1) / _LAYER))


def depth_of(away: Array, contact: float, radius: float) -> Array:
    """Return the depth mm of a gel at distances `away`: the integral of `slope_of`."""
    steepest = contact / np.sqrt(radius**2 - contact**2)
    ratio = np.linspace(1, 8, 200)
    slopes = _outside(ratio)
    steps = (slopes[1:] + slopes[:-1]) / 2 * (ratio[1] - ratio[0])
    below = np.append(np.cumsum(steps[::-1])[::-1], 0.0) * steepest * contact
    inside = np.minimum(away, contact)
    above = np.sqrt(radius**2 - inside**2) - np.sqrt(radius**2 - contact**2)
    return np.asarray(above + np.interp(np.maximum(away / contact, 1), ratio, below))


def normals_of(grid: Grid, pose: Array, radius: float) -> tuple[Array, Array]:
    """Return the sines of the tilt along x and y of a ball at a pose, at the places of a grid."""
    dx = grid.x - pose[0]
    dy = grid.y - pose[1]
    away = np.hypot(dx, dy) + 1e-9
    slope = slope_of(away, float(pose[2]), radius)
    sine = slope / np.sqrt(1 + slope**2) / away
    return sine * dx, sine * dy


def _design(grid: Grid, pose: Array, radius: float) -> Array:
    """Return the columns (n, 16) of the linear problem of the colours for a pose."""
    nx, ny = normals_of(grid, pose, radius)
    columns = [nx**i * ny**j for i, j in _POWERS]
    columns += [nx * grid.u, nx * grid.v, ny * grid.u, ny * grid.v]
    wide = _BLEED * pose[2]
    dx = (grid.x - pose[0]) / wide
    dy = (grid.y - pose[1]) / wide
    glow = np.exp(-(dx**2 + dy**2) / 2)
    return np.stack([*columns, dx * glow, dy * glow, glow], 1)


def _first_pose(change: Array, clear: Array, grid: Grid) -> Array:
    """Return the middle of the strongest changes, and the radius of their area."""
    strength = np.abs(change).max(-1) * clear
    strong = strength > 0.4 * np.percentile(strength, 99.5)
    pixel = abs(float(grid.x[0, 1] - grid.x[0, 0]))
    reach = np.sqrt(strong.sum() / np.pi) * pixel
    return np.array([np.median(grid.x[strong]), np.median(grid.y[strong]), reach])


class _Colours:
    """Colours of some presses, as what is left of them by their poses."""

    def __init__(self, parts: list[tuple[Grid, Array]], radius: float) -> None:
        self._grids = [grid for grid, _ in parts]
        self.changes = np.concatenate([change for _, change in parts])
        self._radius = radius

    def __call__(self, poses: Array) -> Array:
        """Return the residual of the best colours for poses (N * 3,), as one vector."""
        return self.solved(poses)[0].ravel()

    def solved(self, poses: Array) -> tuple[Array, Array]:
        """Return the residual (n, 3), and the colours (16, 3)."""
        rows = np.concatenate(
            [
                _design(grid, pose, self._radius)
                for grid, pose in zip(self._grids, poses.reshape(-1, 3), strict=True)
            ]
        )
        scale = np.sqrt((rows**2).sum(0)) + 1e-9
        rows = rows / scale
        gram = rows.T @ rows + 1e-5 * np.eye(rows.shape[1])
        colours = np.linalg.solve(gram, rows.T @ self.changes)
        return self.changes - rows @ colours, colours / scale[:, None]


def place_balls(change: Array, clear: Array, width_mm: float, ball_mm: float) -> Balls:
    """Return where a ball was pressed.

    Args:
        change: colour changes f32 (N, h, w, 3) of the presses, 0 to 1.
        clear: bool (N, h, w), where they show.
        width_mm: what the width of an image shows.
        ball_mm: diameter of the ball.
    """
    radius = ball_mm / 2
    height, width = change.shape[1:3]
    shrink = _SIDE / max(height, width)
    size = (max(1, round(width * shrink)), max(1, round(height * shrink)))
    small = [cv2.resize(one, size, interpolation=cv2.INTER_AREA) for one in change]
    shown = [cv2.resize(one.astype(np.float32), size) > 0.5 for one in clear]
    grid = grid_of(small[0].shape, width_mm)
    first = np.stack([_first_pose(*one, grid) for one in zip(small, shown, strict=True)])
    parts = []
    for one, seen, pose in zip(small, shown, first, strict=True):
        near = seen & (np.hypot(grid.x - pose[0], grid.y - pose[1]) < _WINDOW * pose[2])
        parts.append((Grid(*(values[near] for values in grid)), one[near].astype(np.float64)))
    colours = _Colours(parts, radius)
    reach = 2 * first[:, 2]
    low = np.stack([first[:, 0] - reach, first[:, 1] - reach, 0 * reach + 0.1 * radius], 1)
    high = np.stack([first[:, 0] + reach, first[:, 1] + reach, 0 * reach + _STEEPEST * radius], 1)
    start = np.clip(first, low + 1e-3, high - 1e-3)
    # The matrices are small, and threads of BLAS wait for each other on a busy machine.
    with threadpool_limits(1):
        found = least_squares(
            colours,
            start.ravel(),
            bounds=(low.ravel(), high.ravel()),
            x_scale=0.2,
            diff_step=1e-2,
            max_nfev=25,
        )
    explained = 1 - 2 * float(found.cost) / float((colours.changes**2).sum())
    poses = found.x.reshape(-1, 3)
    return Balls(poses, explained, _strength(parts, poses, radius))


def _strength(parts: list[tuple[Grid, Array]], poses: Array, radius: float) -> float:
    """Return the colour change over the sine of the tilt, root mean squares in the contacts."""
    changes = 0.0
    tilts = 0.0
    for (grid, change), pose in zip(parts, poses, strict=True):
        nx, ny = normals_of(grid, pose, radius)
        touched = np.hypot(grid.x - pose[0], grid.y - pose[1]) < pose[2]
        changes += float((change[touched] ** 2).mean(1).sum())
        tilts += float((nx[touched] ** 2 + ny[touched] ** 2).sum())
    return float(np.sqrt(changes / max(tilts, 1e-9)))


def usual_strength(name: str) -> float | None:
    """Return the strength of an average device of a simulated sensor, None of a gel without slopes.

    It is over tilts of up to 30 degrees, as balls have.
    """
    sensor = SENSORS.get(name)
    if sensor is None or sensor.kind != "image":
        return None
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    sine = np.sqrt(np.linspace(0.02, 0.98, 12))[:, None] * _USUAL_AT
    nx = (sine * np.cos(angle)).ravel()
    ny = (sine * np.sin(angle)).ravel()
    rows = np.stack([nx**i * ny**j for i, j in POWERS], 1)
    change = sensor.contrast * rows @ np.asarray(look(sensor).normal)[:, 0]
    tilts = float((nx**2 + ny**2).sum())
    strength = float(np.sqrt((change**2).mean(1).sum() / tilts))
    return strength if strength > _LEAST else None
