"""Results of probes: paired differences, tables and JSON."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.probe_results import (
    Outcome,
    ProbeResult,
    RegressionResult,
    SubsetResult,
    accuracy_difference,
    probe_json,
    probe_table,
    task_table,
)
from anytouch_jax.evaluate.statistics import mean_interval

ONE = ProbeResult(
    probe="linear",
    protocol="honest",
    accuracy=0.5,
    balanced_accuracy=0.4,
    low=0.25,
    high=0.75,
    baseline=0.1,
    refit_mean=0.45,
    refit_std=0.02,
    seeds=5,
    penalty=0.01,
    chosen_on="val",
    n_train=100,
    n_test=40,
    test_groups=8,
    classes=("ball", "cube"),
    parts=(SubsetResult("with photo", 0.6, 0.5, 0.7, 20), SubsetResult("empty", float("nan"), None, None, 0)),
    notes=("3 rows without this label left out",),
)
TWO = RegressionResult(
    probe="ridge",
    protocol="published",
    r2=0.81,
    low=0.7,
    high=0.9,
    mae=0.123,
    mae_low=0.1,
    mae_high=0.15,
    baseline_mae=0.5,
    penalty=1.0,
    chosen_on="test",
    n_train=100,
    n_test=40,
    test_groups=8,
)


def outcome(correct: Any, first: int = 0) -> ProbeResult:
    rows = np.arange(first, first + len(correct))
    return replace(ONE, outcome=Outcome(rows, np.asarray(correct, bool), rows // 5))


def test_a_difference_is_paired() -> None:
    rng = np.random.default_rng(0)
    hard = rng.random(60)[np.arange(300) // 5] < 0.5  # whole recordings are hard for both
    better, worse = ~hard, ~hard & (rng.random(300) < 0.9)
    change, low, high = accuracy_difference(outcome(better), outcome(worse))
    assert change == pytest.approx(better.mean() - worse.mean())
    assert 0 < low < change < high
    lock = mean_interval(better, np.arange(300) // 5)
    assert high - low < (lock[1] - lock[0]) / 2
    assert accuracy_difference(outcome(better), outcome(better)) == (0.0, 0.0, 0.0)


def test_a_difference_needs_the_same_rows() -> None:
    with pytest.raises(UserError, match="same rows"):
        accuracy_difference(outcome([True] * 10), outcome([True] * 10, first=1))
    with pytest.raises(UserError, match="same rows"):
        accuracy_difference(ONE, outcome([True] * 10))


def test_table() -> None:
    lines = probe_table([ONE, TWO]).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    assert len({len(row) for row in cells[:5]}) == len({len(row) for row in cells[5:]}) == 1
    assert cells[2][:7] == ["linear", "honest", "50.0 %", "25.0 to 75.0", "40.0 %", "10.0 %", "45.0 % ± 2.0"]
    assert cells[2][7:] == ["100", "40 (8)", "2", "0.01 (val)"]
    assert cells[3][:4] == ["linear: with photo", "honest", "60.0 %", "50.0 to 70.0"]
    assert cells[4][2:4] == ["-", "-"]
    assert cells[-1][:4] == ["ridge", "published", "0.810", "0.700 to 0.900"]
    assert lines[-1] == "- linear (honest): 3 rows without this label left out"


def test_json() -> None:
    one, two = json.loads(probe_json([outcome([True]), TWO]))
    assert one["accuracy"] == 0.5
    assert one["classes"] == ["ball", "cube"]
    assert one["parts"][1]["accuracy"] is None
    assert "outcome" not in one
    assert two["r2"] == 0.81


def test_the_table_of_tasks() -> None:
    names = {"features": "run", "task": "slip", "head": "knn", "protocol": "honest", "metric": "accuracy"}
    sizes = {"train": 50, "test": 20, "groups": 8, "notes": ["folds"]}
    row: dict[str, Any] = names | sizes | {"mean": 0.635, "low": 0.5, "high": 0.75, "chance": 0.6}
    errors = {"mae": 5.1234, "unit": "N", "chance_mae": 6.0}
    force = row | errors | {"task": "force", "metric": "r2", "mean": -0.3, "low": None, "high": None}
    lines = task_table({"results": [row, force], "paper": 0.8}).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    assert cells[2][4:] == ["63.5 %", "50.0 to 75.0", "60.0 %", "50", "20 (8)"]
    assert cells[3][4:7] == ["R2 -0.300, 5.12 N", "-", "6 N"]
    assert "- slip: folds" in lines and "80.00 %" in lines[-1]
