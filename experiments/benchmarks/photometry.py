"""The simulator's pictures against real ones: held-out ball presses, beside Taxim's own renderer in the same run.

Both renderers start from a height map of 480 x 640 samples of the same press and end with a picture of 480 x 640
pixels; they are timed alternately. Ours was fitted on the even presses and is scored on the odd ones. Taxim's tables
were made from all presses, so its figures are in-sample. Both have the real background frame.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.statistics import markdown
from anytouch_jax.sim.sensing import calibration, optics, sensors, units
from anytouch_jax.sim.sensing.calibration import COARSE, INDENTERS, PITCH, Presses

Array = npt.NDArray[Any]
SSIM_SIGMA, SSIM_C1, SSIM_C2 = 1.5, (0.01 * 255) ** 2, (0.03 * 255) ** 2  # Wang et al. 2004


@dataclass(frozen=True)
class Score:
    """One renderer on the held-out presses of one sensor; means over presses.

    `mae` in 0..255, `psnr` in dB and `ssim` inside the drawn circle, `ring_mae` between one and two radii. `ms`:
    median milliseconds a frame, None where nothing is computed. `in_sample`: fitted on the scored presses too.
    """

    sensor: str
    renderer: str
    presses: int
    mae: float
    psnr: float
    ssim: float
    ring_mae: float
    ms: float | None
    in_sample: bool


@dataclass(frozen=True)
class Renderer:
    """A way to draw a press: `height(k)` makes the input of `draw` outside of the clock; u8 (480, 640, 3) comes out."""

    name: str
    height: Callable[[int], Any]
    draw: Callable[[Any], Any]
    in_sample: bool = False
    timed: bool = True


def score(names: Sequence[str] = tuple(INDENTERS), *, limit: int | None = None, rivals: bool = True) -> list[Score]:
    """Score the renderers on the odd presses of each sensor; `limit` of them, without Taxim where `rivals` is false.

    Raises UserError for a sensor without real presses, or without the package `taxim`.
    """
    rows: list[Score] = []
    for name in names:
        presses = calibration.read_presses(name)
        which = calibration.halves(len(presses.radius))[1][:limit]
        renderers = [_constant(presses), _ours(name, presses), _ours(name, presses, shadow=False)]
        if rivals:
            renderers += _taxim(name, presses)
        rows += compare(name, presses, which, renderers)
    return rows


def compare(sensor: str, presses: Presses, which: Array, renderers: Sequence[Renderer]) -> list[Score]:
    """Draw each press in `which` with each renderer in turn; a first drawing that is not counted compiles."""
    if len(which) == 0:
        raise UserError(f"there is no press of {sensor} to score")
    measures: dict[str, list[Array]] = {r.name: [] for r in renderers}
    clock: dict[str, list[float]] = {r.name: [] for r in renderers}
    for renderer in renderers:
        jax.block_until_ready(renderer.draw(renderer.height(int(which[0]))))
    for k in map(int, which):
        for renderer in renderers:
            height = jax.block_until_ready(renderer.height(k))
            start = time.perf_counter()
            image = jax.block_until_ready(renderer.draw(height))
            clock[renderer.name].append(1e3 * (time.perf_counter() - start))
            drawn = np.asarray(image)
            measures[renderer.name].append(measure(drawn, presses.frames[k], presses.centre[k], presses.radius[k]))
    rows = []
    for r in renderers:
        mae, psnr, ssim, ring = (float(x) for x in np.mean(measures[r.name], axis=0))
        ms = float(np.median(clock[r.name])) if r.timed else None
        rows.append(Score(sensor, r.name, len(which), mae, psnr, ssim, ring, ms, r.in_sample))
    return rows


def measure(image: Array, real: Array, centre: Array, radius: float) -> Array:
    """Mean absolute error, PSNR and SSIM inside the circle, mean absolute error in the ring: (4,) of u8 images."""
    rows, columns = np.mgrid[: real.shape[0], : real.shape[1]]
    distance = np.hypot(columns - centre[0], rows - centre[1])
    inside, ring = distance < radius, (distance >= radius) & (distance < 2 * radius)
    error = image.astype(np.float64) - real.astype(np.float64)
    square = max(float((error[inside] ** 2).mean()), 1e-6)
    psnr = 10 * np.log10(255**2 / square)
    return np.array(
        [np.abs(error[inside]).mean(), psnr, ssim_map(image, real)[inside].mean(), np.abs(error[ring]).mean()]
    )


def ssim_map(a: Array, b: Array) -> Array:
    """Structural similarity (h, w, c) of two u8 images in Gaussian windows of 1.5 pixels (Wang et al. 2004)."""
    x, y = a.astype(np.float64), b.astype(np.float64)

    def mean(image: Array) -> Array:
        return cv2.GaussianBlur(image, (11, 11), SSIM_SIGMA)

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
    numerator = (2 * mx * my + SSIM_C1) * (2 * cov + SSIM_C2)
    return np.asarray(numerator / ((mx**2 + my**2 + SSIM_C1) * (vx + vy + SSIM_C2)))


def to_markdown(rows: Sequence[Score]) -> str:
    """A table of scores, with the ratio of Taxim's time to ours where both were timed."""
    head = ["sensor", "renderer", "presses", "MAE", "PSNR dB", "SSIM", "ring MAE", "ms/frame", "x ours"]
    lines = []
    for row in rows:
        ours = next((r.ms for r in rows if r.sensor == row.sensor and r.renderer == "ours"), None)
        ratio = f"{row.ms / ours:.1f}" if row.ms and ours else ""
        name = row.renderer + (" (in-sample)" if row.in_sample else "")
        ms = "" if row.ms is None else f"{row.ms:.1f}"
        figures = [f"{row.mae:.2f}", f"{row.psnr:.2f}", f"{row.ssim:.4f}", f"{row.ring_mae:.2f}", ms, ratio]
        lines.append([row.sensor, name, str(row.presses), *figures])
    return markdown(head, lines)


def _constant(presses: Presses) -> Renderer:
    return Renderer("background only", lambda k: presses.background, lambda image: image, timed=False)


def _ours(name: str, presses: Presses, *, shadow: bool = True) -> Renderer:
    """Height map -> contact -> picture by the project's renderer, with the real background at full size."""
    sensor, indenter = sensors.find_sensor(name), INDENTERS[name]
    unit, size = units.identity_unit(sensor), presses.background.shape[:2]
    behind = jnp.asarray(presses.background.transpose(2, 0, 1), jnp.float32) / 255
    cut = jax.jit(lambda c, r: calibration.ball_cut(c * PITCH, r * PITCH, indenter, size, PITCH))

    @jax.jit
    def draw(height: Any) -> Any:
        coarse = height.reshape(size[0] // COARSE, COARSE, size[1] // COARSE, COARSE).mean((1, 3))
        dent = calibration.settle(coarse, COARSE * PITCH, indenter.reach)
        return optics.render(dent, None, COARSE * PITCH, sensor, unit, resolution=size, shadow=shadow, behind=behind)

    def height(k: int) -> Any:
        return cut(jnp.asarray(presses.centre[k]), jnp.asarray(presses.radius[k]))

    return Renderer("ours" if shadow else "ours, no shadow", height, draw)


def _taxim(name: str, presses: Presses) -> list[Renderer]:
    """Taxim's own JAX renderer with and without shadow, and at the recorded centres where ours were moved."""
    try:
        from taxim.taxim_jax import TaximJax
    except ImportError as error:
        raise UserError("Taxim's own renderer comes with the package taxim: pip install taxim") from error
    folder = Path(str(files("taxim"))) / "calib" / name
    with jax.numpy_rank_promotion("allow"):  # Taxim relies on it; a strict caller stays strict elsewhere
        simulator = TaximJax(calib_folder=folder)
    gel = np.load(folder / "gelmap.npy").astype(np.float64) * simulator.sensor_params.pixmm
    ball = _taxim_ball(name, presses)
    gel -= gel.max()

    def draw(shadow: bool) -> Callable[[Any], Any]:
        def one(height: Any) -> Any:
            with jax.numpy_rank_promotion("allow"):
                return jnp.round(simulator.render_direct(height, with_shadow=shadow) * 255).astype(jnp.uint8)

        return one

    drawn = np.concatenate([presses.centre, presses.radius[:, None]], 1)
    circles = [("", drawn)]
    if not np.array_equal(drawn, presses.recorded):
        circles.append((", recorded circles", presses.recorded))

    def height(at: Array) -> Callable[[int], Any]:
        return lambda k: jnp.asarray(taxim_height(at[k, :2], at[k, 2], ball, gel), jnp.float32)

    return [
        Renderer(f"taxim{', shadow' if shadow else ''}{label}", height(at), draw(shadow), in_sample=True)
        for label, at in circles
        for shadow in (False, True)
    ]


def _taxim_ball(name: str, presses: Presses) -> float:
    """Radius in mm of the ball that the tables of `name` were made with.

    GelSight: published, 4.00 / 2 mm. Mini: unpublished; the last tilt that its table holds values for (bin 110 of 124
    over a quarter turn) at its largest circle gives 57.9 pixels.
    """
    if name == "gelsight":
        return INDENTERS[name].radius
    return float(presses.recorded[:, 2].max() * PITCH / np.sin(110 / 124 * np.pi / 2))


def taxim_height(centre: Array, radius: float, ball: float, gel: Array) -> Array:
    """Taxim's input (h, w) mm: the ball, placed so that it meets the undeformed `gel` (h, w) mm on the drawn circle.

    Taxim counts from the gel's highest point, smaller is nearer to the camera; both ball and `gel` do.
    """
    rows, columns = np.mgrid[: gel.shape[0], : gel.shape[1]]
    distance = np.hypot(columns - centre[0], rows - centre[1])
    on_circle = np.abs(distance - radius) < 1
    edge = np.sqrt(max(ball**2 - (radius * PITCH) ** 2, 1e-6))
    square = (distance * PITCH) ** 2
    height = edge - np.sqrt(np.maximum(ball**2 - square, 0)) + gel[on_circle].mean()
    return np.where(square < ball**2, height, 1.0)
