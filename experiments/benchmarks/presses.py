"""Calibration on real presses of GelSight and GelSight Mini: a photometric model fitted to half of them.

The PyPI package `taxim` (MIT) has the calibration data of Taxim (Si and Yuan, "Taxim: An Example-based Simulation Model
for GelSight Tactile Sensors", RA-L 2022). They are a background and real presses of 640 x 480 pixels with a circle
drawn by hand around each. Its images are BGR, and everything here is RGB.

Taxim's calibration (Basics/sensorParams.py) states a ball of 4.00 mm diameter at 0.0295 mm a pixel, and the largest
tilts in the GelSight table agree. The Mini's circles enclose the visible dent, not the contact, are off by up to 24
pixels, and do not grow with the depth. A rule replaces them (`circle`). The size of its ball is not published. The
numbers of `Indenter` were chosen on the training half, and agree with balls of known size on other units.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError
from anytouch_jax.sim import interpolation
from anytouch_jax.sim.sensing import optics
from anytouch_jax.sim.sensing.sensors import POWERS, Photometry
from experiments.benchmarks import photometry

Array = npt.NDArray[Any]

PITCH = 0.0295  # mm between pixels at 640 x 480, params.json of both sensors
COARSE = 4  # pixels between samples of the grid on which dents are computed
FAINT = 16.0  # levels of 255: the colour change at the border of a dent


@dataclass(frozen=True)
class Indenter:
    """The ball of the real presses, and its dent."""

    radius: float  # mm of its round tip
    share: float = 1.0  # of the recorded circle's radius that is contact
    sink: float = 1.5  # depth over the height of the cap inside the contact, because the gel sinks around it
    reach: float = 1.0  # mm of the dent outside the contact
    halo: float = 1.0  # mm, width of the soft shadow
    odd: int = 0  # pixels, half the window of `odd_centre`; 0 uses the recorded circles
    # None fits the drift of the colours over the image. A number is for presses that are all at one place: the colour
    # change falls by this share from the middle to the middle of an edge.
    fading: float | None = None


INDENTERS = {  # sink, reach, halo and share are the best of a small grid, cross-validated within the training half
    "gelsight": Indenter(radius=4.00 / 2, sink=1.7, reach=1.6, halo=1.5),
    "gelsight_mini": Indenter(radius=1.5, share=0.4, sink=1.8, reach=1.2, halo=1.0, odd=30, fading=0.5),
}


class Presses(NamedTuple):
    """Real presses of one sensor."""

    background: Array  # (480, 640, 3) u8 RGB
    frames: Array  # (n, 480, 640, 3) u8 RGB
    centre: Array  # (n, 2) pixels (x, y) of the circle around the dent
    radius: Array  # (n,) pixels
    recorded: Array  # (n, 3) the published circles


def _read(sensor: str, *names: str) -> list[Array]:
    if sensor not in INDENTERS:
        raise UserError(f"there is no calibration of {sensor!r}; there is one of {', '.join(INDENTERS)}")
    try:
        folder = files("taxim")
    except ModuleNotFoundError as error:
        raise UserError(f"the real frames of {sensor} are in the package taxim: pip install taxim") from error
    with (folder / "calib" / sensor / "dataPack.npz").open("rb") as file, np.load(file, allow_pickle=False) as pack:
        return [np.asarray(pack[name]) for name in names]


def read_background(sensor: str) -> Array:
    """Return the real background image of a unit, u8 (480, 640, 3) RGB. Raises UserError without the package."""
    return np.ascontiguousarray(_read(sensor, "f0")[0][..., ::-1])


def read_presses(sensor: str) -> Presses:
    """Return all real presses of `sensor` in the order of the package. Raises UserError as `read_background`."""
    background, frames, centre, radius = _read(sensor, "f0", "imgs", "touch_center", "touch_radius")
    background, frames = background[..., ::-1], frames[..., ::-1]
    recorded = np.concatenate([centre, radius[:, None]], 1).astype(np.float64)
    circles, half = recorded, INDENTERS[sensor].odd
    if half:
        circles = np.stack([circle(f, background, c[:2], half) for f, c in zip(frames, recorded, strict=True)])
    return Presses(background, frames, circles[:, :2], circles[:, 2], recorded)


def circle(frame: Array, background: Array, start: Array, half: int) -> Array:
    """Return the circle (x, y, r) of a round dent: its `odd_centre`, and the radius where the change falls to FAINT."""
    x, y = odd_centre(frame, background, start, half)
    change = np.abs(frame.astype(np.float32) - background.astype(np.float32)).mean(-1)
    rows, columns = np.mgrid[: frame.shape[0], : frame.shape[1]]
    ring = np.hypot(columns - x, rows - y).round().astype(int).ravel()
    profile = np.bincount(ring, change.ravel()) / np.maximum(np.bincount(ring), 1)
    profile = np.convolve(profile[: min(frame.shape[:2]) // 2], np.ones(5) / 5, "same")
    above = np.flatnonzero(profile > FAINT)
    return np.array([x, y, max(float(above[-1]) + 1.0, 1.0) if len(above) else 1.0])


def odd_centre(frame: Array, background: Array, start: Array, half: int) -> Array:
    """Return the point (x, y) near `start` about which the colour change of `frame` u8 (h, w, 3) is most nearly odd.

    A round dent's slopes are odd about its middle, and so is the first order of its colours. Windows of 2 `half` + 1
    pixels are searched within 28 pixels, first in steps of 4, then of 1.
    """
    change = cv2.GaussianBlur(frame.astype(np.float32) - background.astype(np.float32), (0, 0), 1.5)
    place = np.round(start).astype(int)
    for step, reach in ((4, 28), (1, 4)):
        thin = 1 + step // 2  # every third pixel is enough for the first round
        best, middle = np.inf, place.copy()
        for dy in range(-reach, reach + 1, step):
            for dx in range(-reach, reach + 1, step):
                x, y = middle[0] + dx, middle[1] + dy
                if min(x, y, change.shape[1] - 1 - x, change.shape[0] - 1 - y) < half:
                    continue
                window = change[y - half : y + half + 1 : thin, x - half : x + half + 1 : thin]
                even = window + window[::-1, ::-1]
                score = float(((even - even.mean((0, 1))) ** 2).sum() / np.maximum((window**2).sum(), 1e-6))
                if score < best:
                    best, place = score, np.array([x, y])
    return place.astype(np.float64)


def halves(count: int) -> tuple[Array, Array]:
    """Return the fixed split of `count` presses: even ones for the fit, odd ones for the score."""
    return np.arange(0, count, 2), np.arange(1, count, 2)


def ball_cut(centre: Any, radius: Any, indenter: Indenter, shape: tuple[int, int], pitch: float) -> jax.Array:
    """Return the penetration (h, w) mm of the indenter's tip into the flat gel, at least -1.

    `centre` (2,) is in mm from the middle of the map's first sample, `radius` mm that of the drawn circle. The
    contact's radius is `share` of it, and the depth `sink` times the height of the cap inside it.
    """
    x = jnp.arange(shape[1]) * pitch - centre[0]
    y = jnp.arange(shape[0]) * pitch - centre[1]
    square = x[None, :] ** 2 + y[:, None] ** 2
    tip = indenter.radius
    contact = jnp.minimum(indenter.share * radius, 0.999 * tip)
    depth = indenter.sink * (tip - jnp.sqrt(tip**2 - contact**2))
    cap = jnp.where(square < (0.999 * tip) ** 2, tip - jnp.sqrt(jnp.maximum(tip**2 - square, 1e-9)), 10.0)
    return jnp.maximum(depth - cap, -1.0)


def settle(cut: jax.Array, pitch: float, reach: float) -> jax.Array:
    """Return the displacement (h, w) mm of a gel with the penetration `cut` (h, w) mm.

    Six ever narrower blurs, never below the object, replace contact mechanics. They depend on one length, `reach` mm.
    """
    dent = jnp.maximum(cut, 0.0)
    for level in range(6):
        sigma = reach / pitch / 2 ** (0.8 * level)
        rows, columns = interpolation.blur(cut.shape[0], sigma), interpolation.blur(cut.shape[1], sigma)
        dent = jnp.maximum(rows @ dent @ columns.T, cut)
    return dent


def press_dent(centre: Any, radius: Any, indenter: Indenter, shape: tuple[int, int] = (480, 640)) -> jax.Array:
    """Return the displacement mm of a real press on the coarse grid (h / 4, w / 4). Inputs are in pixels."""
    coarse, pitch = (shape[0] // COARSE, shape[1] // COARSE), COARSE * PITCH
    corner = (jnp.asarray(centre) - (COARSE - 1) / 2) * PITCH
    return settle(ball_cut(corner, jnp.asarray(radius) * PITCH, indenter, coarse, pitch), pitch, indenter.reach)


def _features(
    centre: Any, radius: Any, rows: Array, columns: Array, shape: tuple[int, int], indenter: Indenter
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return two tilts (h, w) and halo features (h, w, 3) of a press at the pixels `rows` x `columns`."""
    dent, pitch = press_dent(centre, radius, indenter, shape), COARSE * PITCH
    ay, dy = interpolation.spline(jnp.asarray((rows + 0.5) / COARSE - 0.5), dent.shape[0])
    ax, dx = interpolation.spline(jnp.asarray((columns + 0.5) / COARSE - 0.5), dent.shape[1])
    by, bx = (interpolation.blur(n, indenter.halo / pitch) for n in dent.shape)
    soft = by @ dent @ bx.T
    nx, ny = optics.tilt(ay @ dent @ dx.T / pitch, dy @ dent @ ax.T / pitch, 0.95)
    return nx, ny, jnp.stack([ay @ soft @ dx.T / pitch, dy @ soft @ ax.T / pitch, ay @ soft @ ax.T], -1)


@lru_cache(maxsize=4)
def fit_photometry(sensor: str, stride: int = 4) -> tuple[Photometry, Photometry]:
    """Return photometric models of a real sensor with and without halo, by ridge regression on the even presses.

    It uses every `stride`-th pixel within two radii of each press. Raises UserError as `read_background`.
    """
    presses = read_presses(sensor)
    train, indenter = halves(len(presses.radius))[0], INDENTERS[sensor]
    height, width = presses.background.shape[:2]
    rows, columns = np.arange(stride // 2, height, stride), np.arange(stride // 2, width, stride)
    features = jax.jit(lambda c, r: _features(c, r, rows, columns, (height, width), indenter))
    u, v = np.meshgrid((columns + 0.5) / width * 2 - 1, (rows + 0.5) / height * 2 - 1)
    grid, base = np.ix_(rows, columns), presses.background.astype(np.float64)
    problem, colours, steepest, widest = [], [], 0.0, np.zeros(photometry.HALO)
    for k in train:
        near = np.hypot(columns - presses.centre[k, 0], rows[:, None] - presses.centre[k, 1]) < 2 * presses.radius[k]
        with jax.ensure_compile_time_eval():  # the first use may be inside a traced function
            outputs = features(presses.centre[k], presses.radius[k])
        nx, ny, soft = (np.asarray(a, np.float64)[near] for a in outputs)
        fits_drift = float(indenter.fading is None)
        problem.append(photometry.design(nx, ny, fits_drift * u[near], fits_drift * v[near], soft))
        colours.append((presses.frames[k][grid] - base[grid])[near] / 255)
        steepest = max(steepest, float(np.hypot(nx, ny).max()))
        widest = np.maximum(widest, np.abs(soft).max(0))
    rows_of, changes = np.concatenate(problem), np.concatenate(colours)
    models = []
    for columns_used in (rows_of.shape[1], len(POWERS) * len(photometry.PLACES)):
        model = photometry.assemble(photometry.ridge(rows_of[:, :columns_used], changes), round(steepest, 3), widest)
        if indenter.fading is not None:
            for place in (photometry.PLACES.index((2, 0)), photometry.PLACES.index((0, 2))):
                model.normal[:, place] = -indenter.fading * model.normal[:, 0]
        models.append(model)
    return models[0], models[1]
