"""Colour change of a gel by its slope, fitted to presses of a ball of known size or to any presses.

A ball's slopes are known up to its place and depth, and these are found together with the colours:
linear least squares and a search take turns.

Without a ball three things are known. The slopes of one surface fit together (no curl), gels are
touched from all sides, and dents are dents. They determine the slopes up to one factor, which is
set to a usual one.
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
_Loss = tuple[float, Array]  # a loss, and what has it
_Key = tuple[float, float, int]  # mm of the gel, mm of the halo, number of the _LIMITS
# powers of (u, v) that a coefficient drifts by
PLACES = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
# Largest tilt, and largest features of the halo, that change a colour: of open light, and of paint
# that is soon dark.
_LIMITS = (0.95, (9.0, 9.0, 1.5)), (0.3, (0.03, 0.03, 0.06))
DEPTHS = np.linspace(0.05, 1.6, 24)  # mm
_REACH = np.array([[-np.inf, -np.inf, DEPTHS[0]], [np.inf, np.inf, DEPTHS[-1]]])  # of a pose
# points and mm of the solved gel
_GRID = 96
_SIDE = 14.0
SKIN = 0.13  # mm: detail that the coating and the lens pass
# mm, of the soft shadow and of the gel: the best is chosen. The gel's decides the depth, and so the
# change by depth.
HALOS = (0.35, 1.0, 1.6)
THICKNESSES = (1.8, 2.3, 2.8, 3.3, 3.9, 4.6)
THIN = 5  # the search looks at every so many pixels
PLAIN = 9  # powers of the normal with which the presses are placed
# mm of place and depth
ROUNDS = (0.8, 0.2), (0.4, 0.1), (0.2, 0.1), (0.1, 0.05), (0.1, 0.05), (0.05, 0.03)
FEATURES = len(POWERS) * len(PLACES)
# Root mean square of the slope of the gel, weighted by its square, and of its depth in mm where the
# change is above a quarter of the strongest. They give the right strength on average over simulated
# units, and set the scale without a ball. Of 30 statistics of the slope this one differs least from
# unit to unit.
USUAL_TILT = 0.30
USUAL_DEPTH = 0.27
UNSURE = (
    "Without a ball the strength is a usual one, which differs by {} (deviation over known "
    "sensors): edit contrast"
)


class Colour(NamedTuple):
    """A fitted photometry."""

    look: Photometry
    halo: float  # mm
    explained: float  # fraction of the squared change that it explains
    source: str  # how it was found, in words
    thickness: float = 3.0  # mm of the gel


class Grid(NamedTuple):
    """Places of the pixels of a colour change (H, W), or of some of them (N,)."""

    x: Array  # mm from the middle
    y: Array
    u: Array  # -1..1
    v: Array


def grid_of(shape: tuple[int, int], width_mm: float) -> Grid:
    """Return the places of square pixels (H, W) of an image that shows `width_mm`."""
    height, width = shape
    pixel = width_mm / width
    x, y = np.meshgrid(
        (np.arange(width) + 0.5 - width / 2) * pixel, (np.arange(height) + 0.5 - height / 2) * pixel
    )
    return Grid(x, y, 2 * x / width_mm, 2 * y / (height * pixel))


class _Profiles(NamedTuple):
    """Dents of a ball at K depths (`DEPTHS`) and R distances from its middle."""

    away: Array  # (R,) mm
    slope: Array  # (K, R)
    soft: Array  # (K, R) mm, depth of the blurred dent
    soft_slope: Array  # (K, R), its slope
    steepest: float  # as in `Photometry`
    widest: Array


def _profiles(ball_mm: float) -> dict[_Key, _Profiles]:
    """Return the dents of a ball by thickness of the gel, halo, and number of the _LIMITS.

    A dent is round, so a line from its middle is all of it. It is solved once, and not in the
    search, which looks it up.
    """
    line = (np.arange(_GRID) - (_GRID - 1) / 2) * _SIDE / _GRID
    away = np.hypot(*np.meshgrid(line, line))
    radius = ball_mm / 2
    surface = np.where(
        away < radius, np.sqrt(np.maximum(radius**2 - away**2, 0)) - radius, -radius - 5
    )
    middle = _GRID // 2
    pitch = _SIDE / _GRID
    height = jnp.asarray(surface, jnp.float32)

    @jax.jit
    def solve(depths: Any, gel: Gel) -> Any:
        return jax.vmap(
            lambda depth: press(height, depth, gel, pitch, fidelity="fast").displacement
        )(depths)

    def lines(dents: Array, width: float) -> tuple[Array, Array]:
        """Return depth and slope (K, R) of dents (K, H, W) blurred by `width` mm."""
        blurred = [cv2.GaussianBlur(dent, (0, 0), width / pitch) for dent in dents]
        depth = np.stack([one[middle, middle:] for one in blurred])
        return depth, np.gradient(depth, pitch, axis=1)

    found = dict[_Key, _Profiles]()
    for thickness in THICKNESSES:
        # An array, so that one compiled program serves all thicknesses.
        gel = Gel(150.0, thickness=np.asarray(thickness, np.float32))
        dents = np.asarray(solve(DEPTHS.astype(np.float32), gel))
        _, slope = lines(dents, SKIN)
        for halo in HALOS:
            soft, soft_slope = lines(dents, halo)
            for number, (steepest, widest) in enumerate(_LIMITS):
                found[thickness, halo, number] = _Profiles(
                    line[middle:], slope, soft, soft_slope, steepest, np.array(widest)
                )
    return found


def _features(grid: Grid, profiles: _Profiles, pose: Array) -> tuple[Array, ...]:
    """Return the arguments of `design` for a ball at `pose` (x, y, depth mm), at N places."""
    dx = grid.x - pose[0]
    dy = grid.y - pose[1]
    away = np.hypot(dx, dy)
    k = float(np.clip(np.interp(pose[2], DEPTHS, np.arange(len(DEPTHS))), 0, len(DEPTHS) - 1.001))
    low = int(k)
    fraction = k - low
    # Between two depths, and between two distances, the profiles are interpolated linearly.
    slope, soft, wide = (
        np.interp(
            away, profiles.away, (1 - fraction) * table[low] + fraction * table[low + 1], right=0.0
        )
        for table in profiles[1:4]
    )
    cos, sin = (along / np.maximum(away, 1e-6) for along in (dx, dy))
    tilt = slope * np.minimum(
        1 / np.sqrt(1 + slope**2), profiles.steepest / np.maximum(np.abs(slope), 1e-6)
    )
    glow = np.clip(np.stack([wide * cos, wide * sin, soft], 1), -profiles.widest, profiles.widest)
    return tilt * cos, tilt * sin, grid.u, grid.v, glow


def design(nx: Array, ny: Array, u: Array, v: Array, halo: Array, *, plain: bool = False) -> Array:
    """Return the rows of the linear least squares problem of a `Photometry`.

    The change of a pixel is linear in the coefficients: powers of the normal times powers of the
    place (`optics.colour_change`), and the halo times a drift.

    Args:
        nx: (N,) sines of the tilt.
        ny: (N,)
        u: (N,) places in -1..1.
        v: (N,)
        halo: (N, 3) slopes and depth of the blurred dent.
        plain: Fewer terms, with which poses are searched.

    Returns:
        (N, 129), or (N, 22) plain ones.
    """
    normal = np.stack([nx**i * ny**j for i, j in (POWERS[:PLAIN] if plain else POWERS)], 1)
    if plain:
        drift = [each * at for each in (nx, ny) for at in (u, v, u * u, u * v, v * v)]
        return np.concatenate([normal, halo, np.stack(drift, 1)], 1)
    place = np.stack([u**i * v**j for i, j in PLACES], 1)
    columns = (normal[:, :, None] * place[:, None, :]).reshape(len(nx), -1)
    return np.concatenate(
        [columns, (halo[:, :, None] * place[:, None, :3]).reshape(len(nx), -1)], 1
    )


def _ridge(gram: Array, target: Array, penalties: Array) -> Array:
    """Return the ridge solution of normal equations, with penalties relative to each column."""
    scale = np.sqrt(np.diag(gram)) + 1e-12
    scaled = gram / scale[:, None] / scale[None, :] + np.diag(penalties)
    return np.asarray(np.linalg.solve(scaled, target / scale[:, None]) / scale[:, None])


# What few presses do not show is small: high powers, drift over the image, and a halo that copies
# the slopes.
_PENALTY = np.concatenate(
    [
        np.ravel(
            [
                [1e-4 * (1 if i + j == 1 else 5) * (1 + 4 * (p + q)) for p, q in PLACES]
                for i, j in POWERS
            ]
        ),
        np.full(9, 1e-2),
    ]
)


def assemble(
    coefficients: Array, steepest: float = _LIMITS[0][0], widest: Any = _LIMITS[0][1]
) -> Photometry:
    """Return the `Photometry` of the coefficients (129, 3) of `design`."""
    normal = coefficients[:FEATURES].reshape(len(POWERS), len(PLACES), 3).astype(np.float32)
    halo = coefficients[FEATURES:].reshape(3, 3, 3).astype(np.float32)
    return Photometry(normal, halo, steepest, np.array(widest, np.float32))


def fit_balls(change: Array, clear: Array, width_mm: float, ball_mm: float) -> Colour:
    """Fit colour changes f32 (N, H, W, 3) of presses of a ball.

    Raises UserError if no ball of that size fits.

    Args:
        change: f32 (N, H, W, 3), colour changes of the presses, 0..1.
        clear: bool (N, H, W), pixels that count.
        width_mm: that an image shows.
        ball_mm: diameter of the ball.
    """
    part = Grid(*(values.ravel() for values in grid_of(change.shape[1:3], width_mm)))
    known = _profiles(ball_mm)
    # A pixel that is not clear has change 0 and features 0, so it has no say.
    flat = change.reshape(len(change), -1, 3).astype(np.float64)
    seen = clear.reshape(len(clear), -1, 1)
    flat = flat * seen
    few = flat[:, ::THIN]
    thin = Grid(*(values[::THIN] for values in part))
    some = seen[:, ::THIN]
    best = (THICKNESSES[2], HALOS[1], 0)
    poses = np.stack([_first_pose(one, part, known[best]) for one in flat])
    # Shadow and limits for one thickness; then thickness and shadow together, which replace each
    # other; then limits.
    for same, rounds in (
        (slice(1), ROUNDS[:4]),
        (slice(2, 3), ROUNDS[3:5]),
        (slice(2), ROUNDS[4:]),
    ):
        keys = [key for key in known if key[same] == best[same]]
        tries = {key: _placed(few, some, thin, known[key], poses, rounds) for key in keys}
        best = min(tries, key=lambda key: tries[key][0])
        poses = tries[best][1]
    if float(np.median(poses[:, 2])) >= 0.95 * min(ball_mm / 2, DEPTHS[-1]):
        raise UserError(
            f"the dents are wider than those of a ball of {ball_mm:g} mm; check --width-mm and "
            "--ball-mm"
        )
    loss, coefficients = _colours(flat, seen, part, known[best], poses, plain=False)
    source = f"{len(change)} presses of a ball of {ball_mm:g} mm"
    return Colour(
        assemble(coefficients, *_LIMITS[best[2]]),
        best[1],
        -loss / float((flat**2).sum()),
        source,
        best[0],
    )


def _placed(
    flat: Array, seen: Array, part: Grid, profiles: _Profiles, poses: Array, rounds: Any
) -> _Loss:
    """Return the loss of `_colours`, and better poses (N, 3).

    The colours and the poses are found in turn, in smaller and smaller steps.
    """
    for step, deep in rounds:
        # Deeper dents with fainter colours look nearly alike, so all depths are also tried
        # together.
        tries = [poses * (1, 1, factor) for factor in (0.8, 0.9, 0.96, 1.0, 1.04, 1.1, 1.25)]
        results = [_colours(flat, seen, part, profiles, one) for one in tries]
        best = int(np.argmin([loss for loss, _ in results]))
        colours = results[best][1]
        steps = np.array([step, step, deep])
        better = [
            _search(one, weight, part, profiles, pose, colours, steps)
            for one, weight, pose in zip(flat, seen, tries[best], strict=True)
        ]
        poses = np.stack(better)
    return _colours(flat, seen, part, profiles, poses, plain=False)[0], poses


def _colours(
    flat: Array, seen: Array, part: Grid, profiles: _Profiles, poses: Array, plain: bool = True
) -> _Loss:
    """Return the best colours (22 or 129, 3) for these poses, after their loss.

    The loss is minus the squares of the change that they explain: of least squares with normal
    matrix G and right side b, the solution c explains 2 b . c - c . G c.
    """
    rows = [
        w * design(*_features(part, profiles, pose), plain=plain)
        for pose, w in zip(poses, seen, strict=True)
    ]
    gram = sum(r.T @ r for r in rows)
    target = sum(r.T @ d for r, d in zip(rows, flat, strict=True))
    found = _ridge(gram, target, np.full(len(gram), 1e-5) if plain else _PENALTY)
    return -float(2 * (target * found).sum() - (found * (gram @ found)).sum()), found


def _first_pose(change: Array, grid: Grid, profiles: _Profiles) -> Array:
    """Return a first pose: the middle of the strongest changes, and a depth that reaches as far."""
    strength = np.abs(change).max(1)
    strong = strength > 0.4 * np.percentile(strength, 99.5)
    x = float(np.median(grid.x[strong]))
    y = float(np.median(grid.y[strong]))
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
    steps: Array,
) -> Array:
    """Return a pose that no step along x, y or depth makes better, after four steps at most."""

    def loss(one: Array) -> float:
        made = design(*_features(grid, profiles, one), plain=True) @ coefficients
        return float(((change - seen * made) ** 2).sum())

    least = loss(pose)
    for _ in range(4):
        moves = [
            np.clip(pose + sign * move, *_REACH) for move in np.diag(steps) for sign in (-1, 1)
        ]
        losses = [loss(one) for one in moves]
        if min(losses) >= least:
            break
        least = min(losses)
        pose = moves[int(np.argmin(losses))]
    return pose


def fit_presses(change: Array, clear: Array) -> Colour:
    """Fit colour changes f32 (N, H, W, 3) of presses of unknown objects.

    A colour change is taken as linear in two slopes. Gels are touched from all sides, so the slopes
    have one variance and no correlation. The two strongest colours, scaled to one variance, are
    therefore the slopes up to a rotation and a mirror image. The rotation is the one of least curl,
    because the slopes of a surface have none, and the sign is the one that makes dents.
    """
    smooth = np.stack([cv2.GaussianBlur(one, (0, 0), 1.0) for one in change])
    grid = grid_of(change.shape[1:3], 2.0)
    strength = np.abs(smooth).max(-1)
    touched = strength > 0.25 * np.percentile(strength, 99.5, axis=(1, 2))[:, None, None]
    values, axes = np.linalg.eigh(np.cov(smooth.reshape(-1, 3).T, ddof=0))
    main = smooth[touched] @ axes[:, -1]
    coefficients = np.zeros((FEATURES + 9, 3))
    # One colour, of one sign: such a gel darkens by depth, and slopes cannot be seen.
    by_depth = values[1] < 0.03 * values[2] and main.mean() ** 2 > 0.1 * main.var()
    if by_depth:
        strength = np.sqrt((main**2).mean())
        coefficients[FEATURES + 6] = axes[:, -1] * np.sign(main.mean()) * strength / USUAL_DEPTH
        source = (
            f"{len(change)} presses of unknown objects, of a gel that changes by depth. "
            f"{UNSURE.format('30 %')}"
        )
        return Colour(assemble(coefficients), 0.35, float(values[2] / values.sum()), source)
    values, axes = np.linalg.eigh(np.cov(smooth[clear].T, ddof=0))
    # (N, H, W, 2), uncorrelated: slopes up to a turn
    white = (smooth @ axes[:, 1:]) / np.sqrt(values[1:])
    slopes = white @ _least_curl(white, clear).T
    if _depth_of(slopes)[touched].mean() < 0:
        slopes = -slopes
    # The colours drift over the image: those of the nearest surface, and the slopes by these
    # colours, in turn.
    place = np.stack([np.ones_like(grid.u), grid.u, grid.v], -1)
    for _ in range(4):
        fitting = np.stack(np.gradient(_depth_of(slopes), axis=(2, 1)), -1)
        square = (fitting**2).sum(-1)
        fitting *= USUAL_TILT / np.sqrt((square**2).sum() / square.sum())
        rows = (fitting[..., None] * place[:, :, None]).reshape(*smooth.shape[:3], 6)[clear]
        penalties = np.array([0, 0.05, 0.05] * 2)
        linear = _ridge(rows.T @ rows, rows.T @ smooth[clear], penalties).reshape(2, 3, 3)
        slopes = _slopes_by(np.einsum("hwp,dpc->hwdc", place, linear), smooth)
    # The powers 1, 0 and 0, 1 of the normal are the first two; the rest stays zero.
    coefficients[:3] = linear[0]
    coefficients[len(PLACES) : len(PLACES) + 3] = linear[1]
    left = ((smooth[clear] - rows @ linear.reshape(6, 3)) ** 2).sum() / (smooth[clear] ** 2).sum()
    source = f"{len(change)} presses of unknown objects. {UNSURE.format('20 %')}"
    return Colour(assemble(coefficients), 1.0, 1 - float(left), source)


def _least_curl(white: Array, clear: Array) -> Array:
    """Return the rotation (2, 2), perhaps with a mirror image, that leaves two maps least curl.

    The maps are `white` (N, H, W, 2), of which places `clear` (N, H, W) count.
    """
    down, across = (np.gradient(white, axis=axis)[clear] for axis in (1, 2))
    least = np.inf
    best = np.eye(2)
    # Half a turn is enough: the other half has the other sign, which is found later.
    for mirror, angle in product((1, -1), np.linspace(0, np.pi, 180, endpoint=False)):
        c = np.cos(angle)
        s = np.sin(angle)
        turn = np.array([[c, s], [-mirror * s, mirror * c]])
        # of slopes (p, q): dp/dy - dq/dx
        curl = down @ turn[0] - across @ turn[1]
        total = float((curl**2).sum())
        if total < least:
            least = total
            best = turn
    return best


def _slopes_by(colours: Array, change: Array) -> Array:
    """Return slopes (N, H, W, 2) of a change (N, H, W, 3), by their colours (H, W, 2, 3).

    They are least squares at each pixel, with a ridge where the two colours are alike.
    """
    square = colours @ colours.swapaxes(2, 3)
    square += 0.01 * np.trace(square.mean((0, 1))) * np.eye(2)
    return np.asarray(np.einsum("hwde,hwec,nhwc->nhwd", np.linalg.inv(square), colours, change))


def _depth_of(slopes: Array) -> Array:
    """Return the surface (N, H, W) whose slopes (N, H, W, 2) along x and y are nearest.

    It is 0 on average at the border. In Fourier space, where k is a wave, the nearest surface is
    (k . slopes) / (2 pi i k^2). The padding keeps opposite sides apart.
    """
    height, width = slopes.shape[1:3]
    ky, kx = np.meshgrid(np.fft.fftfreq(2 * height), np.fft.fftfreq(2 * width), indexing="ij")
    padded = [np.pad(slopes[..., i], ((0, 0), (0, height), (0, width))) for i in range(2)]
    sx, sy = (np.fft.fft2(one, axes=(1, 2)) for one in padded)
    square = (kx**2 + ky**2) * 2j * np.pi
    square[0, 0] = 1
    surface: Any = np.fft.ifft2((kx * sx + ky * sy) / square, axes=(1, 2)).real[:, :height, :width]
    border = np.concatenate([surface[:, 0], surface[:, -1], surface[:, :, 0], surface[:, :, -1]], 1)
    return surface - border.mean(1)[:, None, None]
