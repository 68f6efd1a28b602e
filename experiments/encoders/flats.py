"""Are flat contacts read flat? Depth and force of single objects, most of them with flat tops.

    python -m experiments.encoders.flats anytouch-tiny

Eight height maps are pressed into new devices of the six camera sensors, with the turns, places and
depths of training: a grid of studs of 4.8 mm, a punch of 6 mm, a ball of 6.35 mm, and a coin, a
screw, one stud, a key and cloth. They are none of those that the decoder was trained on, though
most families of `pressed` are like one of them. A row of `flats.jsonl` is an object. `filled` is
the median depth over contact as a ratio of the true one, so a contact that is read as a ring has
less than 1.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from tyro.conf import Positional

from anytouch_jax.config import SimulatedConfig
from anytouch_jax.fields.loss import TOUCHED
from anytouch_jax.nn.functional import build
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.sim import endless
from anytouch_jax.sim.batches import FIELDS, field_batch
from anytouch_jax.sim.recorder import RELIEF, SPACING, ball
from anytouch_jax.train.mesh import enable_compilation_cache
from anytouch_jax.weights.load import load_model
from anytouch_jax.weights.registry import locate
from experiments.benchmarks import machine
from experiments.command import run_script
from experiments.encoders import measure
from experiments.records import write_record

Array = npt.NDArray[Any]
BATCHES = 36  # of SIZE touches
SIZE = 32
LEAST = 0.1  # mm of a press that is scored


@dataclass(frozen=True)
class FlatOptions:
    """Measure depth and force of objects with flat tops."""

    model: Positional[str]  # Encoder that measures.
    picture: Path | None = None  # PNG of true depth above what was read.
    out: Path = Path("experiments/results/flats.jsonl")  # JSON lines.


def _flat(outside: Array, height: float) -> Array:
    """Return a flat top where the distance `outside` mm is negative, with sides of 75 degrees."""
    return -np.clip(3.7 * outside, 0, height)


def objects() -> dict[str, Array]:
    """Return the height maps (RELIEF, RELIEF) mm by name."""
    line = (np.arange(RELIEF) - (RELIEF - 1) / 2) * SPACING
    x, y = np.meshgrid(line, line)
    away = np.hypot(x, y)
    lattice = np.hypot(*(a - 8 * np.round(a / 8) for a in (x, y)))
    coin = np.zeros((RELIEF, RELIEF), np.uint8)
    cv2.putText(coin, "10", (130, 240), cv2.FONT_HERSHEY_SIMPLEX, 3.2, 255, 12, cv2.LINE_AA)
    coin = cv2.GaussianBlur(coin.astype(np.float32) / 255, (0, 0), 1.5)
    rim = np.clip(4 * (away - 9.0), 0, 1)
    turn = np.arcsin(np.clip(x / 3, -1, 1)) / (2 * math.pi)
    thread = np.abs((y / 0.8 - turn) % 1 - 0.5) * 2
    teeth = 0.9 * np.abs((x / 2.6) % 2 - 1)
    blade = np.maximum(np.abs(y) - 3.0, y - 3.0 + teeth)
    groove = np.clip(0.5 - 3 * (np.abs(y + 0.8) - 0.4), 0, 1)
    over = math.pi / 0.9
    cloth = np.maximum(
        np.abs(np.cos(over * x)) + 0.5 * np.cos(over * y + math.pi * np.round(0.9 * x)),
        np.abs(np.cos(over * y)) - 0.5 * np.cos(over * x + math.pi * np.round(0.9 * y)),
    )
    maps = {
        "studs": _flat(lattice - 2.4, 1.7),
        "punch": _flat(away - 3.0, 4.0),
        "ball": ball(6.35, RELIEF),
        "coin": 0.15 * np.maximum(coin, rim) - np.clip(4 * (away - 10.0), 0, 4),
        "screw": np.sqrt(np.clip(9 - x**2, 0, None)) - 3 - 0.45 * thread,
        "stud": _flat(away - 2.4, 1.7),
        "key": _flat(blade, 2.0) - 0.5 * groove,
        "cloth": 0.12 * cloth,
    }
    return {
        name: cv2.GaussianBlur(np.float32(one - one.max()), (0, 0), 1.0)
        for name, one in maps.items()
    }


def world_of(maps: dict[str, Array]) -> endless.World:
    """Return the world of these maps, of a hard material, and of the six camera sensors."""
    world = measure.world_of("test")
    count = len(maps)
    return world._replace(
        relief=np.stack([np.float16(one) for one in maps.values()]),
        material=np.tile(np.float32([2e6, 0.5]), (count, 1)),
        places=np.zeros((count, 1, 2), np.float32),
    )


def scores(model: Path, picture: Path | None) -> dict[str, dict[str, float]]:
    """Return the errors of an encoder by object, and of the studs by sensor too."""
    loaded = load_model(model)
    config = loaded.config.with_settings({"data.background": "subtract"})
    net = build(config.model)
    stored = loaded.metadata.get("fields", "{}")
    factors = json.loads(stored) if isinstance(stored, str) else stored
    maps = objects()
    names = tuple(maps)
    sensors = SimulatedConfig().sensors
    world = jax.device_put(world_of(maps))
    rows = jnp.array([config.model.sensor_row(name) for name in sensors])
    sampling = endless.Sampling(fields=FIELDS, coarse=0.0)
    params = {"touch": loaded.params["touch"], "fields": loaded.params["fields"]}

    @jax.jit
    def read(key: jax.Array, world: endless.World, params: Any) -> tuple[Any, ...]:
        touch = endless.sample_touches(key, world, sampling, SIZE)
        batch = field_batch(key, touch, rows[touch.sensor], config, SIZE)
        return (
            net.measure(params, normalise_touch(batch.clip), batch.sensor, batch.aspect),
            batch,
            (touch.object, touch.sensor[:, -1], touch.width[:, -1], touch.modulus[:, -1]),
        )

    found: dict[str, dict[str, list[float]]] = {}
    shown: dict[tuple[str, str], tuple[Array, Array]] = {}
    for number in range(BATCHES):
        key = jax.random.fold_in(jax.random.key(31), number)
        out, batch, (thing, sensor, width, stiff) = jax.device_get(read(key, world, params))
        for row in range(SIZE):
            one = jax.tree.map(lambda values, row=row: values[row], (out, batch))
            values = _errors(*one, float(width[row]), float(stiff[row]), factors)
            if values is None:
                continue
            name = names[thing[row]]
            kinds = [name, f"{name}, {sensors[sensor[row]]}"] if name == "studs" else [name]
            if name == "punch":
                kinds.append(f"punch, {sensors[sensor[row]]}")
            for kind in kinds:
                for title, value in values.items():
                    found.setdefault(kind, {}).setdefault(title, []).append(value)
            mm = float(width[row])
            shown[name, sensors[sensor[row]]] = (mm * one[1].depth, mm * one[0].depth)
    if picture is not None:
        _draw(picture, names, shown)
    return {
        kind: {title: float(_typical(title)(v)) for title, v in values.items()}
        | {"touches": float(len(next(iter(values.values()))))}
        for kind, values in sorted(found.items())
    }


def _typical(title: str) -> Any:
    """Return the mean of what is a ratio of touches or pixels, and the median of others."""
    return np.nanmean if title in ("iou", "inside", "force_in_2") else np.nanmedian


def _errors(
    out: Any, batch: Any, mm: float, stiff: float, factors: dict[str, float]
) -> dict[str, float] | None:
    """Return the errors of one touch in mm and parts, None of a touch that is too light."""
    touched = batch.pressure > TOUCHED
    true = mm * batch.depth
    if touched.sum() < 8 or true.max() < LEAST:
        return None
    read = mm * out.depth
    seen = out.contact > 0
    scale = stiff * mm**2 * 1e-3
    force = float(out.force[2] * scale)
    real = float(batch.force[2] * scale)
    log_std = math.sqrt(2) * math.exp(5 * math.tanh(float(out.force_log[1]) / 5))
    std = factors.get("normal", 1.0) * (force + 1e-3 * scale) * log_std
    # a deepest point of one pixel would be noise
    deepest = [float(np.partition(x[touched], -4)[-4]) for x in (true, read)]
    return {
        "deepest": deepest[0],
        "read": deepest[1],
        "deepest_error": abs(deepest[1] - deepest[0]),
        "deepest_ratio": deepest[1] / deepest[0],
        "filled": float(np.median(read[touched]) / np.median(true[touched])),
        "depth": float(np.abs(read - true)[touched].mean()),
        "iou": float((seen & touched).sum() / (seen | touched).sum()),
        "force_bias": force / max(real, 0.05) - 1,
        "force": abs(force - real) / max(real, 0.05),
        "force_in_2": float(abs(force - real) < 2 * std),
    }


def _draw(path: Path, names: tuple[str, ...], shown: dict[tuple[str, str], Any]) -> None:
    """Draw the true depth above the one that was read, of two sensors."""
    rows = []
    for sensor in ("digit", "gelsight_mini"):
        for part in (0, 1):
            cells = [shown.get((name, sensor), np.zeros((2, 56, 56)))[part] for name in names]
            rows.append(np.hstack([cv2.resize(cell, (112, 112)) for cell in cells]))
    cv2.imwrite(str(path), np.uint8(np.clip(40 + 200 * np.vstack(rows), 0, 255)))


def run(options: FlatOptions) -> int:
    """Print and store the errors."""
    enable_compilation_cache()
    found = scores(locate(options.model), options.picture)
    about = {"machine": dataclasses.asdict(machine.describe())}
    for name, values in found.items():
        write_record(options.out, name, about | values)
        print(name, {title: round(value, 3) for title, value in values.items()}, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(run_script(FlatOptions, run))
