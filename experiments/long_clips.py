# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # What does a longer look cost, and what does it see?
#
# A clip longer than three frames is embedded as several segments of three, whose features are averaged, summed or
# concatenated (paper, appendix "Discussion on frame number"). Here the same moments are seen with one frame (a still),
# three, five and seven: slip, force, the sign of a twist and the direction of a slide by linear probes of frozen
# features (honest protocol, objects never touched in training), beside the time that a clip takes.
#
#     RUN=runs/stage2 DATA=data/scenes/manifest.parquet .venv/bin/python experiments/long_clips.py
#
# `OUT=` is where `long_clips.md`, `.json` and the picture go, `ROWS=` how many moments of a task at most.

# %%
from __future__ import annotations

import json
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
from study import page

from anytouch_jax.data import manifest as manifests
from anytouch_jax.evaluate import machine, plots, probe, tasks
from anytouch_jax.evaluate.features import Encoder, embed_rows, load_encoder
from anytouch_jax.evaluate.sections import markdown
from anytouch_jax.train.record import write_atomic

RUN, DATA = Path(os.environ.get("RUN", "runs/stage2")), os.environ.get("DATA", "data/scenes/manifest.parquet")
OUT = Path(os.environ.get("OUT", "experiments/results"))
ROWS, ROUNDS, BATCH = int(os.environ.get("ROWS", "1500")), 9, 32
LOOKS = [(1, "mean"), (3, "mean"), *((frames, join) for frames in (5, 7) for join in ("mean", "sum", "concat"))]
LONGEST = max(frames for frames, _ in LOOKS)
TASKS = ("slip", "force", "twist", "slide")

encoder, table = load_encoder(RUN), manifests.read(DATA)

# %% [markdown]
# ## The same moments for every length
#
# A task's moments that end a clip of the longest length, by the sensors in the encoder's table.


# %%
def moments(name: str) -> tasks.Selection:
    found = tasks.select(table, tasks.task_of(name), LONGEST)
    kept = np.flatnonzero(np.isin(found.sensors, encoder.config.model.sensors))
    if len(kept) > ROWS:
        kept = np.sort(np.random.default_rng(0).choice(kept, ROWS, replace=False))
    return tasks.Selection._make([*(one[kept] for one in found[:-1]), found.notes])


chosen = {name: moments(name) for name in TASKS}
rows = np.unique(np.concatenate([one.rows[:, 0] for one in chosen.values()]))


def scores(values: np.ndarray) -> dict[str, dict[str, Any]]:
    """Accuracy, or R2 of force, with its interval over test objects, of each task."""
    result: dict[str, dict[str, Any]] = {}
    for name, one in chosen.items():
        given = (values[np.searchsorted(rows, one.rows[:, 0])], one.labels, one.groups, one.split)
        if name == "force":
            fit = probe.regression_probe(*given)
            result[name] = {"mean": fit.r2, "low": fit.low, "high": fit.high, "test": fit.n_test}
        else:
            hit = probe.linear_probe(*given, seeds=0)
            result[name] = {"mean": hit.accuracy, "low": hit.low, "high": hit.high, "test": hit.n_test}
    return result


# %% [markdown]
# ## Time
#
# All lengths in turns in one process; the median of each, and its ratio to three frames.


# %%
def milliseconds(encoder: Encoder) -> list[float]:
    """Median time of a clip in a batch, for each look."""
    side = encoder.config.model.image_size
    clips = np.random.default_rng(0).integers(0, 256, (BATCH, LONGEST, side, side, 3), np.uint8)
    sensor = np.zeros(BATCH, np.int32)
    spent: list[list[float]] = [[] for _ in LOOKS]
    for turn in range(ROUNDS + 1):
        for k, (frames, join) in enumerate(LOOKS):
            start = time.perf_counter()
            encoder.embed(clips[:, :frames], sensor, pooling="both", join=join)  # type: ignore[arg-type]
            if turn:  # the first one compiles
                spent[k].append(1e3 * (time.perf_counter() - start) / BATCH)
    return [float(np.median(one)) for one in spent]


cost = milliseconds(encoder)
record: list[dict[str, Any]] = []
for (frames, join), ms in zip(LOOKS, cost, strict=True):
    read, values = embed_rows(encoder, table, rows, frames, "both", join, say=lambda _: None)  # type: ignore[arg-type]
    if len(read) < len(rows):
        raise SystemExit(f"{len(rows) - len(read)} rows cannot be read; `anytouch verify` says what is wrong with them")
    about = {"frames": frames, "join": join if frames > 3 else "-", "ms": ms, "ratio": ms / cost[1]}
    record.append(about | {"tasks": scores(values)})
    print({name: round(one["mean"], 3) for name, one in record[-1]["tasks"].items()}, frames, join, flush=True)

# %% [markdown]
# ## Table and picture


# %%
def cell(name: str, one: dict[str, Any]) -> str:
    scale, digits = (1, 2) if name == "force" else (100, 1)
    interval = "" if one["low"] is None else f" ({scale * one['low']:.{digits}f} to {scale * one['high']:.{digits}f})"
    return f"{scale * one['mean']:.{digits}f}{interval}"


head = ("frames", "joined by", "ms a clip", "time / 3 frames", "slip %", "force R2", "twist %", "slide %")
body = [
    (str(one["frames"]), one["join"], f"{one['ms']:.2f}", f"{one['ratio']:.2f}",
     *(cell(name, one["tasks"][name]) for name in TASKS))
    for one in record
]  # fmt: skip
tested = ", ".join(f"{name} {one['test']}" for name, one in record[0]["tasks"].items())
text = f"""# Longer clips: what they see beside what they cost

Made by `experiments/long_clips.py` from the run `{RUN.name}`. {machine.describe().sentence()}
Linear probes of frozen features on objects never touched in training, 95 % over test objects; moments tested: {tested}.
Time: a clip in a batch of {BATCH}, the median of {ROUNDS} rounds in turns.

{markdown(head, body)}

![Slip against time](figures/long_clips.png)
"""
about = {"run": RUN.name, "manifest": table.content_hash, "machine": machine.describe().sentence(), "looks": record}
OUT.mkdir(parents=True, exist_ok=True)
write_atomic(OUT / "long_clips.json", json.dumps(about, indent=1) + "\n")
write_atomic(OUT / "long_clips.md", text)
points = {
    f"{one['frames']} {one['join']}".removesuffix(" -"): (one["ms"], 1 - one["tasks"]["slip"]["mean"]) for one in record
}
plots.pareto(OUT / "figures" / "long_clips.png", points, x="ms a clip", y="share of slips told wrongly")
print(text)
page.show(OUT / "figures" / "long_clips.png")
