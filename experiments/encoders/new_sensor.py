"""A known sensor as if it was new: fitted from images of one device, adapted by simulation, then
asked.

    python -m experiments.encoders.new_sensor anytouch-tiny --minutes 4

A simulated device of DIGIT, GelSlim and 9DTact has hidden parameters. Its tokens are trained on
simulated touches of the fitted sensor alone. Then the device itself, of the hidden parameters,
touches held-out objects: which of some 150 touches by other sensors is the same, how deep, and how
hard? A GelSight Mini is fitted to real images, and asked for real objects. The parts of the
encoder that all sensors share have met every sensor in training. But those of commit 7546a43 had
not met the colours that a GelSight Mini has now:

    python -m experiments.encoders.new_sensor WEIGHTS --sensors gelsight_mini --ball-mm 6.31 --title
    "colours unseen"
"""

from __future__ import annotations

import argparse
import dataclasses
import shutil
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.config import UNIVERSAL
from anytouch_jax.data.images import decode
from anytouch_jax.encoder.adapt import save
from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.evaluate.statistics import mean_interval
from anytouch_jax.sim import endless
from anytouch_jax.sim.batches import FIELDS, field_batch, prepared
from anytouch_jax.sim.endless import CAMERAS, Sampling
from anytouch_jax.sim.fitting.fit import fit_sensor
from anytouch_jax.sim.fitting.tokens import adapt_by_simulation
from anytouch_jax.sim.fitting.touches import COUNT, SIZE, own_world
from anytouch_jax.sim.sensing.sensors import SENSORS, draw_unit
from anytouch_jax.train.mesh import enable_compilation_cache
from experiments.benchmarks import machine
from experiments.encoders.measure import subtracted, touch_errors
from experiments.real import recordings
from experiments.real.features import encoder_features
from experiments.real.scores import other_finger_score
from experiments.records import write_record

HIDDEN = ("digit", "gelslim", "9dtact")
REAL = "gelsight_mini"
# to fit a sensor to; their least score of contact; of touches
IMAGES = 18
PRESSED = 7.0
BATCHES = 8


@partial(jax.jit, static_argnames="sampling")
def device_touches(key: Any, world: Any, unit: Any, sampling: Sampling) -> Any:
    """Return COUNT touches, each by a known sensor and by one device of family 0, which every touch
    shares.
    """
    drawn = endless.draw_touches(key, world, sampling, COUNT, 0)
    own = jax.tree.map(lambda old, one: old.at[:, 1].set(one), drawn.clip.unit, unit)
    numbers = jax.tree.map(lambda old, one: old.at[:, 1].set(one[0]), drawn.numbers, world.families)
    return endless.simulate_drawn(
        drawn._replace(clip=drawn.clip._replace(unit=own), numbers=numbers), sampling
    )


def adapted_to(  # noqa: PLR0913, what a study varies
    encoder: Encoder,
    images: list[np.ndarray],
    gel: np.ndarray,
    width_mm: float,
    name: str,
    folder: Path,
    minutes: float,
    seed: int,
    ball_mm: float | None = None,
) -> tuple[Encoder, str, dict[str, Any]]:
    """Return an encoder with tokens for the sensor of these images, the name of the tokens, and
    how it was fitted.

    Tokens that are not shown to find more touches than the universal ones are not kept: then the
    universal ones stay.
    """
    mine = folder / f"my_{name}.sensor"
    run = folder / f"run_{name}"
    fitted = fit_sensor(
        images, f"new_{name.strip('9')}_unit", width_mm, mine, background=gel, ball_mm=ball_mm
    )
    about: dict[str, Any] = {"simulated": None}
    known = tuple(other for other in CAMERAS if other != name)
    adapted = adapt_by_simulation(encoder.source, mine, minutes=minutes, known=known, seed=seed)
    assert adapted is not None
    if adapted.metadata["source"]["tokens"] == UNIVERSAL:
        return encoder, UNIVERSAL, about
    shutil.rmtree(run, ignore_errors=True)
    save(adapted, encoder.source, run)
    about["simulated"] = [len(adapted.losses), adapted.before, adapted.after]
    return load_encoder(run, engine="xla"), fitted.numbers.name, about


def study(
    encoder: Encoder, name: str, folder: Path, minutes: float, seed: int, ball_mm: float | None
) -> dict[str, Any]:
    """Return the scores of one hidden device."""
    known = tuple(other for other in CAMERAS if other != name)
    rng = np.random.default_rng([seed, 59])
    device = draw_unit(SENSORS[name], rng)
    device = device._replace(
        mirror=np.ones(2, np.float32),
        base=endless.untouched(SENSORS[name])[0],
        offset=np.zeros(2, np.float32),
        rotation=np.float32(0),
    )
    sampling = Sampling(takes=2, size=SIZE, fields=FIELDS)
    touches = partial(device_touches, unit=jax.tree.map(jnp.asarray, device), sampling=sampling)
    root = jax.random.key(seed)
    own = partial(own_world, known=known)
    first = jax.device_get(
        touches(jax.random.fold_in(root, 1), own(name, "train", ball_mm=ball_mm))
    )
    height, width = (round(SIZE * side / min(SENSORS[name].field)) for side in SENSORS[name].field)
    seen = (first.background[0, 1], *first.clip[:IMAGES, 1, -1])
    gel, *images = (cv2.resize(one, (width, height)) for one in seen)
    width_mm = float(SENSORS[name].field[1] * device.zoom)
    after, own_name, about = adapted_to(
        encoder, images, gel, width_mm, name, folder, minutes, seed, ball_mm
    )
    rows = {
        "universal": (encoder, encoder.config.model.universal_row),
        "adapted": (after, after.sensor_row(own_name)),
        "own": (encoder, encoder.sensor_row(name)),
    }
    test = own(name, "test")
    config = subtracted(encoder.config)
    parts = []
    errors = {kind: list[dict[str, np.ndarray]]() for kind in rows}
    for number in range(BATCHES):
        found = touches(key := jax.random.fold_in(root, 100 + number), test)
        batch = jax.device_get(
            field_batch(key, found, jnp.zeros((COUNT, 2), jnp.int32), config, COUNT)
        )
        found = jax.device_get(found)
        use = found.sensor[:, 0] > 0
        known_clip = prepared(key, found.clip[:, 0], found.background[:, 0], config, jitter=False)
        other = [encoder.sensor_row(known[n - 1]) for n in found.sensor[use][:, 0]]
        features = {
            "target": encoder.encode_touch(np.asarray(known_clip)[use], np.array(other, np.int32))
        }
        for kind, (reader, row) in rows.items():
            numbers = np.full(COUNT, row, np.int32)
            features[kind] = reader.encode_touch(batch.clip, numbers)[use]
            out = reader.encode_and_measure(batch.clip, numbers, batch.aspect)[1]
            errors[kind].append(touch_errors(out, batch, found.width[:, 1], found.modulus[:, 1]))
        parts.append(features | {"object": found.object[use]})
    joined = {kind: np.concatenate([part[kind] for part in parts]) for kind in parts[0]}
    objects = joined.pop("object")
    unit_norm = {
        kind: values / np.linalg.norm(values, axis=1, keepdims=True)
        for kind, values in joined.items()
    }
    target = unit_norm.pop("target")
    right = {kind: (z @ target.T).argmax(1) == np.arange(len(z)) for kind, z in unit_norm.items()}
    return about | {
        "touches": len(target),
        "scores": {
            kind: {
                "fraction": float(one.mean()),
                "interval": mean_interval(one.astype(float), objects),
            }
            for kind, one in right.items()
        },
        "depth": {kind: _mean(of, "depth") for kind, of in errors.items()},
        "force": {kind: _mean(of, "force") for kind, of in errors.items()},
    }


def _mean(errors: list[dict[str, np.ndarray]], name: str) -> dict[str, Any]:
    values = np.concatenate([one[name] for one in errors], dtype=float)
    return {
        "fraction": float(values.mean()),
        "interval": mean_interval(values, np.arange(len(values))),
    }


def real_study(
    encoder: Encoder, pack: Path, folder: Path, minutes: float, seed: int
) -> dict[str, Any]:
    """Return scores on real objects of a GelSight Mini whose look is fitted to its real images of
    training.
    """
    data = recordings.read(pack)
    score = data.manifest.number_column("label.contact_score")
    pressed = np.flatnonzero((data.split == "train") & (data.finger == "cam0") & (score > PRESSED))
    gel_name = data.manifest.text_column("background_path")[pressed]
    pressed = pressed[gel_name == np.unique(gel_name)[-1]]
    chosen = np.random.default_rng(seed).choice(pressed, IMAGES, replace=False)
    gel = data.backgrounds.shared(lambda image: image)(chosen[0])
    assert gel is not None
    images = [decode(data.manifest.file(row)) for row in chosen]
    width_mm = SENSORS[REAL].field[1]
    after, own_name, about = adapted_to(encoder, images, gel, width_mm, REAL, folder, minutes, seed)
    rows = {"universal": (encoder, UNIVERSAL), "adapted": (after, own_name), "own": (encoder, REAL)}
    found = {
        kind: other_finger_score(encoder_features(reader, data, sensor=name), data)
        for kind, (reader, name) in rows.items()
    }
    return about | {
        "scores": {
            kind: {"fraction": one.fraction, "interval": one.interval()}
            for kind, one in found.items()
        }
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model")
    parser.add_argument(
        "--sensors", nargs="*", default=(*HIDDEN, "real"), choices=(*HIDDEN, REAL, "real")
    )
    parser.add_argument(
        "--title",
        default="",
        help="of the encoder in the table, where it is not that of the package",
    )
    parser.add_argument(
        "--data",
        type=Path,
        default=Path("../shared/real_touch2/manifest.csv"),
        help="real recordings",
    )
    parser.add_argument("--minutes", type=float, default=8.0)
    parser.add_argument(
        "--ball-mm", type=float, help="press a ball instead of all kinds of objects"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--folder", type=Path, default=Path("runs/new_sensor"))
    parser.add_argument("--out", type=Path, default=Path("experiments/results/new_sensor.jsonl"))
    options = parser.parse_args()
    enable_compilation_cache()
    encoder = load_encoder(options.model, engine="xla")
    about = {"encoder": encoder.fingerprint, "machine": dataclasses.asdict(machine.describe())}
    for name in options.sensors:
        if name == "real":
            key = f"{REAL}, real objects by the other finger"
            record = real_study(
                encoder, options.data, options.folder, options.minutes, options.seed
            )
        else:
            key = f"{name}, {'presses of a ball' if options.ball_mm else 'presses of objects'}"
            record = study(
                encoder, name, options.folder, options.minutes, options.seed, options.ball_mm
            )
        key += f", {options.title}" * bool(options.title)
        write_record(options.out, key, about | {"minutes": options.minutes} | record)
        print(name, record, flush=True)


if __name__ == "__main__":
    main()
