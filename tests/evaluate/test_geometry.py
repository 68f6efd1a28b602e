from typing import Any

import numpy as np
import pytest
from scipy.stats import binomtest

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import statistics
from anytouch_jax.evaluate.plots import alignment, describe, silhouette, tsne, uniformity
from anytouch_jax.evaluate.statistics import (
    GroupSums,
    classification_sums,
    fraction_interval,
    mean_interval,
    regression_sums,
)


def noise(count: int, width: int = 8, seed: int = 0) -> Any:
    return np.random.default_rng(seed).normal(size=(count, width))


def test_alignment_and_uniformity_by_hand() -> None:
    right = np.array([[2.0, 0.0]])
    up = np.array([[0.0, 0.5]])
    assert alignment(right, up) == pytest.approx(2.0) and alignment(right, -right) == pytest.approx(
        4.0
    )
    with pytest.raises(UserError, match="pairs"):
        alignment(right, np.ones((2, 2)))
    three = np.array([[1.0, 0.0], [0.0, 1.0], [-3.0, 0.0]])
    assert uniformity(three) == pytest.approx(np.log((2 * np.exp(-4) + np.exp(-8)) / 3))
    with pytest.raises(UserError, match="two rows"):
        uniformity(np.ones((1, 3)))


def test_silhouettes_know_the_labels_that_made_the_space() -> None:
    labels = np.repeat(["a", "b", "c"], 30)
    centres = 10 * np.eye(8)[np.repeat([0, 1, 2], 30)]
    features = noise(90) * 0.3 + centres
    assert silhouette(features, labels) > 0.9
    assert abs(silhouette(features, np.tile(["x", "y"], 45))) < 0.05
    assert silhouette(features, np.roll(labels, 15)) < 0.3
    assert silhouette(features, ["a"] * 90) is None and silhouette(features, np.arange(90)) is None


def test_a_space_in_figures() -> None:
    """Two sensors feel thirty touches of ten objects: once the sensor decides where they lie, once
    the object.
    """
    sensors = np.repeat(["digit", "gelslim"], 30)
    touches = np.tile(np.arange(30), 2)
    objects = touches // 3
    by_sensor = noise(60) * 0.3 + 5 * np.eye(8)[np.repeat([0, 1], 30)]
    by_object = noise(10, seed=1)[objects] + 0.01 * noise(60, seed=2)
    first, second = (
        describe(x, sensors, objects, touches, name="x") for x in (by_sensor, by_object)
    )
    assert first.silhouette_sensor > 0.8 > 0.1 > second.silhouette_sensor
    assert second.silhouette_object > 0.8 > 0.1 > first.silhouette_object
    assert second.alignment < 0.01 < 1.5 < first.alignment
    pairs = alignment(by_sensor[:30], by_sensor[30:])
    assert first.alignment == pytest.approx(pairs) and first.rows == 60
    # no pair by two sensors
    assert describe(by_sensor, ["digit"] * 60, objects, touches).alignment is None
    # rows of no known object are no object
    names = np.where(objects < 5, objects.astype(str), "")
    some = describe(by_object, sensors, names, touches).silhouette_object
    assert some == pytest.approx(silhouette(by_object[objects < 5], objects[objects < 5]))


def test_tsne_keeps_clusters_apart_and_repeats_itself() -> None:
    labels = np.repeat([0, 1, 2], 20)
    features = noise(60) * 0.2 + 5 * np.eye(8)[labels]
    points = tsne(features)
    assert points.shape == (60, 2) and points.dtype == np.float32
    away = np.linalg.norm(points[:, None] - points[None], axis=-1) + 1e9 * np.eye(60)
    assert (labels[away.argmin(1)] == labels).all()
    np.testing.assert_array_equal(tsne(features), points)
    assert tsne(noise(4)).shape == (4, 2)
    with pytest.raises(UserError, match="4 rows"):
        tsne(noise(3))


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


def r2_interval(
    error: np.ndarray, truth: np.ndarray, groups: np.ndarray
) -> tuple[float | None, float | None]:
    return statistics._bootstrap_interval(
        [regression_sums(error, truth - truth.mean(), groups)], statistics._r2_of
    )


def test_an_offset_changes_no_r2_interval() -> None:
    rng = np.random.default_rng(0)
    truth = rng.standard_normal(60)
    error = 0.1 * rng.standard_normal(60)
    groups = np.arange(60) // 3
    np.testing.assert_allclose(
        r2_interval(error, truth + 1.7e9, groups), r2_interval(error, truth, groups), atol=1e-5
    )
    assert r2_interval(error, np.ones(60), groups) == (None, None)


def test_seeds_and_groups_are_drawn_independently() -> None:
    """Seed k is right on group k alone: drawn alike, seeds and groups would meet in every draw, 0.2
    at least.
    """
    group = np.arange(50) // 10
    low, high = statistics._bootstrap_interval(
        [classification_sums(group == k, group) for k in range(5)], statistics._mean_of
    )
    assert low < 0.1 and 0.2 < high < 0.5


def test_a_value_that_no_draw_has_has_no_interval() -> None:
    still = np.stack([np.ones(20), np.ones(20), np.full(20, 3.0), np.full(20, 9.0), np.ones(20)], 1)
    assert statistics._bootstrap_interval(
        [GroupSums(np.array([f"g{i // 2}" for i in range(20)]), still)], statistics._r2_of
    ) == (None, None)


def test_values_from_sums() -> None:
    truth = np.array([1.0, 2.0, 3.0, 6.0])
    error = np.array([0.0, 0.5, 0.0, -1.0])
    sums = regression_sums(error, truth, np.arange(4)).sums.sum(0)
    assert statistics._r2_of(sums) == pytest.approx(
        1 - 1.25 / np.sum((truth - 3) ** 2)
    ) and statistics._mae_of(sums) == pytest.approx(1.5 / 4)


@pytest.mark.parametrize("right", [True, False])
@pytest.mark.parametrize("count", [2, 7, 60])
def test_an_interval_of_equal_groups_does_not_collapse(right: bool, count: int) -> None:
    """All recordings right, or all wrong: the interval of Clopper and Pearson, whatever frames."""
    for each in (1, 40):
        groups = np.repeat(np.arange(count), each)
        low, high = fraction_interval(np.full(count * each, right), groups)
        exact = binomtest(count * right, count).proportion_ci(0.95, "exact")
        assert (low, high) == pytest.approx((exact.low, exact.high), abs=1e-6)
    one_wrong = np.arange(count) > 0
    assert fraction_interval(one_wrong, np.arange(count)) == mean_interval(
        one_wrong, np.arange(count)
    )
    # a difference that is 0 on every group stays 0
    assert mean_interval(np.zeros(count), np.arange(count)) == (0.0, 0.0)


def test_an_interval_of_one_group_is_none_and_seeds_are_no_trials() -> None:
    assert fraction_interval(np.ones(9), np.zeros(9)) == (None, None)
    groups = np.arange(10)
    run = classification_sums(np.ones(10), groups)
    scored = [statistics.scores([run] * seeds, [run] * seeds, False) for seeds in (1, 5)]
    assert scored[0]["low"] == scored[1]["low"] == pytest.approx(0.025**0.1)
