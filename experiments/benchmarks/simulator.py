"""Benchmarks of the simulator: its mechanics against a converged solution, its pictures against real presses.

Mechanics: time a frame against the error, for each fidelity, grid and number of iterations.

Pictures: held-out ball presses, compared with Taxim's own renderer in the same run. Both renderers start from a height
map of 480 x 640 samples of the same press and end with a picture of 480 x 640 pixels. They are timed alternately. Ours
was fitted on the even presses and is scored on the odd ones. Taxim's tables were made from all presses, so its figures
are in-sample. Both have the real background frame.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.statistics import markdown_table
from anytouch_jax.sim.contact.mechanics import Fidelity, Gel, PressResult, press
from anytouch_jax.sim.contact.shear import Shear, shear_step
from anytouch_jax.sim.recorder import Recorder
from anytouch_jax.sim.scene import Scenes, draw_recording, draw_touch, objects_and_splits
from anytouch_jax.sim.sensing import optics, sensors
from anytouch_jax.sim.sensing.optics import render
from anytouch_jax.sim.sensing.sensors import SENSORS, identity_unit
from experiments.benchmarks import presses as real
from experiments.benchmarks.presses import COARSE, INDENTERS, PITCH, Presses

Fields = npt.NDArray[Any]
Surface = Callable[[Fields, Fields], Fields]
SENSOR = SENSORS["gelsight_mini"]  # its gel and its optics; a bonded layer, as every sensor's
LEVELS = 2  # grey levels that a pixel of the reference's picture must differ from the untouched one's to be scored


def _sphere(x: Fields, y: Fields) -> Fields:
    return -(x**2 + y**2) / 8


def _textured(x: Fields, y: Fields) -> Fields:
    return np.where(np.maximum(abs(x), abs(y)) < 5, -0.1 * (1 - np.cos(4 * x) * np.cos(4 * y)), -np.inf)


def _edge(x: Fields, y: Fields) -> Fields:
    return -0.6 * abs(0.9 * x + 0.44 * y)


def _ring(x: Fields, y: Fields) -> Fields:
    return -((np.hypot(x, y) - 3) ** 2) / 1.2


SCENES: Mapping[str, Surface] = {"sphere": _sphere, "textured flat": _textured, "edge": _edge, "ring": _ring}


@dataclass(frozen=True)
class SolverVariant:
    """A way to solve: `grid` pixels a side; `iterations` None is the fidelity's own."""

    fidelity: Fidelity
    grid: int
    iterations: int | None = None


VARIANTS = (
    *(SolverVariant("exact", grid) for grid in (56, 112, 224)),
    *(SolverVariant("exact", 112, iterations) for iterations in (4, 8, 16)),
    *(SolverVariant("fast", grid) for grid in (56, 112, 224)),
    *(SolverVariant("fast", 112, iterations) for iterations in (1, 4, 8)),
)


@dataclass(frozen=True)
class FidelityRow:
    """A variant's figures; errors are over the reference's largest displacement, of the worst scene unless noted.

    `press_ms`, `shear_ms`: median milliseconds a frame of one step, a batch of all scenes at a time. `rms`, `largest`:
    scene -> error of the normal displacement, brought to the reference's grid by cubic interpolation. `shear`: the
    root mean square of the tangential one. `slip`: of the share of the contact that slips, in points. `force`: of the
    normal force, over the force. `converged`: of the scenes.
    `image`: scene -> mean absolute error in grey levels (0..255) of the picture rendered from the variant's own grid,
    and that of the reference, over the pixels that the touch changes.
    """

    fidelity: str
    grid: int
    iterations: int | None
    press_ms: float
    shear_ms: float
    rms: dict[str, float]
    largest: dict[str, float]
    shear: float
    slip: float
    force: float
    converged: int
    image: dict[str, float]


@dataclass(frozen=True)
class PressSetting:
    """What all variants solve: a square field in mm, a depth in mm, a motion (mm, mm, rad), friction, a gel."""

    size: float = 16.0
    depth: float = 0.4
    motion: tuple[float, float, float] = (0.15, 0.05, 0.02)
    friction: float = 0.6
    gel: Gel = SENSOR.gel


def speed_against_error(
    variants: Sequence[SolverVariant] = VARIANTS,
    scenes: Mapping[str, Surface] = SCENES,
    *,
    setting: PressSetting | None = None,
    reference: int = 224,
    rounds: int = 9,
) -> list[FidelityRow]:
    """Time a frame and error of every variant, against the converged float64 solution on `reference` pixels a side.

    The variants take turns, `rounds` times, in this process. `scenes`: name -> height in mm of x, y in mm, arrays.
    Raises UserError without a variant, a scene or a round.
    """
    if not variants or not scenes or rounds < 1:
        raise UserError("a table of speed against error needs at least one variant, one scene and one round")
    setting = PressSetting() if setting is None else setting
    right = _references(setting, scenes.values(), reference)
    solved = [_solvers(setting, variant, scenes) for variant in variants]
    result = [(pressed(), sheared()) for pressed, sheared in solved]  # compiles
    times = np.zeros((rounds, len(variants), 2))
    for turn in range(rounds):
        for number, pair in enumerate(solved):
            for kind, solve in enumerate(pair):
                start = time.perf_counter()
                jax.block_until_ready(solve())
                times[turn, number, kind] = time.perf_counter() - start
    milliseconds = np.median(times, 0) * 1e3 / len(scenes)
    return [
        _row(variant, setting, milliseconds[number], list(scenes), *result[number], right)
        for number, variant in enumerate(variants)
    ]


class Solution(NamedTuple):
    """Displacement (H, W) and tangential displacement (H, W, 2) in mm, force in N, share of the contact that slips."""

    displacement: Fields
    tangential: Fields
    force: float
    slip: float


def _heights(setting: PressSetting, surface: Surface, grid: int) -> Fields:
    axis = ((np.arange(grid) + 0.5) / grid - 0.5) * setting.size
    return surface(*np.meshgrid(axis, axis))


def _references(setting: PressSetting, surfaces: Iterable[Surface], grid: int) -> list[Solution]:
    pitch, gel, friction, result = setting.size / grid, setting.gel, setting.friction, []

    def solve(heights: Array) -> tuple[PressResult, Shear]:
        contact = press(heights, setting.depth, gel, pitch, tolerance=1e-6, iterations=1000)
        slid = shear_step(None, contact, setting.motion, gel, pitch, friction, tolerance=1e-4, iterations=1000)
        return contact, slid

    with jax.enable_x64(True):
        solved = jax.jit(solve)
        for surface in surfaces:
            contact, slid = solved(jnp.asarray(_heights(setting, surface, grid)))
            if not (bool(contact.converged) and bool(slid.converged)):
                raise UserError("the reference did not converge: take a coarser one, or a smoother scene")
            fields = np.asarray(contact.displacement), np.asarray(slid.displacement)
            result.append(Solution(*fields, float(contact.force), float(slid.slip_fraction)))
    return result


def _solvers(
    setting: PressSetting, variant: SolverVariant, scenes: Mapping[str, Surface]
) -> tuple[Callable[[], PressResult], Callable[[], Shear]]:
    pitch, gel = setting.size / variant.grid, setting.gel
    fidelity, iterations = variant.fidelity, variant.iterations
    heights = np.stack([_heights(setting, surface, variant.grid) for surface in scenes.values()])
    surfaces = jnp.asarray(heights, jnp.float32)

    def push(heights: Array) -> PressResult:
        return press(heights, setting.depth, gel, pitch, fidelity=fidelity, iterations=iterations)

    def slide(contact: PressResult) -> Shear:
        most = None if iterations is None else 3 * iterations  # as in the fidelities' own numbers for `fast`
        friction, motion = setting.friction, setting.motion
        return shear_step(None, contact, motion, gel, pitch, friction, fidelity=fidelity, iterations=most)

    pressed = jax.jit(jax.vmap(push))
    sheared, contact = jax.jit(jax.vmap(slide)), pressed(surfaces)
    return lambda: pressed(surfaces), lambda: sheared(contact)


def _row(
    variant: SolverVariant,
    setting: PressSetting,
    milliseconds: Fields,
    names: list[str],
    contact: PressResult,
    slid: Shear,
    right: list[Solution],
) -> FidelityRow:
    rms, largest, image, shear, slip, force = {}, {}, {}, 0.0, 0.0, 0.0
    bare = _picture(np.zeros_like(right[0][0]), np.zeros_like(right[0][1]), setting)
    for number, name in enumerate(names):
        displacement, tangential, load, slipping = right[number]
        moved = _resized(contact.displacement[number], displacement.shape)
        dragged = _resized(slid.displacement[number], tangential.shape)
        error, top = moved - displacement, displacement.max()
        rms[name], largest[name] = float(np.sqrt(np.mean(error**2)) / top), float(abs(error).max() / top)
        shear = max(shear, float(np.sqrt(np.mean((dragged - tangential) ** 2)) / abs(tangential).max()))
        slip = max(slip, abs(float(slid.slip_fraction[number]) - slipping))
        force = max(force, abs(float(contact.force[number]) / load - 1))
        own = _picture(contact.displacement[number], slid.displacement[number], setting)
        image[name] = _picture_error(own, _picture(displacement, tangential, setting), bare)
    press_ms, shear_ms = map(float, milliseconds)
    converged = int(np.sum(np.asarray(contact.converged)))
    return FidelityRow(
        **dataclasses.asdict(variant),
        press_ms=press_ms,
        shear_ms=shear_ms,
        rms=rms,
        largest=largest,
        shear=shear,
        slip=slip,
        force=force,
        converged=converged,
        image=image,
    )


@functools.cache
def _renderer() -> Callable[..., Array]:
    unit = identity_unit(SENSOR)._replace(marked=np.float32(1))  # markers, no noise
    return jax.jit(lambda displacement, tangential, pitch: render(displacement, tangential, pitch, SENSOR, unit))


def _picture(displacement: Any, tangential: Any, setting: PressSetting) -> Fields:
    """What the sensor sees of displacements (h, w) and (h, w, 2) in mm, f32 (H, W, 3) in grey levels."""
    fields = (jnp.asarray(values, jnp.float32) for values in (displacement, tangential))
    return np.asarray(_renderer()(*fields, setting.size / len(displacement)), np.float32)


def pareto_points(rows: Sequence[FidelityRow]) -> dict[str, tuple[float, float]]:
    """Return (ms a frame, worst rms error in %) of every variant by name."""
    points = {}
    for row in rows:
        name = f"{row.fidelity} {row.grid}" + ("" if row.iterations is None else f", {row.iterations}")
        points[name] = (row.press_ms + row.shear_ms, 100 * max(row.rms.values()))
    return points


def _picture_error(result: Fields, right: Fields, bare: Fields) -> float:
    """Mean absolute difference over the pixels that the touch changes by more than `LEVELS`; 0 where there are none."""
    changed = abs(right - bare).max(-1) > LEVELS
    return float(abs(result - right)[changed].mean()) if changed.any() else 0.0


def _resized(values: Any, shape: tuple[int, ...]) -> Fields:
    return np.asarray(jax.image.resize(values, shape, "cubic"))


@dataclass(frozen=True)
class Recorded:
    """Whole recordings by `sensor` (or all of them, two at a time, as `simulate` does): frames a second."""

    sensor: str
    frames_per_second: float


def recording_speed(
    sensors: Sequence[str] = ("gelsight_mini", "digit", "gelslim", "duragel"),
    *,
    batch: int = 8,
    frames: int = 10,
    size: int = 224,
    rounds: int = 9,
) -> list[Recorded]:
    """Frames a second of the default fidelity when compiled: contact, shear with its history, picture and labels.

    Batches of recordings of `frames` frames with a short side of `size` pixels, as `simulate` makes them; the median
    over `rounds`, all in turns.
    """
    scenes = Scenes(touches=batch, sensors=tuple(sensors), frames=frames, size=size)
    objects, splits = objects_and_splits(scenes)
    touches = [draw_touch(scenes, number, splits) for number in range(batch)]
    asked = {name: [draw_recording(scenes, touch, name) for touch in touches] for name in sensors}
    recorder = Recorder(scenes, objects, batch)
    taken: dict[str, list[float]] = {name: [] for name in (*sensors, "all, two at a time")}
    with ThreadPoolExecutor(2) as pool:
        for turn in range(rounds + 1):
            ways = {name: [one] for name, one in asked.items()} | {"all, two at a time": list(asked.values())}
            for name, several in ways.items():
                start = time.perf_counter()
                list(pool.map(recorder.record, several))
                if turn:  # the first one compiles
                    taken[name].append(len(several) * batch * frames / (time.perf_counter() - start))
    return [Recorded(name, float(np.median(values))) for name, values in taken.items()]


def recording_table(rows: Sequence[Recorded]) -> str:
    """A table with a line a sensor."""
    cells = [(one.sensor, f"{one.frames_per_second:.0f}") for one in rows]
    return markdown_table(("recordings by", "frames/s"), cells) + "\n"


def fidelity_table(rows: Sequence[FidelityRow]) -> str:
    """A table with a line a variant; errors in percent of the largest displacement, or grey levels of the picture
    (see `FidelityRow.image`), times in milliseconds a frame."""
    names = list(rows[0].rms) if rows else []
    heads = ["fidelity", "grid", "iterations", "press ms", "shear ms"]
    heads += [f"{name}: rms / max %" for name in names] + ["shear rms %", "slip points", "force %", "converged"]
    heads += [f"{name}: picture" for name in names]
    lines = []
    for row in rows:
        cells = [row.fidelity, str(row.grid), "own" if row.iterations is None else str(row.iterations)]
        cells += [f"{row.press_ms:.2f}", f"{row.shear_ms:.2f}"]
        cells += [f"{100 * row.rms[name]:.2f} / {100 * row.largest[name]:.2f}" for name in names]
        cells += [
            f"{100 * row.shear:.2f}",
            f"{100 * row.slip:.1f}",
            f"{100 * row.force:.2f}",
            f"{row.converged} of {len(row.rms)}",
        ]
        lines.append(cells + [f"{row.image[name]:.2f}" for name in names])
    return markdown_table(heads, lines) + "\n"


# Pictures against real ones -------------------------------------------------------------------------------------------

SSIM_SIGMA, SSIM_C1, SSIM_C2 = 1.5, (0.01 * 255) ** 2, (0.03 * 255) ** 2  # Wang et al. 2004


@dataclass(frozen=True)
class PressScore:
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


def score_presses(
    names: Sequence[str] = tuple(INDENTERS), *, limit: int | None = None, rivals: bool = True
) -> list[PressScore]:
    """Score the renderers on the odd presses of each sensor; `limit` of them, without Taxim where `rivals` is false.

    Raises UserError for a sensor without real presses, or without the package `taxim`.
    """
    rows: list[PressScore] = []
    for name in names:
        presses = real.read_presses(name)
        which = real.halves(len(presses.radius))[1][:limit]
        renderers = [_constant(presses), _ours(name, presses), _ours(name, presses, shadow=False)]
        if rivals:
            renderers += _taxim(name, presses)
        rows += compare_renderers(name, presses, which, renderers)
    return rows


def compare_renderers(sensor: str, presses: Presses, which: Fields, renderers: Sequence[Renderer]) -> list[PressScore]:
    """Draw each press in `which` with each renderer in turn; a first drawing that is not counted compiles."""
    if len(which) == 0:
        raise UserError(f"there is no press of {sensor} to score")
    measures: dict[str, list[Fields]] = {r.name: [] for r in renderers}
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
            measures[renderer.name].append(image_errors(drawn, presses.frames[k], presses.centre[k], presses.radius[k]))
    rows = []
    for r in renderers:
        mae, psnr, ssim, ring = (float(x) for x in np.mean(measures[r.name], axis=0))
        ms = float(np.median(clock[r.name])) if r.timed else None
        rows.append(PressScore(sensor, r.name, len(which), mae, psnr, ssim, ring, ms, r.in_sample))
    return rows


def image_errors(image: Fields, real: Fields, centre: Fields, radius: float) -> Fields:
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


def ssim_map(a: Fields, b: Fields) -> Fields:
    """Structural similarity (h, w, c) of two u8 images in Gaussian windows of 1.5 pixels (Wang et al. 2004)."""
    x, y = a.astype(np.float64), b.astype(np.float64)

    def mean(image: Fields) -> Fields:
        return cv2.GaussianBlur(image, (11, 11), SSIM_SIGMA)

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
    numerator = (2 * mx * my + SSIM_C1) * (2 * cov + SSIM_C2)
    return np.asarray(numerator / ((mx**2 + my**2 + SSIM_C1) * (vx + vy + SSIM_C2)))


def press_table(rows: Sequence[PressScore]) -> str:
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
    return markdown_table(head, lines)


def _constant(presses: Presses) -> Renderer:
    return Renderer("background only", lambda k: presses.background, lambda image: image, timed=False)


def _ours(name: str, presses: Presses, *, shadow: bool = True) -> Renderer:
    """Height map -> contact -> picture by the project's renderer, with the real background at full size."""
    sensor, indenter = SENSORS[name], INDENTERS[name]
    unit, size = sensors.identity_unit(sensor), presses.background.shape[:2]
    model = real.fit_photometry(name)[0 if shadow else 1]
    behind = jnp.asarray(presses.background.transpose(2, 0, 1), jnp.float32) / 255
    cut = jax.jit(lambda c, r: real.ball_cut(c * PITCH, r * PITCH, indenter, size, PITCH))

    @jax.jit
    def draw(height: Any) -> Any:
        coarse = height.reshape(size[0] // COARSE, COARSE, size[1] // COARSE, COARSE).mean((1, 3))
        dent = real.settle(coarse, COARSE * PITCH, indenter.reach)
        return optics.render(dent, None, COARSE * PITCH, sensor, unit, resolution=size, photometry=model, behind=behind)

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

    def height(at: Fields) -> Callable[[int], Any]:
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


def taxim_height(centre: Fields, radius: float, ball: float, gel: Fields) -> Fields:
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
