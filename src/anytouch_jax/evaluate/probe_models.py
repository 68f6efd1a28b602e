"""The fits behind the probes: logistic regression, ridge, nearest neighbours; arrays in, arrays out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from anytouch_jax.evaluate import logistic
from anytouch_jax.evaluate.logistic import Logistic

Array = npt.NDArray[Any]
Scaling = Literal["column", "common"]


class Linear:
    """A fitted standardiser and logistic regression; called on features it gives class numbers.

    `scaling` column: every feature to unit variance; common: one factor for all, which keeps the ranking of
    principal components (to unit variance their noise would weigh as much as their signal).
    """

    def __init__(
        self,
        x: Array,
        y: Array,
        penalty: float,
        *,
        weights: Array | None = None,
        start: Linear | None = None,
        scaling: Scaling = "column",
    ):
        self.mean, self.scale = standard(x, weights, scaling)
        self.classes, numbers = np.unique(y, return_inverse=True)
        self.fit: Logistic | None = None
        if len(self.classes) == 1:  # a small fold or bootstrap may hold one class only
            return
        scaled = (x - self.mean) / self.scale
        before = start.fit if start is not None and np.array_equal(start.classes, self.classes) else None
        self.fit = next(logistic.path(scaled, numbers, len(self.classes), [penalty], before, weights))

    @property
    def finished(self) -> bool:
        """Whether the fit converged."""
        return self.fit is None or self.fit.finished

    def __call__(self, x: Array) -> Array:
        if self.fit is None:
            return np.repeat(self.classes, len(x))
        return self.classes[self.fit((x - self.mean) / self.scale)]


def path(x: Array, y: Array, penalties: Sequence[float], scaling: Scaling = "column") -> Iterator[Linear]:
    """Models along decreasing penalties, each started from the one before."""
    model = None
    for penalty in penalties:
        model = Linear(x, y, penalty, start=model, scaling=scaling)
        yield model


def standard(x: Array, weights: Array | None = None, scaling: Scaling = "column") -> tuple[Array, Array]:
    """Mean and standard deviation by column, summed in float64; a constant column gets deviation 1.

    `scaling` common: one deviation for all columns, the root of their mean variance.
    """
    if weights is None:
        mean = x.mean(0, dtype=np.float64).astype(np.float32)
        variance = np.mean((x - mean) ** 2, 0, dtype=np.float64)
    else:
        shares = weights / weights.sum(dtype=np.float64)
        mean = (shares @ x).astype(np.float32)
        variance = shares @ (x - mean) ** 2
    if scaling == "common":
        variance = np.full_like(variance, variance.mean())
    scale = np.sqrt(variance)
    return mean, np.where(scale > 1e-6 * np.abs(mean), scale, 1.0).astype(np.float32)


def ridge(x: Array, y: Array, scored: Array, penalties: Sequence[float], scaling: Scaling = "column") -> list[Array]:
    """Predictions for `scored`, one array a penalty, from one eigendecomposition of the covariance."""
    mean, scale = standard(x, scaling=scaling)
    x, scored = ((one - mean).astype(np.float64) / scale for one in (x, scored))
    values, vectors = np.linalg.eigh(x.T @ x / len(x))
    turned, ahead = vectors.T @ (x.T @ (y - y.mean()) / len(x)), scored @ vectors
    return [ahead @ (turned / (np.maximum(values, 0) + penalty)) + y.mean() for penalty in penalties]


def nearest(train: Array, scored: Array, k: int) -> tuple[Array, Array]:
    """Row numbers in `train` and cosines of the k nearest of each unit row of `scored`, nearest first."""
    k = min(k, len(train))
    ids, cosines = np.empty((len(scored), k), np.int64), np.empty((len(scored), k), np.float32)
    for start in range(0, len(scored), 512):
        part = slice(start, start + 512)
        ids[part], cosines[part] = _top(scored[part] @ train.T, k)
    return ids, cosines


def _top(values: Array, k: int, block: int = 64) -> tuple[Array, Array]:
    """Columns and values of the k largest of each row, largest first.

    They lie in the k blocks of columns with the largest maxima; partitioning whole rows takes ten times longer.
    """
    blocks = values.shape[1] // block
    columns = np.broadcast_to(np.arange(values.shape[1]), values.shape)
    if blocks > 2 * k:
        whole = values[:, : blocks * block].reshape(len(values), blocks, block)
        best = np.argpartition(-whole.max(2), k - 1, axis=1)[:, :k]
        inside = (best[:, :, None] * block + np.arange(block)).reshape(len(values), -1)
        columns = np.concatenate([inside, columns[:, blocks * block :]], axis=1)
    found = np.take_along_axis(values, columns, 1)
    near = np.argpartition(-found, k - 1, axis=1)[:, :k]
    near = np.take_along_axis(near, np.argsort(-np.take_along_axis(found, near, 1), axis=1, kind="stable"), 1)
    return np.take_along_axis(columns, near, 1), np.take_along_axis(found, near, 1)


def vote(labels: Array, likeness: Array, classes: int) -> Array:
    """Commonest class of each row of `labels` (n, k); among equals the one of larger summed likeness."""
    votes = np.zeros((len(labels), classes))
    rows = np.repeat(np.arange(len(labels)), labels.shape[1])
    np.add.at(votes, (rows, labels.ravel()), (1 + 1e-3 * likeness / labels.shape[1]).ravel())
    return votes.argmax(1)


def commonest(y: Array) -> int:
    """The class number that occurs most often in `y`, the smallest of equals."""
    return int(np.bincount(y).argmax())
