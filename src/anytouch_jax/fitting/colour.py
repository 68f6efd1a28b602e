"""The colour change of a gel by its slope: from presses of a ball of known size, or from any presses.

A ball's slopes are known up to its place and depth, and these are found together with the colours: linear least squares
and a search take turns. Without a ball three things are known. The slopes of one surface fit together (no curl), gels
are touched from all sides, and dents are dents.
"""

from __future__ import annotations

from itertools import product
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.sim.contact.mechanics import Gel, press
from anytouch_jax.sim.sensing.sensors import POWERS, Photometry

Array = np.ndarray
PLACES = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))  # powers of (u, v) that a coefficient drifts by
STEEPEST = 0.95
WIDEST = (9.0, 9.0, 1.5)  # of the halo's features
DEPTHS = np.linspace(0.05, 1.6, 24)  # mm
_GRID, _SIDE = 96, 14.0  # points and mm of the solved gel
SKIN = 0.13  # mm: detail that the coating and the lens pass
HALOS, THICKNESSES = (0.35, 1.0, 1.6), (2.0, 3.0, 4.5)  # mm, of the soft shadow and of the gel: the best is chosen
THIN = 5  # the search looks at every so many pixels
PLAIN = 9  # powers of the normal with which the presses are placed
ROUNDS = (
    (0.8, 0.2),
    (0.4, 0.1),
    (0.2, 0.1),
    (0.1, 0.05),
    (0.1, 0.05),
    (0.05, 0.03),
)  # steps of the search, mm of place and depth
FEATURES = len(POWERS) * len(PLACES)
# Root mean square of the slope of the gel, where its change is above a quarter of the strongest, and of its depth there
# in mm, in simulated touches of 0.15 to 1.0 mm. They set the scale where no ball does.
USUAL_TILT, USUAL_DEPTH = 0.22, 0.3
UNSURE = "Without a ball of known size the strength is a usual one, perhaps half or double the true one: edit contrast."


class Colour(NamedTuple):
    """A fitted look with the width mm of its halo, the share of the change that it explains, and how it was found."""

    look: Photometry
    halo: float
    explained: float
    source: str
    doubt: str = ""


class Grid(NamedTuple):
    """Places of the pixels of a colour change (H, W): mm from the middle, and -1..1."""

    x: Array
    y: Array
    u: Array
    v: Array


def grid_of(shape: tuple[int, int], width_mm: float) -> Grid:
    """Return the places of the pixels (H, W) of a picture that shows `width_mm`, with square pixels."""
    height, width = shape
    pixel = width_mm / width
    x, y = np.meshgrid((np.arange(width) + 0.5 - width / 2) * pixel, (np.arange(height) + 0.5 - height / 2) * pixel)
    return Grid(x, y, 2 * x / width_mm, 2 * y / (height * pixel))


class _Profiles(NamedTuple):
    """Dents of a ball by depth (K,) and distance (R,) mm: slope, and depth and slope of the blurred dent (K, R)."""

    away: Array
    slope: Array
    soft: Array
    soft_slope: Array


def _profiles(ball_mm: float) -> dict[tuple[float, float], _Profiles]:
    """Return the dents of a ball in gels of THICKNESSES, with HALOS."""
    line = (np.arange(_GRID) - (_GRID - 1) / 2) * _SIDE / _GRID
    away, radius = np.hypot(*np.meshgrid(line, line)), ball_mm / 2
    surface = np.where(away < radius, np.sqrt(np.maximum(radius**2 - away**2, 0)) - radius, -radius - 5)
    middle, pitch = _GRID // 2, _SIDE / _GRID
    height = jnp.asarray(surface, jnp.float32)

    @jax.jit
    def solve(depths: Any, gel: Gel) -> Any:
        return jax.vmap(lambda depth: press(height, depth, gel, pitch, fidelity="fast").displacement)(depths)

    found = dict[tuple[float, float], _Profiles]()
    for thickness in THICKNESSES:
        dents = np.asarray(solve(DEPTHS.astype(np.float32), Gel(150.0, thickness=np.float32(thickness))))

        def rows(width: float, dents: Array = dents) -> tuple[Array, Array]:
            blurred = [cv2.GaussianBlur(dent, (0, 0), width / pitch) for dent in dents]
            lines = np.stack([one[middle, middle:] for one in blurred])
            return lines, np.gradient(lines, pitch, axis=1)

        sharp = rows(SKIN)[1]
        found |= {(thickness, halo): _Profiles(line[middle:], sharp, *rows(halo)) for halo in HALOS}
    return found


def _features(grid: Grid, profiles: _Profiles, pose: Array) -> tuple[Array, Array, Array]:
    """Return tilts (N,) along x and y and halo features (N, 3) of a ball at `pose` x, y, depth mm."""
    dx, dy = grid.x.ravel() - pose[0], grid.y.ravel() - pose[1]
    away = np.hypot(dx, dy)
    k = float(np.clip(np.interp(pose[2], DEPTHS, np.arange(len(DEPTHS))), 0, len(DEPTHS) - 1.001))
    low, share = int(k), k - int(k)
    slope, soft, wide = (
        np.interp(away, profiles.away, (1 - share) * table[low] + share * table[low + 1], right=0.0)
        for table in profiles[1:]
    )
    cos, sin = dx / np.maximum(away, 1e-6), dy / np.maximum(away, 1e-6)
    scale = 1 / np.sqrt(1 + slope**2)
    return slope * cos * scale, slope * sin * scale, np.stack([wide * cos, wide * sin, soft], 1)


def design(nx: Array, ny: Array, u: Array, v: Array, halo: Array, *, plain: bool = False) -> Array:
    """Return the rows (N, 129) of the least squares problem of a `Photometry`; `plain` ones are (N, 22)."""
    normal = np.stack([nx**i * ny**j for i, j in (POWERS[:PLAIN] if plain else POWERS)], 1)
    if plain:
        drift = [each * at for each in (nx, ny) for at in (u, v, u * u, u * v, v * v)]
        return np.concatenate([normal, halo, np.stack(drift, 1)], 1)
    place = np.stack([u**i * v**j for i, j in PLACES], 1)
    columns = (normal[:, :, None] * place[:, None, :]).reshape(len(nx), -1)
    return np.concatenate([columns, (halo[:, :, None] * place[:, None, :3]).reshape(len(nx), -1)], 1)


def _ridge(gram: Array, target: Array, penalties: Array) -> Array:
    scale = np.sqrt(np.diag(gram)) + 1e-12
    scaled = gram / scale[:, None] / scale[None, :] + np.diag(penalties)
    return np.asarray(np.linalg.solve(scaled, target / scale[:, None]) / scale[:, None])


# What few presses do not show is small: high powers, drift over the picture, and a halo that copies the slopes.
_PENALTY = np.concatenate([
    np.ravel([[1e-4 * (1 if i + j == 1 else 5) * (1 + 4 * (p + q)) for p, q in PLACES] for i, j in POWERS]),
    np.full(9, 1e-2),
])  # fmt: skip


def assemble(coefficients: Array) -> Photometry:
    """Return the `Photometry` of the coefficients (129, 3) of `design`."""
    normal = coefficients[:FEATURES].reshape(len(POWERS), len(PLACES), 3).astype(np.float32)
    halo = coefficients[FEATURES:].reshape(3, 3, 3).astype(np.float32)
    return Photometry(normal, halo, STEEPEST, np.array(WIDEST, np.float32))


def fit_balls(change: Array, clear: Array, width_mm: float, ball_mm: float) -> Colour:
    """Fit colour changes f32 (N, H, W, 3) of presses of a ball. Raises UserError if no ball of that size fits."""
    grid, known = grid_of(change.shape[1:3], width_mm), _profiles(ball_mm)
    part = Grid(*(values.ravel() for values in grid))
    # A pixel that is not clear has change 0 and features 0.
    flat, seen = change.reshape(len(change), -1, 3).astype(np.float64), clear.reshape(len(clear), -1, 1)
    flat = flat * seen
    few, thin, some = flat[:, ::THIN], Grid(*(values[::THIN] for values in part)), seen[:, ::THIN]
    usual = known[THICKNESSES[1], HALOS[1]]
    poses = np.stack([_first_pose(one, part, usual) for one in flat])
    if float(np.median(poses[:, 2])) >= 0.95 * min(ball_mm / 2, DEPTHS[-1]):
        raise UserError(
            f"the dents are wider than a ball of {ball_mm:g} mm makes them, if the picture is {width_mm:g} mm wide; "
            "check --width-mm and --ball-mm"
        )
    tries = dict[tuple[float, float], tuple[float, Array]]()

    def attempt(key: tuple[float, float], poses: Array, rounds: Any) -> None:
        placed = _placed(few, some, thin, known[key], poses, rounds)
        tries[key] = _plain(few, some, thin, known[key], placed)[0], placed

    for halo in HALOS:
        attempt((THICKNESSES[1], halo), poses, ROUNDS)
    nearest = min(tries, key=lambda key: tries[key][0])
    for thickness in (THICKNESSES[0], THICKNESSES[2]):
        attempt((thickness, nearest[1]), tries[nearest][1], ROUNDS[-3:])
    best = min(tries, key=lambda key: tries[key][0])
    rows = [w * design(*_at(part, known[best], pose)) for pose, w in zip(tries[best][1], seen, strict=True)]
    gram, target = sum(r.T @ r for r in rows), sum(r.T @ d for r, d in zip(rows, flat, strict=True))
    coefficients = _ridge(gram, target, _PENALTY)
    left = sum(float(((one - r @ coefficients) ** 2).sum()) for one, r in zip(flat, rows, strict=True))
    explained = 1 - left / float((flat**2).sum())
    return Colour(assemble(coefficients), best[1], explained, f"{len(change)} presses of a ball of {ball_mm:g} mm")


def _placed(flat: Array, seen: Array, part: Grid, profiles: _Profiles, poses: Array, rounds: Any) -> Array:
    """Return better poses (N, 3): the colours and the poses are found in turn."""
    for step, deep in rounds:
        # Deeper dents with fainter colours look nearly alike, so all depths are also tried together.
        tries = [poses * (1, 1, factor) for factor in (0.8, 0.9, 0.96, 1.0, 1.04, 1.1, 1.25)]
        losses, solutions = zip(*(_plain(flat, seen, part, profiles, one) for one in tries), strict=True)
        best = int(np.argmin(losses))
        poses = np.stack([
            _search(one, weight, part, profiles, pose, solutions[best], (step, step, deep))
            for one, weight, pose in zip(flat, seen, tries[best], strict=True)
        ])  # fmt: skip
    return poses


def _plain(flat: Array, seen: Array, part: Grid, profiles: _Profiles, poses: Array) -> tuple[float, Array]:
    """Return what is left of the change with the best plain colours (22, 3), and these."""
    rows = [w * design(*_at(part, profiles, pose), plain=True) for pose, w in zip(poses, seen, strict=True)]
    gram, target = sum(r.T @ r for r in rows), sum(r.T @ d for r, d in zip(rows, flat, strict=True))
    found = _ridge(gram, target, np.full(len(gram), 1e-5))
    return -float(2 * (target * found).sum() - (found * (gram @ found)).sum()), found


def _at(part: Grid, profiles: _Profiles, pose: Array) -> tuple[Array, ...]:
    nx, ny, halo = _features(part, profiles, pose)
    return nx, ny, part.u, part.v, halo


def _first_pose(change: Array, grid: Grid, profiles: _Profiles) -> Array:
    """Return a first place and depth: the middle of the strongest changes, and the depth whose slopes reach as far."""
    strength = np.abs(change).max(1)
    strong = strength > 0.4 * np.percentile(strength, 99.5)
    x, y = float(np.median(grid.x[strong])), float(np.median(grid.y[strong]))
    pixel = float(np.ptp(grid.x)) * float(np.ptp(grid.y)) / len(grid.x)
    reach = np.sqrt(strong.sum() * pixel / np.pi)
    slopes = np.abs(profiles.slope)
    edges = [profiles.away[np.flatnonzero(line > 0.4 * line.max())[-1]] for line in slopes]
    return np.array([x, y, float(np.interp(reach, np.maximum.accumulate(edges), DEPTHS))])


def _search(
    change: Array,
    seen: Array,
    grid: Grid,
    profiles: _Profiles,
    pose: Array,
    coefficients: Array,
    steps: tuple[float, ...],
) -> Array:
    """Return a pose that no step along x, y or depth makes better, after four steps at most."""

    def loss(one: Array) -> float:
        return float(((change - seen * (design(*_at(grid, profiles, one), plain=True) @ coefficients)) ** 2).sum())

    least = loss(pose)
    for _ in range(4):
        moves = [pose + sign * np.eye(3)[axis] * steps[axis] for axis in range(3) for sign in (-1, 1)]
        moves = [np.array([x, y, np.clip(depth, DEPTHS[0], DEPTHS[-1])]) for x, y, depth in moves]
        losses = [loss(one) for one in moves]
        if min(losses) >= least:
            break
        least, pose = min(losses), moves[int(np.argmin(losses))]
    return pose


def fit_presses(change: Array, clear: Array) -> Colour:
    """Fit colour changes f32 (N, H, W, 3) of presses of unknown objects: their slopes without a curl, see above."""
    smooth = np.stack([cv2.GaussianBlur(one, (0, 0), 1.0) for one in change])
    strength = np.abs(smooth).max(-1)
    touched = strength > 0.25 * np.percentile(strength, 99.5, axis=(1, 2))[:, None, None]
    values, axes = np.linalg.eigh(np.cov(smooth.reshape(-1, 3).T, ddof=0))
    mean = smooth[touched].mean(0)
    even = float((mean @ axes[:, -1]) ** 2 / (smooth[touched] @ axes[:, -1]).var())
    if values[1] < 0.03 * values[2] and even > 0.1:  # one colour, of one sign: depth and not slope
        strength = np.sqrt(((smooth[touched] @ axes[:, -1]) ** 2).mean()) / USUAL_DEPTH
        coefficients = np.zeros((FEATURES + 9, 3))
        coefficients[FEATURES + 6] = axes[:, -1] * np.sign(mean @ axes[:, -1]) * strength
        source = f"{len(change)} presses of unknown objects, of a gel that changes by depth"
        return Colour(assemble(coefficients), 0.35, float(values[2] / values.sum()), source, UNSURE)
    white = (smooth @ axes[:, 1:]) / np.sqrt(values[1:])  # (N, H, W, 2), uncorrelated: slopes up to a turn
    down, across = (np.gradient(white, axis=axis)[:, 2:-2, 2:-2] for axis in (1, 2))
    best = (np.inf, np.eye(2))
    for mirror, angle in product((1, -1), np.linspace(0, np.pi, 180, endpoint=False)):
        turn = np.array([[np.cos(angle), np.sin(angle)], [-mirror * np.sin(angle), mirror * np.cos(angle)]])
        curl = down @ turn[0] - across @ turn[1]
        loss = float((curl**2).sum())
        best = min(best, (loss, turn), key=lambda one: one[0])
    slopes = white @ best[1].T
    if _depth_of(slopes)[touched].mean() < 0:
        slopes = -slopes
    slopes = slopes * USUAL_TILT / np.sqrt((slopes[touched] ** 2).sum(-1).mean())
    flat, seen = slopes[clear], smooth[clear]
    linear = np.linalg.solve(flat.T @ flat, flat.T @ seen)
    coefficients = np.zeros((FEATURES + 9, 3))
    coefficients[0], coefficients[len(PLACES)] = linear
    left = ((seen - flat @ linear) ** 2).sum() / (seen**2).sum()
    return Colour(assemble(coefficients), 1.0, 1 - float(left), f"{len(change)} presses of unknown objects", UNSURE)


def _depth_of(slopes: Array) -> Array:
    """Return the surface (N, H, W) whose slopes (N, H, W, 2) along x and y are nearest, 0 on average at the border."""
    height, width = slopes.shape[1:3]
    ky, kx = np.meshgrid(np.fft.fftfreq(2 * height), np.fft.fftfreq(2 * width), indexing="ij")
    padded = [np.pad(slopes[..., i], ((0, 0), (0, height), (0, width))) for i in range(2)]
    sx, sy = (np.fft.fft2(one, axes=(1, 2)) for one in padded)
    square = (kx**2 + ky**2) * 2j * np.pi
    square[0, 0] = 1
    surface: Any = np.fft.ifft2((kx * sx + ky * sy) / square, axes=(1, 2)).real[:, :height, :width]
    border = np.concatenate([surface[:, 0], surface[:, -1], surface[:, :, 0], surface[:, :, -1]], 1)
    return surface - border.mean(1)[:, None, None]
