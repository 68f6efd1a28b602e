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
#     make long-clips RUN=runs/stage2 DATA=data/scenes/manifest.parquet
#
# `OUT=` is where the page, its picture and the folder `long_clips/` (a JSON file for each length) go, `ROWS=` how many
# moments of a task at most. A length whose file is there, of this encoder and these data, is not done again. `QUICK=1`
# is a trial of a minute or two, and `TABLE=1` makes the page anew from the files alone.

# %%
from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.encoder import Encoder, embed_rows, load_encoder
from anytouch_jax.evaluate import array_probes, plots, tasks
from anytouch_jax.evaluate.statistics import markdown
from anytouch_jax.files import atomic_write
from anytouch_jax.train.progress import silent
from experiments.benchmarks import machine
from experiments.tables import asked, page
from experiments.tables.results import noted

RUN, DATA = asked.path("RUN", "runs/stage2"), asked.path("DATA", "data/scenes/manifest.parquet")
QUICK, TABLE = asked.switch("QUICK"), asked.switch("TABLE")
OUT, NAME = asked.path("OUT", "experiments/results"), "long_clips-quick" if QUICK else "long_clips"
ROWS = asked.number("ROWS", 100 if QUICK else 1500)
ROUNDS, BATCH = (3, 8) if QUICK else (9, 32)
LOOKS = [(1, "mean"), (3, "mean"), *((frames, join) for frames in (5, 7) for join in ("mean", "sum", "concat"))]
LONGEST = max(frames for frames, _ in LOOKS)
TASKS = ("slip", "force", "twist", "slide")

if not TABLE:
    encoder, table = load_encoder(RUN), manifests.read(DATA)

# %% [markdown]
# ## The same moments for every length
#
# A task's moments that end a clip of the longest length, by the sensors in the encoder's table.


# %%
def moments(name: str) -> tasks.TaskRows:
    found = tasks.select(table, tasks.find_task(name), LONGEST)
    kept = np.flatnonzero(np.isin(found.sensors, encoder.config.model.sensors))
    if len(kept) > ROWS:
        kept = np.sort(np.random.default_rng(0).choice(kept, ROWS, replace=False))
    return found.take(kept)


if not TABLE:
    chosen = {name: moments(name) for name in TASKS}
    rows = np.unique(np.concatenate([one.rows[:, 0] for one in chosen.values()]))


def scores(values: np.ndarray) -> dict[str, dict[str, Any]]:
    """Accuracy, or R2 of force, with its interval over test objects, of each task."""
    result: dict[str, dict[str, Any]] = {}
    for name, one in chosen.items():
        given = (values[np.searchsorted(rows, one.rows[:, 0])], one.labels, one.groups, one.split)
        if name == "force":
            fit = array_probes.regression_probe(*given)
            result[name] = {"mean": fit.r2, "low": fit.low, "high": fit.high, "test": fit.n_test, "chance": 0.0}
        else:
            hit = array_probes.linear_probe(*given, seeds=0)
            result[name] = {"mean": hit.accuracy, "low": hit.low, "high": hit.high, "test": hit.n_test}
            result[name] |= {"chance": hit.baseline, "balanced": hit.balanced_accuracy}
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


# %% [markdown]
# ## Look by look

# %%
FOLDER = OUT / NAME
FOLDER.mkdir(parents=True, exist_ok=True)
SETTINGS: dict[str, Any] = {"version": 2, "rows": ROWS, "rounds": ROUNDS, "batch": BATCH}
if not TABLE:
    SETTINGS |= {"encoder": encoder.mark, "manifest": table.content_hash}


def finished(path: Path) -> dict[str, Any] | None:
    """What was measured with these settings, if it was; with TABLE=1 whatever was measured."""
    found = noted(path)
    return found if found and (TABLE or found.get("settings") == SETTINGS) else None


def make(name: str, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    path = FOLDER / f"{name}.json"
    found = finished(path)
    if found is None and TABLE:
        raise SystemExit(f"there is no {path}: run this page without TABLE=1")
    if found is None:
        found = {"run": RUN.name, "machine": machine.describe().sentence(), "settings": SETTINGS} | measure()
        atomic_write(path, json.dumps(found, indent=1) + "\n")
    return found


def seen(frames: int, join: Any) -> dict[str, Any]:
    read, values = embed_rows(encoder, table, rows, frames, "both", join, log=silent)
    if len(read) < len(rows):
        raise SystemExit(f"{len(rows) - len(read)} rows cannot be read; `anytouch verify` says what is wrong with them")
    found = scores(values)
    print({name: round(one["mean"], 3) for name, one in found.items()}, frames, join, flush=True)
    return {"tasks": found}


time_taken = make("time", lambda: {"ms": milliseconds(encoder)})
cost = time_taken["ms"]
record: list[dict[str, Any]] = []
for (frames, join), ms in zip(LOOKS, cost, strict=True):
    about = {"frames": frames, "join": join if frames > 3 else "-", "ms": ms, "ratio": ms / cost[1]}
    record.append(about | make(f"{frames}-{join}", partial(seen, frames, join)))

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
chance = (
    cell(name, record[0]["tasks"][name] | {"mean": record[0]["tasks"][name]["chance"], "low": None}) for name in TASKS
)
body.append(("*the commonest answer*", "-", "-", "-", *chance))
tested = ", ".join(f"{name} {one['test']}" for name, one in record[0]["tasks"].items())
text = f"""# Longer clips: what they see beside what they cost

Made by `make long-clips` from the run `{time_taken["run"]}`. {time_taken["machine"]}
Linear probes of frozen features, one fit, on objects never touched in training, 95 % over them; moments: {tested}.
An accuracy equal to that of the commonest answer is one: the probe found nothing and gives the same answer for all.
Time: a clip in a batch of {BATCH}, the median of {ROUNDS} rounds in turns.

{markdown(head, body)}

![Slip against time](figures/{NAME}.png)
"""
atomic_write(OUT / f"{NAME}.md", text)
points = {
    f"{one['frames']} {one['join']}".removesuffix(" -"): (one["ms"], 1 - one["tasks"]["slip"]["mean"]) for one in record
}
picture = OUT / "figures" / f"{NAME}.png"
plots.pareto(picture, points, x="ms a clip", y="share of slips told wrongly")
print(text)
page.show(picture)
