"""Linear heads of many classes."""

import time
from typing import Any

import numpy as np
import pytest
from scipy.linalg import eigh
from task_world import blobs
from threadpoolctl import ThreadpoolController

from anytouch_jax.evaluate import discriminant, heads, logistic
from anytouch_jax.evaluate.array_probes import probe_features
from anytouch_jax.evaluate.discriminant import discriminant_path
from anytouch_jax.evaluate.heads import ProbeHead, fit_head, linear_path, vote


def many(classes: int, *, each: int = 8, d: int = 24, apart: float = 1.0, seed: int = 0) -> Any:
    """Features and classes: class means under noise that is correlated, as that of a network."""
    rng = np.random.default_rng(seed)
    y = np.repeat(np.arange(classes), each)
    noise = rng.normal(size=(len(y), d)) @ rng.normal(size=(d, d)) * np.geomspace(1, 0.1, d)
    x = apart * rng.normal(size=(classes, d))[y] + 0.2 * noise
    return x.astype(np.float32), y


@pytest.mark.parametrize("penalty", [1.0, 0.01])
def test_it_is_the_discriminant_of_the_textbook(penalty):
    x, y = blobs(300, classes=4)
    (ours,) = discriminant_path(x, y, 4, [penalty])
    means = np.stack([x[y == k].mean(0) for k in range(4)])
    within = (x - means[y]).T @ (x - means[y]) / len(x)
    inverse = np.linalg.inv(within + penalty * np.eye(x.shape[1]))
    prior = np.log(np.bincount(y) / len(y))
    bias = prior - 0.5 * np.einsum("ki,ij,kj->k", means, inverse, means)
    np.testing.assert_allclose(ours.weights, (means @ inverse).T, rtol=2e-3, atol=1e-3)
    np.testing.assert_allclose(ours.bias, bias, rtol=2e-3, atol=1e-2)
    assert ours.finished


def test_a_row_that_counts_twice_is_a_row_given_twice():
    x, y = blobs(200, classes=5)
    times = np.random.default_rng(0).integers(1, 4, len(y))
    (counted,) = discriminant_path(x, y, 5, [0.1], times.astype(np.float32))
    (repeated,) = discriminant_path(np.repeat(x, times, 0), np.repeat(y, times), 5, [0.1])
    np.testing.assert_allclose(counted.weights, repeated.weights, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(counted.bias, repeated.bias, rtol=1e-3, atol=1e-3)


def test_it_names_as_many_as_logistic_regression():
    """The best of each path on other rows: within two points, where classes are many."""
    x, y = many(120)
    test = np.arange(len(y)) % 4 == 0
    exact = linear_path(x[~test], y[~test], heads.PENALTIES)
    fast = linear_path(x[~test], y[~test], heads.PENALTIES, total=heads.MANY_CLASSES + 1)
    best = [max(np.mean(one(x[test]) == y[test]) for one in path) for path in (exact, fast)]
    assert 0.5 < best[0] < best[1] + 0.02


def test_the_factorisation_has_one_thread_and_leaves_the_others_as_they_were(monkeypatch):
    """Several wait for each other on a busy machine, where it took 30 times as long."""
    libraries = ThreadpoolController()
    seen = []

    def counted(matrix):
        seen.append({one["num_threads"] for one in libraries.info()})
        return eigh(matrix)

    monkeypatch.setattr(discriminant, "eigh", counted)
    x, y = blobs(200, classes=5)
    with libraries.limit(limits=2):
        list(discriminant_path(x, y, 5, [0.1]))
        after = {one["num_threads"] for one in libraries.info()}
    assert seen == [{1}] and after == {2}


def test_the_kind_of_head_goes_by_the_classes_of_the_probe_not_of_a_fold(monkeypatch):
    called = []
    monkeypatch.setattr(heads, "logistic_path", lambda *_: called.append("regression") or iter(()))
    plain = heads.discriminant_path
    monkeypatch.setattr(
        heads, "discriminant_path", lambda *a: called.append("discriminant") or plain(*a)
    )
    x, y = blobs(200, classes=10)
    fit_head(ProbeHead(), x, y, 10)
    fit_head(ProbeHead(), x, y, heads.MANY_CLASSES)
    fit_head(ProbeHead(), x, y, heads.MANY_CLASSES + 1)
    assert called == ["regression", "regression", "discriminant"]


def test_three_thousand_classes_are_probed_in_seconds():
    x, y = many(3000, each=6, apart=3.0)
    split = np.array(["train", "train", "train", "val", "test", "test"] * 3000)
    groups = np.char.add(np.char.add(split, " "), y.astype(str))
    begun = time.process_time()
    linear, knn = (
        probe_features(x, y, groups, split, ProbeHead(name), seeds=0) for name in ("linear", "knn")
    )
    # 3 s; logistic regression of a tenth of the classes takes longer
    assert time.process_time() - begun < 60
    assert linear.accuracy > 0.9 and knn.accuracy > 0.5 and len(linear.classes) == 3000


def test_predictions_in_parts_are_those_of_all_rows(monkeypatch):
    x, y = many(30)
    model = linear_path(x, y, [0.01])[0]
    whole = model(x)
    monkeypatch.setattr(logistic, "_LOGITS", 30 * 7)
    np.testing.assert_array_equal(model(x), whole)


def test_votes_of_neighbours_are_those_of_a_table_of_classes():
    rng = np.random.default_rng(0)
    labels = rng.integers(0, 4, (500, 7))
    cosines = rng.random((500, 7)).round(1)
    table = np.zeros((500, 4))
    weights = 1 + 1e-3 * cosines / 7
    np.add.at(table, (np.repeat(np.arange(500), 7), labels.ravel()), weights.ravel())
    np.testing.assert_array_equal(vote(labels, cosines, 4), table.argmax(1))


def test_the_cost_is_told_before_the_work(monkeypatch):
    x, y = blobs(200, classes=10)
    monkeypatch.setattr(heads, "path_seconds", lambda *_: 30.0)
    assert "about 90 s" in heads.cost_sentence(x, y, 10, 3)
    assert "about 5 minutes" in heads.cost_sentence(x, y, 10, 10)
    assert "discriminant" in heads.cost_sentence(x, y, 201, 10)
    monkeypatch.setattr(heads, "path_seconds", lambda *_: 0.1)
    assert heads.cost_sentence(x, y, 10, 3) == "" == heads.cost_sentence(x, y, 0, 3)


def test_an_estimate_of_the_time_is_of_the_right_size():
    x, y = many(40, each=20)
    begun = time.perf_counter()
    linear_path(x, y, heads.PENALTIES)
    took = time.perf_counter() - begun
    assert took / 30 < logistic.path_seconds(x, y, 40, heads.PENALTIES[0]) < took * 30
