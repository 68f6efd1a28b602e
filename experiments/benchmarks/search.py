"""Search by touch: recall and latency of cells (FAISS) and of exact search (numpy).

    python -m experiments.benchmarks.search --count 1000000

A line a way and size goes to `experiments/results/search.jsonl`. `make results` makes the page from that file alone.
"""

from __future__ import annotations

import dataclasses
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.encoder.search import load_index
from anytouch_jax.evaluate.statistics import markdown_table
from experiments.benchmarks import machine
from experiments.command import run_script
from experiments.records import write_record

WAYS = {"exact (numpy)": False, "cells (FAISS)": True}


@dataclass(frozen=True)
class SearchOptions:
    """Time searches among made features in clusters, as touches of one object are."""

    count: int = 1_000_000  # Features.
    width: int = 128  # Values of a feature.
    queries: int = 200
    nearest: int = 10
    out: Path = Path("experiments/results/search.jsonl")  # JSON lines.


def timed(function: Callable[[], Any]) -> tuple[float, float, Any]:
    """Return the seconds of a call, the processor seconds of all its threads, and its result."""
    begin, work = time.perf_counter(), time.process_time()
    result = function()
    return time.perf_counter() - begin, time.process_time() - work, result


def made_features(options: SearchOptions) -> tuple[np.ndarray, np.ndarray]:
    """Return features (count, width), some 50 around a middle, and queries near some of them, all f32."""
    rng = np.random.default_rng(0)
    middles = rng.standard_normal((max(1, options.count // 50), options.width), np.float32)
    values = middles[rng.integers(len(middles), size=options.count)]
    values += 0.5 * rng.standard_normal(values.shape, np.float32)
    queries = values[rng.integers(options.count, size=options.queries)]
    return values, queries + 0.3 * rng.standard_normal(queries.shape, np.float32)


def measured(path: Path, queries: np.ndarray, options: SearchOptions) -> dict[str, dict[str, Any]]:
    """Return the record of each way: times of one query alone in ms, recall of the exact result, seconds to open."""
    records: dict[str, dict[str, Any]] = {}
    truth: Any = None
    for way, approximate in WAYS.items():
        opened, work, index = timed(partial(load_index, path, approximate=approximate))
        load, found = (
            os.getloadavg()[0],
            [timed(partial(index.search, q, options.nearest)) for q in queries],
        )
        ids = np.stack([result[0][0] for *_, result in found])
        truth = truth if approximate else ids
        wall, processor = (1e3 * np.array([each[i] for each in found]) for i in (0, 1))
        records[way] = {
            "count": options.count, "width": options.width, "nearest": options.nearest, "queries": options.queries,
            "recall": float(np.mean([len(set(a) & set(b)) / len(a) for a, b in zip(ids, truth, strict=True)])),
            "p50_ms": float(np.median(wall)), "p99_ms": float(np.percentile(wall, 99)),
            "processor_ms": float(processor.mean()), "opened_s": opened, "opened_processor_s": work, "load": load,
            "machine": dataclasses.asdict(machine.describe()),
        }  # fmt: skip
    return records


def run(options: SearchOptions) -> int:
    """Measure both ways, store them and print a table."""
    values, queries = made_features(options)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "features.npz"
        np.savez(path, features=values, rows=np.arange(len(values)))
        del values
        records = measured(path, queries, options)
    for way, record in records.items():
        write_record(options.out, f"{options.count:09d}/{way}", record | {"way": way})
    shown = ("recall", "p50_ms", "p99_ms", "processor_ms", "opened_s", "opened_processor_s", "load")
    rows = [(way, *(f"{record[name]:.3f}" for name in shown)) for way, record in records.items()]
    print(markdown_table((f"{options.count:,} features", *shown), rows))
    return 0


if __name__ == "__main__":
    sys.exit(run_script(SearchOptions, run))
