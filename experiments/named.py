# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Can what captions name be told of an object never touched?
#
# Captions name hardness, roughness and material. After both stages these three are told hardly better than by an
# untrained encoder, while the form of the indenter, which no caption names, is told far better. Is it the training that
# is short, or can the simulated touches not tell it? So here the same encoder is trained with the labels themselves,
# which is more than any caption can say, on the scenes of `make experiments`: contact frames of four sensors, turned
# over by chance, one linear head a label. What it tells of its own frames is what could be learned by heart; what it
# tells of the test split, whose pairs of primitive and texture training never had, is what carries over.
#
# Then the sensor that is left out, in six touches of each object: linear probes of contact frames, shallow and deep
# ones, read hardness, roughness, material and indenter from the frozen features of AnyTouch of Tables 2 to 4, of the
# encoder trained with the labels, of an untrained one, and from pixels less the untouched gel.
#
# `python experiments/named.py` takes some ten minutes a seed on one core where the encoders of `make experiments` are
# there. `STUDY=` is the folder of scenes and encoders (made where they are not there), `STEPS=` and `SEEDS=` change the
# size, `QUICK=1` is a trial, `TABLE=1` only rewrites the page `named.md` from the JSON in `named/`, where what is
# finished is not done again.

# %%
from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from study import asked, cuts, plan
from study.by_object import probe_table, probed
from study.work import Work

from anytouch_jax.config import UserError
from anytouch_jax.data import manifest as manifests
from anytouch_jax.data.evaluation import evaluation
from anytouch_jax.evaluate import baseline, machine
from anytouch_jax.evaluate.features import Encoder, embed_rows, load_encoder, random_encoder, text_column
from anytouch_jax.evaluate.results import markdown, seed_interval
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.sim.dataset import VERSION
from anytouch_jax.train.mesh import enable_compilation_cache
from anytouch_jax.train.watch import silent
from anytouch_jax.whole import write_whole

QUICK, TABLE = asked.switch("QUICK"), asked.switch("TABLE")
SIZE = plan.QUICK if QUICK else plan.FULL
STUDY = asked.path("STUDY", f"runs/matrix{'-quick' if QUICK else ''}")
OUT, NAME = asked.path("OUT", "experiments/results"), "named_quick" if QUICK else "named"
THERE = ",".join(sorted((file.stem for file in (OUT / NAME).glob("*.json")), key=int)) if TABLE else ""
SEEDS = asked.numbers("SEEDS", THERE or ("0" if QUICK else "0,1,2"))  # the table alone is of all that are there
STEPS = asked.number("STEPS", 5 if QUICK else 1200)
NAMED, UNNAMED = ("hardness", "roughness", "material"), ("indenter",)  # by captions
LABELS = (*NAMED, *UNNAMED)
NAMES = ("AnyTouch", "trained with labels", "untrained")  # encoders
LEFT_OUT = plan.Scenes("left_out", (plan.UNSEEN,), 6 * SIZE.objects, "fine", 0, 0.25, first=10_000)  # same objects
BATCH, RATE, WARMUP = 64, 1e-3, 100
SETTINGS = {"size": SIZE.name, "steps": STEPS, "batch": BATCH, "rate": RATE, "simulator": VERSION}
SETTINGS |= {"touches": LEFT_OUT.touches}
enable_compilation_cache()

# %% [markdown]
# ## The touches


# %%
def touches(work: Work, encoder: Encoder) -> dict[str, np.ndarray]:
    """Contact frames that AnyTouch is trained on, and tested: images u8 (n, h, w, 3), sensor rows, splits, labels."""
    files = [work.manifest(f"own/{name}") for name in plan.SENSORS] + [work.manifest(name) for name in plan.ALIGNED]
    found: dict[str, list[np.ndarray]] = {name: [] for name in ("image", "sensor", "split", *LABELS)}
    for file in files:
        table = manifests.read([file])
        known = np.isin(text_column(table, "split"), ("train", "test"))
        rows = np.flatnonzero(known & (text_column(table, "label.contact") == "1"))
        for ids, batch in evaluation(table, rows, encoder.config, "still", frames=1, unknown="universal"):
            found["image"].append(np.asarray(batch.clip)[: len(ids), 0])
            found["sensor"].append(np.asarray(batch.sensor)[: len(ids)])
            found["split"].append(text_column(table, "split")[ids])
            for label in LABELS:
                found[label].append(text_column(table, f"label.{label}")[ids])
    return {name: np.concatenate(parts) for name, parts in found.items()}


# %% [markdown]
# ## Training with the labels


# %%
def taught(encoder: Encoder, data: dict[str, np.ndarray], seed: int) -> tuple[Encoder, dict[str, dict[str, float]]]:
    """The encoder trained with the labels of the train split; {label: {train, test, commonest}} shares told right."""
    classes = {label: np.unique(data[label]) for label in LABELS}
    numbers = {label: np.searchsorted(classes[label], data[label]) for label in LABELS}
    train, test = (np.flatnonzero(data["split"] == part) for part in ("train", "test"))
    params: Any = {"touch": encoder.params["touch"]}
    params["heads"] = {label: jnp.zeros((encoder.config.model.embed, len(names))) for label, names in classes.items()}
    warm = min(WARMUP, STEPS // 2)
    optimiser = optax.adamw(optax.warmup_cosine_decay_schedule(0.0, RATE, warm, STEPS), weight_decay=0.1)

    def logits(params: Any, images: Any, sensor: Any) -> Any:
        z = encoder.net.apply({"touch": params["touch"]}, "encode", normalise_touch(images[:, None]), sensor)
        return {label: z.astype(jnp.float32) @ head for label, head in params["heads"].items()}

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
        sensor = np.where(rng.random(BATCH) < 0.5, encoder.config.model.universal_row, data["sensor"][rows])
        params, state = step(params, state, images, sensor.astype(np.int32), {k: v[rows] for k, v in numbers.items()})

    say = jax.jit(logits)

    def right(label: str, rows: np.ndarray) -> float:
        parts = [rows[first : first + 256] for first in range(0, len(rows), 256)]
        told = [np.asarray(say(params, data["image"][p], data["sensor"][p])[label]).argmax(-1) for p in parts]
        return float(np.mean(np.concatenate(told) == numbers[label][rows]))

    some = np.random.default_rng(seed).choice(train, min(2000, len(train)), replace=False)
    scores = {}
    for label in LABELS:
        commonest = np.bincount(numbers[label][train]).argmax()
        scores[label] = {"train": right(label, some), "test": right(label, test)}
        scores[label]["commonest"] = float(np.mean(numbers[label][test] == commonest))
    taught_params = {"touch": jax.tree.map(np.asarray, params["touch"])}
    return Encoder(encoder.config, taught_params, "trained with labels"), scores


# %% [markdown]
# ## The sensor left out


# %%
def probes(encoders: dict[str, Encoder], work: Work) -> dict[str, Any]:
    """What linear probes of contact frames (universal tokens) get right of each object never seen, by label."""
    table = manifests.read([work.manifest(LEFT_OUT.name)])
    known = np.isin(text_column(table, "split"), cuts.SPLITS)
    rows = np.flatnonzero(known & (text_column(table, "label.contact") == "1"))
    split, groups = text_column(table, "split")[rows], text_column(table, "object")[rows]
    found = {name: embed_rows(one, table, rows, pooling="both", say=silent)[1] for name, one in encoders.items()}
    found["pixels"] = baseline.reduce(baseline.background_difference(table, rows), split == "train")
    labels = {label: [table.value(int(row), f"label.{label}") for row in rows] for label in LABELS}
    return probed(found, labels, groups, split)


# %%
def one_seed(seed: int) -> dict[str, Any]:
    file = OUT / NAME / f"{seed}.json"
    found = json.loads(file.read_text()) if file.exists() else {}
    if TABLE or found.get("settings") == SETTINGS:
        if not found:
            raise UserError(f"there is no {file}: run this page without TABLE=1")
        return found
    work = Work(STUDY)
    last = plan.training(SIZE, "anytouch", seed)
    anytouch = load_encoder(work.runs({"anytouch": last}, SIZE)["anytouch"])
    if not work.made(LEFT_OUT, SIZE):
        work.make(LEFT_OUT, SIZE)
    assert last.init is not None
    fresh = random_encoder(last.init.config, seed)
    trained, scores = taught(fresh, touches(work, fresh), seed)
    data = {name: cuts.content_hash(work.manifest(name)) for name in (*last.manifests, LEFT_OUT.name)}
    found = {"settings": SETTINGS, "anytouch": f"{last.key} (weights {anytouch.mark})", "data": data}
    found |= {"machine": machine.describe().sentence(), "scores": scores}
    found["probes"] = probes(dict(zip(NAMES, (anytouch, trained, fresh), strict=True)), work)
    file.parent.mkdir(parents=True, exist_ok=True)
    write_whole(file, json.dumps(found) + "\n")
    return found


runs = [one_seed(seed) for seed in SEEDS]

# %% [markdown]
# ## The table


# %%
def percent(values: list[float]) -> str:
    low, high = seed_interval(values)
    interval = "" if low is None or high is None else f" ({100 * low:.1f} to {100 * high:.1f})"
    return f"{100 * np.mean(values):.1f} %{interval}"


rows = [
    (label, *(percent([run["scores"][label][part] for run in runs]) for part in ("commonest", "train", "test")))
    for label in LABELS
]
told = markdown(("label", "commonest answer of train", "its own frames", "objects never touched"), rows)
probed_runs = [run["probes"] for run in runs]
left_out = probe_table(probed_runs, (*NAMES, "pixels", "commonest"), ("untrained", "pixels"), NAMED, UNNAMED)
seeds = f"{len(runs)} seed{'s' if len(runs) > 1 else ''}"
made = f"SEEDS={','.join(map(str, SEEDS))} python experiments/named.py"
text = f"""# What captions name, of objects never touched

The encoder of Tables 2 to 4 trained with the labels themselves ({runs[0]["settings"]["steps"]} steps of {BATCH} contact
frames of four sensors), {seeds}; mean with its 95 % interval over seeds. The test split has pairs of primitive and
texture that training never had. Captions name hardness, roughness and material; they do not name the indenter.

{told}

## {plan.UNSEEN}, left out of training: linear probes of contact frames (mean and spread over seeds)

{runs[0]["settings"]["touches"]} touches of the same objects; none of those tested was touched in training, by any
sensor. AnyTouch is that of Tables 2 to 4, of the same seeds; captions name the first three labels.

{left_out}

Made by `{made}` ({runs[0]["machine"]}), from the JSON in `{NAME}/`.
"""
Path(OUT).mkdir(parents=True, exist_ok=True)
write_whole(OUT / f"{NAME}.md", text)
print(text)
