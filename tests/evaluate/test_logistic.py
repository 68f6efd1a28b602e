"""Logistic regression against scikit-learn's, and its starts."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import log_loss
from task_world import blobs

from anytouch_jax.evaluate import heads


@pytest.mark.parametrize("classes", [2, 3, 20])
@pytest.mark.parametrize("penalty", [1.0, 0.01, 0.0001])
def test_the_optimum_is_scikit_learns(classes, penalty):
    x, y = blobs(classes=classes)
    ours = list(heads.logistic_path(x, y, classes, [1.0, penalty][penalty == 1.0 :]))[-1]
    model = LogisticRegression(C=1 / (penalty * len(y)), tol=1e-8, max_iter=5000)
    model.fit(x.astype(np.float64), y)
    theirs = log_loss(y, model.predict_proba(x), labels=range(classes)) + penalty / 2 * np.sum(model.coef_**2)
    assert ours.finished
    assert abs(ours.loss - theirs) < 1e-4
    logits, weights = x @ ours.weights + ours.bias, ours.weights
    exact = np.mean(np.logaddexp(0, -np.where(y == 1, 1, -1) * logits[:, 0])) if classes == 2 else np.mean(
        np.log(np.exp(logits).sum(1)) - logits[np.arange(len(y)), y])  # fmt: skip
    assert exact + penalty / 2 * np.sum(weights**2) == pytest.approx(ours.loss, abs=1e-5)
    assert np.mean(ours(x) == model.predict(x)) > 0.99


def test_a_start_saves_steps_and_changes_nothing(monkeypatch):
    x, y = blobs()
    calls = []
    plain = heads._log_loss
    monkeypatch.setattr(heads, "_log_loss", lambda *a: calls.append(1) or plain(*a))
    cold = next(heads.logistic_path(x, y, 4, [0.001]))
    took = len(calls)
    warm = next(heads.logistic_path(x, y, 4, [0.001], cold))
    assert len(calls) - took < took / 3
    assert warm.loss == pytest.approx(cold.loss, abs=1e-6)


def test_more_features_than_rows_is_no_obstacle():
    x, y = blobs(n=30, d=80, classes=3, apart=3.0)
    fit = next(heads.logistic_path(x, y, 3, [0.01]))
    assert np.isfinite(fit.loss) and np.mean(fit(x) == y) == 1.0
    constant = np.concatenate([x, np.zeros((30, 4), np.float32)], 1)
    assert next(heads.logistic_path(constant, y, 3, [0.01])).loss == pytest.approx(fit.loss, abs=1e-4)


def test_threads_are_limited_for_small_fits_only(monkeypatch):
    limits_set = []
    monkeypatch.setattr(heads, "_libraries", lambda: SimpleNamespace(limit=lambda limits: limits_set.append(limits)))
    for size in (1e3, 1e9):
        partial(heads.threads, size)()
    assert limits_set == [1, None]
