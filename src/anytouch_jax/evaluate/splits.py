"""Train/validation/test splits that keep whole groups together, and the selection of an option.

Every result names its protocol. By "grouped" (a grouped hold-out) the penalty (k, epoch) is
selected on val, or by cross-validation over groups of train, and test is read once. By "released"
it is selected on test, as the authors released it.

Groups are held out whole because frames of one recording, and recordings of one object, are alike:
a head that has seen one frame names the others by their gel, light and texture, whatever it knows
of the label.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import heads
from anytouch_jax.evaluate.heads import FittedHead, ProbeHead
from anytouch_jax.evaluate.statistics import Array, Protocol
from anytouch_jax.evaluate.tasks import Task, TaskRows, label_text
from anytouch_jax.progress import tracked

Sides = Mapping[str, Sequence[str] | None]  # names or patterns by SIDES

SIDES = ("train_sensors", "test_sensors", "train_units", "test_units")
FOLDS = 5
# A penalty or k is selected on so many rows, which keeps folds over 100,000 rows affordable. The
# reported fit has all rows.
SELECT_ROWS = 20_000


class Split(NamedTuple):
    """Row numbers to fit on, to select on (may be empty) and to test on."""

    fit: Array
    val: Array
    test: Array


class RowRoles(NamedTuple):
    """Labels `y`, `groups` and masks of the rows of a task, all (n,).

    `test` goes by the split of the manifest, `may_fit` and `may_test` by sensor and sensor
    instance. With `regression` labels are continuous, else class numbers.
    """

    y: Array
    groups: Array
    test: Array
    may_fit: Array
    may_test: Array
    regression: bool = False

    @property
    def fitted(self) -> Array:
        return ~self.test & self.may_fit

    @property
    def tested(self) -> Array:
        return self.test & self.may_test


def assign_roles(task: Task, rows: TaskRows, sides: Sides) -> tuple[RowRoles, Array]:
    """Return the roles of the rows and the class names.

    Raises UserError if nothing is left to fit on or to test.
    """
    regression = task.kind == "regression"
    may_fit = _on_side("train", rows, sides)
    may_test = _on_side("test", rows, sides)
    names = np.array([], str)
    y = rows.labels
    if not regression:
        names, y = np.unique(rows.labels, return_inverse=True)
    roles = RowRoles(y, rows.groups, rows.split == "test", may_fit, may_test, regression)
    for mask, purpose in ((roles.tested, "test"), (roles.may_fit, "train")):
        if not mask.any():
            raise UserError(
                f"Task {task.name}: no row is left to {purpose}. Check the splits, sensors and "
                "units."
            )
    if regression and np.ptp(y[roles.tested]) == 0:
        raise UserError(
            f"Task {task.name}: {task.label} is constant on test. R2 has no meaning there."
        )
    if not regression and len(names) < 2:
        raise UserError(
            f"Task {task.name}: the label is {str(names[0])!r} on every row. A probe needs two "
            "classes."
        )
    return roles, names


def _on_side(purpose: Literal["train", "test"], rows: TaskRows, sides: Sides) -> Array:
    """Return which rows are of the sensors and sensor instances named for a side, bool (n,).

    Raises UserError for a name or pattern that no row has.
    """
    mask = np.ones(len(rows.labels), bool)
    for kind, column in (("sensor", rows.sensors), ("unit", rows.units)):
        patterns = sides.get(f"{purpose}_{kind}s") or ()
        known = np.unique(column)
        named = list[str]()
        for pattern in patterns:
            found = fnmatch.filter(known, pattern)
            if not found:
                listed = ", ".join(known) or "none"
                raise UserError(f"No row has the {kind} {pattern!r}. There are {listed}.")
            named += found
        if patterns:
            mask &= np.isin(column, named)
    return mask


def subsample(rows: Array, most: int | None = None) -> Array:
    """Return at most `most` (default SELECT_ROWS) of `rows`, drawn with a fixed seed, in order."""
    most = most or SELECT_ROWS
    if len(rows) <= most:
        return rows
    return rows[np.sort(np.random.default_rng(0).choice(len(rows), most, replace=False))]


def assign_folds(
    groups: Array, y: Array | None, rng: np.random.Generator, count: int = FOLDS
) -> Array:
    """Return the fold i64 (n,) of each row.

    `groups` (n,) stay whole, and the groups of each class of `y` (n,) are dealt to the folds in
    turn, so that every fold has every class if there are enough groups. A group counts as the class
    of its first row. Without `y` the groups are shuffled. Raises UserError if all rows are of one
    group.

    Args:
        groups: (n,), each stays whole.
        y: classes (n,), None to shuffle the groups only.
        rng: draws the order of the groups.
        count: of folds.
    """
    # scikit-learn's StratifiedGroupKFold takes 60 times longer on 100 groups, 200 times on 2000.
    names, first, group_ids = np.unique(groups, return_index=True, return_inverse=True)
    if len(names) < 2:
        raise UserError(
            f"All rows to fit on are of one group, {str(names[0])!r}. Give two, or rows of split "
            "val."
        )
    count = min(count, len(names))
    group_class = np.zeros(len(names))
    if y is not None:
        group_class = y[first]
    order = np.lexsort((rng.permutation(len(names)), group_class))
    fold = np.empty(len(names), np.int64)
    fold[order] = (np.arange(len(names)) + rng.integers(count)) % count
    return fold[group_ids]


def group_folds(
    rows: Array, groups: Array, y: Array | None, count: int
) -> Iterator[tuple[Array, Array]]:
    """Yield (rows to fit on, rows left out) for each fold of `rows`.

    The folds do not depend on a seed of the caller, so heads with other penalties are compared on
    the same folds.

    Args:
        rows: i64 (m,) to divide.
        groups: (n,) of all rows.
        y: classes (n,) of all rows, or None.
        count: of folds.
    """
    own = None
    if y is not None:
        own = y[rows]
    fold = assign_folds(groups[rows], own, np.random.default_rng(0), count)
    for number in range(int(fold.max()) + 1):
        yield rows[fold != number], rows[fold == number]


def group_bootstraps(rows: Array, groups: Array, seeds: int) -> Iterator[tuple[Array, Array]]:
    """Yield (rows drawn at least once, how often each was drawn) for each seed.

    As many groups are drawn as there are, with replacement, and a group comes with all its rows.
    """
    names, group_ids = np.unique(groups[rows], return_inverse=True)
    chances = np.full(len(names), 1 / len(names))
    for seed in range(seeds):
        times = np.random.default_rng(seed).multinomial(len(names), chances)
        weights = times[group_ids].astype(np.float32)
        yield rows[weights > 0], weights[weights > 0]


def split_scheme(roles: RowRoles) -> tuple[Literal["split", "folds"], Array, str]:
    """Return how a grouped hold-out is made, the rows bool (n,) that take part, and the reason.

    The manifest's split is kept if it keeps groups apart. Else folds are made, of test rows if
    train lacks classes.
    """
    fitted = roles.y[roles.fitted]
    tested = roles.y[roles.tested]
    if roles.regression:
        missing = "row to fit on"
        can_fit = len(fitted) > 0
    else:
        missing = "class of test"
        can_fit = bool(np.isin(tested, fitted).any())
    if not can_fit:
        return (
            "folds",
            roles.test,
            f"no {missing} is in train: folds over the test rows, whole groups left out",
        )
    shared = np.intersect1d(roles.groups[roles.fitted], roles.groups[roles.tested])
    if len(shared):
        why = (
            f"{len(shared)} groups are in train and test: folds over all rows instead, whole "
            "groups left out"
        )
        return "folds", np.ones(len(roles.y), bool), why
    return "split", np.ones(len(roles.y), bool), ""


def seeded_splits(roles: RowRoles, seed: int, protocol: Protocol) -> list[Split]:
    """Return the splits of one seed.

    It is one by the manifest's split, or FOLDS that test every row once.

    In a grouped hold-out a fifth of the groups of train selects, in each fold anew: the choice is
    nested, so no row has a part in the choice by which it is scored. By "released" the manifest's
    split is used even if it shares groups, and test selects. Raises UserError for too few groups.
    """
    _check_protocol(protocol)
    # The first number keeps this stream apart from other streams of the same seed.
    rng = np.random.default_rng([11, seed])

    def folds(rows: Array) -> Array:
        y = None
        if not roles.regression:
            y = roles.y[rows]
        return assign_folds(roles.groups[rows], y, rng)

    def split(train: Array, test: Array) -> Split:
        if protocol == "released":
            return Split(train, train[:0], test)
        fold = folds(train)
        return Split(train[fold != 0], train[fold == 0], test)

    scheme, used, _ = split_scheme(roles)
    has_train = np.any(used & ~roles.test)
    if scheme == "split" or (protocol == "released" and has_train):
        return [split(np.flatnonzero(roles.fitted), np.flatnonzero(roles.tested))]
    rows = np.flatnonzero(used & (roles.may_fit | roles.may_test))
    fold = folds(rows)
    cuts = []
    for number in range(int(fold.max()) + 1):
        fit = rows[(fold != number) & roles.may_fit[rows]]
        test = rows[(fold == number) & roles.may_test[rows]]
        if len(fit) and len(test):
            cuts.append(split(fit, test))
    return cuts


def _check_protocol(protocol: str) -> None:
    if protocol not in ("grouped", "released"):
        raise UserError(f"Unknown protocol {protocol!r}. Choose grouped or released.")


class LabelledFeatures(NamedTuple):
    """Features `x` (n, d) with class numbers or floats `y` (n,) and `groups` (n,).

    Class `names` are empty where `y` are floats.
    """

    x: Array
    y: Array
    names: Array
    groups: Array

    def fit(self, head: ProbeHead, ids: Array, **options: Any) -> FittedHead:
        """Fit a head on some rows; `options` are those of `fit_head`."""
        return heads.fit_head(head, self.x[ids], self.y[ids], len(self.names), **options)


class Selection(NamedTuple):
    """The selected option and its place among all, and what it was chosen on.

    `scores` has one for each option, and `fitted` is their fit, None after many folds.
    """

    place: int
    option: float
    chosen_on: str
    scores: Sequence[float] | Array = ()
    fitted: FittedHead | None = None


def select_option(
    head: ProbeHead, data: LabelledFeatures, split: Split, protocol: Protocol
) -> Selection:
    """Fit all options of a head and select the best by the protocol.

    They are fitted on at most SELECT_ROWS rows of `split.fit`.

    Args:
        head: kind of head, with its options.
        data: features, labels and groups of all rows.
        split: rows of train, val and test.
        protocol: "grouped" selects on validation rows, "released" on test.
    """
    _check_protocol(protocol)
    if head.options is not None and len(head.options) == 1:
        return Selection(0, head.options[0], "given")
    # An epoch is not selected on fewer rows, as its number of steps would change.
    fit = split.fit
    if head.name != "gradient":
        fit = subsample(split.fit)
    classes = len(data.names)
    if protocol == "released":
        chosen_on = "test"
        parts = [(fit, split.test)]
    elif len(split.val):
        chosen_on = "val"
        parts = [(fit, split.val)]
    else:
        chosen_on = "cross-validation"
        y = data.y if classes else None
        parts = list(group_folds(fit, data.groups, y, FOLDS))
    totals: Any = 0
    for inner, out in tracked(parts, "folds"):
        fitted = data.fit(head, inner)
        predictions = fitted.predict(data.x[out])
        scores = [heads.head_score(one, data.y[out], classes) for one in predictions]
        # Weighted by rows, so that the sum is the score of all rows predicted once.
        totals = totals + len(out) * np.array(scores)
    equal = np.flatnonzero(totals == np.max(totals))
    # the middle one: the ends of a plateau are fragile
    place = int(equal[len(equal) // 2])
    only = fitted if len(parts) == 1 else None
    return Selection(place, fitted.options[place], chosen_on, totals, only)


def check_rows(
    features: Array,
    labels: npt.ArrayLike,
    groups: npt.ArrayLike,
    split: npt.ArrayLike,
    *,
    regression: bool = False,
    tested: bool = True,
) -> tuple[LabelledFeatures, Split, tuple[str, ...]]:
    """Return the arguments of a probe as records, with notes on the rows.

    Args:
        features: (n, d), finite on the rows that take part.
        labels: (n,) classes or numbers; None, "" and NaN are no label.
        groups: (n,) names.
        split: (n,) "train", "val" or "test" for the rows that take part.
        regression: labels are continuous.
        tested: whether rows of test are needed. Without, rows of train are enough.

    Raises:
        UserError: for arrays that do not fit together, and rows that cannot be probed.
    """
    x = np.asarray(features, np.float32)
    groups = np.asarray(groups).astype(str)
    split = np.asarray(split).astype(str)
    values = np.asarray(labels, object)
    sizes = {"features": len(x), "labels": len(values), "groups": len(groups), "split": len(split)}
    if x.ndim != 2 or len(set(sizes.values())) != 1:
        raise UserError(
            f"A probe needs features (n, d) and n labels, groups and splits, not {x.shape} and "
            f"{sizes}."
        )
    y, names, has_label = _parse_labels(values, regression)
    data = LabelledFeatures(x, y, names, groups)
    rows = Split(
        np.flatnonzero((split == "train") & has_label),
        np.flatnonzero((split == "val") & has_label),
        np.flatnonzero((split == "test") & has_label),
    )
    _check_parts(rows, tested)
    _check_used(data, rows)
    _check_labels(data, rows, tested)
    notes = []
    unlabelled = int(np.sum(np.isin(split, ("train", "val", "test")) & ~has_label))
    if unlabelled:
        notes.append(f"{unlabelled} rows without this label left out")
    for part, ids in (("val", rows.val), ("test", rows.test)):
        shared = np.intersect1d(groups[rows.fit], groups[ids])
        if len(shared):
            notes.append(
                f"{len(shared)} groups lie in both train and {part}: these are not independent"
            )
    if not regression:
        notes += unlearned_note(y[rows.test], np.unique(y[rows.fit]), names)
    return data, rows, tuple(notes)


def _check_parts(rows: Split, tested: bool) -> None:
    """Raise UserError for a part of the split without rows."""
    parts = [("train", rows.fit)]
    if tested:
        parts.append(("test", rows.test))
    for part, ids in parts:
        if not len(ids):
            raise UserError(
                f"No row of split {part!r} has this label. Choose another label or another "
                "manifest."
            )


def _check_used(data: LabelledFeatures, rows: Split) -> None:
    """Raise UserError for rows without a group or with features that are not finite."""
    used = np.sort(np.concatenate(rows))
    without = used[np.isin(data.groups[used], ["", "None", "nan"])]
    if len(without):
        raise UserError(
            f"Rows {_listed(without)} have no group. Give at least their recording (`sequence`)."
        )
    bad = used[~np.isfinite(data.x[used]).all(axis=1)]
    if len(bad):
        raise UserError(
            f"The features of rows {_listed(bad)} are NaN or infinite. Embed them again or leave "
            "them out."
        )


def _check_labels(data: LabelledFeatures, rows: Split, tested: bool) -> None:
    """Raise UserError for labels that nothing can be learned from, or that cannot be scored."""
    regression = not len(data.names)
    learned = np.unique(data.y[rows.fit])
    truth = data.y[rows.test]
    if len(learned) < 2:
        if regression:
            value = f"{learned[0]:g}"
        else:
            value = repr(str(data.names[learned[0]]))
        raise UserError(
            f"The label is {value} on every row of train. A probe needs at least two values."
        )
    if regression and tested and np.ptp(truth) == 0:
        raise UserError(f"The label is {truth[0]:g} on every row of test. R2 has no meaning there.")
    if tested and not regression and not np.isin(truth, learned).any():
        raise UserError(
            "No class of test is in train. Take another label, or let `anytouch probe tasks` split "
            "again."
        )


def unlearned_note(tested: Array, learned: Array, names: Array) -> list[str]:
    """Return a note on test rows of classes that no row of train has, or nothing."""
    unknown = tested[~np.isin(tested, learned)]
    if not len(unknown):
        return []
    listed = _listed(names[np.unique(unknown)])
    return [f"{len(unknown)} test rows of classes that train lacks count as errors: {listed}"]


def _parse_labels(values: Array, regression: bool) -> tuple[Array, Array, Array]:
    """Return class numbers (-1: no label) or floats of labels (n,).

    Then come the sorted class names, and which rows have a label.
    """
    if regression:
        known = [np.nan if value in (None, "") else value for value in values]
        try:
            y = np.array([float(value) for value in known], np.float64)
        except ValueError as error:
            raise UserError(
                f"The label is not a number ({error}). Use the linear probe for classes."
            ) from None
        return y, np.array([], str), np.isfinite(y)
    texts = np.array([label_text(value) for value in values], dtype=str)
    has_label = texts != ""
    y = np.full(len(texts), -1)
    names, y[has_label] = np.unique(texts[has_label], return_inverse=True)
    return y, names, has_label


def _listed(items: Array) -> str:
    """Return the first ten items, and how many more there are."""
    listed = ", ".join(map(str, items[:10]))
    if len(items) > 10:
        listed += f" and {len(items) - 10} more"
    return listed
