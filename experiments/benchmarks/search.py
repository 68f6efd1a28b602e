"""Search by touch: recall and latency of the graph of neighbours next to exact search.

python -m experiments.benchmarks.search --count 1000000
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.encoder.search import load_index
from anytouch_jax.evaluate.statistics import markdown_table
from experiments.command import run_script


@dataclass(frozen=True)
class SearchOptions:
    """Time searches among made features in clusters, as touches of one object are."""

    count: int = 1_000_000  # Features.
    width: int = 128  # Values of a feature.
    queries: int = 100
    nearest: int = 10


def seconds(function: Callable[[], Any]) -> tuple[float, Any]:
    """Return the time of a call, and its result."""
    begin = time.perf_counter()
    result = function()
    return time.perf_counter() - begin, result


def run(options: SearchOptions) -> int:
    """Print a table with both ways."""
    rng = np.random.default_rng(0)
    middles = rng.standard_normal((max(1, options.count // 50), options.width), np.float32)
    values = middles[rng.integers(len(middles), size=options.count)]
    values += 0.5 * rng.standard_normal(values.shape, np.float32)
    queries = values[rng.integers(options.count, size=options.queries)]
    queries = queries + 0.3 * rng.standard_normal(queries.shape, np.float32)
    rows, truth = [], np.zeros(0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "features.npz"
        np.savez(path, features=values, rows=np.arange(len(values)))
        for name, approximate in (("exact", False), ("graph (usearch)", True)):
            built, index = seconds(lambda approximate=approximate: load_index(path, approximate=approximate))
            found = [seconds(lambda q=q, index=index: index.search(q, options.nearest)) for q in queries]
            times, ids = 1e3 * np.array([each[0] for each in found]), np.stack([each[1][0][0] for each in found])
            truth = truth if approximate else ids
            recall = np.mean([len(set(a) & set(b)) / len(a) for a, b in zip(ids, truth, strict=True)])
            rows.append((name, f"{recall:.3f}", *(f"{np.percentile(times, q):.2f}" for q in (50, 99)), f"{built:.0f}"))
    head = (
        f"{options.count:,} features of {options.width}",
        f"recall@{options.nearest}",
        "p50 ms",
        "p99 ms",
        "ready in s",
    )
    print(markdown_table(head, rows))
    return 0


if __name__ == "__main__":
    sys.exit(run_script(SearchOptions, run))
