"""What every probe does before a fit: check the rows, cut folds by group, choose a penalty."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.choices import FOLDS, best_of, dealt, thinned
from anytouch_jax.evaluate.statistics import Protocol

Array = npt.NDArray[Any]
Scores = Callable[[Array, Array, Sequence[float]], list[float]]  # (fit rows, scored rows, options) -> higher is better


@dataclass(frozen=True)
class Rows:
    """Checked input: `y` class numbers into `names` (-1: no label) or floats; `train`, `val`, `test` row numbers."""

    x: Array
    y: Array
    names: Array
    groups: Array
    train: Array
    val: Array
    test: Array
    notes: tuple[str, ...]


def prepare(
    features: Array,
    labels: Any,
    groups: Any,
    split: Any,
    *,
    measured: bool = False,
    tested: bool = True,
    least_classes: int = 2,
) -> Rows:
    """The arguments of a probe as `Rows`; `measured`: float labels; `tested`: there must be test rows.

    Raises UserError on lengths that differ, an empty train or test, NaN features, labels that never change, or classes
    of which train and test share none.
    """
    x, groups, split = np.asarray(features, np.float32), np.asarray(groups).astype(str), np.asarray(split).astype(str)
    sizes = {"features": len(x), "labels": len(labels), "groups": len(groups), "split": len(split)}
    if x.ndim != 2 or len(set(sizes.values())) != 1:
        raise UserError(f"a probe needs (n, d) features and n labels, groups and splits, not {x.shape} and {sizes}")
    y, has, names = _numbers(labels) if measured else _classes(labels)
    rows = {part: np.flatnonzero((split == part) & has) for part in ("train", "val", "test")}
    for part in ("train", "test")[: 1 + tested]:
        if not len(rows[part]):
            raise UserError(f"no row of split {part!r} has this label; choose another label or another manifest")
    used = np.concatenate(list(rows.values()))
    loose = np.sort(used[np.isin(groups[used], ["", "None", "nan"])])
    if len(loose):
        raise UserError(f"rows {_listed(loose)} name no group; a recording (`sequence`) is the least there is")
    bad = np.sort(used[~np.isfinite(x[used]).all(axis=1)])
    if len(bad):
        raise UserError(f"the features of rows {_listed(bad)} hold NaN or infinity; embed them again or leave them out")
    seen = np.unique(y[rows["train"]])
    if len(seen) < least_classes:
        what = (
            f"the label is {seen[0]:g} on every row"
            if measured
            else f"the label has one class only, {str(names[seen[0]])!r},"
        )
        raise UserError(f"{what} of train; a probe needs at least two values")
    if measured and np.ptp(y[rows["test"]]) == 0:
        raise UserError(f"the label is {y[rows['test']][0]:g} on every row of test; R2 has no meaning there")
    if tested and not measured and not np.isin(y[rows["test"]], seen).any():
        raise UserError(
            "no class of test is in train: whole ones are held out there; take another label, or a task of --tasks, "
            "which deals the recordings anew"
        )
    notes = _remarks(rows, y, names, groups, split, has, measured)
    return Rows(x, y, names, groups, rows["train"], rows["val"], rows["test"], notes)


def _remarks(
    rows: dict[str, Array], y: Array, names: Array, groups: Array, split: Array, has: Array, measured: bool
) -> tuple[str, ...]:
    """What a reader of the numbers must know about the rows."""
    notes = []
    bare = int(np.sum(np.isin(split, list(rows)) & ~has))
    if bare:
        notes.append(f"{bare} rows without this label left out")
    for part in ("val", "test"):
        shared = np.intersect1d(groups[rows["train"]], groups[rows[part]])
        if len(shared):
            notes.append(f"{len(shared)} groups lie in both train and {part}: these are not independent")
    if not measured:
        strange = np.setdiff1d(y[rows["test"]], y[rows["train"]])
        if len(strange):
            count = int(np.isin(y[rows["test"]], strange).sum())
            notes.append(f"{count} test rows of classes that train lacks count as errors: {_listed(names[strange])}")
    return tuple(notes)


def _listed(items: Array) -> str:
    return ", ".join(map(str, items[:10])) + (f" and {len(items) - 10} more" if len(items) > 10 else "")


def _classes(labels: Any) -> tuple[Array, Array, Array]:
    """Class numbers (-1: none), whether a label is there, and the names in sorted order."""
    texts = np.array(["" if one is None else _text(one) for one in np.asarray(labels, object)], dtype=str)
    has = texts != ""
    names, numbers = np.unique(texts[has], return_inverse=True)
    y = np.full(len(texts), -1)
    y[has] = numbers
    return y, has, names


def _text(value: Any) -> str:
    if isinstance(value, float | np.floating):
        if np.isnan(value):
            return ""
        if not np.isfinite(value) or value != int(value):
            raise UserError(f"the label holds {value:g}, a measured quantity and no class; --tasks force measures one")
        return str(int(value))
    return str(value)


def _numbers(labels: Any) -> tuple[Array, Array, Array]:
    try:
        y = np.array([np.nan if one in (None, "") else float(one) for one in np.asarray(labels, object)], np.float64)
    except ValueError as error:
        raise UserError(f"the label is not a number ({error}); use the linear probe for classes") from None
    return y, np.isfinite(y), np.array([], str)


def choose(
    rows: Rows, options: Sequence[float], scores: Scores, protocol: Protocol, *, edges: bool = True
) -> tuple[float, str, tuple[str, ...]]:
    """The best of `options` (the middle one of equals), what it was chosen on, and notes on the choice."""
    if len(options) == 1:
        return options[0], "given", ()
    if protocol == "published":
        values, how = scores(rows.train, rows.test, options), "test"
    elif protocol == "honest":
        fit = thinned(rows.train)
        if len(rows.val):
            values, how = scores(fit, rows.val, options), "val"
        else:
            pairs = list(folded(rows, fit, FOLDS))
            table = [[len(out) * value for value in scores(inner, out, options)] for inner, out in pairs]
            values, how = list(np.sum(table, axis=0)), "cross-validation"
    else:
        raise UserError(f"unknown protocol {protocol!r}; choose honest or published")
    best = best_of(values)
    notes: tuple[str, ...] = ()
    if how == "test":
        notes += ("chosen on test, as the authors' code does: an upper estimate",)
    alone = np.count_nonzero(np.asarray(values) == np.max(values)) == 1
    if edges and alone and best in (0, len(options) - 1):
        notes += (f"the chosen penalty {options[best]:g} lies at the edge of those tried",)
    return options[best], how, notes


def folded(rows: Rows, used: Array, count: int) -> Iterator[tuple[Array, Array]]:
    """(rows to fit, rows left out) with whole groups on one side and each class spread over the folds."""
    fold = dealt(rows.groups[used], rows.y[used], np.random.default_rng(0), count)
    for number in range(int(fold.max()) + 1):
        out = fold == number
        yield used[~out], used[out]


def bootstraps(rows: Rows, seeds: int) -> Iterator[tuple[Array, Array]]:
    """For each seed the train rows of a bootstrap over groups, and how often each was drawn."""
    for seed in range(seeds):
        names, ids = np.unique(rows.groups[rows.train], return_inverse=True)
        times = np.random.default_rng(seed).multinomial(len(names), np.full(len(names), 1 / len(names)))
        weights = times[ids].astype(np.float32)
        yield rows.train[weights > 0], weights[weights > 0]
