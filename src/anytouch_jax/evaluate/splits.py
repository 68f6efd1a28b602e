"""Train, validation and test splits that keep whole groups together."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.statistics import Protocol

Array = npt.NDArray[Any]

FOLDS = 5
SELECT_ROWS = 20_000  # a penalty or k is selected on so many rows; the reported fit has all rows


class Split(NamedTuple):
    """Row numbers to fit on, to select on (may be empty) and to test on."""

    fit: Array
    val: Array
    test: Array


class RowRoles(NamedTuple):
    """Labels `y` (n,), numbers if `measured`; `groups` (n,); and boolean masks (n,) of the use of a row.

    `train`, `test`: by the manifest's split (val counts as train). `may_fit`, `may_test`: by sensor and unit.
    """

    y: Array
    groups: Array
    train: Array
    test: Array
    may_fit: Array
    may_test: Array
    measured: bool = False

    @property
    def fitted(self) -> Array:
        return self.train & self.may_fit

    @property
    def tested(self) -> Array:
        return self.test & self.may_test


def subsample(rows: Array, most: int | None = None) -> Array:
    """Return at most `most` (default SELECT_ROWS) of `rows`, drawn with a fixed seed, in order."""
    most = most or SELECT_ROWS
    if len(rows) <= most:
        return rows
    return rows[np.sort(np.random.default_rng(0).choice(len(rows), most, replace=False))]


def best_option(scores: Any) -> int:
    """Return the index of the best score, the middle one of equals: the ends of a plateau are fragile."""
    equal = np.flatnonzero(np.asarray(scores) == np.max(scores))
    return int(equal[len(equal) // 2])


def assign_folds(groups: Array, y: Array | None, rng: np.random.Generator, count: int = FOLDS) -> Array:
    """Return the fold i64 (n,) of each row, with whole `groups` (n,) and each class of `y` (n,) spread over the folds.

    Without `y` the groups are shuffled. Raises UserError if all rows are of one group.
    """
    # scikit-learn's StratifiedGroupKFold takes 60 times longer on 100 groups, 200 times on 2000.
    names, first, group_ids = np.unique(groups, return_index=True, return_inverse=True)
    if len(names) < 2:
        raise UserError(
            f"All rows to fit on are of one group, {str(names[0])!r}. Selection takes two groups, or rows of split val."
        )
    count = min(count, len(names))
    order = np.lexsort((rng.permutation(len(names)), np.zeros(len(names)) if y is None else y[first]))
    fold = np.empty(len(names), np.int64)
    fold[order] = (np.arange(len(names)) + rng.integers(count)) % count
    return fold[group_ids]


def group_folds(rows: Array, groups: Array, y: Array | None, count: int) -> Iterator[tuple[Array, Array]]:
    """Yield (rows to fit on, rows left out) for each fold of `rows`; `groups` and `y` are of all rows."""
    fold = assign_folds(groups[rows], None if y is None else y[rows], np.random.default_rng(0), count)
    for number in range(int(fold.max()) + 1):
        yield rows[fold != number], rows[fold == number]


def group_bootstraps(rows: Array, groups: Array, seeds: int) -> Iterator[tuple[Array, Array]]:
    """Yield (rows drawn at least once, how often each was drawn) for each seed of a bootstrap over groups."""
    names, group_ids = np.unique(groups[rows], return_inverse=True)
    for seed in range(seeds):
        times = np.random.default_rng(seed).multinomial(len(names), np.full(len(names), 1 / len(names)))
        weights = times[group_ids].astype(np.float32)
        yield rows[weights > 0], weights[weights > 0]


def split_scheme(roles: RowRoles) -> tuple[Literal["split", "folds"], Array, str]:
    """Return how honest tests are split, the rows bool (n,) that take part, and the reason.

    The manifest's split is kept if it keeps groups apart. If no class of test is in train, the test rows are cut into
    folds. If a group is in both, all rows are.
    """
    missing = "row to fit on" if roles.measured else "class of test"
    fitted, tested = roles.y[roles.fitted], roles.y[roles.tested]
    if not (len(fitted) if roles.measured else np.isin(tested, fitted).any()):
        return "folds", roles.test, f"no {missing} is in train: folds over the test rows, whole groups left out"
    shared = np.intersect1d(roles.groups[roles.fitted], roles.groups[roles.tested])
    if len(shared):
        why = f"{len(shared)} groups are in train and test: folds over all rows instead, whole groups left out"
        return "folds", roles.train | roles.test, why
    return "split", roles.train | roles.test, ""


def seeded_splits(roles: RowRoles, seed: int, protocol: Protocol) -> list[Split]:
    """Return the splits of one seed: one by the manifest's split, or FOLDS that test every row once.

    honest: a fifth of the groups of train selects, the rest is fitted on. published: the manifest's split even if it
    shares groups, all of train is fitted on, and test selects. Raises UserError for too few groups.
    """
    check_protocol(protocol)
    rng = np.random.default_rng([11, seed])

    def folds(rows: Array) -> Array:
        return assign_folds(roles.groups[rows], None if roles.measured else roles.y[rows], rng)

    def split(train: Array, test: Array) -> Split:
        if protocol == "published":
            return Split(train, train[:0], test)
        fold = folds(train)
        return Split(train[fold != 0], train[fold == 0], test)

    scheme, used, _ = split_scheme(roles)
    if scheme == "split" or (protocol == "published" and np.any(used & roles.train)):
        return [split(np.flatnonzero(roles.fitted), np.flatnonzero(roles.tested))]
    rows = np.flatnonzero(used & (roles.may_fit | roles.may_test))
    fold, cuts = folds(rows), []
    for number in range(int(fold.max()) + 1):
        fit = rows[(fold != number) & roles.may_fit[rows]]
        test = rows[(fold == number) & roles.may_test[rows]]
        if len(fit) and len(test):
            cuts.append(split(fit, test))
    return cuts


def check_protocol(protocol: str) -> None:
    """Raise UserError for an unknown protocol."""
    if protocol not in ("honest", "published"):
        raise UserError(f"Unknown protocol {protocol!r}. Choose honest or published.")
