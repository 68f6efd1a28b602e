"""Multinomial logistic regression for 100,000 rows: preconditioned L-BFGS along falling penalties.

Features of a network are correlated, which costs L-BFGS hundreds of passes. The Hessian at equal probabilities is
known: 1/K (I - 11'/K) (x) X'X/n. We change to the coordinates of its Cholesky factor, with the penalty on the diagonal.
There tens of passes suffice. Arithmetic on the features is float32, and losses are summed in float64.
"""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize
from threadpoolctl import ThreadpoolController

from anytouch_jax.evaluate.statistics import Array

STEPS = 300


class Logistic(NamedTuple):
    """A fit: `weights` f32 (d, columns) and `bias` f32 (columns,), one column for two classes, else one a class.

    `loss` is the mean log loss plus the penalty times half the squared weights. `finished`: within STEPS.
    """

    weights: Array
    bias: Array
    loss: float
    finished: bool

    def __call__(self, x: Array) -> Array:
        """Return class numbers i64 (n,) of features (n, d)."""
        logits = x @ self.weights + self.bias
        return (logits[:, 0] > 0).astype(np.int64) if logits.shape[1] == 1 else logits.argmax(1)


def path(
    x: Array, y: Array, classes: int, penalties: Sequence[float], start: Logistic | None = None,
    weights: Array | None = None,
) -> Iterator[Logistic]:  # fmt: skip
    """Yield fits of class numbers `y` (n,) below `classes` on features `x` f32 (n, d), one a penalty.

    Each starts from the fit before. A penalty is the factor of half the squared weights, added to the mean log loss;
    the bias is free. Give standardised features, and the strongest penalty first. `weights` (n,) of rows in that mean.
    """
    x = np.ascontiguousarray(x, np.float32)
    columns = 1 if classes == 2 else classes
    counts = np.ones(len(x)) if weights is None else weights
    shares = (counts / np.sum(counts, dtype=np.float64)).astype(np.float32)[:, None]
    with threads(x.size * columns):
        covariance = (x.T @ (x * shares)).astype(np.float64)
        for penalty in penalties:
            start = _fit(x, y, shares, columns, penalty, covariance, start)
            yield start


def _fit(
    x: Array, y: Array, shares: Array, columns: int, penalty: float, covariance: Array, start: Logistic | None
) -> Logistic:
    d, share = x.shape[1], 0.25 if columns == 1 else 1 / columns
    # A small diagonal keeps the factor when there are fewer rows than features.
    diagonal = penalty + 1e-6 * share * np.trace(covariance) / d
    factor = cholesky(share * covariance + diagonal * np.eye(d), lower=True, check_finite=False)
    back = functools.partial(solve_triangular, factor, lower=True, trans="T", check_finite=False)
    forth = functools.partial(solve_triangular, factor, lower=True, check_finite=False)

    def unpacked(v: Array) -> tuple[Array, Array]:
        v = v.reshape(d + 1, columns)
        return back(v[:d]), v[d] / np.sqrt(share)

    def value(v: Array) -> tuple[float, Array]:
        weights, bias = unpacked(v)
        loss, slope = _log_loss(x @ weights.astype(np.float32) + bias.astype(np.float32), y, shares)
        loss += penalty / 2 * float(np.sum(weights**2))
        by_weights = (x.T @ slope).astype(np.float64) + penalty * weights
        by_bias = slope.sum(0, dtype=np.float64)
        return loss, np.concatenate([forth(by_weights), by_bias[None] / np.sqrt(share)]).ravel()

    first = np.zeros((d + 1, columns))
    if start is not None and start.weights.shape == (d, columns):
        first = np.concatenate([factor.T @ start.weights, np.sqrt(share) * start.bias[None]])
    options = {"maxiter": STEPS, "maxfun": 2 * STEPS, "maxcor": 20, "ftol": 1e-7, "gtol": 1e-6}
    optimum = minimize(value, first.ravel(), jac=True, method="L-BFGS-B", options=options)
    weights, bias = unpacked(optimum.x)
    return Logistic(weights.astype(np.float32), bias.astype(np.float32), float(optimum.fun), optimum.nit < STEPS)


def _log_loss(logits: Array, y: Array, shares: Array) -> tuple[float, Array]:
    """Return the log loss, weighted by `shares` (n, 1), and its gradient by the logits (n, columns), overwritten."""
    if logits.shape[1] == 1:
        signed = np.where(y == 1, logits[:, 0], -logits[:, 0])
        loss = float(np.sum(shares[:, 0] * np.logaddexp(0, -signed), dtype=np.float64))
        slope = np.where(y == 1, -1, 1) / (1 + np.exp(np.minimum(signed, 80)))
        return loss, (slope[:, None] * shares).astype(np.float32)
    rows = np.arange(len(y))
    logits -= logits.max(1, keepdims=True)
    right = logits[rows, y]
    np.exp(logits, out=logits)
    total = logits.sum(1, keepdims=True)
    loss = float(np.sum(shares[:, 0] * (np.log(total[:, 0]) - right), dtype=np.float64))
    logits *= shares / total
    logits[rows, y] -= shares[:, 0]
    return loss, logits


@functools.cache
def _libraries() -> ThreadpoolController:
    return ThreadpoolController()  # finding the libraries takes longer than a small fit


def threads(size: int) -> contextlib.AbstractContextManager[Any]:
    """Limit numerical libraries to one thread for a small fit, where more threads are slower."""
    return _libraries().limit(limits=1 if size < 1e8 else None)
