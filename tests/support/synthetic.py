"""Records of the matrix with made-up numbers: what the tables and images read."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from experiments.records import read_records, write_record
from experiments.tables import plan
from experiments.tables.columns import FORM, FOUR, MOVING, SIX
from experiments.tables.results import Column

Mean = Callable[[str, str, int, str, str], float]  # (question, name, seed, view, task) -> 0..1


def level(question: str, name: str, seed: int, view: str, task: str) -> float:
    """Every model the same."""
    return 0.5


def write(results: Path, leaves: Sequence[plan.Leaf], mean: Mean = level) -> None:
    """Write a record of each run."""
    lines = [json.dumps({"key": leaf.key, **record_of(leaf, mean)}) for leaf in leaves]
    results.parent.mkdir(parents=True, exist_ok=True)
    results.write_text("".join(f"{line}\n" for line in sorted(lines)))


def change(results: Path, key: str, **values: Any) -> None:
    """Change fields of a record; None removes one."""
    record = read_records(results)[key] | values
    write_record(results, key, {name: value for name, value in record.items() if value is not None})


def record_of(leaf: plan.Leaf, mean: Mean = level) -> dict[str, Any]:
    rows = [
        row
        for one in COLUMNS[leaf.question]
        for row in _rows(leaf, one.view, one.task, one.metric, mean)
    ]
    return {
        "question": leaf.question,
        "name": leaf.name,
        "seed": leaf.seed,
        "identity": leaf.identity,
        "simulator": plan.simulator(),
        "settings": plan.settings(leaf.size),
        "scoring": plan.scoring(leaf.question),
        "size": leaf.size.name,
        "trained": [{"key": one.key, "seconds": 60.0} for one in leaf.trainings],
        "data": {"own": "0" * 64},
        "version": "0",
        "source": "s",
        "machine": "a machine; load 1",
        "seconds": 30.0,
        "rows": rows,
        "points": _points(leaf.seed) if leaf.question == "q2" else [],
    }


SILHOUETTES = [f"silhouette by {one}" for one in ("sensor", "object")]
COLUMNS = {
    "q1": (*FOUR, *FORM),
    "ablations": (*FOUR, *FORM),
    "q3": (*SIX, *FORM, *MOVING),
    "q2": (
        Column("class token", "top-1", "fraction"),
        *(Column("class token", one, one) for one in SILHOUETTES),
    ),
}


def _rows(leaf: plan.Leaf, view: str, task: str, metric: str, mean: Mean) -> list[dict[str, Any]]:
    value = mean(leaf.question, leaf.name, leaf.seed, view, task)
    shared = {"view": view, "task": task, "metric": metric, "test": 100}
    both = ("grouped",) if leaf.question == "q2" else ("grouped", "released")
    return [
        shared | {"protocol": one, "mean": value, "low": value - 0.05, "high": value + 0.05}
        for one in both
    ]


def _points(seed: int) -> list[dict[str, Any]]:
    rng = np.random.default_rng(seed)
    return [
        {"x": float(rng.normal()), "y": float(rng.normal()), "sensor": sensor, "touch": touch}
        for touch in range(30)
        for sensor in ("digit", "gelsight", "gelsight_mini")
    ]
