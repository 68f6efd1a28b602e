"""Geometry of a feature space: alignment, uniformity, silhouettes, t-SNE."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt

from anytouch_jax.encoder.arrays import Array, unit_rows
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.splits import subsample

MOST = 4000  # rows that are compared in pairs


@dataclass(frozen=True)
class Space:
    """Numbers of one feature space; see the functions of the same names.

    None: not defined for these labels.
    """

    name: str
    alignment: float | None
    uniformity: float
    silhouette_sensor: float | None
    silhouette_object: float | None
    rows: int


def alignment(first: Array, second: Array) -> float:
    """Return the mean squared distance of unit-norm positive pairs (n, d).

    0 is best (Wang & Isola, 2020).
    """
    first = _unit(first)
    second = _unit(second)
    if first.shape != second.shape or not len(first):
        raise UserError(f"Alignment needs pairs of rows, not {first.shape} and {second.shape}.")
    return float(np.mean(np.linalg.norm(first - second, axis=1) ** 2))


def uniformity(features: Array) -> float:
    """Return the log of the mean of exp(-2 |x - y|^2) over pairs of unit-norm rows, -8 to 0.

    Lower is more even (Wang & Isola, 2020).
    """
    x = _unit(subsample(np.asarray(features), MOST))
    if len(x) < 2:
        raise UserError("Uniformity needs two rows or more.")
    likeness = (x @ x.T)[np.triu_indices(len(x), 1)]
    # |x - y|^2 of unit rows, which rounding can make negative
    square = np.maximum(2 - 2 * likeness, 0.0)
    return float(np.log(np.mean(np.exp(-2.0 * square))))


def silhouette(features: Array, labels: npt.ArrayLike) -> float | None:
    """Return the mean silhouette by cosine distance, -1..1.

    It is None with fewer than two labels, or as many as rows.
    """
    from sklearn.metrics import silhouette_score

    labels = subsample(np.asarray(labels).astype(str), MOST)
    count = len(np.unique(labels))
    if not 2 <= count < len(labels):
        return None
    x = _unit(subsample(np.asarray(features), MOST))
    return float(silhouette_score(x, labels, metric="cosine"))


def tsne(features: Array, *, seed: int = 0) -> Array:
    """Return a t-SNE of features (n, d) by cosine distance, f32 (n, 2).

    Raises UserError below 4 rows or 2 columns.
    """
    from sklearn.manifold import TSNE
    from threadpoolctl import threadpool_limits

    features = np.asarray(features)
    if features.ndim != 2 or features.shape[0] < 4 or features.shape[1] < 2:
        raise UserError(f"A t-SNE needs 4 rows of 2 columns or more, not {features.shape}.")
    x = _unit(features)
    # Squared Euclidean distances of unit-norm rows are twice the cosine distances.
    model = TSNE(
        perplexity=min(30.0, (len(x) - 1) / 3), init="pca", max_iter=600, random_state=seed
    )
    # its threads wait for each other at every step, very long on a busy machine
    with threadpool_limits(1):
        return np.asarray(model.fit_transform(x.astype(np.float32)), np.float32)


def describe(
    features: Array,
    sensors: npt.ArrayLike,
    objects: npt.ArrayLike,
    touches: npt.ArrayLike,
    *,
    name: str = "features",
) -> Space:
    """Return all numbers of features.

    Args:
        features: (n, d).
        sensors: names (n,).
        objects: names (n,), "" where it is unknown.
        touches: names (n,); positive pairs are the rows of one touch by different sensors.
        name: of the space in tables.
    """
    x = np.asarray(features)
    sensors = np.asarray(sensors).astype(str)
    objects = np.asarray(objects).astype(str)
    known = objects != ""
    members = dict[str, list[int]]()
    for row, touch in enumerate(np.asarray(touches).astype(str)):
        members.setdefault(touch, []).append(row)
    pairs = []
    for _, rows in sorted(members.items()):
        pairs += [(a, b) for a, b in combinations(rows, 2) if sensors[a] != sensors[b]]
    aligned = None
    if pairs:
        first, second = np.array(pairs, np.int64).T
        aligned = alignment(x[first], x[second])
    by_sensor = silhouette(x, sensors)
    by_object = silhouette(x[known], objects[known])
    return Space(name, aligned, uniformity(x), by_sensor, by_object, len(x))


def _unit(features: Array) -> Array:
    x = np.asarray(features, np.float64)
    if x.ndim != 2 or not np.isfinite(x).all():
        raise UserError(f"Features must be finite numbers (n, d), not {x.shape} with NaN or Inf.")
    return unit_rows(x)
