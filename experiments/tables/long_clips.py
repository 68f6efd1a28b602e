"""Longer clips: what they cost and what they show.

A clip of more than three frames is embedded as segments of three, whose features are averaged, summed or concatenated
(App. "Discussion on frame number"). The same moments are embedded with one, three, five and seven frames. Linear probes
of frozen features (honest protocol, objects never touched in training) read slip, force, the sign of a twist and the
direction of a slide.

    make long-clips RUN=runs/stage2 DATA=data/scenes/manifest.parquet

`OUT=` is the folder of `long_clips.jsonl`, a line a length. `ROWS=` bounds the moments of a task. A
length that was measured with the same encoder and data is not measured again. `QUICK=1` is a trial of a minute or two.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.encoder.encoder import Encoder, load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import probing, tasks
from anytouch_jax.train.progress import silent
from experiments.benchmarks import machine
from experiments.benchmarks.speed import interleaved
from experiments.records import read_records, write_record
from experiments.tables import env

RUN, DATA = env.path("RUN", "runs/stage2"), env.path("DATA", "data/scenes/manifest.parquet")
QUICK = env.switch("QUICK")
OUT, NAME = env.path("OUT", "experiments/results"), "long_clips-quick" if QUICK else "long_clips"
ROWS = env.number("ROWS", 100 if QUICK else 1500)
ROUNDS, BATCH = (3, 8) if QUICK else (9, 32)
LOOKS = [(1, "mean"), (3, "mean"), *((frames, join) for frames in (5, 7) for join in ("mean", "sum", "concat"))]
LONGEST = max(frames for frames, _ in LOOKS)
TASKS = ("slip", "force", "twist", "slide")

RESULTS = OUT / f"{NAME}.jsonl"
SETTINGS: dict[str, Any] = {"version": 2, "rows": ROWS, "rounds": ROUNDS, "batch": BATCH}


class Moments(NamedTuple):
    """The same moments for every length: `rows` of `table` that end a clip of the longest, and by task."""

    encoder: Encoder
    table: Manifest
    tasks: dict[str, tasks.TaskRows]
    rows: np.ndarray


def moments() -> Moments:
    """Return the moments of each task by the sensors in the encoder's table."""
    encoder, table = load_encoder(RUN), manifests.read(DATA)
    chosen = {}
    for name in TASKS:
        ends = tasks.select(table, tasks.find_task(name), LONGEST)
        kept = np.flatnonzero(np.isin(ends.sensors, encoder.config.model.sensors))
        if len(kept) > ROWS:
            kept = np.sort(np.random.default_rng(0).choice(kept, ROWS, replace=False))
        chosen[name] = ends.take(kept)
    return Moments(encoder, table, chosen, np.unique(np.concatenate([one.rows[:, 0] for one in chosen.values()])))


def scores(of: Moments, values: np.ndarray) -> dict[str, dict[str, Any]]:
    """Return the accuracy, or R2 of force, with its interval over test objects, of each task."""
    result: dict[str, dict[str, Any]] = {}
    for name, one in of.tasks.items():
        given = (values[np.searchsorted(of.rows, one.rows[:, 0])], one.labels, one.groups, one.split)
        if name == "force":
            fit = probing.probe_features(*given, measured=True)
            result[name] = {"mean": fit.r2, "low": fit.low, "high": fit.high, "test": fit.n_test, "chance": 0.0}
        else:
            hit = probing.probe_features(*given, seeds=0)
            result[name] = {"mean": hit.accuracy, "low": hit.low, "high": hit.high, "test": hit.n_test}
            result[name] |= {"chance": hit.baseline, "balanced": hit.balanced_accuracy}
    return result


def milliseconds(encoder: Encoder) -> list[float]:
    """Return the median time of a clip in a batch for each length, all in turns."""
    side = encoder.config.model.image_size
    clips = np.random.default_rng(0).integers(0, 256, (BATCH, LONGEST, side, side, 3), np.uint8)
    sensor = np.zeros(BATCH, np.int32)
    calls = [partial(encoder.encode_touch, clips[:, :n], sensor, pooling="both", join=join) for n, join in LOOKS]
    return [float(np.median(spent)) * 1e3 / BATCH for spent in interleaved(calls, ROUNDS)]


def probed(of: Moments, frames: int, join: Any) -> dict[str, Any]:
    """Return the scores of a length."""
    read, values = embed_rows(of.encoder, of.table, of.rows, frames, "both", join, log=silent)
    if len(read) < len(of.rows):
        raise UserError(f"{len(of.rows) - len(read)} rows cannot be read; check them with `anytouch data verify`")
    found = scores(of, values)
    print({name: round(one["mean"], 3) for name, one in found.items()}, frames, join, flush=True)
    return {"tasks": found}


def record_of(key: str, of: Moments, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the record of a length, measured first unless it was measured with these settings."""
    record = read_records(RESULTS).get(key)
    settings = SETTINGS | {"encoder": of.encoder.fingerprint, "manifest": of.table.content_hash}
    if record is None or record["settings"] != settings:
        record = {"run": RUN.name, "machine": machine.describe().sentence(), "settings": settings} | measure()
        write_record(RESULTS, key, record)
    return record


def main() -> None:
    of = moments()
    record_of("time", of, lambda: {"ms": milliseconds(of.encoder)})
    for frames, join in LOOKS:
        record_of(f"{frames}-{join}", of, partial(probed, of, frames, join))


if __name__ == "__main__":
    main()
