"""Stage 1 where something touches: masks and losses weighted by contact.

    python -m experiments.encoders.by_contact data/corpus/00000/manifest.parquet

A small encoder learns still pictures, one a simulated recording. A patch has contact if it differs from the untouched
gel. Its chance to be hidden, or its weight in the loss, is raised. All ways are judged alike, on objects of their own
with masks by pure chance. A line for each way and seed goes to `by_contact.jsonl`, and `make results` makes the page
from that file alone.
"""

from __future__ import annotations

import sys
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from tyro.conf import Positional

from anytouch_jax import objectives
from anytouch_jax.batch import TouchBatch
from anytouch_jax.config import Config, Stack, preset
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.transforms import subtract_background
from anytouch_jax.encoder.arrays import unit_rows
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import build
from anytouch_jax.ops import tokens
from anytouch_jax.train.optim import optimizer
from anytouch_jax.train.step import init_state, make_step, merge
from experiments.benchmarks import machine
from experiments.command import run_script
from experiments.records import write_record

NAME = "by_contact.jsonl"
SIDE, PATCH, BATCH = 56, 7, 32
JUDGED, FOUND = 256, 600  # held-out touches of the error, and of recall@1
CHANGED = 6.0  # grey levels from the untouched gel, mean of a patch, that count as contact
WAYS = {  # what is added to the noise of patches with contact (more of them are hidden), and to their weight
    "as in the paper": (0.0, 0.0),
    "contact hidden more often": (0.4, 0.0),
    "contact counts more": (0.0, 3.0),
    "both": (0.4, 3.0),
}


@dataclass(frozen=True)
class ContactOptions:
    """Train stage 1 with masks and losses by contact, and compare steps to the same error."""

    data: Positional[Path]  # Manifest of simulated touches.
    steps: int = 600  # Training steps.
    every: int = 50  # Steps between two validations.
    seeds: int = 1  # Trainings of each way.
    out: Path = Path(__file__).parents[1] / "results" / NAME  # JSON lines.


@dataclass(frozen=True)
class Stills:
    """Two frames of each touch u8 (n, SIDE, SIDE, 3), the gel subtracted, and sensors i32 (n,).

    `pictures` are the deepest frames, `lighter` are others.
    """

    pictures: np.ndarray
    lighter: np.ndarray
    sensor: np.ndarray


def read_stills(path: Path, sensors: tuple[str, ...], splits: tuple[str, ...], count: int | None = None) -> Stills:
    """Return two frames of `count` recordings in some splits. Raises UserError for a manifest without them."""
    table = manifests.read([path])
    depth = np.asarray(table.table["label.depth"].to_pylist(), float)
    sequence, frames = table.text_column("sequence"), dict[str, list[int]]()
    for row in np.flatnonzero(np.isin(table.text_column("split"), splits)).tolist():
        frames.setdefault(sequence[row], []).append(row)
    if not frames:
        raise UserError(f"{path} has no recordings of the splits {', '.join(splits)}")
    ordered = [sorted(rows, key=lambda row: -depth[row]) for rows in frames.values()]
    chosen = np.random.default_rng(0).permutation([(rows[0], rows[len(rows) // 2]) for rows in ordered])[:count]
    pictures = [[_less_gel(table, int(row)) for row in rows] for rows in chosen.T]
    sensor = np.array([sensors.index(name) for name in table.text_column("sensor")[chosen[:, 0]]], np.int32)
    return Stills(np.stack(pictures[0]), np.stack(pictures[1]), sensor)


def _less_gel(table: manifests.Manifest, row: int) -> np.ndarray:
    frame, gel = (
        cv2.resize(decode(table.file(row, column)), (SIDE, SIDE), interpolation=cv2.INTER_AREA)
        for column in ("path", "background_path")
    )
    return subtract_background([frame], gel)[0]


def contact_of(clip: jax.Array) -> jax.Array:
    """Return which patches of background-subtracted stills u8 (B, 1, H, W, 3) have contact, bool (B, N)."""
    change = jnp.abs(clip.astype(jnp.float32) - 128).max(-1, keepdims=True)
    return tokens.patchify(change, PATCH).mean((2, 3)) > CHANGED


def squares(params: Any, batch: TouchBatch, noise: jax.Array, *, net: Any, config: Config) -> Any:
    """Return the mean squared error of each patch and which are hidden, both (B, N)."""
    clip = objectives.normalise_touch(batch.clip)
    pixels, hidden = objectives.reconstruct(params, clip, batch.sensor, noise, net=net, config=config)
    return jnp.square(pixels - tokens.patchify(clip, PATCH)).mean((2, 3)), hidden


def weighted_loss(
    params: Any, batch: TouchBatch, key: jax.Array, progress: jax.Array, *, net: Any, config: Config, way: str
) -> Any:
    """Return the loss of masked patches, with masks and weights by contact."""
    del progress
    more, weight = WAYS[way]
    contact = contact_of(batch.clip)
    noise = jax.random.uniform(key, contact.shape) + more * contact
    error, hidden = squares(params, batch, noise, net=net, config=config)
    counts = hidden * (1 + weight * contact)
    return jnp.sum(error * counts) / jnp.sum(counts), {}


def train(way: str, seed: int, train: Stills, held: Stills, config: Config, options: ContactOptions) -> dict[str, Any]:
    """Return the steps of the validations, with errors of all hidden patches and those with contact, and recall@1."""
    net = build(config.model)
    loss = partial(weighted_loss, net=net, config=config, way=way)
    rules = partial(objectives.trained_by, config=config)
    step = jax.jit(make_step(loss, optimizer(config), total_steps=options.steps, trained=rules))
    state = init_state(net.init(jax.random.key(seed)), config)
    noise = np.random.default_rng(0).random((len(held.pictures), config.model.patches)).astype(np.float32)
    whole = TouchBatch(np.concatenate([held.pictures, held.lighter])[:, None], np.tile(held.sensor, 2))

    @jax.jit
    def judge(params: Any) -> Any:
        judged = min(JUDGED, len(noise))
        some = jax.tree.map(lambda x: x[:judged], whole)
        error, hidden = squares(params, some, noise[:judged], net=net, config=config)
        contact = hidden * contact_of(some.clip)
        features = net.encode_touch(params, objectives.normalise_touch(whole.clip), whole.sensor)
        return (error * hidden).sum() / hidden.sum(), (error * contact).sum() / contact.sum(), features

    rng, curve = np.random.default_rng(seed), []
    for number in range(1, options.steps + 1):
        rows = rng.integers(0, len(train.pictures), BATCH)
        state, _ = step(state, TouchBatch(train.pictures[rows][:, None], train.sensor[rows]), jax.random.key(seed))
        if number % options.every == 0:
            error, contact, features = jax.device_get(judge(merge(state.trainable, state.frozen)))
            curve.append([number, float(error), float(contact), recall(features, held)])
    return {"curve": curve}


def recall(features: np.ndarray, held: Stills) -> float:
    """Return the share of lighter frames whose nearest deepest frame, by the same sensor, is of the same touch."""
    deepest, lighter = (unit_rows(part - part.mean(0)) for part in np.split(features, 2))
    near = lighter @ deepest.T
    near[held.sensor[:, None] != held.sensor[None]] = -np.inf
    return float(np.mean(near.argmax(1) == np.arange(len(near))))


def run(options: ContactOptions) -> int:
    """Train all ways and store a line for each seed. Raises UserError for a manifest without the splits."""
    whole = preset("tiny")
    model = replace(whole.model, image_size=SIDE, patch=PATCH, touch=Stack(128, 4, 4, 512))
    config = replace(whole, model=model, run=replace(whole.run, steps=options.steps))
    sets = [read_stills(options.data, model.sensors, *part) for part in ((("train",),), (("val", "test"), FOUND))]
    for seed in range(options.seeds):
        for way in WAYS:
            record = train(way, seed, *sets, config, options)
            write_record(options.out, f"{way}, seed {seed}", record | {
                "way": way, "seed": seed, "steps": options.steps, "touches": [len(one.pictures) for one in sets],
                "machine": asdict(machine.describe()),
            })  # fmt: skip
            print(way, seed, record["curve"][-1], flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(run_script(ContactOptions, run))
