"""The encoder in the package, carried over to another look of a simulated sensor without forgetting the others.

    git show 7546a43:src/anytouch_jax/sim/sensing/looks.npz > runs/before.npz
    python -m experiments.encoders.carry --before runs/before.npz --contrast 0.68 --minutes 42 --out runs/carried \
        --real data/real/pack1/manifest.csv data/real/pack2/manifest.csv

A third of the touches are by the sensor. The encoder learns to have of its new picture the features that the encoder
in the package has of its old picture of the same touch. Of other sensors, mixed ones and real recordings it keeps the
features. Depth and force are trained at the same time, with true values.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.batch import FieldBatch
from anytouch_jax.config import SimulatedConfig
from anytouch_jax.data.gels import UnitGels
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.transforms import UNTOUCHED
from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.nn.functional import Net, build
from anytouch_jax.objectives import field_terms, normalise_touch
from anytouch_jax.sim import endless
from anytouch_jax.sim.scene import Scenes
from anytouch_jax.sim.sensing.sensors import Photometry
from anytouch_jax.simulated import FIELDS, field_batch
from anytouch_jax.train.loop import fit
from anytouch_jax.train.mesh import enable_compilation_cache
from anytouch_jax.train.progress import to_stderr as log
from anytouch_jax.weights.load import load_model
from anytouch_jax.weights.registry import DEFAULT, PARTS, locate, write_encoder
from experiments.encoders.measure import UNIVERSAL

HALF, REAL = 12, 14  # touches of a batch by the sensor, and as many by any; real ones
SETTINGS: dict[str, Any] = {
    "data.background": "either", "data.batch_size": 2 * HALF + REAL, "optim.learning_rate": 2e-4, "optim.warmup": 40,
    "optim.grad_clip": 1.0, "optim.weight_decay": 0.0, "run.steps": 100_000, "run.save_every": 0, "run.keep": 1,
    "run.figure_every": 0, "run.seed": 61,
}  # fmt: skip


class RealFrames(NamedTuple):
    """Frames in order: pictures u8 (n, S, S, 3), rows, aspects and the first frames of their recordings (n,)."""

    subtracted: Any
    plain: Any
    row: Any
    aspect: Any
    first: Any


SAMPLING = endless.Sampling(free=0.04, fields=FIELDS, depth=(0.15, 1.3))


def take(drawn: endless.DrawnTouches, sampling: endless.Sampling) -> endless.SimulatedTouches:
    """Simulate drawn touches."""
    simulate = jax.vmap(jax.vmap(partial(endless.simulate_take, sampling=sampling)))
    out, field = simulate(drawn.clip, drawn.numbers, drawn.pitch), drawn.numbers.field
    return endless.SimulatedTouches(
        out.image, out.background, drawn.sensor, drawn.object, drawn.photo, out.field[:, :, -1],
        field[..., 1] * drawn.clip.unit.zoom, jnp.log(field[..., 0] / field[..., 1]), drawn.numbers.gel[..., 0],
        out.labels,
    )  # fmt: skip


def read_real(encoder: Encoder, paths: Sequence[Path]) -> RealFrames:
    """Return all frames of the train splits of manifests, on the device."""
    rows, start = [list[Any]() for _ in RealFrames._fields], 0
    for path in paths:
        table = manifests.read(path)
        sensors = table.text_column("sensor")
        gel, sequence = UnitGels(table).shared(lambda picture: picture), table.codes("sequence", own=True)
        order = np.lexsort((table.number_column("frame_index"), sequence))
        order = order[table.text_column("split")[order] == "train"]
        for row in order.tolist():
            frame = decode(table.file(row))
            first = start + int(np.flatnonzero(sequence[order] == sequence[row])[0])
            values = (
                encoder.prepare(frame, gel(row)), encoder.prepare(frame), encoder.sensor_row(sensors[row]),
                np.float32(np.log(frame.shape[0] / frame.shape[1])), first,
            )  # fmt: skip
            for column, value in zip(rows, values, strict=True):
                column.append(value)
        start += len(order)
    return RealFrames(*(jnp.asarray(np.stack(column)) for column in rows))


def draw_real(key: Any, real: RealFrames, frames: int) -> tuple[Any, Any, Any]:
    """Return REAL clips u8 in other light and another place, with or without the untouched gel, rows and aspects."""
    which, toss, gain, colour, level, scale, shift = jax.random.split(key, 7)
    size, side = (REAL, 1, 1, 1), real.plain.shape[1]
    number = jax.random.randint(which, (REAL,), 0, len(real.plain))
    clip = jnp.maximum(number[:, None] + jnp.arange(1 - frames, 1), real.first[number][:, None])
    subtract = jax.random.bernoulli(toss, 0.6, (*size, 1))
    x = jnp.where(subtract, real.subtracted[clip], real.plain[clip]).astype(jnp.float32) - UNTOUCHED
    x = x * jnp.exp(0.15 * jax.random.normal(gain, (*size, 1)) + 0.08 * jax.random.normal(colour, (*size, 3)))
    x = x + 3.0 * jax.random.normal(level, (*size, 3))

    def moved(clip: Any, zoom: Any, place: Any) -> Any:
        return jax.image.scale_and_translate(clip, clip.shape, (1, 2), zoom, side / 2 * (1 - zoom) + place, "linear")

    zoom = jnp.exp(jax.random.uniform(scale, (REAL, 2), minval=-0.05, maxval=0.2))
    x = jax.vmap(moved)(x, zoom, jax.random.uniform(shift, (REAL, 2), minval=-10, maxval=10))
    return jnp.round(jnp.clip(x + UNTOUCHED, 0, 255)).astype(jnp.uint8), real.row[number], real.aspect[number]


def away(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return one minus the cosine of features (n, d)."""
    a, b = (x / jnp.linalg.norm(x, axis=-1, keepdims=True) for x in (a, b))
    return 1 - jnp.sum(a * b, -1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--before", type=Path, required=True, help="looks.npz with the look that the encoder knows")
    parser.add_argument("--contrast", type=float, default=1.0, help="of that look over that of now")
    parser.add_argument("--sensor", default="gelsight_mini", choices=endless.CAMERAS)
    parser.add_argument("--real", nargs="+", type=Path, required=True, help="manifests of real recordings")
    parser.add_argument("--init", default=DEFAULT, help="weights to start from")
    parser.add_argument("--minutes", type=float, default=42.0)
    parser.add_argument("--out", type=Path, default=Path("runs/carried"))
    given = parser.parse_args()
    enable_compilation_cache()
    loaded, usual = load_model(locate(DEFAULT)), SimulatedConfig()
    things = endless.objects_of(Scenes(objects=usual.objects, seed=usual.seed, depth=usual.depth), "train", variants=2)
    world = jax.device_put(endless.make_world(things, usual.sensors))
    alone = jax.device_put(endless.make_world(things, (given.sensor,)))._replace(relief=world.relief)
    with np.load(given.before) as pack:
        old = Photometry(*(jnp.asarray(pack[f"{given.sensor}.{part}"], jnp.float32) for part in Photometry._fields))
    config = loaded.config.with_settings(SETTINGS)
    model, net = config.model, build(config.model)
    rows = jnp.array([*map(model.sensor_row, usual.sensors), model.universal_row])
    real = read_real(load_encoder(DEFAULT), given.real)
    teacher = jax.device_put({"touch": loaded.params["touch"], "fields": loaded.params["fields"]})

    @partial(jax.jit, static_argnums=5)
    def make(key: Any, world: Any, alone: Any, real: RealFrames, teacher: Any, frames: int) -> tuple[Any, ...]:
        first, second, prepare, toss, third = jax.random.split(key, 5)
        sampling = dataclasses.replace(SAMPLING, frames=frames)
        drawn = endless.draw_touches(first, alone, sampling, HALF)
        unit = drawn.clip.unit
        known = drawn._replace(
            clip=drawn.clip._replace(unit=unit._replace(gain=unit.gain * given.contrast)),
            numbers=drawn.numbers._replace(photometry=jax.tree.map(
                lambda x, y: jnp.broadcast_to(y, x.shape), drawn.numbers.photometry, old)),
        )  # fmt: skip
        rest = endless.sample_touches(second, world, dataclasses.replace(sampling, wild=0.25), HALF)
        row = jnp.full((HALF, 1), model.sensor_row(given.sensor))
        new, seen = (field_batch(prepare, take(each, sampling), row, config, HALF) for each in (drawn, known))
        others = field_batch(prepare, rest, rows[rest.sensor], config, HALF)
        batch = FieldBatch(*(jnp.concatenate(pair) for pair in zip(new, others, strict=True)))
        recorded, row, aspect = draw_real(third, real, frames)
        sensor, aspect = (jnp.concatenate(pair) for pair in ((batch.sensor, row), (batch.aspect, aspect)))
        sensor = jnp.where(jax.random.uniform(toss, sensor.shape) >= UNIVERSAL, sensor, model.universal_row)
        seen, clip = (normalise_touch(jnp.concatenate([*clips, recorded]))
                      for clips in ((seen.clip, others.clip), (batch.clip,)))  # fmt: skip
        targets = net.encode_and_measure(teacher, seen, sensor, aspect)[:2]
        return batch._replace(sensor=sensor[: 2 * HALF]), clip, sensor, aspect, targets

    def stream(start: int, stop: int) -> Iterator[tuple[int, Any, dict[str, Any]]]:
        for step in range(start, stop):
            key = jax.random.fold_in(jax.random.key(6161), step)
            yield step, make(key, world, alone, real, teacher, model.frames if step % 4 == 3 else 1), {}

    def loss(params: Any, batch: Any, key: Any, progress: Any) -> tuple[Any, dict[str, Any]]:
        touches, clip, sensor, aspect, (token, mean) = batch
        own, pooled, out = net.encode_and_measure(params, clip, sensor, aspect)
        out = jax.tree.map(lambda x: x[: 2 * HALF], out)
        fields, metrics = field_terms(params, touches, net=cast(Net, SimpleNamespace(measure=lambda *_: out)))
        apart = away(own, token) + away(pooled, mean)
        parts = {"new": apart[:HALF], "held": apart[HALF : 2 * HALF], "real": apart[2 * HALF :]}
        return 10 * jnp.mean(apart) + 0.2 * fields, metrics | {name: jnp.mean(x) for name, x in parts.items()}

    begun = load_model(locate(given.init)).params
    params = {part: begun[part] for part in teacher}
    until = time.monotonic() + 60 * given.minutes
    result = fit(config, params=params, loss_fn=loss, batches=stream, run_dir=given.out / "run", until=until, log=log)
    log(f"{result.step} steps, {result.metrics}")
    card = json.loads((locate(DEFAULT).parent / "config.json").read_text())
    full = dataclasses.replace(
        loaded, params=loaded.params | jax.device_get(result.params),
        config=dataclasses.replace(loaded.config, stage=card["stage"]).with_settings({"run.steps": card["steps"]}),
    )  # fmt: skip
    notes = Path(__file__).with_name(f"{DEFAULT}.md").read_text(encoding="utf-8")
    write_encoder(given.out / DEFAULT, full, notes, parts=(*PARTS, "fields"),
                  tokenizer=locate(DEFAULT).parent / "tokenizer.json")  # fmt: skip


if __name__ == "__main__":
    main()
