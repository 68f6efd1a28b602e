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
# `OUT=` is the folder of the page, its picture and `long_clips.jsonl`, which has a line for each length. `ROWS=` is the
# largest number of moments of a task. A length that was measured with the same encoder and data is not measured again.
# `QUICK=1` is a trial of a minute or two. `TABLE=1` makes the page from `long_clips.jsonl` alone.

# %%
from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import array_probes, plots, tasks
from anytouch_jax.evaluate.statistics import markdown_table
from anytouch_jax.files import atomic_write
from anytouch_jax.train.progress import silent
from experiments.benchmarks import machine
from experiments.records import read_records, write_record
from experiments.tables import env, page

RUN, DATA = env.path("RUN", "runs/stage2"), env.path("DATA", "data/scenes/manifest.parquet")
QUICK, TABLE = env.switch("QUICK"), env.switch("TABLE")
OUT, NAME = env.path("OUT", "experiments/results"), "long_clips-quick" if QUICK else "long_clips"
ROWS = env.number("ROWS", 100 if QUICK else 1500)
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
            fit = array_probes.probe_features(*given, measured=True)
            result[name] = {"mean": fit.r2, "low": fit.low, "high": fit.high, "test": fit.n_test, "chance": 0.0}
        else:
            hit = array_probes.probe_features(*given, seeds=0)
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
            encoder.encode_touch(clips[:, :frames], sensor, pooling="both", join=join)  # type: ignore[arg-type]
            if turn:  # the first one compiles
                spent[k].append(1e3 * (time.perf_counter() - start) / BATCH)
    return [float(np.median(one)) for one in spent]


# %% [markdown]
# ## Look by look

# %%
RESULTS = OUT / f"{NAME}.jsonl"
SETTINGS: dict[str, Any] = {"version": 2, "rows": ROWS, "rounds": ROUNDS, "batch": BATCH}
if not TABLE:
    SETTINGS |= {"encoder": encoder.fingerprint, "manifest": table.content_hash}


def make(key: str, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the record of a length, measured first unless it was measured with these settings."""
    record = read_records(RESULTS).get(key)
    if TABLE and record is None:
        raise UserError(f"{RESULTS} has no record {key}. Run this page without TABLE=1.")
    if record is None or not (TABLE or record["settings"] == SETTINGS):
        record = {"run": RUN.name, "machine": machine.describe().sentence(), "settings": SETTINGS} | measure()
        write_record(RESULTS, key, record)
    return record


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

{markdown_table(head, body)}

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
