"""Linear probes, nearest-neighbour probes and regression probes of feature arrays.

They take `features` (n, d); `labels` (n,), where None, "" or NaN is no label; `groups` (n,), recordings or objects that
no fold or bootstrap cuts; and `split` (n,), "train", "val" or "test" for the rows that take part.

Two protocols, always named in the result. honest: the penalty (k, epoch) is selected on val, or by cross-validation
over groups of train, and test is read once. published: it is selected on test, as the authors' released code does.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import heads, splits, statistics
from anytouch_jax.evaluate.heads import FittedHead, ProbeHead, Scaling
from anytouch_jax.evaluate.probe_results import Outcome, ProbeResult, RegressionResult, subset_results
from anytouch_jax.evaluate.splits import Split
from anytouch_jax.evaluate.statistics import Protocol
from anytouch_jax.evaluate.tasks import label_text

Array = npt.NDArray[Any]
Subsets = Mapping[str, Array]


class LabelledFeatures(NamedTuple):
    """Features `x` (n, d), class numbers or floats `y` (n,), class `names` (empty: y are floats), `groups` (n,)."""

    x: Array
    y: Array
    names: Array
    groups: Array


class Selection(NamedTuple):
    """The selected option of a head and its place, the rows it was chosen on, and the scores and the fit of all."""

    place: int
    option: float
    chosen_on: str
    scores: Sequence[float] = ()
    fitted: FittedHead | None = None


def select_option(head: ProbeHead, data: LabelledFeatures, split: Split, protocol: Protocol) -> Selection:
    """Fit all options of a head on at most SELECT_ROWS rows of `split.fit` and select the best by the protocol."""
    splits.check_protocol(protocol)
    classes = len(data.names)
    if head.options is not None and len(head.options) == 1:
        return Selection(0, head.options[0], "given")
    # An epoch is not selected on fewer rows, as its number of steps would change.
    fit = split.fit if head.name == "gradient" else splits.subsample(split.fit)

    def scores(fitted: FittedHead, rows: Array) -> list[float]:
        return [heads.head_score(predicted, data.y[rows], classes) for predicted in fitted.predict(data.x[rows])]

    if protocol == "published" or len(split.val):
        chosen_on, rows = ("test", split.test) if protocol == "published" else ("val", split.val)
        fitted = heads.fit_head(head, data.x[fit], data.y[fit], classes)
        values = scores(fitted, rows)
        index = splits.best_option(values)
        return Selection(index, fitted.options[index], chosen_on, values, fitted)
    totals: Any = 0
    for inner, out in splits.group_folds(fit, data.groups, data.y if classes else None, splits.FOLDS):
        fitted = heads.fit_head(head, data.x[inner], data.y[inner], classes)
        totals = totals + len(out) * np.array(scores(fitted, out))
    index = splits.best_option(totals)
    return Selection(index, fitted.options[index], "cross-validation", totals)


def linear_probe(
    features: Array, labels: Any, groups: Any, split: Any, *, protocol: Protocol = "honest",
    penalties: Sequence[float] = heads.PENALTIES, seeds: int = 5, scaling: Scaling = "column",
    subsets: Subsets | None = None, name: str = "linear",
) -> ProbeResult:  # fmt: skip
    """Probe with multinomial logistic regression on features standardised by train.

    A penalty is the factor of half the squared weights, next to the mean log loss. `seeds` bootstraps of the train
    groups are fitted too. `scaling`: "common" for principal components. `subsets` (name -> mask over all rows) report
    parts of test. Raises UserError for features that are not finite, labels of one class, or an empty train or test.
    """
    head = ProbeHead("linear", scaling, _strongest_first(penalties))
    return _probe_classes(head, (features, labels, groups, split), protocol, seeds, subsets, name)


def knn_probe(
    features: Array, labels: Any, groups: Any, split: Any, *, protocol: Protocol = "honest",
    neighbours: Sequence[int] = heads.NEIGHBOURS, seeds: int = 5, subsets: Subsets | None = None, name: str = "kNN",
) -> ProbeResult:  # fmt: skip
    """Probe with a vote of the k nearest rows of train by cosine. Parameters and errors are those of `linear_probe`."""
    head = ProbeHead("knn", options=_strongest_first(neighbours))
    return _probe_classes(head, (features, labels, groups, split), protocol, seeds, subsets, name)


def _probe_classes(
    head: ProbeHead, arrays: tuple[Any, ...], protocol: Protocol, seeds: int, subsets: Subsets | None, name: str
) -> ProbeResult:
    data, rows, notes = check_rows(*arrays)
    selected = select_option(head, data, rows, protocol)
    notes += _selection_notes(selected, head)
    head = dataclasses.replace(head, options=(selected.option,))
    truth, tested = data.y[rows.test], data.x[rows.test]

    def fit(ids: Array, weights: Array | None = None, start: Any = None) -> FittedHead:
        return heads.fit_head(head, data.x[ids], data.y[ids], len(data.names), weights=weights, start=start)

    best = fit(rows.fit)
    model = best.models[0] if best.models else None
    correct, refits = best.predict(tested)[0] == truth, []
    for ids, weights in splits.group_bootstraps(rows.fit, data.groups, seeds):
        refits.append(float(np.mean(fit(ids, weights, model).predict(tested)[0] == truth)))
    if model is not None and not model.finished:
        notes += ("the fit stopped at its limit of iterations",)
    result = _probe_result(name, protocol, data, rows, correct, selected, notes, subsets, refits)
    outcome = Outcome(rows.test, correct, data.groups[rows.test], (model, data.names))
    return dataclasses.replace(result, outcome=outcome)


def majority_baseline(labels: Any, groups: Any, split: Any, *, subsets: Subsets | None = None) -> ProbeResult:
    """Score the most frequent class of train on test."""
    data, rows, _ = check_rows(np.zeros((len(labels), 1), np.float32), labels, groups, split, least_classes=1)
    correct = data.y[rows.test] == heads.majority_class(data.y[rows.fit])
    return _probe_result("commonest class", "honest", data, rows, correct, None, (), subsets)


def leave_groups_out(
    features: Array, labels: Any, groups: Any, *, folds: int | None = 10,
    penalties: Sequence[float] = (10.0, *heads.PENALTIES), scaling: Scaling = "column", subsets: Subsets | None = None,
    name: str = "linear, groups left out",
) -> ProbeResult:  # fmt: skip
    """Probe each row with a linear fit on no row of its group, for instance on held-out objects.

    The groups are assigned to `folds` folds (None: each group alone). The penalty is selected by folds over the other
    groups. `baseline` is the most frequent class of the same other rows. Every labelled row is tested.
    """
    data, rows, notes = check_rows(features, labels, groups, np.full(len(labels), "train"), tested=False)
    used, y, chosen = rows.fit, data.y, []
    predicted, baseline = np.full(len(y), -1), np.full(len(y), -1)
    head = ProbeHead("linear", scaling, _strongest_first(penalties))
    count = len(np.unique(data.groups[used])) if folds is None else folds
    for fit, out in splits.group_folds(used, data.groups, y, count):
        penalty = select_option(head, data, Split(fit, fit[:0], out), "honest").option
        chosen.append(penalty)
        (model,) = heads.linear_path(data.x[fit], y[fit], [penalty], scaling=scaling)
        predicted[out], baseline[out] = model(data.x[out]), heads.majority_class(y[fit])
    values, times = np.unique(chosen, return_counts=True)
    counts = ", ".join(f"{value:g} ({count} x)" for value, count in zip(values, times, strict=True))
    selected = Selection(0, float(np.median(chosen)), "cross-validation, median of the folds")
    notes += (f"penalties of the folds: {counts}",)
    everything, correct = Split(used, used[:0], used), (predicted == y)[used]
    result = _probe_result(name, "honest", data, everything, correct, selected, notes, subsets)
    return dataclasses.replace(result, baseline=float(np.mean(baseline[used] == y[used])))


def regression_probe(
    features: Array, labels: Any, groups: Any, split: Any, *, protocol: Protocol = "honest",
    penalties: Sequence[float] = heads.RIDGE, name: str = "ridge",
) -> RegressionResult:  # fmt: skip
    """Probe with ridge regression of a measured label (floats) on features standardised by train.

    A penalty is added to the mean squared error. Raises UserError as `linear_probe`, and for a constant label.
    """
    data, rows, notes = check_rows(features, labels, groups, split, measured=True)
    head = ProbeHead("linear", options=_strongest_first(penalties))
    selected = select_option(head, data, rows, protocol)
    (predicted,) = heads.fit_ridge(data.x[rows.fit], data.y[rows.fit], [selected.option])(data.x[rows.test])
    truth, tested_groups = data.y[rows.test], data.groups[rows.test]
    error = predicted - truth
    low, high = statistics.r2_interval(error, truth, tested_groups)
    mae_low, mae_high = statistics.mean_interval(np.abs(error), tested_groups)
    return RegressionResult(
        probe=name,
        protocol=protocol,
        r2=1 - float(np.sum(error**2) / np.sum((truth - truth.mean()) ** 2)),
        low=low,
        high=high,
        mae=float(np.abs(error).mean()),
        mae_low=mae_low,
        mae_high=mae_high,
        baseline_mae=float(np.abs(data.y[rows.fit].mean() - truth).mean()),
        penalty=selected.option,
        chosen_on=selected.chosen_on,
        n_train=len(rows.fit),
        n_test=len(rows.test),
        test_groups=len(np.unique(tested_groups)),
        notes=notes + _selection_notes(selected, head),
    )


def _strongest_first(options: Sequence[float]) -> tuple[float, ...]:
    """Return the options in falling order: a strong penalty is a good start for the next weaker one."""
    if not options or min(options) <= 0:
        raise UserError(f"Penalties and numbers of neighbours must be above 0, at least one, not {list(options)}.")
    return tuple(sorted(set(options), reverse=True))


def _selection_notes(selected: Selection, head: ProbeHead) -> tuple[str, ...]:
    notes: tuple[str, ...] = ()
    if selected.chosen_on == "test":
        notes += ("chosen on test, as the authors' code does: an upper estimate",)
    alone = len(selected.scores) and np.count_nonzero(np.asarray(selected.scores) == np.max(selected.scores)) == 1
    if alone and head.name != "knn" and selected.place in (0, len(selected.scores) - 1):
        notes += (f"the chosen penalty {selected.option:g} lies at the edge of those tried",)
    return notes


def _probe_result(
    name: str, protocol: Protocol, data: LabelledFeatures, rows: Split, correct: Array, selected: Selection | None,
    notes: tuple[str, ...], subsets: Subsets | None, refits: Sequence[float] = (),
) -> ProbeResult:  # fmt: skip
    y, groups = data.y[rows.test], data.groups[rows.test]
    low, high = statistics.mean_interval(correct, groups)
    return ProbeResult(
        probe=name,
        protocol=protocol,
        accuracy=float(correct.mean()),
        balanced_accuracy=float(np.mean([correct[y == number].mean() for number in np.unique(y)])),
        low=low,
        high=high,
        baseline=float(np.mean(y == heads.majority_class(data.y[rows.fit]))),
        refit_mean=float(np.mean(refits)) if len(refits) else None,
        refit_std=float(np.std(refits, ddof=1)) if len(refits) > 1 else None,
        seeds=len(refits),
        penalty=selected.option if selected else None,
        chosen_on=selected.chosen_on if selected else "",
        n_train=len(rows.fit),
        n_test=len(rows.test),
        test_groups=len(np.unique(groups)),
        classes=tuple(map(str, data.names[np.unique(data.y[rows.fit])])),
        parts=subset_results(correct, groups, subsets or {}, rows.test),
        notes=notes if low is not None else (*notes, "test has one group only: no interval"),
        outcome=Outcome(rows.test, correct, groups),
    )


def check_rows(
    features: Array, labels: Any, groups: Any, split: Any, *, measured: bool = False, tested: bool = True,
    least_classes: int = 2,
) -> tuple[LabelledFeatures, Split, tuple[str, ...]]:  # fmt: skip
    """Return the arguments of a probe as records, with notes on the rows.

    Raises UserError for lengths that differ, an empty train or test, features that are not finite, labels that never
    change, or classes of which train and test share none.
    """
    x, groups, split = np.asarray(features, np.float32), np.asarray(groups).astype(str), np.asarray(split).astype(str)
    sizes = {"features": len(x), "labels": len(labels), "groups": len(groups), "split": len(split)}
    if x.ndim != 2 or len(set(sizes.values())) != 1:
        raise UserError(f"A probe needs features (n, d) and n labels, groups and splits, not {x.shape} and {sizes}.")
    y, names, has_label = _measured_labels(labels) if measured else _class_labels(labels)
    rows = Split(*(np.flatnonzero((split == part) & has_label) for part in ("train", "val", "test")))
    for part, ids in (("train", rows.fit), ("test", rows.test))[: 1 + tested]:
        if not len(ids):
            raise UserError(f"No row of split {part!r} has this label. Choose another label or another manifest.")
    used = np.sort(np.concatenate(rows))
    without = used[np.isin(groups[used], ["", "None", "nan"])]
    if len(without):
        raise UserError(f"Rows {_listed(without)} have no group. Give at least their recording (`sequence`).")
    bad = used[~np.isfinite(x[used]).all(axis=1)]
    if len(bad):
        raise UserError(f"The features of rows {_listed(bad)} are NaN or infinite. Embed them again or leave them out.")
    learned = np.unique(y[rows.fit])
    if len(learned) < least_classes:
        value = f"{learned[0]:g}" if measured else repr(str(names[learned[0]]))
        raise UserError(f"The label is {value} on every row of train. A probe needs at least two values.")
    if measured and np.ptp(y[rows.test]) == 0:
        raise UserError(f"The label is {y[rows.test][0]:g} on every row of test. R2 has no meaning there.")
    if tested and not measured and not np.isin(y[rows.test], learned).any():
        raise UserError(
            "No class of test is in train. Choose another label, or `anytouch probe tasks`, which splits again."
        )
    unlabelled = int(np.sum(np.isin(split, ("train", "val", "test")) & ~has_label))
    notes = [f"{unlabelled} rows without this label left out"] if unlabelled else []
    for part, ids in (("val", rows.val), ("test", rows.test)):
        shared = np.intersect1d(groups[rows.fit], groups[ids])
        if len(shared):
            notes.append(f"{len(shared)} groups lie in both train and {part}: these are not independent")
    notes += [] if measured else unlearned_note(y[rows.test], learned, names)
    return LabelledFeatures(x, y, names, groups), rows, tuple(notes)


def unlearned_note(tested: Array, learned: Array, names: Array) -> list[str]:
    """Return a note on test rows of classes that no row of train has, or nothing."""
    unknown = tested[~np.isin(tested, learned)]
    listed = _listed(names[np.unique(unknown)])
    return [f"{len(unknown)} test rows of classes that train lacks count as errors: {listed}"] if len(unknown) else []


def _class_labels(labels: Any) -> tuple[Array, Array, Array]:
    """Return class numbers (-1: no label), the sorted names, and which rows have a label."""
    texts = np.array([label_text(value) for value in np.asarray(labels, object)], dtype=str)
    has_label, y = texts != "", np.full(len(texts), -1)
    names, y[has_label] = np.unique(texts[has_label], return_inverse=True)
    return y, names, has_label


def _measured_labels(labels: Any) -> tuple[Array, Array, Array]:
    try:
        y = np.array([np.nan if v in (None, "") else float(v) for v in np.asarray(labels, object)], np.float64)
    except ValueError as error:
        raise UserError(f"The label is not a number ({error}). Use the linear probe for classes.") from None
    return y, np.array([], str), np.isfinite(y)


def _listed(items: Array) -> str:
    return ", ".join(map(str, items[:10])) + (f" and {len(items) - 10} more" if len(items) > 10 else "")
