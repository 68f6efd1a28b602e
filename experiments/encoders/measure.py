"""Deviations and errors of the depth, shear, contact and force that an encoder reads.

    python -m experiments.encoders.measure train anytouch-tiny --minutes 75 --out runs/anytouch-tiny
    python -m experiments.encoders.measure calibrate runs/anytouch-tiny
    python -m experiments.encoders.measure test anytouch-tiny

`train` trains the decoder alone, so features stay as they are. `calibrate` scales the deviations on
objects of the validation split, and writes the folder again. `test` measures errors on objects of
the test split, by sensor, and writes `measure.jsonl`. Both see new units of the sensors only.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.batch import FieldBatch
from anytouch_jax.config import Config, SimulatedConfig, parse_json
from anytouch_jax.data.background.dots import DotFlow
from anytouch_jax.fields.loss import LEAST_FORCE, TOUCHED, output_terms
from anytouch_jax.fields.measure import Measure, Scale, border_in_contact, interval_of
from anytouch_jax.fields.outputs import FORCE, LENGTH, STATES, TORQUE, FieldOutput
from anytouch_jax.nn.functional import build
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.sim import endless, scene
from anytouch_jax.sim.batches import FIELDS, field_batch, misregistered_background
from anytouch_jax.train.loop import fit
from anytouch_jax.train.mesh import enable_compilation_cache
from anytouch_jax.train.progress import to_stderr as log
from anytouch_jax.weights.load import load_model
from anytouch_jax.weights.registry import PARTS, locate, write_encoder
from experiments.benchmarks import machine
from experiments.encoders.pressed import draw_maps
from experiments.records import write_record

UNIVERSAL = 0.25  # fraction of the touches that get the universal tokens
DEEPER = 0.35  # fraction of the touches that are pressed deeper than for the encoder
MAPS = 336  # further height maps, beside 308 objects
REUSE = 2  # steps in which a simulated batch is used, on average
POOL = 64  # batches to draw from, of stills and of clips
HEADS_FIRST = 0.03  # of the time, in which only the last layers are trained
LAST = ("maps", "slope", "press", "whole")
SETTINGS: dict[str, Any] = {
    "data.background": "either",
    "data.batch_size": 24,
    "optim.learning_rate": 4e-4,
    "optim.warmup": 40,
    "optim.grad_clip": 20.0,
    "optim.weight_decay": 0.0,
    "run.steps": 100_000,
    "run.save_every": 200,
    "run.keep": 1,
    "run.figure_every": 0,
}
STIFFNESS = 0.15  # deviation of the logarithm of the modulus among gels of a family
QUANTITIES = ("depth", "shear", "normal", "tangential", "torque", "slip")


def sampling(frames: int, *, wild: float, free: float) -> endless.Sampling:
    """Return what is simulated for a batch of stills or clips."""
    return endless.Sampling(frames=frames, wild=wild, free=free, fields=FIELDS)


def world_of(split: Any, variants: int = 1, sensors: tuple[str, ...] = ()) -> endless.World:
    """Return the world of the objects of a split, with those kinds held out that training of the
    encoder held out.
    """
    settings = SimulatedConfig()
    scenes = scene.Scenes(objects=settings.objects, seed=settings.seed, depth=settings.depth)
    things = endless.objects_of(scenes, split, variants=variants)
    return jax.device_put(endless.make_world(things, sensors or settings.sensors))


def batches(
    world: endless.World,
    config: Config,
    count: int,
    seed: int,
    number: int = 0,
    *,
    moved: bool = False,
    **options: float,
) -> Iterator[FieldBatch]:
    """Yield batches with normalised pixels and sensor rows: three of stills, which cost less, then
    one of clips.
    """
    rows = np.array(
        [config.model.sensor_row(name) for name in SimulatedConfig().sensors]
        + [config.model.universal_row]
    )

    @partial(jax.jit, static_argnums=(2,))
    def make(key: jax.Array, world: endless.World, frames: int) -> FieldBatch:
        draw, prepare, toss = jax.random.split(key, 3)
        touches = endless.sample_touches(draw, world, sampling(frames, **options), count)
        if moved:
            touches = misregistered_background(jax.random.fold_in(key, 7), touches)
        batch = field_batch(prepare, touches, jnp.asarray(rows)[touches.sensor], config, count)
        own = jax.random.uniform(toss, (count,)) >= UNIVERSAL
        sensor = jnp.where(own, batch.sensor, config.model.universal_row)
        return batch._replace(clip=normalise_touch(batch.clip), sensor=sensor)

    while True:
        frames = config.model.frames if number % 4 == 3 else 1
        yield make(jax.random.fold_in(jax.random.key(seed), number), world, frames)
        number += 1


def calibrate(folder: Path) -> None:
    """Scale the deviations on the validation split, and write the encoder again with its card."""
    loaded = load_model(folder)
    errors = collect(loaded.params, subtracted(loaded.config), "val", 24)
    factors = {
        name: float(np.quantile(np.abs(values["error"]) / values["deviation"], 0.68))
        for name, values in errors.items()
    }
    log(f"deviations are multiplied by {factors}")
    rewrite(
        folder, folder, dataclasses.replace(loaded, metadata={**loaded.metadata, "fields": factors})
    )


def scale(folder: Path, factor: float) -> None:
    """Multiply the depth that an encoder reads, and write it again with its card.

    All else that it reads stays, because the layer that takes depth divides by the factor.
    """
    loaded = load_model(folder)
    fields = jax.tree.map(lambda value: np.array(value), loaded.params["fields"])
    for name, outputs in (("slope", slice(0, 2)), ("maps", slice(0, 1))):
        fields[name]["kernel"][:, outputs] *= factor
        fields[name]["bias"][outputs] *= factor
    fields["press"]["up"]["kernel"][-1] /= factor
    params = loaded.params | {"fields": fields}
    rewrite(folder, folder, dataclasses.replace(loaded, params=params))


def deepened(key: jax.Array, drawn: endless.DrawnTouches) -> endless.DrawnTouches:
    """Return touches of which a part is pressed deeper, up to three quarters of the gel.

    Real fingers press thick gels by 2 mm. The world of the encoder ends at 1 mm.
    """
    toss, stretch = jax.random.split(key)
    count = drawn.sensor.shape
    deeper = jax.random.uniform(toss, count) < DEEPER
    factor = jnp.where(deeper, jax.random.uniform(stretch, count, minval=1.0, maxval=2.4), 1.0)
    most = 0.75 * drawn.numbers.gel[..., 1] * drawn.clip.unit.thickness
    depth = jnp.minimum(drawn.clip.depth * factor[..., None], most[..., None])
    return drawn._replace(clip=drawn.clip._replace(depth=depth))


def pressed_world(maps: int) -> endless.World:
    """Return the world of the objects that training of the encoder had, and of `maps` others.

    Most of the others have flat tops (`pressed`). They are of hard materials.
    """
    world = world_of("train")
    hard = np.random.default_rng(74).uniform(0.2, 0.9, maps)
    material = np.stack([np.full(maps, 2e6), hard], 1).astype(np.float32)
    return world._replace(
        relief=jnp.concatenate([world.relief, draw_maps(maps, 75)]),
        material=jnp.concatenate([world.material, material]),
        places=jnp.concatenate([world.places, jnp.zeros((maps, *world.places.shape[1:]))]),
    )


class Sampled(NamedTuple):
    """A batch to train the decoder on, with the states of the frozen encoder."""

    states: jax.Array
    batch: FieldBatch


def sampler(
    world: endless.World, config: Config, touch: Any
) -> Callable[[jax.Array, int], Sampled]:
    """Return a function of a key and the frames of a clip that simulates and encodes a batch."""
    net = build(config.model)
    rows = np.array(
        [config.model.sensor_row(name) for name in SimulatedConfig().sensors]
        + [config.model.universal_row]
    )
    count = config.data.batch_size

    @partial(jax.jit, static_argnums=(3,))
    def make(key: jax.Array, world: endless.World, touch: Any, frames: int) -> Sampled:
        draw, prepare, toss, move, deep = jax.random.split(key, 5)
        sampled = sampling(frames, wild=0.2, free=0.12)
        drawn = deepened(deep, endless.draw_touches(draw, world, sampled, count))
        touches = misregistered_background(move, endless.simulate_drawn(drawn, sampled))
        batch = field_batch(prepare, touches, jnp.asarray(rows)[touches.sensor], config, count)
        own = jax.random.uniform(toss, (count,)) >= UNIVERSAL
        sensor = jnp.where(own, batch.sensor, config.model.universal_row)
        batch = batch._replace(clip=normalise_touch(batch.clip), sensor=sensor)
        encoder = net.bind({"touch": touch}).touch
        return Sampled(encoder.states(batch.clip, batch.sensor, STATES), batch)

    return lambda key, frames: make(key, world, touch, frames)


def train(model: str, minutes: float, out: Path) -> None:
    """Train the decoder on endless touches and untouched gels that moved a little, and write the
    encoder to `out`.

    The encoder is frozen. Each batch is trained on REUSE times, at random distances, because its
    simulation and its states cost half of a step.
    """
    path = locate(model)
    loaded = load_model(path)
    folder = path if path.is_dir() else path.parent
    config, net = loaded.config.with_settings(SETTINGS), build(loaded.config.model)
    make = sampler(pressed_world(MAPS), config, jax.device_put(loaded.params["touch"]))
    frames = (1, 1, 1, config.model.frames)

    def stream(start: int, stop: int) -> Iterator[tuple[int, Any, dict[str, Any]]]:
        rng = np.random.default_rng([76, start])
        pools: dict[int, list[Sampled]] = {}
        for step in range(start, stop):
            pool = pools.setdefault(frames[step % 4], [])
            number = step // 4
            if number % REUSE == 0 or not pool:
                key = jax.random.fold_in(jax.random.key(76), step)
                pool.append(make(key, frames[step % 4]))
                del pool[:-POOL]
            yield step, pool[int(rng.integers(len(pool)))], {}

    def loss(params: Any, sampled: Sampled, key: Any, progress: Any) -> tuple[Any, dict[str, Any]]:
        batch = sampled.batch
        # What was trained already waits until the last layers have met the new touches.
        begun = progress > HEADS_FIRST
        fields = {
            name: value
            if name in LAST
            else jax.tree.map(lambda x: jnp.where(begun, x, jax.lax.stop_gradient(x)), value)
            for name, value in params["fields"].items()
        }
        decoder = net.bind({"fields": fields}).fields
        outputs = decoder.with_slope(sampled.states, batch.clip, batch.aspect)
        return output_terms(*outputs, batch)

    result = fit(
        config,
        params={"fields": loaded.params["fields"]},
        loss_fn=loss,
        batches=stream,
        run_dir=out.with_name("run"),
        until=time.monotonic() + 60 * minutes,
        log=log,
    )
    log(f"{result.step} steps of {config.data.batch_size}, {result.metrics}")
    rewrite(
        folder,
        out,
        dataclasses.replace(loaded, params=loaded.params | jax.device_get(result.params)),
    )


def rewrite(folder: Path, out: Path, loaded: Any) -> None:
    """Write an encoder with the card of `folder` to `out`."""
    card = parse_json((folder / "config.json").read_text())
    config = dataclasses.replace(loaded.config, stage=card["stage"]).with_settings(
        {"run.steps": card["steps"]}
    )
    notes = Path(__file__).with_name("anytouch-tiny.md").read_text(encoding="utf-8")
    full = dataclasses.replace(loaded, config=config)
    tokenizer = None if out == folder else folder / "tokenizer.json"
    write_encoder(out, full, notes, parts=(*PARTS, "fields"), tokenizer=tokenizer)


def subtracted(config: Config) -> Config:
    """Return the configuration of a user who has the image of the untouched gel."""
    return config.with_settings({"data.background": "subtract"})


def collect(
    params: Any, config: Config, split: str, count: int, size: int = 32
) -> dict[str, dict[str, np.ndarray]]:
    """Return errors and deviations of every quantity, in units of the outputs, over new touches of
    a split.
    """
    net = build(config.model)
    measure = jax.jit(net.measure)
    errors: dict[str, dict[str, list[np.ndarray]]] = {
        name: {"error": [], "deviation": []} for name in QUANTITIES
    }
    source = batches(world_of(split), config, size, 7, wild=0.0, free=0.0)
    for _ in range(count):
        batch = next(source)
        out = jax.device_get(measure(params, batch.clip, batch.sensor, batch.aspect))
        batch = jax.device_get(batch)
        touched = batch.pressure > TOUCHED
        normal = np.log((out.force[:, 2] + LEAST_FORCE) / (batch.force[:, 2] + LEAST_FORCE))
        slip = 1 / (1 + np.exp(-out.slip)) - batch.slip
        pairs = {
            "depth": ((out.depth - batch.depth)[touched] / LENGTH, out.depth_log[touched]),
            "shear": (
                (out.shear - batch.shear)[touched] / LENGTH,
                out.shear_log[touched][:, None].repeat(2, 1),
            ),
            "normal": (normal, out.force_log[:, 1]),
            "tangential": (
                (out.force - batch.force)[:, :2] / FORCE,
                out.force_log[:, :1].repeat(2, 1),
            ),
            "torque": ((out.torque - batch.torque) / TORQUE, out.torque_log),
            "slip": (slip, out.slip_log),
        }
        for name, (error, log_scale) in pairs.items():
            errors[name]["error"].append(error.ravel())
            errors[name]["deviation"].append(
                np.sqrt(2) * np.exp(5 * np.tanh(log_scale / 5)).ravel()
            )
    return {
        name: {part: np.concatenate(rows) for part, rows in both.items()}
        for name, both in errors.items()
    }


def scores(
    params: Any, config: Config, sensor: str, factors: dict[str, float], touches: int = 192
) -> dict[str, float]:
    """Return the errors of one sensor on new units and objects of the test split, stills and clips
    together.

    `false_contact` and `false_force` are fractions of gels that nothing touches, but that moved a
    little since the image of them: those with a pixel of contact, and those with more than 0.05
    N.
    """
    world = world_of("test", sensors=(sensor,))
    row = config.model.sensor_row(sensor)
    size = 32
    measure = jax.jit(build(config.model).measure)
    sample = jax.jit(endless.sample_touches, static_argnums=(2, 3))

    def read(number: int, frames: int, free: float) -> tuple[Any, ...]:
        key = jax.random.fold_in(jax.random.key(11), number)
        touch = sample(key, world, sampling(frames, wild=0, free=free), size)
        touch = misregistered_background(key, touch) if free else touch
        batch = field_batch(key, touch, jnp.full((size, 1), row), config, size)
        out = measure(params, normalise_touch(batch.clip), batch.sensor, batch.aspect)
        return tuple(jax.device_get((out, batch, touch)))

    rows: dict[str, list[np.ndarray]] = {}
    for number in range(touches // size):
        fields, batch, touch = read(number, (1, config.model.frames)[number % 2], 0)
        found = touch_errors(
            fields, batch, touch.width[:, -1], touch.modulus[:, -1], factors["depth"]
        )
        stiffness = np.exp(STIFFNESS * np.random.default_rng(number).standard_normal(size))
        found["covered"] = covered_forces(fields, batch, stiffness, factors["normal"])
        out, _, free = read(1000 + number, 1, 1)
        newton = np.abs(out.force[:, 2]) * free.modulus[:, -1] * free.width[:, -1] ** 2 * 1e-3
        found |= {"false_contact": (out.contact > 0).any((1, 2)), "false_force": newton > 0.05}
        for name, value in (found | dots_errors(fields, batch, touch)).items():
            rows.setdefault(name, []).append(np.asarray(value, np.float64).ravel())
    joined = {name: np.concatenate(parts) for name, parts in rows.items()}
    return {
        name: float(np.median(v) if name == "force" else v.mean())
        for name, v in joined.items()
        if len(v)
    }


def covered_forces(
    out: FieldOutput, batch: FieldBatch, stiffness: np.ndarray, factor: float
) -> np.ndarray:
    """Return which true forces lie in the 90 % interval of a device of a known family.

    Args:
        out: what was read of touches.
        batch: the touches.
        stiffness: of each gel, over that of its family (B,).
        factor: on the deviations of normal forces.
    """
    deviation = factor * np.sqrt(2) * np.exp(5 * np.tanh(out.force_log[:, 1] / 5))
    at_border = border_in_contact(1 / (1 + np.exp(-out.contact)))
    low, high = interval_of(out.force[:, 2], deviation, "family", 0.0, at_border)
    true = batch.force[:, 2] * stiffness
    enough = (batch.pressure > TOUCHED).sum((1, 2)) >= 8
    return ((low <= true) & (true <= high))[enough]


def dots_errors(out: FieldOutput, batch: FieldBatch, touch: Any) -> dict[str, np.ndarray]:
    """Return where shear and force along gels with dots are within 20 degrees, and within one
    deviation.
    """
    found = {name: [np.zeros(0)] for name in ("dots_shear", "dots_inside", "drag", "drag_inside")}
    aspects = np.exp(batch.aspect)
    for row, (gel, clip, width) in enumerate(
        zip(touch.background[:, -1], touch.clip[:, -1], touch.width, strict=True)
    ):
        size = 240, max(1, round(240 * float(aspects[row])))
        gel, frame = (
            cv2.resize(one, size, interpolation=cv2.INTER_CUBIC) for one in (gel, clip[-1])
        )
        if not DotFlow(gel):
            continue
        scale = Scale(
            float(width[-1]),
            float(touch.modulus[row, -1]),
            0.0,
            None,
            dict.fromkeys(QUANTITIES, 1.0),
        )
        measure = Measure(scale, "simulated", gel, lambda _: None, 0, "none")
        one = measure(FieldOutput._make(value[row : row + 1] for value in out), [frame])
        true = batch.shear[row] * scale.width
        touched = batch.pressure[row] > TOUCHED
        moved = touched & (np.linalg.norm(true, axis=-1) > 0.1)
        found["dots_shear"].append((_apart(one.shear[0], true) < 20)[moved])
        found["dots_inside"].append(
            (np.abs(one.shear[0] - true).mean(-1) < one.shear_std[0])[touched]
        )
        newton = np.array([touch.labels[f"force_{axis}"][row, -1, -1] for axis in "xy"])
        if np.linalg.norm(newton) > 0.1:
            found["drag"].append(_apart(one.force[:, :2], newton) < 20)
            found["drag_inside"].append(
                (np.abs(one.force[0] - [*newton, 0]) < one.force_std[0])[:2]
            )
    return {name: np.concatenate(parts) for name, parts in found.items()}


def touch_errors(
    out: FieldOutput, batch: FieldBatch, width: np.ndarray, stiff: np.ndarray, factor: float = 1.0
) -> dict[str, np.ndarray]:
    """Return errors of what was read of touches, of gels that are `width` mm wide and `stiff` kPa.

    A touch that shows fewer than 8 pixels of contact has no error of depth, overlap and force.
    """
    touched = batch.pressure > TOUCHED
    pixels = (slice(None), None, None)
    depth, true = out.depth * width[pixels], batch.depth * width[pixels]
    seen = out.contact > 0
    enough = touched.sum((1, 2)) >= 8
    fraction = (np.abs(depth - true) * touched).sum((1, 2)) / np.maximum(touched.sum((1, 2)), 1)
    either = (seen | touched).sum((1, 2))
    scale = stiff * width**2 * 1e-3
    force, real = out.force[:, 2] * scale, batch.force[:, 2] * scale
    deviation = np.sqrt(2) * np.exp(5 * np.tanh(out.depth_log / 5)) * LENGTH * factor
    inside = np.abs(out.depth - batch.depth)[touched] < deviation[touched]
    values = {
        "depth": fraction[enough],
        "relative": (fraction / np.maximum(true.max((1, 2)), 1e-3))[enough],
        "iou": ((seen & touched).sum((1, 2)) / np.maximum(either, 1))[enough],
        "inside": inside,
        "force": (np.abs(force - real) / np.maximum(real, 0.05))[enough],
    }
    if batch.clip.shape[1] > 1:
        moved = touched & (np.linalg.norm(batch.shear, axis=-1) * width[pixels] > 0.1)
        values["shear"] = _apart(out.shear, batch.shear)[moved] < 20
    return values


def _apart(a: Any, b: Any) -> Any:
    """Return degrees between vectors (..., 2), 180 where `a` has no length."""
    angle = np.arctan2(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0], (a * b).sum(-1))
    return np.where(np.any(a, -1), np.degrees(np.abs(angle)), 180)


def test(model: Path, out: Path) -> None:
    """Write the errors of an encoder that measures, sensor by sensor."""
    loaded = load_model(locate(str(model)))
    config = subtracted(loaded.config)
    params = {"touch": loaded.params["touch"], "fields": loaded.params["fields"]}
    stored = loaded.metadata.get("fields", "{}")
    factors = dict.fromkeys(QUANTITIES, 1.0) | (
        json.loads(stored) if isinstance(stored, str) else stored
    )
    for sensor in SimulatedConfig().sensors:
        record = {"machine": dataclasses.asdict(machine.describe())} | scores(
            params, config, sensor, factors
        )
        write_record(out, sensor, record)
        print(
            sensor,
            {name: round(value, 3) for name, value in record.items() if isinstance(value, float)},
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(dest="command", required=True)
    zeroth = commands.add_parser("train", help="train the decoder of an encoder")
    zeroth.add_argument("model", type=Path)
    zeroth.add_argument("--minutes", type=float, default=75.0)
    zeroth.add_argument(
        "--out", type=Path, required=True, help="folder to write, named as the encoder"
    )
    first = commands.add_parser("calibrate", help="scale the deviations of an encoder's folder")
    first.add_argument("model", type=Path)
    third = commands.add_parser("scale", help="multiply the depth that an encoder's folder reads")
    third.add_argument("model", type=Path)
    third.add_argument("factor", type=float)
    second = commands.add_parser(
        "test", help="measure errors on objects that training never touched"
    )
    second.add_argument("model", type=Path)
    second.add_argument("--out", type=Path, default=Path("experiments/results/measure.jsonl"))
    given = parser.parse_args()
    enable_compilation_cache()
    if given.command == "train":
        train(str(given.model), given.minutes, given.out)
    elif given.command == "calibrate":
        calibrate(given.model)
    elif given.command == "scale":
        scale(given.model, given.factor)
    else:
        test(given.model, given.out)


if __name__ == "__main__":
    main()
