from dataclasses import replace

import numpy as np
import pytest
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import log_loss
from task_world import blobs

from anytouch_jax.encoder import embed as search
from anytouch_jax.encoder import linear_head
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import heads, logistic
from anytouch_jax.evaluate.heads import GradientRecipe, ProbeHead, fit_head, linear_path

FIT = slice(0, 500)
TEST = slice(500, 700)


def data(classes: int = 4):
    x, y = blobs(900, classes=max(classes, 2))
    return x, y if classes else x @ np.arange(x.shape[1]) * 0.1 + 5


def scores(head: ProbeHead, classes: int, start=None) -> list[float]:
    x, y = data(classes)
    fitted = fit_head(head, x[FIT], y[FIT], classes, start=start)
    return [heads.head_score(predicted, y[TEST], classes) for predicted in fitted.predict(x[TEST])]


@pytest.mark.parametrize("name", ["linear", "knn", "gradient"])
@pytest.mark.parametrize("classes", [2, 4])
def test_every_head_learns_classes(name, classes):
    head = ProbeHead(name, recipe=GradientRecipe(epochs=20, batch=64, rate=0.01))
    x, y = data(classes)
    assert len(fit_head(head, x[FIT], y[FIT], classes).options) == len(scores(head, classes))
    assert max(scores(head, classes)) > 0.95


@pytest.mark.parametrize(("name", "least"), [("linear", 0.999), ("knn", 0.3), ("gradient", 0.9)])
def test_every_head_learns_a_number(name, least):
    head = ProbeHead(name, recipe=GradientRecipe(epochs=60, batch=64, rate=0.05))
    assert 1 + max(scores(head, 0)) / np.var(data(0)[1][TEST]) > least


@pytest.mark.parametrize("name", ["linear", "knn"])
@pytest.mark.parametrize("classes", [2, 4])
def test_a_row_that_counts_twice_is_a_row_given_twice(name, classes):
    x, y = blobs(classes=classes)
    times = np.random.default_rng(0).integers(0, 4, len(y))
    kept = times > 0
    head = ProbeHead(name)
    counted = fit_head(
        head, x[kept], y[kept], classes, weights=times[kept].astype(np.float32)
    ).predict(x)
    repeated = fit_head(head, np.repeat(x, times, 0), np.repeat(y, times), classes).predict(x)
    assert np.mean(np.array(counted) == np.array(repeated)) > 0.99


def test_scaling_of_the_features_does_not_matter_to_the_linear_head():
    factor = np.geomspace(0.01, 100, 24).astype(np.float32)
    (x, y) = data()

    def predicted(scale, shift, **changes):
        return np.array(
            fit_head(ProbeHead("linear", **changes), x[FIT] * scale + shift, y[FIT], 4).predict(
                x[TEST] * scale + shift
            )
        )

    assert np.mean(predicted(1, 0) == predicted(factor, 3)) > 0.99
    assert np.mean(predicted(7, 0, scaling="common") == predicted(1, 0, scaling="common")) > 0.99


def test_ridge_equals_its_normal_equations():
    x, y = data(0)
    y = y + np.random.default_rng(0).normal(size=len(y))
    scaled = (x - x.mean(0)) / x.std(0)
    weights = np.linalg.solve(
        scaled.T @ scaled / len(x) + 0.3 * np.eye(24), scaled.T @ (y - y.mean()) / len(x)
    )
    np.testing.assert_allclose(
        heads.fit_ridge(x, y, [0.3])(x)[0], scaled @ weights + y.mean(), atol=1e-4
    )


@pytest.mark.parametrize("k", [1, 5, 20])
@pytest.mark.parametrize("columns", [3, 20, 700, 3001])
def test_nearest_equals_sorting_everything(k, columns):
    rng = np.random.default_rng(0)
    train, scored = (rng.normal(size=(n, 16)).astype(np.float32) for n in (columns, 9))
    ids, cosines = search.nearest(train, scored, k)
    expected = np.argsort(-(scored @ train.T), axis=1)[:, :k]
    np.testing.assert_array_equal(ids, expected)
    np.testing.assert_allclose(
        cosines, np.take_along_axis(scored @ train.T, expected, 1), rtol=1e-5
    )


def test_votes():
    labels = np.array([[0, 1, 1], [2, 0, 0], [1, 2, 0], [0, 1, 2]])
    cosines = np.array([[0.99, 0.1, 0.1], [0.9, 0.8, 0.7], [0.2, 0.9, 0.5], [0.3, 0.2, 0.1]])
    np.testing.assert_array_equal(heads.vote(labels, cosines, 3), [1, 0, 2, 0])


@pytest.mark.parametrize("classes", [0, 2, 4])
def test_the_gradient_head_takes_adamw_steps_of_its_loss(classes):
    """The first step of Adam is the sign of the gradient; decoupled decay shrinks weights and
    bias.
    """
    rng = np.random.default_rng(1)
    x = rng.normal(size=(6, 3)).astype(np.float32)
    params = [rng.normal(size=(3, max(1, classes * (classes > 2))))]
    params = (params[0].astype("f4"), rng.normal(size=params[0].shape[1]).astype("f4"))
    y = rng.integers(classes, size=6) if classes else rng.normal(size=6).astype(np.float32)
    target = y.astype(np.int32 if classes > 2 else np.float32)
    logits = x @ params[0] + params[1][None]
    predicted = (
        np.asarray(logits)[:, 0] if classes == 0 else 1 / (1 + np.exp(-np.asarray(logits)[:, 0]))
    )
    if classes > 2:
        predicted = np.exp(logits) / np.exp(logits).sum(1, keepdims=True) - np.eye(classes)[y]
        slope = predicted
    else:
        slope = (predicted - target)[:, None]
    init, step = heads._gradient_step(GradientRecipe(decay=0.2), classes)
    (weights, bias), _ = step(params, init(params), x, target, np.float32(0.1))
    np.testing.assert_allclose(
        weights, params[0] * (1 - 0.02) - 0.1 * np.sign(x.T @ slope), atol=1e-5
    )
    np.testing.assert_allclose(
        bias, params[1] * (1 - 0.02) - 0.1 * np.sign(slope.sum(0)), atol=1e-5
    )


def test_the_gradient_head_is_drawn_from_its_seed_and_its_rate_falls_to_zero(monkeypatch):
    x, y = data()
    plain = heads._gradient_step
    rates = []

    def watched(recipe, classes):
        init, step = plain(recipe, classes)
        return init, lambda *a: rates.append(float(a[-1])) or step(*a)

    monkeypatch.setattr(heads, "_gradient_step", watched)
    head = ProbeHead("gradient", recipe=GradientRecipe(epochs=3, batch=100, rate=0.01))
    first, again, other = (
        np.array(fit_head(replace(head, seed=seed), x[FIT], y[FIT], 4).predict(x[TEST]))
        for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()
    assert len(rates) == 45 and rates[0] == pytest.approx(0.01) and 0 < rates[14] < 0.0002
    assert np.all(np.diff(rates[:15]) < 0)


@pytest.mark.parametrize("classes", [2, 3])
def test_a_saved_head_gives_the_same_predictions(tmp_path, classes):
    x, y = blobs(classes=classes)
    names = np.array(["a", "b", "c"][:classes])
    (model,) = linear_path(x, y, [0.01])
    about = {"label": "shape", "pooling": "mean", "frames": 3, "fingerprint": "f"}
    linear_head.save_head(tmp_path / "h.npz", heads.linear_head(model, names, **about))
    head = linear_head.load_head(tmp_path / "h.npz")
    labels, p = head(x)
    np.testing.assert_array_equal(labels, names[model(x)])
    np.testing.assert_allclose(p.sum(1), 1, atol=1e-6)
    assert p.shape == (len(x), classes) and {name: getattr(head, name) for name in about} == about
    head.check("here", "f", "mean", 3)
    for wrong in (
        ("other", "mean", 3),
        ("f", "class", 3),
        ("f", "mean", 1),
        ("f", "mean", 3, "sum"),
    ):
        with pytest.raises(UserError):
            head.check("here", *wrong)


def test_heads_of_the_first_release_still_load(tmp_path):
    arrays = {
        "classes": np.array(["a", "b"]),
        "weights": np.ones((2, 1)),
        "bias": np.zeros(1),
        "mean": np.zeros(2),
        "scale": np.ones(2),
        "label": "l",
        "pooling": "both",
        "frames": 1,
        "mark": "12ab",
    }
    np.savez(tmp_path / "h.npz", format="anytouch_jax.head.1", **arrays)
    head = linear_head.load_head(tmp_path / "h.npz")
    assert head.fingerprint == "12ab" and head([[3.0, 0.0], [-3.0, 0.0]])[0].tolist() == ["b", "a"]
    np.savez(tmp_path / "other.npz", format="another")
    for name in ("other.npz", "gone.npz"):
        with pytest.raises(UserError, match=name):
            linear_head.load_head(tmp_path / name)
    for name, value in (
        ("scale", np.zeros(2)),
        ("pooling", "sum"),
        ("classes", np.array(["a", "a"])),
    ):
        np.savez(tmp_path / "h.npz", **{"format": "anytouch_jax.head.1", **arrays, name: value})
        with pytest.raises(UserError, match=r"h\.npz is not the head of a probe"):
            linear_head.load_head(tmp_path / "h.npz")


@pytest.mark.parametrize("classes", [2, 3, 20])
@pytest.mark.parametrize("penalty", [1.0, 0.01, 0.0001])
def test_the_optimum_is_scikit_learns(classes, penalty):
    x, y = blobs(classes=classes)
    ours = list(heads.logistic_path(x, y, classes, [1.0, penalty][penalty == 1.0 :]))[-1]
    model = LogisticRegression(C=1 / (penalty * len(y)), tol=1e-8, max_iter=5000)
    model.fit(x.astype(np.float64), y)
    theirs = log_loss(y, model.predict_proba(x), labels=range(classes)) + penalty / 2 * np.sum(
        model.coef_**2
    )
    assert ours.finished
    assert abs(ours.loss - theirs) < 1e-4
    logits = x @ ours.weights + ours.bias
    weights = ours.weights
    exact = (
        np.mean(np.logaddexp(0, -np.where(y == 1, 1, -1) * logits[:, 0]))
        if classes == 2
        else np.mean(np.log(np.exp(logits).sum(1)) - logits[np.arange(len(y)), y])
    )
    assert exact + penalty / 2 * np.sum(weights**2) == pytest.approx(ours.loss, abs=1e-5)
    assert np.mean(ours(x) == model.predict(x)) > 0.99


def test_a_start_saves_steps_and_changes_nothing(monkeypatch):
    x, y = blobs()
    calls = []
    plain = logistic._log_loss
    monkeypatch.setattr(logistic, "_log_loss", lambda *a: calls.append(1) or plain(*a))
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
    assert next(heads.logistic_path(constant, y, 3, [0.01])).loss == pytest.approx(
        fit.loss, abs=1e-4
    )
