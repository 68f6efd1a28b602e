"""Intervals over groups, paired differences, tables and JSON."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.statistics import (
    GroupSums,
    Outcome,
    Part,
    ProbeResult,
    RegressionResult,
    bootstrap_interval,
    classification_sums,
    difference,
    mae_of,
    mean_interval,
    mean_of,
    r2_interval,
    r2_of,
    regression_sums,
    to_json,
    to_table,
    verdict,
)

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
    parts=(Part("with photo", 0.6, 0.5, 0.7, 20), Part("nobody", float("nan"), None, None, 0)),
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


def width(groups: int, each: int, seed: int = 0) -> float:
    """Width of the interval of a coin thrown once a group: all frames of a group agree."""
    coin = np.random.default_rng(seed).permutation(groups) % 2
    low, high = mean_interval(np.repeat(coin, each), np.repeat(np.arange(groups), each))
    assert low is not None
    assert high is not None
    return high - low


def test_the_interval_shrinks_with_groups_not_with_frames() -> None:
    assert width(400, 5) == pytest.approx(width(25, 5) / 4, rel=0.2)
    assert width(25, 100) == pytest.approx(width(25, 1), rel=1e-9)


def test_the_interval_is_that_of_a_binomial() -> None:
    assert width(400, 3) == pytest.approx(2 * 1.96 * 0.5 / np.sqrt(400), rel=0.1)


def test_the_interval_covers_the_truth_about_95_times_in_100() -> None:
    rng = np.random.default_rng(0)
    groups = np.repeat(np.arange(60), 4)
    hits = 0
    for _ in range(200):
        values = rng.random(240) < rng.beta(2, 2, 60)[groups]
        low, high = mean_interval(values, groups)
        hits += low <= 0.5 <= high
    assert 180 <= hits <= 200


def test_one_group_has_no_interval() -> None:
    assert mean_interval(np.ones(5), np.zeros(5)) == (None, None)
    assert r2_interval(np.ones(5), np.arange(5.0), np.zeros(5)) == (None, None)


def test_an_offset_changes_no_r2_interval() -> None:
    rng = np.random.default_rng(0)
    truth, error, groups = rng.standard_normal(60), 0.1 * rng.standard_normal(60), np.arange(60) // 3
    np.testing.assert_allclose(r2_interval(error, truth + 1.7e9, groups), r2_interval(error, truth, groups), atol=1e-5)
    assert r2_interval(error, np.ones(60), groups) == (None, None)


def test_r2_interval_holds_the_value() -> None:
    rng = np.random.default_rng(0)
    truth, error, groups = rng.normal(size=600), 0.5 * rng.normal(size=600), np.arange(600) // 3
    low, high = r2_interval(error, truth, groups)
    assert low < 0.75 < high
    assert high - low < 0.2
    low, high = r2_interval(np.zeros(600), truth, groups)
    assert (low, high) == (1.0, 1.0)


def outcome(correct: Any, first: int = 0) -> ProbeResult:
    rows = np.arange(first, first + len(correct))
    return replace(ONE, outcome=Outcome(rows, np.asarray(correct, bool), rows // 5))


def test_seeds_that_differ_widen_the_interval() -> None:
    group = np.arange(200)
    same = np.arange(200) % 2 == 0
    narrow = bootstrap_interval([classification_sums(same, group)] * 5, mean_of)
    apart = [classification_sums(np.arange(200) % 10 < k, group) for k in (1, 3, 5, 7, 9)]
    wide = bootstrap_interval(apart, mean_of)
    assert wide[1] - wide[0] > 2 * (narrow[1] - narrow[0])


def test_seeds_and_groups_are_drawn_independently() -> None:
    """Seed k is right on group k alone: drawn alike, seeds and groups would meet in every draw, 0.2 at least."""
    group = np.arange(50) // 10
    low, high = bootstrap_interval([classification_sums(group == k, group) for k in range(5)], mean_of)
    assert low < 0.1 and 0.2 < high < 0.5


def test_values_from_sums() -> None:
    truth, said = np.array([1.0, 2.0, 3.0, 6.0]), np.array([1.0, 2.5, 3.0, 5.0])
    error = said - truth
    sums = regression_sums(error, truth, np.arange(4)).sums.sum(0)
    assert r2_of(sums) == pytest.approx(1 - 1.25 / np.sum((truth - 3) ** 2))
    assert mae_of(sums) == pytest.approx(1.5 / 4)
    assert mean_of(np.array([3.0, 4.0])) == 0.75


def test_a_value_that_no_draw_has_has_no_interval() -> None:
    still = np.stack([np.ones(20), np.ones(20), np.full(20, 3.0), np.full(20, 9.0), np.ones(20)], 1)
    assert bootstrap_interval([GroupSums(np.array([f"g{i // 2}" for i in range(20)]), still)], r2_of) == (None, None)


def test_a_difference_is_paired() -> None:
    rng = np.random.default_rng(0)
    hard = rng.random(60)[np.arange(300) // 5] < 0.5  # whole recordings are hard for both
    better, worse = ~hard, ~hard & (rng.random(300) < 0.9)
    change, low, high = difference(outcome(better), outcome(worse))
    assert change == pytest.approx(better.mean() - worse.mean())
    assert 0 < low < change < high
    lock = mean_interval(better, np.arange(300) // 5)
    assert high - low < (lock[1] - lock[0]) / 2
    assert difference(outcome(better), outcome(better)) == (0.0, 0.0, 0.0)


def test_a_difference_needs_the_same_rows() -> None:
    with pytest.raises(UserError, match="not tested on the same rows"):
        difference(outcome([True] * 10), outcome([True] * 10, first=1))
    with pytest.raises(UserError, match="not tested on the same rows"):
        difference(ONE, outcome([True] * 10))


def test_table() -> None:
    lines = to_table([ONE, TWO]).splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    assert len({len(row) for row in cells[:5]}) == len({len(row) for row in cells[5:]}) == 1
    assert cells[2][:7] == ["linear", "honest", "50.0 %", "25.0 to 75.0", "40.0 %", "10.0 %", "45.0 % ± 2.0"]
    assert cells[2][7:] == ["100", "40 (8)", "2", "0.01 (val)"]
    assert cells[3][:4] == ["linear: with photo", "honest", "60.0 %", "50.0 to 70.0"]
    assert cells[4][2:4] == ["-", "-"]
    assert cells[-1][:4] == ["ridge", "published", "0.810", "0.700 to 0.900"]
    assert lines[-1] == "- linear (honest): 3 rows without this label left out"


def test_json() -> None:
    one, two = json.loads(to_json([outcome([True]), TWO]))
    assert one["accuracy"] == 0.5
    assert one["classes"] == ["ball", "cube"]
    assert one["parts"][1]["accuracy"] is None
    assert "outcome" not in one
    assert two["r2"] == 0.81


@pytest.mark.parametrize(
    ("low", "high", "seeds", "wanted", "word"),
    [
        (0.1, 2.0, 3, 1, "agrees"),
        (0.1, 2.0, 3, -1, "disagrees"),
        (-2.0, -0.1, 3, -1, "agrees"),
        (-2.0, -0.1, 5, 1, "disagrees"),
        (-0.1, 2.0, 3, 1, "undecided"),
        (0.0, 2.0, 3, 1, "undecided"),
        (None, None, 3, 1, "undecided"),
        (0.1, 2.0, 2, 1, "2 seeds, no claim"),
        (0.1, 2.0, 1, 1, "1 seed, no claim"),
    ],
)
def test_a_sign_is_told_of_an_interval_that_leaves_zero_out(low, high, seeds, wanted, word):
    assert verdict(low, high, seeds, wanted=wanted) == word
