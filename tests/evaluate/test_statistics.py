import numpy as np
import pytest

from anytouch_jax.evaluate.statistics import (
    GroupSums,
    bootstrap_interval,
    classification_sums,
    mae_of,
    mean_interval,
    mean_of,
    r2_of,
    regression_sums,
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


def test_the_interval_covers_the_truth_about_95_times_in_100() -> None:
    rng = np.random.default_rng(0)
    groups = np.repeat(np.arange(60), 4)
    hits = 0
    for _ in range(200):
        values = rng.random(240) < rng.beta(2, 2, 60)[groups]
        low, high = mean_interval(values, groups)
        hits += low <= 0.5 <= high
    assert 180 <= hits <= 200


def r2_interval(error: np.ndarray, truth: np.ndarray, groups: np.ndarray) -> tuple[float | None, float | None]:
    return bootstrap_interval([regression_sums(error, truth - truth.mean(), groups)], r2_of)


def test_an_offset_changes_no_r2_interval() -> None:
    rng = np.random.default_rng(0)
    truth, error, groups = rng.standard_normal(60), 0.1 * rng.standard_normal(60), np.arange(60) // 3
    np.testing.assert_allclose(r2_interval(error, truth + 1.7e9, groups), r2_interval(error, truth, groups), atol=1e-5)
    assert r2_interval(error, np.ones(60), groups) == (None, None)


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
