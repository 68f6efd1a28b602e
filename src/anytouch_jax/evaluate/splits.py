"""Train/validation/test splits that keep whole groups together, and the selection of an option of a
head.

Every result names its protocol. By "honest" the penalty (k, epoch) is selected on val, or by
cross-validation over groups of train, and test is read once. By "published" it is selected on test,
as the authors' released code does.
"""

import fnmatch
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import heads
from anytouch_jax.evaluate.heads import FittedHead, ProbeHead
from anytouch_jax.evaluate.statistics import Array, Protocol
from anytouch_jax.evaluate.tasks import Task, TaskRows, label_text
from anytouch_jax.progress import tracked

Sides = Mapping[str, Sequence[str] | None]  # names or patterns by SIDES

SIDES = ("train_sensors", "test_sensors", "train_units", "test_units")
FOLDS = 5
SELECT_ROWS = 20_000  # a penalty or k is selected on so many rows; the reported fit has all rows


class Split(NamedTuple):
    """Row numbers to fit on, to select on (may be empty) and to test on."""

    fit: Array
    val: Array
    test: Array


class RowRoles(NamedTuple):
    """Labels `y`, `groups` and masks, all (n,): `test` by the split, `may_fit`, `may_test` by
    sensor and unit.
    """

    y: Array
    groups: Array
    test: Array
    may_fit: Array
    may_test: Array
    measured: bool = False

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
    measured = task.kind == "regression"
    masks = dict.fromkeys(("train", "test"), np.ones(len(rows.labels), bool))
    for side in SIDES:
        purpose, _, kind = side.partition("_")
        column = rows.sensors if kind == "sensors" else rows.units
        for pattern in (patterns := sides.get(side) or ()):
            if not fnmatch.filter(column, pattern):
                known = ", ".join(np.unique(column)) or "none"
                raise UserError(f"No row has the {kind[:-1]} {pattern!r}. There are {known}.")
        if patterns:
            named = [
                name for pattern in patterns for name in fnmatch.filter(np.unique(column), pattern)
            ]
            masks[purpose] = masks[purpose] & np.isin(column, named)
    names, y = (
        (np.array([], str), rows.labels)
        if measured
        else np.unique(rows.labels, return_inverse=True)
    )
    roles = RowRoles(y, rows.groups, rows.split == "test", masks["train"], masks["test"], measured)
    for mask, purpose in ((roles.tested, "test"), (roles.may_fit, "train")):
        if not mask.any():
            raise UserError(
                f"Task {task.name}: no row is left to {purpose}. Check the splits, sensors and "
                "units."
            )
    if measured and np.ptp(y[roles.tested]) == 0:
        raise UserError(
            f"Task {task.name}: {task.label} is constant on test. R2 has no meaning there."
        )
    if not measured and len(names) < 2:
        raise UserError(
            f"Task {task.name}: the label is {str(names[0])!r} on every row. A probe needs two "
            "classes."
        )
    return roles, names


def subsample(rows: Array, most: int | None = None) -> Array:
    """Return at most `most` (default SELECT_ROWS) of `rows`, drawn with a fixed seed, in order."""
    most = most or SELECT_ROWS
    if len(rows) <= most:
        return rows
    return rows[np.sort(np.random.default_rng(0).choice(len(rows), most, replace=False))]


def assign_folds(
    groups: Array, y: Array | None, rng: np.random.Generator, count: int = FOLDS
) -> Array:
    """Return the fold i64 (n,) of each row, with whole `groups` (n,) and each class of `y` (n,)
    spread over the folds.

    Without `y` the groups are shuffled. Raises UserError if all rows are of one group.
    """
    # scikit-learn's StratifiedGroupKFold takes 60 times longer on 100 groups, 200 times on 2000.
    names, first, group_ids = np.unique(groups, return_index=True, return_inverse=True)
    if len(names) < 2:
        raise UserError(
            f"All rows to fit on are of one group, {str(names[0])!r}. Give two, or rows of split "
            "val."
        )
    count = min(count, len(names))
    order = np.lexsort(
        (rng.permutation(len(names)), np.zeros(len(names)) if y is None else y[first])
    )
    fold = np.empty(len(names), np.int64)
    fold[order] = (np.arange(len(names)) + rng.integers(count)) % count
    return fold[group_ids]


def group_folds(
    rows: Array, groups: Array, y: Array | None, count: int
) -> Iterator[tuple[Array, Array]]:
    """Yield (rows to fit on, rows left out) for each fold of `rows`; `groups` and `y` are of all
    rows.
    """
    fold = assign_folds(
        groups[rows], None if y is None else y[rows], np.random.default_rng(0), count
    )
    for number in range(int(fold.max()) + 1):
        yield rows[fold != number], rows[fold == number]


def group_bootstraps(rows: Array, groups: Array, seeds: int) -> Iterator[tuple[Array, Array]]:
    """Yield (rows drawn at least once, how often each was drawn) for each seed of a bootstrap over
    groups.
    """
    names, group_ids = np.unique(groups[rows], return_inverse=True)
    for seed in range(seeds):
        times = np.random.default_rng(seed).multinomial(
            len(names), np.full(len(names), 1 / len(names))
        )
        weights = times[group_ids].astype(np.float32)
        yield rows[weights > 0], weights[weights > 0]


def split_scheme(roles: RowRoles) -> tuple[Literal["split", "folds"], Array, str]:
    """Return how honest tests are split, the rows bool (n,) that take part, and the reason.

    The manifest's split is kept if it keeps groups apart. Else folds are made, of test rows if
    train lacks classes.
    """
    missing = "row to fit on" if roles.measured else "class of test"
    fitted = roles.y[roles.fitted]
    tested = roles.y[roles.tested]
    if not (len(fitted) if roles.measured else np.isin(tested, fitted).any()):
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
    """Return the splits of one seed: one by the manifest's split, or FOLDS that test every row
    once.

    By "honest" a fifth of the groups of train selects. By "published" the manifest's split is used
    even if it shares groups, and test selects. Raises UserError for too few groups.
    """
    _check_protocol(protocol)
    rng = np.random.default_rng([11, seed])

    def folds(rows: Array) -> Array:
        return assign_folds(roles.groups[rows], None if roles.measured else roles.y[rows], rng)

    def split(train: Array, test: Array) -> Split:
        if protocol == "published":
            return Split(train, train[:0], test)
        fold = folds(train)
        return Split(train[fold != 0], train[fold == 0], test)

    scheme, used, _ = split_scheme(roles)
    if scheme == "split" or (protocol == "published" and np.any(used & ~roles.test)):
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
    if protocol not in ("honest", "published"):
        raise UserError(f"Unknown protocol {protocol!r}. Choose honest or published.")


class LabelledFeatures(NamedTuple):
    """Features `x` (n, d), class numbers or floats `y` (n,), class `names` (empty: y are floats),
    `groups` (n,).
    """

    x: Array
    y: Array
    names: Array
    groups: Array

    def fit(self, head: ProbeHead, ids: Array, **options: Any) -> FittedHead:
        """Fit a head on some rows; `options` are those of `fit_head`."""
        return heads.fit_head(head, self.x[ids], self.y[ids], len(self.names), **options)


class Selection(NamedTuple):
    """The selected option and its place, what it was chosen on, all scores, and their fit (None
    after many folds).
    """

    place: int
    option: float
    chosen_on: str
    scores: Sequence[float] | Array = ()
    fitted: FittedHead | None = None


def select_option(
    head: ProbeHead, data: LabelledFeatures, split: Split, protocol: Protocol
) -> Selection:
    """Fit all options of a head on at most SELECT_ROWS rows of `split.fit` and select the best by
    the protocol.
    """
    _check_protocol(protocol)
    if head.options is not None and len(head.options) == 1:
        return Selection(0, head.options[0], "given")
    # An epoch is not selected on fewer rows, as its number of steps would change.
    fit = split.fit if head.name == "gradient" else subsample(split.fit)
    if protocol == "published" or len(split.val):
        chosen_on, rows = ("test", split.test) if protocol == "published" else ("val", split.val)
        parts = [(fit, rows)]
    else:
        chosen_on = "cross-validation"
        parts = list(group_folds(fit, data.groups, data.y if len(data.names) else None, FOLDS))
    totals: Any = 0
    for inner, out in tracked(parts, "folds"):
        fitted = data.fit(head, inner)
        scores = [
            heads.head_score(one, data.y[out], len(data.names))
            for one in fitted.predict(data.x[out])
        ]
        totals = totals + len(out) * np.array(scores)
    equal = np.flatnonzero(totals == np.max(totals))
    # the middle one: the ends of a plateau are fragile
    place = int(equal[len(equal) // 2])
    return Selection(
        place, fitted.options[place], chosen_on, totals, fitted if len(parts) == 1 else None
    )


def check_rows(
    features: Array,
    labels: Any,
    groups: Any,
    split: Any,
    *,
    measured: bool = False,
    tested: bool = True,
) -> tuple[LabelledFeatures, Split, tuple[str, ...]]:
    """Return the arguments of a probe as records, with notes on the rows.

    Raises UserError if they do not fit.
    """
    x = np.asarray(features, np.float32)
    groups = np.asarray(groups).astype(str)
    split = np.asarray(split).astype(str)
    sizes = {"features": len(x), "labels": len(labels), "groups": len(groups), "split": len(split)}
    if x.ndim != 2 or len(set(sizes.values())) != 1:
        raise UserError(
            f"A probe needs features (n, d) and n labels, groups and splits, not {x.shape} and "
            f"{sizes}."
        )
    y, names, has_label = _parse_labels(labels, measured)
    rows = Split(
        *(np.flatnonzero((split == part) & has_label) for part in ("train", "val", "test"))
    )
    for part, ids in (("train", rows.fit), ("test", rows.test))[: 1 + tested]:
        if not len(ids):
            raise UserError(
                f"No row of split {part!r} has this label. Choose another label or another "
                "manifest."
            )
    used = np.sort(np.concatenate(rows))
    without = used[np.isin(groups[used], ["", "None", "nan"])]
    if len(without):
        raise UserError(
            f"Rows {_listed(without)} have no group. Give at least their recording (`sequence`)."
        )
    bad = used[~np.isfinite(x[used]).all(axis=1)]
    if len(bad):
        raise UserError(
            f"The features of rows {_listed(bad)} are NaN or infinite. Embed them again or leave "
            "them out."
        )
    learned = np.unique(y[rows.fit])
    if len(learned) < 2:
        value = f"{learned[0]:g}" if measured else repr(str(names[learned[0]]))
        raise UserError(
            f"The label is {value} on every row of train. A probe needs at least two values."
        )
    if measured and np.ptp(y[rows.test]) == 0:
        raise UserError(
            f"The label is {y[rows.test][0]:g} on every row of test. R2 has no meaning there."
        )
    if tested and not measured and not np.isin(y[rows.test], learned).any():
        raise UserError(
            "No class of test is in train. Take another label, or let `anytouch probe tasks` split "
            "again."
        )
    unlabelled = int(np.sum(np.isin(split, ("train", "val", "test")) & ~has_label))
    notes = [f"{unlabelled} rows without this label left out"] if unlabelled else []
    for part, ids in (("val", rows.val), ("test", rows.test)):
        shared = np.intersect1d(groups[rows.fit], groups[ids])
        if len(shared):
            notes.append(
                f"{len(shared)} groups lie in both train and {part}: these are not independent"
            )
    notes += [] if measured else unlearned_note(y[rows.test], learned, names)
    return LabelledFeatures(x, y, names, groups), rows, tuple(notes)


def unlearned_note(tested: Array, learned: Array, names: Array) -> list[str]:
    """Return a note on test rows of classes that no row of train has, or nothing."""
    unknown = tested[~np.isin(tested, learned)]
    listed = _listed(names[np.unique(unknown)])
    if len(unknown):
        return [f"{len(unknown)} test rows of classes that train lacks count as errors: {listed}"]
    return []


def _parse_labels(labels: Any, measured: bool) -> tuple[Array, Array, Array]:
    """Return class numbers (-1: no label) or floats, the sorted class names, and which rows have a
    label.
    """
    values = np.asarray(labels, object)
    if measured:
        try:
            y = np.array(
                [np.nan if value in (None, "") else float(value) for value in values], np.float64
            )
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
    return ", ".join(map(str, items[:10])) + (
        f" and {len(items) - 10} more" if len(items) > 10 else ""
    )
