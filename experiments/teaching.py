# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Do simulated scenes teach a representation of touch?
#
# On objects never touched in training (whole pairs of primitive and texture are held out):
#
# 1. **Retrieval.** The same touch by another sensor and another unit, among 50 touches that resemble it most in
#    position, depth and force, after each sensor's mean feature was subtracted. Stage 2 against stage 1 alone, an
#    untrained encoder (shown touches less the untouched gel, as the trained ones, and as the camera gives them),
#    background-differenced pixels, and the vector (contact area, centroid, force). For fine data (one motion for all
#    sensors) and coarse data (by hand); one encoder a seed learns from both.
# 2. **A sensor left out.** GelSlim is not in the sensor table of the trained encoders: its touches get the universal
#    tokens. Linear probes on its features, for labels that captions name (hardness, roughness, material) and for one
#    that they do not (indenter).
#
# `.venv/bin/python experiments/teaching.py` does all of it, run by run, in an hour or more a seed: what is finished is
# not done again. `TOUCHES=500 STEPS2=1000` is less than half the work, and less is learned;
# `TOUCHES=260 STEPS1=20 STEPS2=20 SEEDS=0 GRADES=fine` is a trial of minutes. `WORK=` and `OUT=` are where runs and
# results go.

# %%
from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from study import asked

from anytouch_jax.cli import main
from anytouch_jax.data import manifest as manifests
from anytouch_jax.evaluate import baseline, probe, results, retrieval
from anytouch_jax.evaluate.contacts import background_difference, contact_vector, deepest_rows
from anytouch_jax.evaluate.features import embed_rows, load_encoder, random_encoder, text_column
from anytouch_jax.evaluate.sections import markdown
from anytouch_jax.sim.dataset import VERSION
from anytouch_jax.train.record import write_atomic

WORK, OUT = asked.path("WORK", "runs/teaching"), asked.path("OUT", "experiments/results")
TOUCHES, STEPS1, STEPS2 = asked.number("TOUCHES", 1200), asked.number("STEPS1", 600), asked.number("STEPS2", 4000)
MORE = asked.number("MORE", 2 * TOUCHES, least=0)
OBJECTS = asked.number("OBJECTS", min(TOUCHES // 2, 500))
SEEDS = asked.numbers("SEEDS", "0,1,2")
GRADES = asked.names("GRADES", "fine,coarse", ("fine", "coarse"))
SENSORS, LEFT_OUT = "gelsight_mini,digit,duragel", "gelslim"
STACK, DEPTH = {"width": 128, "heads": 4, "mlp": 512}, {"touch": 4, "image": 2, "text.stack": 2}
TABLE = ["gelsight_mini", "digit", "duragel", "universal"]
NAMED, UNNAMED = ("hardness", "roughness", "material"), ("indenter",)


def anytouch(*words: Any) -> None:
    """Run a subcommand; a run or a data set that is finished answers at once."""
    status = main([str(word) for word in words])
    if status:
        raise SystemExit(status)


# %% [markdown]
# ## Data and runs
#
# One data set a grade, and one by the sensor that is left out, with six touches of each of the same objects (at two
# touches an object a probe cannot tell encoders apart). Places differ from grade to grade; objects, and which of
# them are held out, do not. `MORE=` touches a grade, of the same objects at other places, are trained on alone, so that
# what is scored stays the same whatever their number. Both stages for every seed, on all grades together as on
# TacQuad's two parts, at preset tiny with smaller towers and pictures: less work a step, and more is learned in a
# minute.
#
# **Contact frames.** The paper's data are contact frames. A simulated recording begins before anything shows, and pairs
# of such a frame with one of full contact teach little: with them contrast learned more slowly. So `anytouch contact`
# marks the frames that have six tenths of the strongest contact of their recording, and only these are drawn.
#
# Matching departs from the paper here. Its head tells a pair from *one* other pair, on an encoder that already knows
# pictures (CLIP); the same loss on an encoder from scratch stays at chance for as long as a CPU can wait. Cosines
# against all other touches of the batch (`match_head=cosine`) tell 126 pairs apart at once; all touches to be found in
# a batch are of one sensor (`negatives=same_sensor`), as in the galleries, so that the sensor tells none of them apart.
# It begins on a plateau, since stage 1 leaves the class token nearly equal for all touches; in a trial of one seed it
# left it sooner, and came further, after 600 steps of stage 1 than after 150.

# %%
SMALL = ["--preset", "tiny", "--model.image-size", 84]
LESS = ["--loader.background", "subtract"]  # the contact alone: units differ more than touches do
LESS += ["--loader.contact-only", "--loader.jitter", 0, 0, 0, 0]  # colours tell slopes
LESS += ["--loader.cache", 5000]  # all frames, once read


def tower(name: str) -> list[Any]:
    return [word for size, n in (STACK | {"depth": DEPTH[name]}).items() for word in (f"--model.{name}.{size}", n)]


TRAIN1 = [*SMALL, *tower("touch"), "--steps", STEPS1, "--batch", 48, "--optim.learning-rate", 1e-3]
TRAIN2 = [*SMALL, *tower("touch"), *tower("image"), *tower("text.stack"), "--steps", STEPS2, "--batch", 64]
TRAIN2 += ["--optim.learning-rate", 1e-3, "--loader.negatives", "same_sensor"]
TRAIN2 += ["--model.match-head", "cosine", "--objective.match-weight", 8.0]


def scenes(grade: str) -> list[Path]:
    """The manifests to train on of a grade, contact frames marked. Makes touches by the sensor left out, too."""
    turn, marked = GRADES.index(grade), []
    sets = {  # sensors, touches, number of the first
        f"scenes-{grade}": (SENSORS, TOUCHES, TOUCHES * turn),
        f"more-{grade}": (SENSORS, MORE, TOUCHES * len(GRADES) + MORE * turn),
        f"{LEFT_OUT}-{grade}": (LEFT_OUT, 6 * OBJECTS, 6 * OBJECTS * turn),
    }
    for name, (sensors, touches, first) in sets.items():
        folder, how = WORK / name, ["--objects", OBJECTS, "--grade", grade, "--size", 128]
        if touches:
            anytouch("simulate", "--out", folder, "--sensors", sensors, "--touches", touches, "--first", first, *how)
        if touches and sensors == SENSORS:
            marked.append(folder / "manifest_contact.parquet")
            if not marked[-1].exists():
                anytouch("contact", folder / "manifest.parquet", "--share", 0.6, "--out", marked[-1])
    return marked


def prepare(seed: int) -> tuple[Path, Path]:
    """The runs of both stages for a seed."""
    one, two = (WORK / f"{'-'.join(GRADES)}-{seed}-stage{stage}" for stage in (1, 2))
    manifests_of = [manifest for grade in GRADES for manifest in scenes(grade)]
    data = ["--data", *manifests_of, "--seed", seed, "--model.sensors", *TABLE, *LESS]
    anytouch("train", "--stage", 1, "--run", one, *TRAIN1, *data)
    finished(one, STEPS1)
    anytouch("train", "--stage", 2, "--run", two, "--init", one, *TRAIN2, *data)
    finished(two, STEPS2)
    return one, two


def finished(run: Path, steps: int) -> None:
    """A signal ends training politely; what is half trained must not be scored."""
    if not (run / "checkpoints" / f"{steps:08d}").is_dir():
        raise SystemExit(f"{run} was stopped before its {steps} steps; the same command goes on")


def features(runs: tuple[Path, Path], seed: int, table: Any, rows: np.ndarray, pooling: Any) -> dict[str, np.ndarray]:
    one, two = (load_encoder(run) for run in runs)
    plain = replace(one.config, data=replace(one.config.data, background="keep"))
    encoders = {"stage 2": two, "stage 1": one, "untrained": random_encoder(one.config, seed)}
    encoders["untrained, whole picture"] = random_encoder(plain, seed)
    return {name: embed_rows(e, table, rows, pooling=pooling, say=lambda _: None)[1] for name, e in encoders.items()}


# %% [markdown]
# ## Retrieval on objects never seen


# %%
def retrieve(grade: str, seed: int, runs: tuple[Path, Path]) -> list[retrieval.Retrieval]:
    table = manifests.read(WORK / f"scenes-{grade}" / "manifest.parquet")
    rows = deepest_rows(table, table.rows_of("test"))
    found = features(runs, seed, table, rows, "class")
    found |= {"pixels": background_difference(table, rows), "vector": contact_vector(table, rows)}
    scored = retrieval.cross_sensor_retrieval(table, found, rows, centre=(True,), metrics={"vector": "euclidean"})
    return [one for one in scored if one.query_sensor == retrieval.ALL]


def probes(grade: str, seed: int, runs: tuple[Path, Path]) -> dict[str, dict[str, results.ProbeResult]]:
    """Linear probes on the sensor left out, universal tokens, objects never seen in the test split."""
    table = manifests.read(WORK / f"{LEFT_OUT}-{grade}" / "manifest.parquet")
    rows = np.concatenate([deepest_rows(table, table.rows_of(split)) for split in ("train", "val", "test")])
    split, groups = text_column(table, "split")[rows], text_column(table, "object")[rows]
    found = features(runs, seed, table, rows, "both")
    found["pixels"] = baseline.reduce(background_difference(table, rows), split == "train")
    probed: dict[str, dict[str, results.ProbeResult]] = {}
    for label in (*NAMED, *UNNAMED):
        values = [table.value(int(row), f"label.{label}") for row in rows]
        for name, x in found.items():
            scaling = "common" if name == "pixels" else "column"
            one = probe.linear_probe(x, values, groups, split, name=name, seeds=0, scaling=scaling)
            probed.setdefault(label, {})[name] = one
    return probed


def averaged(several: list[results.ProbeResult]) -> results.ProbeResult:
    """Probes of the same touches (other seeds, other labels) as one: the share of them that was right, by touch."""
    tables = [one.outcome for one in several if one.outcome is not None]
    outcome = replace(tables[0], correct=np.mean([table.correct for table in tables], axis=0))
    return replace(several[0], accuracy=float(outcome.correct.mean()), outcome=outcome)


# %%
def points(change: tuple[float, float | None, float | None]) -> str:
    mean, low, high = change
    return f"{100 * mean:+.1f}" + ("" if low is None or high is None else f" ({100 * low:+.1f} to {100 * high:+.1f})")


def percent(values: list[float]) -> str:
    return f"{100 * np.mean(values):.1f} %" + (f" +- {100 * np.std(values, ddof=1):.1f}" if len(values) > 1 else "")


NAMES = ("stage 2", "stage 1", "untrained", "untrained, whole picture", "pixels", "vector")
RIVALS = ("untrained", "pixels")  # of the probes
SIZE = f"TOUCHES={TOUCHES} MORE={MORE} OBJECTS={OBJECTS} STEPS1={STEPS1} STEPS2={STEPS2} "
SIZE += f"SEEDS={','.join(map(str, SEEDS))} GRADES={','.join(GRADES)}"
NETWORK = f"preset tiny with a touch tower of {STACK['width']} x {DEPTH['touch']} at 84 pixels"


def retrieval_table(scored: dict[str, list[retrieval.Retrieval]], pooled: dict[str, retrieval.Retrieval]) -> str:
    """Shares of the seeds together, and how far stage 2 is ahead: together, and seed by seed."""
    rows = []
    for name, one in pooled.items():
        change = "-" if name == "stage 2" else points(retrieval.difference(pooled["stage 2"], one))
        pairs = zip(scored["stage 2"], scored[name], strict=True)
        each = "-" if name == "stage 2" else "; ".join(points(retrieval.difference(a, b)) for a, b in pairs)
        rows.append((name, f"{100 * one.top1:.1f} %", f"{100 * one.top5:.1f} %", change, each))
    return markdown(
        ("features", "top-1 of 50", "top-5", "stage 2 ahead by (points, 95 % over objects)", "seed by seed"), rows
    )


def by_seed(several: list[results.ProbeResult], rivals: list[results.ProbeResult]) -> str:
    """How far ahead in each seed: the interval over objects is of these encoders, not of others trained alike."""
    return ", ".join(points((a.accuracy - b.accuracy, None, None)) for a, b in zip(several, rivals, strict=True))


def probe_table(probed: list[dict[str, dict[str, results.ProbeResult]]]) -> str:
    """Accuracies by label, and of all that captions name together; and how far stage 2 is ahead."""
    rows = []
    for title, labels in [
        *((one, (one,)) for one in NAMED),
        ("these three", NAMED),
        *((one, (one,)) for one in UNNAMED),
    ]:
        seeds = {name: [averaged([found[label][name] for label in labels]) for found in probed] for name in NAMES[:5]}
        mean = {name: averaged(several) for name, several in seeds.items()}
        changes = [
            points(results.difference(mean["stage 2"], mean[name])) + "; " + by_seed(seeds["stage 2"], seeds[name])
            for name in RIVALS
        ]
        rows.append((title, *(percent([one.accuracy for one in several]) for several in seeds.values()), *changes))
    head = ("label", *NAMES[:5], *(f"stage 2 ahead of {name} (points, 95 % over objects; by seed)" for name in RIVALS))
    return markdown(head, rows)


# %%
lines = ["# Simulated scenes as teachers", "", f"Made by `{SIZE} python experiments/teaching.py`, {NETWORK}.", ""]
record: dict[str, Any] = {"touches": TOUCHES, "more": MORE, "objects": OBJECTS, "steps": [STEPS1, STEPS2]}
record |= {"seeds": SEEDS, "simulator": VERSION}
runs_of = {seed: prepare(seed) for seed in SEEDS}
for grade in GRADES:
    scored: dict[str, list[retrieval.Retrieval]] = {name: [] for name in NAMES}
    for seed in SEEDS:
        for one in retrieve(grade, seed, runs_of[seed]):
            scored[one.name].append(one)
    pooled = {name: retrieval.averaged(several, name) for name, several in scored.items()}
    probed = [probes(grade, seed, runs_of[seed]) for seed in SEEDS]
    accuracies = [{k: {n: one.accuracy for n, one in v.items()} for k, v in found.items()} for found in probed]
    record[grade] = {"retrieval": retrieval.to_records(list(pooled.values())), "probes": accuracies}
    lines += [f"## Retrieval, {grade} data, {len(SEEDS)} seed{'s' if len(SEEDS) > 1 else ''}", ""]
    lines += [retrieval_table(scored, pooled), ""]
    lines += [f"## {LEFT_OUT}, left out of training, {grade} data: linear probes (mean and spread over seeds)", ""]
    lines += [probe_table(probed), ""]

# %%
OUT.mkdir(parents=True, exist_ok=True)
write_atomic(OUT / "teaching.json", json.dumps(record, indent=2) + "\n")
write_atomic(OUT / "teaching.md", "\n".join(lines))
print("\n".join(lines))
