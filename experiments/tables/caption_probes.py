"""Probes of what captions name, on objects never touched: hardness, roughness and material.

Are touches too poor to show these labels, or is training too short? The encoder of Tables 2 to 4 is trained with the
labels themselves, more than any caption says, on contact frames of four sensors, flipped at random, one linear head a
label. The test split has pairs of primitive and texture that training never had. A small convolutional network is
trained alike. Then the sensor left out: linear probes of contact frames on the frozen features of each.

`python -m experiments.tables.caption_probes` takes 20 minutes a seed on one core, with the encoders of
`make experiments` (`STUDY=`). `STEPS=`, `SEEDS=` and `QUICK=1` change the size. Finished seeds are not run
again. `CONVOLUTIONS=1` has encoders whose patches are read by small convolutions, and its own records.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

from anytouch_jax.data.loading.samples import evaluation
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.encoder.encoder import Encoder, load_encoder, random_encoder
from anytouch_jax.evaluate.feature_cache import background_difference, principal_components
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.sim.dataset import VERSION
from anytouch_jax.train.mesh import enable_compilation_cache
from anytouch_jax.train.progress import silent
from experiments.benchmarks import machine
from experiments.records import read_records, write_record
from experiments.tables import cuts, env, plan
from experiments.tables.by_object import probed
from experiments.tables.work import Work

QUICK = env.switch("QUICK")
SIZE = plan.QUICK if QUICK else plan.FULL
STUDY = env.path("STUDY", f"runs/matrix{'-quick' if QUICK else ''}")
CONVOLUTIONS = env.switch("CONVOLUTIONS")
OUT, PLAIN = env.path("OUT", "experiments/results"), "named_quick" if QUICK else "named"
NAME = PLAIN.replace("named", "named_convolutional") if CONVOLUTIONS else PLAIN
RESULTS = OUT / f"{NAME}.jsonl"
SEEDS = env.numbers("SEEDS", "0" if QUICK else "0,1,2")
STEPS = env.number("STEPS", 5 if QUICK else 1200)
NAMED, UNNAMED = ("hardness", "roughness", "material"), ("indenter",)  # by captions
LABELS = (*NAMED, *UNNAMED)
NAMES = ("AnyTouch", "trained with labels", "untrained")  # encoders
CONVOLUTIONAL = "convolutional, with labels"
LEFT_OUT = plan.Scenes("left_out", (plan.UNSEEN,), 6 * SIZE.objects, "fine", 0, 0.25, first=10_000)  # same objects
BATCH, RATE, WARMUP = 64, 1e-3, 100
SETTINGS = {"size": SIZE.name, "steps": STEPS, "batch": BATCH, "rate": RATE, "simulator": VERSION}
SETTINGS |= {"touches": LEFT_OUT.touches}


def frames(file: Path, splits: tuple[str, ...], encoder: Encoder) -> dict[str, np.ndarray]:
    """Contact frames of a manifest: images u8 (n, h, w, 3) as the encoder gets them, sensor rows, splits, labels."""
    table = manifests.read([file])
    rows = contact_rows(table, splits)
    batches = [
        (np.asarray(batch.clip)[: len(ids), 0], np.asarray(batch.sensor)[: len(ids)])
        for ids, batch in evaluation(table, rows, encoder.config, "still", frames=1, unknown="universal")
    ]
    image, sensor = (np.concatenate(parts) for parts in zip(*batches, strict=True))
    labels = {label: table.text_column(f"label.{label}")[rows] for label in LABELS}
    return {"image": image, "sensor": sensor, "split": table.text_column("split")[rows], **labels}


def contact_rows(table: manifests.Manifest, splits: tuple[str, ...]) -> np.ndarray:
    known = np.isin(table.text_column("split"), splits)
    return np.flatnonzero(known & (table.text_column("label.contact") == "1"))


def touches(work: Work, encoder: Encoder) -> dict[str, np.ndarray]:
    """The frames that AnyTouch is trained on, and tested."""
    files = [work.manifest(f"own/{name}") for name in plan.SENSORS] + [work.manifest(name) for name in plan.ALIGNED]
    several = [frames(file, ("train", "test"), encoder) for file in files]
    return {name: np.concatenate([one[name] for one in several]) for name in several[0]}


def training(seed: int) -> plan.Training:
    """AnyTouch of Tables 2 to 4, or the same with convolutions inside its patches."""
    last = plan.training(SIZE, "anytouch", seed)
    return by_convolutions_inside(last) if CONVOLUTIONS else last


def by_convolutions_inside(one: plan.Training) -> plan.Training:
    model = replace(one.config.model, patch_encoder="convolutional")
    return plan.Training(replace(one.config, model=model), by_convolutions_inside(one.init) if one.init else None)


class Pupil(NamedTuple):
    """What is trained: f32 features (B, `width`) of images u8 (B, h, w, 3) and sensor rows (B,), by `params`."""

    features: Callable[[Any, Any, Any], Any]
    params: Any
    width: int


def of_encoder(encoder: Encoder) -> Pupil:
    def features(params: Any, images: Any, sensor: Any) -> Any:
        z = encoder.net.encode_touch({"touch": params}, normalise_touch(images[:, None]), sensor)
        return z.astype(jnp.float32)

    return Pupil(features, encoder.params["touch"], encoder.config.model.embed)


WIDTHS = (24, 48, 96, 160)
FEATURES = 2 * WIDTHS[-1]


class Convolutional(nnx.Module):
    """Strided and plain convolutions with group norms; (B, H, W, 3) to the mean and the maximum over places of
    what they find, (B, FEATURES)."""

    def __init__(self, seed: int) -> None:
        rngs, plan = nnx.Rngs(seed), [(3, WIDTHS[0], 5, 2)]
        for before, width in pairwise(WIDTHS):
            plan += [(before, width, 3, 2), (width, width, 3, 1)]
        self.layers = nnx.List(
            [nnx.Conv(a, b, (side, side), strides=step, use_bias=False, rngs=rngs) for a, b, side, step in plan]
        )
        self.norms = nnx.List([nnx.GroupNorm(width, num_groups=8, rngs=rngs) for _, width, _, _ in plan])

    def __call__(self, x: Any) -> Any:
        for layer, norm in zip(self.layers, self.norms, strict=True):
            x = jax.nn.relu(norm(layer(x)))
        return jnp.concatenate([x.mean((1, 2)), x.max((1, 2))], -1)


def convolutional(seed: int) -> Pupil:
    graph, params = nnx.split(Convolutional(seed))
    return Pupil(lambda params, images, _: nnx.merge(graph, params)(normalise_touch(images)), params, FEATURES)


def taught(
    pupil: Pupil, data: dict[str, np.ndarray], seed: int, universal: int
) -> tuple[Any, dict[str, dict[str, float]]]:
    """Parameters trained with the labels of the train split; {label: {train, test, commonest}} shares told right."""
    classes = {label: np.unique(data[label]) for label in LABELS}
    numbers = {label: np.searchsorted(classes[label], data[label]) for label in LABELS}
    train, test = (np.flatnonzero(data["split"] == part) for part in ("train", "test"))
    heads = {label: jnp.zeros((pupil.width, len(names))) for label, names in classes.items()}
    params: Any = {"features": pupil.params, "heads": heads}
    warm = min(WARMUP, STEPS // 2)
    optimiser = optax.adamw(optax.warmup_cosine_decay_schedule(0.0, RATE, warm, STEPS), weight_decay=0.1)

    def logits(params: Any, images: Any, sensor: Any) -> Any:
        z = pupil.features(params["features"], images, sensor)
        return {label: z @ head for label, head in params["heads"].items()}

    def loss(params: Any, images: Any, sensor: Any, wanted: Any) -> Any:
        cross = optax.softmax_cross_entropy_with_integer_labels
        return sum(cross(one, wanted[label]).mean() for label, one in logits(params, images, sensor).items())

    @jax.jit
    def step(params: Any, state: Any, *batch: Any) -> Any:
        change, state = optimiser.update(jax.grad(loss)(params, *batch), state, params)
        return optax.apply_updates(params, change), state

    state = optimiser.init(params)
    for number in range(STEPS):
        rng = np.random.default_rng([seed, number])
        rows, turned = rng.choice(train, BATCH), rng.integers(2, size=(BATCH, 2)) * 2 - 1
        images = np.stack(
            [data["image"][row][::down, ::across] for row, (down, across) in zip(rows, turned, strict=True)]
        )
        sensor = np.where(rng.random(BATCH) < 0.5, universal, data["sensor"][rows])
        params, state = step(params, state, images, sensor.astype(np.int32), {k: v[rows] for k, v in numbers.items()})

    log = jax.jit(logits)

    def right(label: str, rows: np.ndarray) -> float:
        predicted = [log(params, *some)[label].argmax(-1) for some in batched(data, rows)]
        return float(np.mean(np.concatenate(predicted) == numbers[label][rows]))

    some = np.random.default_rng(seed).choice(train, min(2000, len(train)), replace=False)
    scores = {}
    for label in LABELS:
        commonest = np.bincount(numbers[label][train]).argmax()
        scores[label] = {"train": right(label, some), "test": right(label, test)}
        scores[label]["commonest"] = float(np.mean(numbers[label][test] == commonest))
    return jax.tree.map(np.asarray, params["features"]), scores


def batched(data: dict[str, np.ndarray], rows: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Images and sensor rows of some rows, some hundred at a time."""
    parts = [rows[first : first + 256] for first in range(0, len(rows), 256)]
    return [(data["image"][part], data["sensor"][part]) for part in parts]


def probes(features: dict[str, np.ndarray], table: manifests.Manifest, rows: np.ndarray) -> dict[str, Any]:
    """What linear probes of contact frames get right of each object never seen, by label."""
    split, groups = table.text_column("split")[rows], table.text_column("object")[rows]
    labels = {label: [table.value(int(row), f"label.{label}") for row in rows] for label in LABELS}
    return probed(features, labels, groups, split)


def by_encoders(seed: int, fresh: Encoder, data: dict[str, np.ndarray], work: Work, table: Any) -> dict[str, Any]:
    """What AnyTouch, the encoder trained with the labels, an untrained one and pixels tell."""
    last = training(seed)
    anytouch = load_encoder(work.runs({"anytouch": last}, SIZE)["anytouch"])
    params, scores = taught(of_encoder(fresh), data, seed, fresh.config.model.universal_row)
    named = (anytouch, Encoder(fresh.config, {"touch": params}, "trained with labels"), fresh)
    rows = contact_rows(table, cuts.SPLITS)
    result = [embed_rows(one, table, rows, pooling="both", log=silent)[1] for one in named]
    pixels = background_difference(table, rows)
    features = dict(zip(NAMES, result, strict=True))
    features["pixels"] = principal_components(pixels, table.text_column("split")[rows] == "train")
    return {
        "settings": SETTINGS,
        "anytouch": f"{last.key} (weights {anytouch.fingerprint})",
        "data": {name: cuts.content_hash(work.manifest(name)) for name in (*last.manifests, LEFT_OUT.name)},
        "machine": machine.describe().sentence(),
        "scores": scores,
        "probes": probes(features, table, rows),
    }


def by_convolutions(seed: int, fresh: Encoder, data: dict[str, np.ndarray], work: Work, table: Any) -> dict[str, Any]:
    """What a convolutional network trained with the labels tells."""
    pupil, rows = convolutional(seed), contact_rows(table, cuts.SPLITS)
    params, scores = taught(pupil, data, seed, fresh.config.model.universal_row)
    read, images = jax.jit(pupil.features), frames(work.manifest(LEFT_OUT.name), cuts.SPLITS, fresh)
    features = np.concatenate([np.asarray(read(params, *some)) for some in batched(images, np.arange(len(rows)))])
    return {"scores": scores, "probes": probes({CONVOLUTIONAL: features}, table, rows)}


def one_seed(seed: int) -> dict[str, Any]:
    """Return the record of a seed. What it lacks, or has of other settings, is measured first."""
    result = read_records(RESULTS).get(str(seed), {})
    if result.get("settings") != SETTINGS:
        result = {}
    if {"probes", CONVOLUTIONAL} <= set(result):
        return result
    work = Work(STUDY)
    first = training(seed).init
    assert first is not None
    work.make_sets(first.manifests, SIZE)
    if not work.made(LEFT_OUT, SIZE):
        work.make(LEFT_OUT, SIZE)
    fresh = random_encoder(first.config, seed)
    about = seed, fresh, touches(work, fresh), work, manifests.read([work.manifest(LEFT_OUT.name)])
    if "probes" not in result:
        result = by_encoders(*about)
    there = read_records(OUT / f"{PLAIN}.jsonl").get(str(seed), {})  # the network depends on no encoder
    same = all(there.get(kind) == result[kind] for kind in ("settings", "data"))
    result[CONVOLUTIONAL] = there[CONVOLUTIONAL] if same and CONVOLUTIONAL in there else by_convolutions(*about)
    write_record(RESULTS, str(seed), result)
    return result


def main() -> None:
    enable_compilation_cache()
    for seed in SEEDS:
        one_seed(seed)


if __name__ == "__main__":
    main()
