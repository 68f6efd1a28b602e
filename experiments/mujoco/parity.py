"""Is a press in a MuJoCo scene that of `simulate_touch`, and what does it cost?

    python -m experiments.mujoco.parity [digit ...] --poses 200
    python -m experiments.mujoco.parity --speed

A record a sensor: over shapes and poses the difference of the images inside the contact in grey
levels, the relative difference of the forces, and the indentation of MuJoCo's softened contact over
that of the gel. A record `friction` compares directions while an object slides. Speeds are a record
of their own.
"""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
import tyro

import anytouch_jax as at
from anytouch_jax.sim.endless import CAMERAS
from anytouch_jax.sim.mujoco import TouchSensor, nominal_unit
from anytouch_jax.sim.mujoco.gel import feel, unloaded
from anytouch_jax.sim.mujoco.pad import RayGrid, Rays
from experiments.benchmarks import machine
from experiments.command import run_script
from experiments.mujoco.scenes import MM, SHAPES, Shape, height_map, loaded, pressing_scene
from experiments.records import write_record

RESULTS = Path(__file__).parents[1] / "results" / "mujoco.jsonl"
SIZE = 112
Record = dict[str, Any]


@dataclass(frozen=True)
class Options:
    """Parity of presses in MuJoCo with `simulate_touch`, and their speed."""

    sensors: tyro.conf.Positional[tuple[str, ...]] = CAMERAS
    poses: int = 200
    speed: bool = False  # only the speed
    out: Path = RESULTS


def presses(
    sensor: str, shape: Shape, count: int, rng: np.random.Generator, simulate: Any
) -> dict[str, list]:
    """Return errors of `count` presses of a shape, each with a weight at a drawn place.

    `simulate` is `simulate_touch` of a height map and poses.
    """
    model, data = loaded(pressing_scene(shape, sensor))
    touch = TouchSensor(model, "pad", sensor, size=SIZE)
    # The object must rest where it was put: only z is free.
    model.dof_damping[[0, 1, 3]] = 1e3
    relief = height_map(shape)
    key = jax.random.split(jax.random.key(0), 2)[1]
    found: dict[str, list] = {"grey": [], "force": [], "rigid": []}
    for _ in range(count):
        mujoco.mj_resetData(model, data)
        touch.reset()
        data.qpos[:2] = rng.uniform(-3, 3, 2) * MM
        data.qpos[3] = rng.uniform(-np.pi, np.pi)
        newton = rng.uniform(0.2, 2.0)
        data.qfrc_applied[2] = -newton
        mujoco.mj_step(model, data, 400)
        mujoco.mj_forward(model, data)
        reading = touch.read(data, key)
        x, y = data.qpos[:2] / MM
        turn = data.qpos[3]
        c, s = np.cos(turn), np.sin(turn)
        # The place of the object's map that lies under the middle of the pad.
        pose = [-(c * x + s * y), s * x - c * y, turn, float(reading.indentation)]
        other = simulate(relief, np.asarray([pose], np.float32))
        pressure = np.asarray(other.pressure[0])
        inside = pressure > 0.02 * pressure.max()
        apart = np.abs(reading.image.astype(float) - np.asarray(other.image[0])).mean(-1)
        found["grey"].append(float(apart[inside].mean()))
        found["force"].append(float(reading.force[2] / newton - 1))
        found["rigid"].append(float(-data.qpos[2] / MM / reading.indentation))
    return found


def parity(options: Options, sensor: str) -> None:
    """Measure one sensor and write its record."""
    rng = np.random.default_rng(0)
    count = options.poses // len(SHAPES)
    shapes = {}
    unit = nominal_unit(sensor)
    simulate = jax.jit(
        lambda relief, pose: at.simulate_touch(relief, pose, sensor, size=SIZE, unit=unit)
    )
    for name, shape in SHAPES.items():
        found = presses(sensor, shape, count, rng, simulate)
        shapes[name] = {
            "poses": count,
            "grey": float(np.mean(found["grey"])),
            "grey_most": float(np.max(found["grey"])),
            "within": float(np.mean(np.array(found["grey"]) < 1)),
            "force": float(np.max(np.abs(found["force"]))),
            "rigid": float(np.median(found["rigid"])),
        }
        print(sensor, name, shapes[name], flush=True)
    write_record(options.out, sensor, {"kind": "parity", "size": SIZE, "shapes": shapes})


def friction(options: Options) -> None:
    """Compare the direction of friction while a ball slides with that of its velocity."""
    model, data = loaded(pressing_scene(SHAPES["ball"], "digit"))
    touch = TouchSensor(model, "pad", "digit", size=SIZE)
    model.dof_damping[:2] = 8
    rng = np.random.default_rng(0)
    off = {"velocity": [], "mujoco": []}
    for _ in range(40):
        mujoco.mj_resetData(model, data)
        touch.reset()
        data.qfrc_applied[2] = -1
        mujoco.mj_step(model, data, 300)
        touch.read(data)
        way = rng.uniform(-np.pi, np.pi)
        data.qfrc_applied[:2] = 1.2 * np.cos(way), 1.2 * np.sin(way)
        for _ in range(3):
            mujoco.mj_step(model, data, 10)
            reading = touch.read(data)
        along = np.arctan2(reading.force[1], reading.force[0])
        wrench = np.zeros(6)
        mujoco.mj_contactForce(model, data, 0, wrench)
        pull = data.contact[0].frame.reshape(3, 3).T @ wrench[:3]
        sign = 1 if model.geom(data.contact[0].geom[1]).name == "pad" else -1
        for name, vector in (("velocity", data.qvel[:2]), ("mujoco", sign * pull[:2])):
            turn = along - np.arctan2(vector[1], vector[0])
            off[name].append(abs(np.rad2deg((turn + np.pi) % (2 * np.pi) - np.pi)))
    most = {name: float(np.max(values)) for name, values in off.items()}
    print("friction", most, flush=True)
    write_record(options.out, "friction", {"kind": "friction", "degrees": most})


def speed(options: Options) -> None:
    """Time a step with its image, a batch, an untouched pad, and rays."""
    record: Record = {"kind": "speed", "machine": asdict(machine.describe())}
    for size in (112, 224):
        model, data = loaded(pressing_scene(SHAPES["ball"], "digit"))
        touch = TouchSensor(model, "pad", "digit", size=size)
        data.qfrc_applied[2] = -1
        mujoco.mj_step(model, data, 300)

        def step(model: Any = model, data: Any = data, touch: Any = touch) -> None:
            mujoco.mj_step(model, data)
            touch.read(data)

        record[f"step_{size}"] = timed(step)
        data.qpos[2] = 0.02
        mujoco.mj_forward(model, data)
        record[f"untouched_{size}"] = timed(lambda touch=touch, data=data: touch.read(data))
    record["batch_112"] = batched()
    record["rays"] = rays()
    print(record)
    write_record(options.out, "speed", record)


def timed(work: Any, most: float = 6.0) -> dict[str, float]:
    """Return seconds of processor and of the clock for a call: the medians."""
    work()
    walls = []
    cpus = []
    end = time.perf_counter() + most
    while len(walls) < 200 and (time.perf_counter() < end or len(walls) < 20):
        wall = time.perf_counter()
        cpu = time.process_time()
        work()
        walls.append(time.perf_counter() - wall)
        cpus.append(time.process_time() - cpu)
    return {
        "seconds": float(np.median(walls)),
        "least": float(np.min(walls)),
        "processor": float(np.median(cpus)),
    }


def batched(count: int = 32) -> dict[str, float]:
    """Return what a pad takes of contact and rendering, in two threads with half the batch each."""
    model, data = loaded(pressing_scene(SHAPES["ball"], "digit"))
    touch = TouchSensor(model, "pad", "digit", size=SIZE)
    view = touch.view
    data.qfrc_applied[2] = -1
    mujoco.mj_step(model, data, 300)
    (met,) = touch.meet(data)
    assert met is not None
    states, contacts = jax.tree.map(
        lambda one: np.stack([one] * (count // 2)), (unloaded(view), met.contact)
    )
    keys = jax.random.split(jax.random.key(0), count // 2)
    program = jax.jit(
        jax.vmap(
            lambda state, contact, key: feel(
                touch.device, state, contact, key, touch.background, view
            )
        )
    )

    def half(_: int) -> None:
        jax.block_until_ready(program(states, contacts, keys))

    with ThreadPoolExecutor(2) as pool:
        found = timed(lambda: list(pool.map(half, range(2))))
    return {name: value / count for name, value in found.items()}


def rays() -> dict[str, float]:
    """Return seconds of a height map of 84 x 64 points: at once, and by a ray a call."""
    line = (np.arange(64) - 31.5) * 0.2 * MM
    x, y = np.meshgrid(line, np.linspace(-1, 1, 84) * 0.009)
    found = {}
    for name, shape in SHAPES.items():
        model, data = loaded(pressing_scene(shape, "digit"))
        mujoco.mj_forward(model, data)
        geom = model.geom("object").id
        work = partial(Rays(model).along, data, 0, [geom], RayGrid(x, y))
        found[name] = timed(work, 1.0)["processor"]
    one = np.zeros(1, np.int32)

    def loop() -> None:
        for a, b in zip(x.ravel(), y.ravel(), strict=True):
            start = np.array([a, b, -0.05])
            mujoco.mj_ray(model, data, start, np.array([0.0, 0, 1]), None, True, 1, one)

    found["a ray a call"] = timed(loop, 2.0)["processor"]
    return found


def run(options: Options) -> int:
    """Measure."""
    if options.speed:
        speed(options)
        return 0
    friction(options)
    for sensor in options.sensors:
        parity(options, sensor)
    return 0


if __name__ == "__main__":
    raise SystemExit(run_script(Options, run))
