"""Logistic regression for 100,000 rows: preconditioned L-BFGS along falling penalties.

Features of a network are correlated, which costs L-BFGS hundreds of passes. The Hessian at equal
probabilities is known: 1/K (I - 11'/K) (x) X'X/n for K classes. In the coordinates of its Cholesky
factor, with the penalty on the diagonal, tens of passes suffice.

Arithmetic on the features is float32, because that is what the passes cost. Losses are summed in
float64, because the optimiser compares sums that differ in the seventh digit.
"""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.optimize import minimize
from threadpoolctl import ThreadpoolController

from anytouch_jax.encoder.arrays import Array

STEPS = 300  # of L-BFGS for one penalty
# Time of a path over that of its strongest penalty: 14 to 25 on most features, 72 on the worst.
_PATH = 20
_LOGITS = 1 << 25  # at once, of predictions: 128 MB


class Logistic(NamedTuple):
    """A fit: `weights` f32 (d, columns) and `bias` (columns,), one column for two classes.

    `loss` includes the penalty, and the fit has `finished` if it took fewer than STEPS.
    """

    weights: Array
    bias: Array
    loss: float
    finished: bool

    def __call__(self, x: Array) -> Array:
        """Return class numbers i64 (n,) of features (n, d)."""
        # In parts where logits of all rows would fill the memory.
        most = max(1, _LOGITS // len(self.bias))
        if len(x) > most:
            return np.concatenate([self(x[i : i + most]) for i in range(0, len(x), most)])
        logits = x @ self.weights + self.bias
        if logits.shape[1] == 1:
            return (logits[:, 0] > 0).astype(np.int64)
        return logits.argmax(1)


def logistic_path(
    x: Array,
    y: Array,
    classes: int,
    penalties: Sequence[float],
    start: Logistic | None = None,
    weights: Array | None = None,
) -> Iterator[Logistic]:
    """Yield a multinomial logistic regression for each penalty.

    A penalty is the factor of half the squared weights, added to the mean log loss; the bias is
    free. Each fit starts from the one before, which saves most of its steps: the optimum moves
    little from one penalty to the next, and the strongest penalty has the roundest valley.

    Args:
        x: standardised features f32 (n, d).
        y: class numbers (n,) below `classes`.
        classes: how many there are.
        penalties: the strongest first.
        start: a fit of the same classes that the first one starts from.
        weights: of the rows in the mean log loss (n,), equal by default.
    """
    x = np.ascontiguousarray(x, np.float32)
    columns = 1 if classes == 2 else classes
    counts = weights
    if counts is None:
        counts = np.ones(len(x))
    fractions = (counts / np.sum(counts, dtype=np.float64)).astype(np.float32)[:, None]
    with threads(x.size * columns):
        covariance = (x.T @ (x * fractions)).astype(np.float64)
        for penalty in penalties:
            start = _fit(x, y, fractions, columns, penalty, covariance, start)
            yield start


def path_seconds(x: Array, y: Array, classes: int, strongest: float) -> float:
    """Estimate how long a path of five penalties takes, by the fit of the strongest one.

    Args:
        x: f32 (n, d), scaled.
        y: class numbers i64 (n,).
        classes: how many there are.
        strongest: the largest penalty.
    """
    took = []
    for _ in range(2):  # the first call in a process finds its libraries, too
        begun = time.perf_counter()
        next(logistic_path(x, y, classes, [strongest]))
        took.append(time.perf_counter() - begun)
    return _PATH * min(took)


def _fit(
    x: Array,
    y: Array,
    fractions: Array,
    columns: int,
    penalty: float,
    covariance: Array,
    start: Logistic | None,
) -> Logistic:
    """Return the optimum for one penalty.

    `fractions` (n, 1) are the weights of the rows and sum to 1. `covariance` (d, d) is X'X with
    them.
    """
    d = x.shape[1]
    # The curvature of the log loss at equal probabilities: p (1 - p) for two classes, else 1 / K.
    # The part -11'/K^2 is left out: it couples the classes, and makes the matrix singular.
    fraction = 0.25 if columns == 1 else 1 / columns
    # A small diagonal keeps the factor when there are fewer rows than features.
    diagonal = penalty + 1e-6 * fraction * np.trace(covariance) / d
    factor = cholesky(fraction * covariance + diagonal * np.eye(d), lower=True, check_finite=False)
    back = functools.partial(solve_triangular, factor, lower=True, trans="T", check_finite=False)
    forth = functools.partial(solve_triangular, factor, lower=True, check_finite=False)

    # The optimiser sees v, the weights times the factor: there the Hessian is about the identity.
    def unpacked(v: Array) -> tuple[Array, Array]:
        v = v.reshape(d + 1, columns)
        return back(v[:d]), v[d] / np.sqrt(fraction)

    def value(v: Array) -> tuple[float, Array]:
        weights, bias = unpacked(v)
        loss, slope = _log_loss(
            x @ weights.astype(np.float32) + bias.astype(np.float32), y, fractions
        )
        loss += penalty / 2 * float(np.sum(weights**2))
        # The gradient by v is that by the weights, times the inverse of the factor (chain rule).
        by_weights = (x.T @ slope).astype(np.float64) + penalty * weights
        by_bias = slope.sum(0, dtype=np.float64)
        return loss, np.concatenate([forth(by_weights), by_bias[None] / np.sqrt(fraction)]).ravel()

    first = np.zeros((d + 1, columns))
    if start is not None and start.weights.shape == (d, columns):
        first = np.concatenate([factor.T @ start.weights, np.sqrt(fraction) * start.bias[None]])
    options = {"maxiter": STEPS, "maxfun": 2 * STEPS, "maxcor": 20, "ftol": 1e-7, "gtol": 1e-6}
    optimum = minimize(value, first.ravel(), jac=True, method="L-BFGS-B", options=options)
    weights, bias = unpacked(optimum.x)
    return Logistic(
        weights.astype(np.float32), bias.astype(np.float32), float(optimum.fun), optimum.nit < STEPS
    )


def _log_loss(logits: Array, y: Array, fractions: Array) -> tuple[float, Array]:
    """Return the log loss, weighted by `fractions` (n, 1), and its gradient by the logits.

    `logits` (n, columns) are overwritten: for 100,000 rows another array of them is what costs.
    """
    if logits.shape[1] == 1:
        signed = np.where(y == 1, logits[:, 0], -logits[:, 0])
        loss = float(np.sum(fractions[:, 0] * np.logaddexp(0, -signed), dtype=np.float64))
        # float32 overflows above e**88, and beyond 80 the slope is 0 anyway
        slope = np.where(y == 1, -1, 1) / (1 + np.exp(np.minimum(signed, 80)))
        return loss, (slope[:, None] * fractions).astype(np.float32)
    rows = np.arange(len(y))
    logits -= logits.max(1, keepdims=True)
    right = logits[rows, y]
    np.exp(logits, out=logits)
    total = logits.sum(1, keepdims=True)
    loss = float(np.sum(fractions[:, 0] * (np.log(total[:, 0]) - right), dtype=np.float64))
    logits *= fractions / total
    logits[rows, y] -= fractions[:, 0]
    return loss, logits


# finding the libraries takes longer than a small fit
_libraries = functools.cache(ThreadpoolController)


def threads(size: int) -> contextlib.AbstractContextManager[Any]:
    """Limit numerical libraries to one thread for a small fit, where more threads are slower."""
    return _libraries().limit(limits=1 if size < 1e8 else None)
