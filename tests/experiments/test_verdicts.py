"""Claims of the studies."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.probing import Outcome, ProbeResult
from anytouch_jax.evaluate.statistics import mean_interval
from experiments.verdicts import accuracy_difference, verdict


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


def outcome(correct: Any, first: int = 0) -> ProbeResult:
    rows = np.arange(first, first + len(correct))
    outcome = Outcome(rows, np.asarray(correct, bool), rows // 5)
    return ProbeResult("linear", "honest", None, None, 0.01, "val", 100, len(rows), 8, outcome=outcome)


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
        accuracy_difference(ProbeResult("x", "honest", None, None, None, "", 1, 1, 1), outcome([True] * 10))
