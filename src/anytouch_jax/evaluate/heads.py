"""What is put on frozen features: a path of fitted heads from which a protocol chooses one.

A head is fitted on some rows and predicts others for each of its options: penalties (logistic and ridge regression),
neighbours (kNN), epochs (the authors' gradient-trained linear layer). `honest` takes the option that is best on rows
left out of train, `published` the one that is best on test, as the authors' released code takes its epoch.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import logistic
from anytouch_jax.evaluate.choices import NEIGHBOURS, PENALTIES, RIDGE, best_of, thinned
from anytouch_jax.evaluate.probe_models import Scaling, nearest, ridge, standard, vote

Array = npt.NDArray[Any]
HeadName = Literal["linear", "knn", "gradient"]


class Problem(NamedTuple):
    """Features f32 (n, d) to fit on, of val and of test; `y`: class numbers below `classes`, or floats with 0 classes.

    `scaling` as in `probe_models.Linear`; `seed` of what a head draws.
    """

    x: Array
    y: Array
    val: Array
    test: Array
    classes: int
    scaling: Scaling = "column"
    seed: int = 0


class Path(NamedTuple):
    """Predictions for each option: class numbers, or numbers. `final(i)`: those for test of option i, fitted on all.
    `finished`: whether each fit converged (empty: nothing that has to)."""

    options: tuple[float, ...]
    val: list[Array]
    test: list[Array]
    final: Callable[[int], Array]
    finished: tuple[bool, ...] = ()


@dataclass(frozen=True)
class Recipe:
    """The authors' head: a linear layer on features as they are, AdamW, cosine to 0 without warm-up.

    The defaults are those of `run_probe_OF1.sh` in the released code for two devices (batch is of both).
    """

    epochs: int = 50
    batch: int = 128
    rate: float = 1e-3
    decay: float = 0.01
    beta1: float = 0.9
    beta2: float = 0.99


def fit(head: HeadName, problem: Problem, recipe: Recipe | None = None) -> Path:
    """The path of a head on a problem. Raises UserError for an unknown head."""
    if head not in ("linear", "knn", "gradient"):
        raise UserError(f"there is no head {head!r}; choose among linear, knn, gradient")
    if problem.classes and len(np.unique(problem.y)) == 1:  # a fold of a small data set may hold one class only
        only = [np.full(len(rows), problem.y[0]) for rows in (problem.val, problem.test)]
        return Path((0.0,), only[:1], only[1:], lambda _: only[1])
    if head == "gradient":
        return _gradient(problem, recipe or Recipe())
    if head == "knn":
        return _knn(problem, NEIGHBOURS)
    return _linear(problem, PENALTIES) if problem.classes else _ridge(problem, RIDGE)


def score(predicted: Array, truth: Array, classes: int) -> float:
    """Accuracy, or minus the mean squared error of numbers."""
    return float(np.mean(predicted == truth)) if classes else -float(np.mean((predicted - truth) ** 2))


def choose(found: Sequence[Array], truth: Array, classes: int) -> int:
    """The option that scores best (see `choices.best_of`)."""
    return best_of([score(one, truth, classes) for one in found])


def _linear(problem: Problem, penalties: Sequence[float]) -> Path:
    mean, scale = standard(problem.x, scaling=problem.scaling)
    x, val, test = ((rows - mean) / scale for rows in (problem.x, problem.val, problem.test))
    kept = thinned(np.arange(len(x)))
    models = list(logistic.path(x[kept], problem.y[kept], problem.classes, penalties))

    def final(option: int) -> Array:
        if len(kept) == len(x):
            return models[option](test)
        whole = logistic.path(x, problem.y, problem.classes, penalties[option : option + 1], models[option])
        return next(whole)(test)

    on_val, on_test = ([one(rows) for one in models] for rows in (val, test))
    return Path(tuple(penalties), on_val, on_test, final, tuple(one.finished for one in models))


def _ridge(problem: Problem, penalties: Sequence[float]) -> Path:
    whole = np.concatenate([problem.val, problem.test])
    found = ridge(problem.x, problem.y, whole, penalties, problem.scaling)
    val, test = ([one[part] for one in found] for part in (slice(len(problem.val)), slice(len(problem.val), None)))
    return Path(tuple(penalties), val, test, lambda option: test[option])


def _knn(problem: Problem, neighbours: Sequence[int]) -> Path:
    unit = [rows / np.maximum(np.linalg.norm(rows, axis=1, keepdims=True), 1e-12) for rows in
            (problem.x, problem.val, problem.test)]  # fmt: skip

    def predicted(rows: Array) -> list[Array]:
        near, likeness = nearest(unit[0], rows, max(neighbours))
        if problem.classes:
            return [vote(problem.y[near[:, :k]], likeness[:, :k], problem.classes) for k in neighbours]
        return [problem.y[near[:, :k]].mean(1) for k in neighbours]

    val, test = predicted(unit[1]), predicted(unit[2])
    return Path(tuple(map(float, neighbours)), val, test, lambda option: test[option])


def _gradient(problem: Problem, recipe: Recipe) -> Path:
    """One epoch an option. Two classes share one logit, as in the released code; numbers are fitted in spreads."""
    rng = np.random.default_rng(problem.seed)
    x, y = np.asarray(problem.x, np.float32), problem.y
    n, d = x.shape
    middle, spread = (0.0, 1.0) if problem.classes else (float(y.mean()), float(y.std()) or 1.0)
    wanted = _wanted(y, problem.classes, middle, spread)
    weights = [
        np.asarray(0.01 * rng.standard_normal((d, wanted.shape[1])), np.float32),
        np.asarray(rng.uniform(-1, 1, wanted.shape[1]) / np.sqrt(d), np.float32),
    ]
    moments = [[np.zeros_like(one) for one in weights] for _ in range(2)]
    batch = min(recipe.batch, n)
    steps, step = n // batch, 0
    val, test = [], []
    told = partial(_told, classes=problem.classes, middle=middle, spread=spread)
    with logistic.threads(batch * d * wanted.shape[1]):
        for _ in range(recipe.epochs):
            order = rng.permutation(n)[: steps * batch].reshape(steps, batch)
            for rows in order:
                rate = recipe.rate * 0.5 * (1 + np.cos(np.pi * step / (steps * recipe.epochs)))
                step += 1
                slope = _slope(x[rows] @ weights[0] + weights[1], wanted[rows], problem.classes)
                _adamw(weights, [x[rows].T @ slope, slope.sum(0)], moments, rate, step, recipe)
            val.append(told(problem.val @ weights[0] + weights[1]))
            test.append(told(problem.test @ weights[0] + weights[1]))
    return Path(tuple(range(1, recipe.epochs + 1)), val, test, lambda option: test[option])


def _wanted(y: Array, classes: int, middle: float, spread: float) -> Array:
    """What the layer should say, f32 (n, columns): 0 or 1, one column a class, or a number in spreads."""
    if classes > 2:
        return np.eye(classes, dtype=np.float32)[y]
    return ((y - middle) / spread).astype(np.float32)[:, None]


def _slope(said: Array, wanted: Array, classes: int) -> Array:
    """Gradient of the mean loss (cross-entropy, or half the squared error) by what the layer said."""
    if classes > 2:
        said = np.exp(said - said.max(1, keepdims=True))
        said /= said.sum(1, keepdims=True)
    elif classes == 2:
        said = 1 / (1 + np.exp(-said.clip(-80, 80)))
    return ((said - wanted) / np.float32(len(said))).astype(np.float32)


def _told(said: Array, classes: int, middle: float, spread: float) -> Array:
    if classes > 2:
        return said.argmax(1)
    return (said[:, 0] > 0).astype(np.int64) if classes else said[:, 0] * spread + middle


def _adamw(
    weights: list[Array], slopes: list[Array], moments: list[list[Array]], rate: float, step: int, recipe: Recipe
) -> None:
    """One step in place; the decay is decoupled and meets the bias too, as in the released code."""
    for one, slope, first, second in zip(weights, slopes, *moments, strict=True):
        first += (1 - recipe.beta1) * (slope - first)
        second += (1 - recipe.beta2) * (slope**2 - second)
        one *= np.float32(1 - rate * recipe.decay)
        one -= (
            np.float32(rate / (1 - recipe.beta1**step))
            * first
            / (np.sqrt(second / np.float32(1 - recipe.beta2**step)) + np.float32(1e-8))
        )
