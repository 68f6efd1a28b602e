"""The heads: their optimum, their options, their steps; and logistic regression against scikit-learn's."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import log_loss

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import heads, logistic
from anytouch_jax.evaluate.heads import Problem, Recipe, choose, fit

RNG = np.random.default_rng(0)


def blobs(n: int = 600, d: int = 24, classes: int = 4, apart: float = 1.0, seed: int = 0):
    """Correlated features, as a network's are: spreads from 1 to 100, then standardised; class numbers."""
    rng = np.random.default_rng(seed)
    mixed = np.linalg.qr(rng.normal(size=(d, d)))[0] * np.geomspace(1, 100, d)
    y = rng.integers(classes, size=n)
    x = (rng.normal(size=(n, d)) + apart * rng.normal(size=(classes, d))[y]) @ mixed
    return ((x - x.mean(0)) / x.std(0)).astype(np.float32), y


@pytest.mark.parametrize("classes", [2, 3, 20])
@pytest.mark.parametrize("penalty", [1.0, 0.01, 0.0001])
def test_the_optimum_is_scikit_learns(classes, penalty):
    x, y = blobs(classes=classes)
    ours = list(logistic.path(x, y, classes, [1.0, penalty][penalty == 1.0 :]))[-1]
    model = LogisticRegression(C=1 / (penalty * len(y)), tol=1e-8, max_iter=5000)
    model.fit(x.astype(np.float64), y)
    theirs = log_loss(y, model.predict_proba(x), labels=range(classes)) + penalty / 2 * np.sum(model.coef_**2)
    assert ours.finished
    assert abs(ours.loss - theirs) < 1e-4
    said, weights = x @ ours.weights + ours.bias, ours.weights
    exact = np.mean(np.logaddexp(0, -np.where(y == 1, 1, -1) * said[:, 0])) if classes == 2 else np.mean(
        np.log(np.exp(said).sum(1)) - said[np.arange(len(y)), y])  # fmt: skip
    assert exact + penalty / 2 * np.sum(weights**2) == pytest.approx(ours.loss, abs=1e-5)
    assert np.mean(ours(x) == model.predict(x)) > 0.99


def test_a_start_saves_steps_and_changes_nothing(monkeypatch):
    x, y = blobs()
    calls = []
    plain = logistic._log_loss
    monkeypatch.setattr(logistic, "_log_loss", lambda *a: calls.append(1) or plain(*a))
    cold = next(logistic.path(x, y, 4, [0.001]))
    took = len(calls)
    warm = next(logistic.path(x, y, 4, [0.001], cold))
    assert len(calls) - took < took / 3
    assert warm.loss == pytest.approx(cold.loss, abs=1e-6)


def test_more_features_than_rows_is_no_obstacle():
    x, y = blobs(n=30, d=80, classes=3, apart=3.0)
    found = next(logistic.path(x, y, 3, [0.01]))
    assert np.isfinite(found.loss) and np.mean(found(x) == y) == 1.0
    constant = np.concatenate([x, np.zeros((30, 4), np.float32)], 1)
    assert next(logistic.path(constant, y, 3, [0.01])).loss == pytest.approx(found.loss, abs=1e-4)


def problem(classes: int = 4, **changes) -> Problem:
    x, y = blobs(900, classes=max(classes, 2))
    target = y if classes else x @ np.arange(x.shape[1]) * 0.1 + 5
    cut = (slice(0, 500), slice(500, 700), slice(700, 900))
    return Problem(x[cut[0]], target[cut[0]], x[cut[1]], x[cut[2]], classes)._replace(**changes)


def truth(classes: int = 4):
    x, y = blobs(900, classes=max(classes, 2))
    return (y if classes else x @ np.arange(x.shape[1]) * 0.1 + 5)[700:]


@pytest.mark.parametrize("head", ["linear", "knn", "gradient"])
@pytest.mark.parametrize("classes", [2, 4])
def test_every_head_learns_classes(head, classes):
    path = fit(head, problem(classes), Recipe(epochs=20, batch=64, rate=0.01))
    assert len(path.options) == len(path.val) == len(path.test)
    assert all(len(one) == 200 for one in (*path.val, *path.test))
    best = choose(path.test, truth(classes), classes)
    assert heads.score(path.final(best), truth(classes), classes) > 0.95
    np.testing.assert_array_equal(path.final(best), path.test[best])


@pytest.mark.parametrize(("head", "least"), [("linear", 0.999), ("knn", 0.3), ("gradient", 0.9)])
def test_every_head_learns_a_number(head, least):
    path = fit(head, problem(0), Recipe(epochs=60, batch=64, rate=0.05))
    best = path.final(choose(path.test, truth(0), 0))
    assert 1 + heads.score(best, truth(0), 0) / np.var(truth(0)) > least


def test_scaling_of_the_features_does_not_matter_to_the_linear_head():
    factor, plain = np.geomspace(0.01, 100, 24).astype(np.float32), problem()

    def scaled(factor, shift, **changes):
        parts = {name: getattr(plain, name) * factor + shift for name in ("x", "val", "test")}
        return np.array(fit("linear", plain._replace(**parts, **changes)).test)

    assert np.mean(scaled(1, 0) == scaled(factor, 3)) > 0.99
    common = scaled(7, 0, scaling="common")
    assert np.mean(common == scaled(1, 0, scaling="common")) > 0.99


def test_many_rows_choose_on_some_and_report_a_fit_on_all(monkeypatch):
    x, y = blobs(900, apart=0.3)
    hard = problem()._replace(x=x[:500], y=y[:500], val=x[500:700], test=x[700:])
    whole = fit("linear", hard)
    monkeypatch.setattr("anytouch_jax.evaluate.choices.SELECT_ROWS", 100)
    few, option = fit("linear", hard), 3
    assert np.mean(few.test[option] == whole.test[option]) < 1.0  # chosen by a fit on 100 rows
    assert np.mean(few.final(option) == whole.test[option]) > 0.99  # reported by one on all


def test_one_class_is_what_is_said():
    one = problem()._replace(y=np.full(500, 2))
    for head in ("linear", "knn", "gradient"):
        path = fit(head, one)
        assert set(path.final(0)) == {2} and len(path.val[0]) == len(path.test[0]) == 200


def test_the_middle_of_equals_is_chosen():
    right, wrong = np.array([1, 1]), np.array([1, 0])
    assert choose([wrong, right, right, right, wrong], right, 2) == 2
    assert choose([np.array([2.0, 2.0]), np.array([1.0, 1.5])], np.array([1.0, 1.0]), 0) == 1


def test_an_unknown_head_is_refused():
    with pytest.raises(UserError, match="no head 'forest'; choose among linear"):
        fit("forest", problem())


def test_the_gradient_head_takes_adamw_steps():
    """Against optax: decoupled decay on weights and bias, beta2 0.99."""
    recipe = Recipe(rate=0.1, decay=0.2)
    ours = [RNG.normal(size=(3, 2)).astype(np.float32), RNG.normal(size=2).astype(np.float32)]
    theirs = [one.copy() for one in ours]
    moments = [[np.zeros_like(one) for one in ours] for _ in range(2)]
    tx = optax.adamw(0.1, b1=0.9, b2=0.99, eps=1e-8, weight_decay=0.2)
    state = tx.init(theirs)
    for step in range(1, 5):
        slopes = [RNG.normal(size=one.shape).astype(np.float32) for one in ours]
        heads._adamw(ours, slopes, moments, 0.1, step, recipe)
        updates, state = tx.update(slopes, state, theirs)
        theirs = optax.apply_updates(theirs, updates)
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("classes", [0, 2, 4])
def test_the_gradient_heads_slope_is_that_of_its_loss(classes):
    said = RNG.normal(size=(6, classes if classes > 2 else 1)).astype(np.float32)
    y = RNG.integers(classes, size=6) if classes else RNG.normal(size=6)
    wanted = heads._wanted(y, classes, 0.0, 1.0)
    losses = {
        0: lambda z: jnp.mean((z - wanted) ** 2) / 2,
        2: lambda z: optax.sigmoid_binary_cross_entropy(z, wanted).mean(),
        4: lambda z: optax.softmax_cross_entropy(z, wanted).mean(),
    }
    np.testing.assert_allclose(heads._slope(said, wanted, classes), jax.grad(losses[classes])(said), atol=1e-6)


def test_the_gradient_head_is_drawn_from_its_seed_and_ends_at_rate_zero(monkeypatch):
    recipe = Recipe(epochs=3, batch=100, rate=0.01)
    first, again, other = (fit("gradient", problem(seed=seed), recipe) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first.test, again.test)
    assert (np.array(first.test) != np.array(other.test)).any()
    rates = []
    plain = heads._adamw
    monkeypatch.setattr(heads, "_adamw", lambda *a: rates.append(a[3]) or plain(*a))
    fit("gradient", problem(), recipe)
    assert len(rates) == 15 and rates[0] == pytest.approx(0.01) and 0 < rates[-1] < 0.0002
    assert np.all(np.diff(rates) < 0)


def test_the_gradient_head_sees_features_as_they_are():
    """As in the released code nothing is standardised: shrunken features learn less in the same steps."""
    small = problem()
    small = small._replace(x=small.x * 1e-3, val=small.val * 1e-3, test=small.test * 1e-3)
    recipe = Recipe(epochs=2, batch=100)
    scores = [heads.score(fit("gradient", one, recipe).test[-1], truth(), 4) for one in (problem(), small)]
    assert scores[0] > scores[1]


def test_threads_are_limited_for_small_fits_only(monkeypatch):
    asked = []
    monkeypatch.setattr(logistic, "_libraries", lambda: SimpleNamespace(limit=lambda limits: asked.append(limits)))
    for size in (1e3, 1e9):
        partial(logistic.threads, size)()
    assert asked == [1, None]
