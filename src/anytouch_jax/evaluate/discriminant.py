"""Linear discriminants for many classes: one factorisation, whatever their number.

Logistic regression takes tens of passes over features and classes for each penalty, and its time
grows with the number of classes faster than the classes do. A linear discriminant has a closed
form: the classes are taken as normal, with one covariance within all of them, and a row belongs to
the class whose mean is nearest in the space where that covariance is round (Fisher 1936; shrunk as
by Friedman 1989). It is a linear head like the other one, so it is saved and calibrated alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.linalg import eigh
from scipy.sparse import csr_matrix

from anytouch_jax.encoder.arrays import Array
from anytouch_jax.evaluate.logistic import Logistic, threads


def discriminant_path(
    x: Array, y: Array, classes: int, penalties: Sequence[float], weights: Array | None = None
) -> Iterator[Logistic]:
    """Yield a linear discriminant for each penalty, in the form of a logistic regression.

    A penalty is added to the variance within classes, in units of the variance of a standardised
    feature. So the strongest give the nearest class mean by plain distance.

    Args:
        x: standardised features f32 (n, d).
        y: class numbers (n,) below `classes`, each of which has a row.
        classes: how many there are, three or more.
        penalties: in any order.
        weights: of the rows (n,), equal by default.
    """
    counts = weights
    if counts is None:
        counts = np.ones(len(x))
    rows = (counts / np.sum(counts, dtype=np.float64)).astype(np.float64)
    # Sums over the rows of each class, as a sparse product: 3,000 masks would each read all rows.
    member = csr_matrix((rows, (y, np.arange(len(y)))), shape=(classes, len(y)))
    fraction = np.asarray(member.sum(axis=1)).ravel()
    means = np.asarray(member @ x.astype(np.float64)) / fraction[:, None]
    with threads(x.size * x.shape[1]):
        total = (x * rows[:, None].astype(np.float32)).T @ x
    # The rest is small, and there several threads wait for each other: eigh of 448 features took
    # 3 s instead of 0.1 s where other work had a core of two.
    with threads(0):
        within = total.astype(np.float64) - (means * fraction[:, None]).T @ means
        values, vectors = eigh(within)
        # rounding leaves directions of no variance a little below 0
        values = np.maximum(values, 0.0)
        turned = means @ vectors
        for penalty in penalties:
            # The inverse covariance times the means, in the space of the eigenvectors.
            scaled = turned / (values + penalty)
            directions = scaled @ vectors.T
            bias = np.log(fraction) - 0.5 * np.sum(scaled * turned, axis=1)
            yield Logistic(
                np.asarray(directions.T, np.float32), np.asarray(bias, np.float32), np.nan, True
            )
