"""Benchmarks of the simulator: time a frame against the error, for each fidelity, grid and number of iterations."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from anytouch_jax.errors import UserError
from anytouch_jax.sim.contact.mechanics import Fidelity, Gel, PressResult, press
from anytouch_jax.sim.contact.shear import Shear, shear_step
from anytouch_jax.sim.recorder import Recorder
from anytouch_jax.sim.scene import Scenes, draw_recording, draw_touch, objects_and_splits
from anytouch_jax.sim.sensing.optics import render
from anytouch_jax.sim.sensing.sensors import SENSORS, identity_unit

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
