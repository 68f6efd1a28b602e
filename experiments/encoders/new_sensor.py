"""A known sensor as if it was new: fitted from pictures of one device, adapted by simulation, asked for look-alikes.

    python -m experiments.encoders.new_sensor anytouch-tiny --minutes 8

A simulated device of DIGIT, GelSlim and 9DTact has hidden parameters. Its tokens are trained on simulated touches of
the fitted sensor alone. Then the device itself, of the hidden parameters, touches held-out objects: which of some 150
touches by other sensors is the same? The parts of the encoder that all sensors share have met the sensor in training.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import shutil
import time
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.config import UNIVERSAL
from anytouch_jax.encoder.adapt import save
from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.errors import CheckError
from anytouch_jax.evaluate.statistics import mean_interval
from anytouch_jax.fitting.fit import fit_sensor
from anytouch_jax.fitting.tokens import adapt_by_simulation
from anytouch_jax.fitting.touches import COUNT, SIZE, own_world
from anytouch_jax.sim import endless
from anytouch_jax.sim.endless import CAMERAS, Sampling
from anytouch_jax.sim.sensing.sensors import SENSORS, draw_unit
from anytouch_jax.train.mesh import enable_compilation_cache
from experiments.benchmarks import machine
from experiments.records import write_record

HIDDEN = ("digit", "gelslim", "9dtact")
BATCHES = 8


@partial(jax.jit, static_argnames="sampling")
def device_touches(key: Any, world: Any, unit: Any, sampling: Sampling) -> Any:
    """Return COUNT touches, each by a known sensor and by one device of family 0, which every touch shares."""
    drawn = endless.draw_touches(key, world, sampling, COUNT, 0)
    own = jax.tree.map(lambda old, one: old.at[:, 1].set(one), drawn.clip.unit, unit)
    numbers = jax.tree.map(lambda old, one: old.at[:, 1].set(one[0]), drawn.numbers, world.families)
    take = jax.vmap(jax.vmap(partial(endless.simulate_take, sampling=sampling)))
    out = take(drawn.clip._replace(unit=own), numbers, drawn.pitch)
    return out.image[:, :, 0], out.background, drawn.sensor, drawn.object


def study(
    encoder: Encoder, name: str, folder: Path, minutes: float, seed: int, ball_mm: float | None
) -> dict[str, Any]:
    """Return the scores of one hidden device."""
    known = tuple(other for other in CAMERAS if other != name)
    rng = np.random.default_rng([seed, 59])
    device = draw_unit(SENSORS[name], rng)
    device = device._replace(mirror=np.ones(2, np.float32), base=endless.untouched(SENSORS[name])[0],
                             offset=np.zeros(2, np.float32), rotation=np.float32(0))  # fmt: skip
    unit = jax.tree.map(jnp.asarray, device)
    touches = partial(device_touches, unit=unit, sampling=Sampling(takes=2, size=SIZE))
    root = jax.random.key(seed)
    own = partial(own_world, known=known)
    image, behind, *_ = jax.device_get(touches(jax.random.fold_in(root, 1), own(name, "train", ball_mm=ball_mm)))
    height, width = (round(SIZE * side / min(SENSORS[name].field)) for side in SENSORS[name].field)
    shown = [cv2.resize(one, (width, height)) for one in (behind[0, 1], *image[:18, 1])]
    mine, run = folder / f"my_{name}.sensor", folder / f"run_{name}"
    begun = time.monotonic()
    fitted = fit_sensor(shown[1:], f"new_{name.strip('9')}_unit", float(SENSORS[name].field[1] * device.zoom), mine,
                        background=shown[0], ball_mm=ball_mm)  # fmt: skip
    seconds = time.monotonic() - begun
    after, own_name, simulated = encoder, UNIVERSAL, None
    with contextlib.suppress(CheckError):  # the tokens were refused: the universal ones stay
        adapted = adapt_by_simulation(encoder.source, mine, minutes=minutes, known=known, seed=seed)
        assert adapted is not None
        shutil.rmtree(run, ignore_errors=True)
        save(adapted, encoder.source, run)
        after, own_name = load_encoder(run, engine="xla"), fitted.numbers.name
        simulated = [len(adapted.losses), adapted.before, adapted.after]
    rows = {"universal": encoder.config.model.universal_row, "own": encoder.sensor_row(name)}
    test, parts = own(name, "test"), []
    for number in range(BATCHES):
        image, behind, sensor, thing = jax.device_get(touches(jax.random.fold_in(root, 100 + number), test))
        use = sensor[:, 0] > 0
        ready = np.stack([encoder.prepare(a, b) for a, b in zip(image[use].reshape(-1, *image.shape[2:]),
                          behind[use].reshape(-1, *behind.shape[2:]), strict=True)])  # fmt: skip
        other = [encoder.sensor_row(known[n - 1]) for n in sensor[use][:, 0]]
        features = {"target": encoder.encode_touch(ready[::2], np.array(other, np.int32))}
        for kind, row in rows.items():
            features[kind] = encoder.encode_touch(ready[1::2], np.full(use.sum(), row, np.int32))
        features["adapted"] = after.encode_touch(ready[1::2], own_name)
        parts.append(features | {"object": thing[use]})
    joined = {kind: np.concatenate([part[kind] for part in parts]) for kind in parts[0]}
    objects = joined.pop("object")
    unit_norm = {kind: values / np.linalg.norm(values, axis=1, keepdims=True) for kind, values in joined.items()}
    target = unit_norm.pop("target")
    right = {kind: (z @ target.T).argmax(1) == np.arange(len(z)) for kind, z in unit_norm.items()}
    return {
        "touches": len(target), "fit_seconds": seconds, "simulated": simulated,
        "scores": {kind: {"share": float(one.mean()), "interval": mean_interval(one.astype(float), objects)}
                   for kind, one in right.items()},
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model")
    parser.add_argument("--sensors", nargs="*", default=HIDDEN, choices=CAMERAS)
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument("--ball-mm", type=float, help="press a ball instead of all kinds of objects")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=Path("runs/new_sensor"))
    parser.add_argument("--out", type=Path, default=Path("experiments/results/new_sensor.jsonl"))
    options = parser.parse_args()
    enable_compilation_cache()
    encoder = load_encoder(options.model, engine="xla")
    about = {"encoder": encoder.fingerprint, "machine": dataclasses.asdict(machine.describe())}
    for name in options.sensors:
        record = study(encoder, name, options.folder, options.minutes, options.seed, options.ball_mm)
        key = f"{name}, {'presses of a ball' if options.ball_mm else 'presses of objects'}"
        write_record(options.out, key, about | {"minutes": options.minutes} | record)
        print(name, record, flush=True)


if __name__ == "__main__":
    main()
