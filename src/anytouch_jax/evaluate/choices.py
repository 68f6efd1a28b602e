"""What both kinds of probe choose among and how: the options, the rows on which they are tried, the best, the folds."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError

Array = npt.NDArray[Any]

PENALTIES = (1.0, 0.1, 0.01, 0.001, 0.0001)  # of logistic regression
RIDGE = (100.0, 10.0, *PENALTIES)
NEIGHBOURS = (20, 10, 5, 1)
FOLDS = 5
SELECT_ROWS = 20_000  # on so many rows an option is chosen; the head that is reported has all


def thinned(rows: Array, most: int | None = None) -> Array:
    """At most `most` (SELECT_ROWS) of `rows`, evenly by chance and always the same."""
    most = most or SELECT_ROWS
    if len(rows) <= most:
        return rows
    return rows[np.sort(np.random.default_rng(0).choice(len(rows), most, replace=False))]


def best_of(scores: Any) -> int:
    """The option that scores best, the middle one of equals: the ends of a plateau are one step from falling off."""
    equals = np.flatnonzero(np.asarray(scores) == np.max(scores))
    return int(equals[len(equals) // 2])


def dealt(groups: Array, y: Array | None, rng: np.random.Generator, count: int = FOLDS) -> Array:
    """The fold i64 (n,) of each row: whole `groups` (n,) are dealt in turn, class by class of `y` (n,) or by chance.

    Raises UserError where all rows are of one group.
    """
    names, first, ids = np.unique(groups, return_index=True, return_inverse=True)
    if len(names) < 2:
        raise UserError(
            f"all rows to learn from are of one group, {str(names[0])!r}; to choose takes two, or rows of split val"
        )
    count = min(count, len(names))
    order = np.lexsort((rng.permutation(len(names)), np.zeros(len(names)) if y is None else y[first]))
    fold = np.empty(len(names), np.int64)
    fold[order] = (np.arange(len(names)) + rng.integers(count)) % count
    return fold[ids]
