"""Linear, nearest-neighbour and regression probes of feature arrays, their results and tables.

They take `features` (n, d); `labels` (n,), where None, "" or NaN is no label; `groups` (n,), recordings or objects that
no fold or bootstrap cuts; and `split` (n,), "train", "val" or "test" for the rows that take part.

Two protocols, always named in the result. honest: the penalty (k, epoch) is selected on val, or by cross-validation
over groups of train, and test is read once. published: it is selected on test, as the authors' released code does.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import heads, splits, statistics
from anytouch_jax.evaluate.heads import FittedHead, ProbeHead, Scaling
from anytouch_jax.evaluate.splits import Split
from anytouch_jax.evaluate.statistics import Protocol
from anytouch_jax.evaluate.tasks import label_text

Array = npt.NDArray[Any]
Subsets = Mapping[str, Array]
Notes = tuple[str, ...]

NAN = float("nan")
OF_CLASSES = ("accuracy", "balanced_accuracy", "baseline", "refit_mean", "refit_std", "seeds", "classes", "parts")
OF_NUMBERS = ("r2", "mae", "mae_low", "mae_high", "baseline_mae")


@dataclass(frozen=True)
class SubsetResult:
    """Accuracy on a named part of the test rows; `low`, `high` as in `ProbeResult`."""

    name: str
    accuracy: float
    low: float | None
    high: float | None
    n_test: int


@dataclass(frozen=True, eq=False)
class Outcome:
    """The test rows, whether each was right, and its group; `fitted`: the linear model and the names of its classes."""

    rows: Array
    correct: Array
    groups: Array
    fitted: tuple[Any, Array] | None = None


@dataclass(frozen=True)
class ProbeResult:
    """The score of a head fitted on all of train, on the test rows. Shares are in 0..1.

    `low`, `high`: 95 % interval of the accuracy or R2 under a bootstrap over the test groups, None with fewer than two.
    `penalty` (k, epoch) was selected on `chosen_on`. If that is test, the score is an upper estimate.

    Of classes: a test row of a class that train lacks counts as an error. `baseline` is the accuracy of the most
    frequent class of train. `refit_mean`, `refit_std`: accuracy of `seeds` heads fitted on bootstraps of the train
    groups. Each has some 63 % of the groups, so the mean is a little below `accuracy`.

    Of numbers: `r2` and the mean absolute error `mae` in units of the label. `baseline_mae` is that of train's mean.
    """

    probe: str
    protocol: Protocol
    low: float | None
    high: float | None
    penalty: float | None
    chosen_on: str
    n_train: int
    n_test: int
    test_groups: int
    accuracy: float = NAN
    balanced_accuracy: float = NAN
    baseline: float = NAN
    refit_mean: float | None = None
    refit_std: float | None = None
    seeds: int = 0
    classes: tuple[str, ...] = ()
    parts: tuple[SubsetResult, ...] = ()
    r2: float = NAN
    mae: float = NAN
    mae_low: float | None = None
    mae_high: float | None = None
    baseline_mae: float = NAN
    notes: Notes = ()
    outcome: Outcome | None = field(default=None, repr=False, compare=False)

    @property
    def measured(self) -> bool:
        """Whether the label is a number."""
        return not np.isnan(self.r2)


class LabelledFeatures(NamedTuple):
    """Features `x` (n, d), class numbers or floats `y` (n,), class `names` (empty: y are floats), `groups` (n,)."""

    x: Array
    y: Array
    names: Array
    groups: Array

    def fit(self, head: ProbeHead, ids: Array, **options: Any) -> FittedHead:
        """Fit a head on some rows; `options` are those of `fit_head`."""
        return heads.fit_head(head, self.x[ids], self.y[ids], len(self.names), **options)


class Selection(NamedTuple):
    """The selected option of a head and its place, the rows it was chosen on, and the scores and the fit of all."""

    place: int
    option: float
    chosen_on: str
    scores: Sequence[float] | Array = ()
    fitted: FittedHead | None = None


def select_option(head: ProbeHead, data: LabelledFeatures, split: Split, protocol: Protocol) -> Selection:
    """Fit all options of a head on at most SELECT_ROWS rows of `split.fit` and select the best by the protocol."""
    splits.check_protocol(protocol)
    if head.options is not None and len(head.options) == 1:
        return Selection(0, head.options[0], "given")
    # An epoch is not selected on fewer rows, as its number of steps would change.
    fit = split.fit if head.name == "gradient" else splits.subsample(split.fit)

    def scores(fitted: FittedHead, rows: Array) -> Array:
        predictions = fitted.predict(data.x[rows])
        return np.array([heads.head_score(predicted, data.y[rows], len(data.names)) for predicted in predictions])

    if protocol == "published" or len(split.val):
        chosen_on, rows = ("test", split.test) if protocol == "published" else ("val", split.val)
        fitted = data.fit(head, fit)
        values = scores(fitted, rows)
        index = splits.best_option(values)
        return Selection(index, fitted.options[index], chosen_on, values, fitted)
    totals: Any = 0
    for inner, out in splits.group_folds(fit, data.groups, data.y if len(data.names) else None, splits.FOLDS):
        fitted = data.fit(head, inner)
        totals = totals + len(out) * scores(fitted, out)
    index = splits.best_option(totals)
    return Selection(index, fitted.options[index], "cross-validation", totals)


def probe_features(
    features: Array, labels: Any, groups: Any, split: Any, head: ProbeHead | None = None, *, measured: bool = False,
    protocol: Protocol = "honest", seeds: int = 5, subsets: Subsets | None = None, name: str = "linear",
) -> ProbeResult:  # fmt: skip
    """Probe with a head (default: linear) that is selected and fitted on train, and tested on test.

    `measured`: labels are numbers. `seeds` heads of classes are fitted on bootstraps of the train groups too. `subsets`
    (name -> mask over all rows) report parts of test. Raises UserError as `check_rows`.
    """
    data, rows, notes = check_rows(features, labels, groups, split, measured=measured)
    head = head or ProbeHead()
    selected = select_option(head, data, rows, protocol)
    if selected.chosen_on == "test":
        notes += ("chosen on test, as the authors' code does: an upper estimate",)
    scores = np.asarray(selected.scores)
    at_edge = len(scores) and selected.place in (0, len(scores) - 1) and np.sum(scores == scores.max()) == 1
    if at_edge and head.name == "linear":
        notes += (f"the chosen penalty {selected.option:g} lies at the edge of those tried",)
    head = replace(head, options=(selected.option,))
    best = data.fit(head, rows.fit)
    model = best.models[0] if best.models else None
    refits = []
    for ids, weights in splits.group_bootstraps(rows.fit, data.groups, 0 if measured else seeds):
        (predicted,) = data.fit(head, ids, weights=weights, start=model).predict(data.x[rows.test])
        refits.append(float(np.mean(predicted == data.y[rows.test])))
    if model is not None and not model.finished:
        notes += ("the fit stopped at its limit of iterations",)
    (predicted,) = best.predict(data.x[rows.test])
    result = _result(name, protocol, data, rows, predicted, selected, notes, subsets)
    if refits:
        spread = float(np.std(refits, ddof=1)) if len(refits) > 1 else None
        result = replace(result, refit_mean=float(np.mean(refits)), refit_std=spread, seeds=len(refits))
    return replace(result, outcome=result.outcome and replace(result.outcome, fitted=(model, data.names)))


def majority_baseline(labels: Any, groups: Any, split: Any, *, subsets: Subsets | None = None) -> ProbeResult:
    """Score the most frequent class of train on test."""
    data, rows, _ = check_rows(np.zeros((len(labels), 1), np.float32), labels, groups, split, least_classes=1)
    predicted = np.full(len(rows.test), heads.majority_class(data.y[rows.fit]))
    return _result("commonest class", "honest", data, rows, predicted, None, (), subsets)


def leave_groups_out(
    features: Array, labels: Any, groups: Any, *, folds: int | None = 10,
    penalties: Sequence[float] = (10.0, *heads.PENALTIES), scaling: Scaling = "column",
    subsets: Subsets | None = None, name: str = "linear, groups left out",
) -> ProbeResult:  # fmt: skip
    """Probe each row with a linear fit on no row of its group, for instance on held-out objects.

    The groups are assigned to `folds` folds (None: each group alone). The penalty is selected by folds over the other
    groups. `baseline` is the most frequent class of the same other rows. Every labelled row is tested.
    """
    data, rows, notes = check_rows(features, labels, groups, np.full(len(labels), "train"), tested=False)
    used, y, chosen = rows.fit, data.y, []
    predicted, baseline = np.full(len(y), -1), np.full(len(y), -1)
    head = ProbeHead("linear", scaling, tuple(penalties))
    count = len(np.unique(data.groups[used])) if folds is None else folds
    for fit, out in splits.group_folds(used, data.groups, y, count):
        chosen.append(select_option(head, data, Split(fit, fit[:0], out), "honest").option)
        (predicted[out],) = data.fit(replace(head, options=(chosen[-1],)), fit).predict(data.x[out])
        baseline[out] = heads.majority_class(y[fit])
    values, times = np.unique(chosen, return_counts=True)
    counts = ", ".join(f"{value:g} ({count} x)" for value, count in zip(values, times, strict=True))
    selected = Selection(0, float(np.median(chosen)), "cross-validation, median of the folds")
    notes += (f"penalties of the folds: {counts}",)
    result = _result(name, "honest", data, Split(used, used[:0], used), predicted[used], selected, notes, subsets)
    return replace(result, baseline=float(np.mean(baseline[used] == y[used])))


def _result(
    name: str, protocol: Protocol, data: LabelledFeatures, rows: Split, predicted: Array, selected: Selection | None,
    notes: Notes, subsets: Subsets | None,
) -> ProbeResult:  # fmt: skip
    """Return the scores of predictions for the test rows."""
    y, truth, groups = data.y[rows.fit], data.y[rows.test], data.groups[rows.test]
    scores: dict[str, Any]
    if not len(data.names):
        error = predicted - truth
        low, high = statistics.r2_interval(error, truth, groups)
        mae_low, mae_high = statistics.mean_interval(np.abs(error), groups)
        scores = {
            "r2": 1 - float(np.sum(error**2) / np.sum((truth - truth.mean()) ** 2)), "mae": float(np.abs(error).mean()),
            "mae_low": mae_low, "mae_high": mae_high, "baseline_mae": float(np.abs(y.mean() - truth).mean()),
        }  # fmt: skip
    else:
        correct, parts = predicted == truth, []
        low, high = statistics.mean_interval(correct, groups)
        for part, mask in (subsets or {}).items():
            chosen = np.asarray(mask, bool)[rows.test]
            interval = statistics.mean_interval(correct[chosen], groups[chosen])
            accuracy = float(correct[chosen].mean()) if chosen.any() else NAN
            parts.append(SubsetResult(part, accuracy, *interval, int(chosen.sum())))
        scores = {
            "accuracy": float(correct.mean()), "baseline": float(np.mean(truth == heads.majority_class(y))),
            "balanced_accuracy": float(np.mean([correct[truth == number].mean() for number in np.unique(truth)])),
            "classes": tuple(map(str, data.names[np.unique(y)])), "parts": tuple(parts),
            "outcome": Outcome(rows.test, correct, groups),
        }  # fmt: skip
        notes = notes if low is not None else (*notes, "test has one group only: no interval")
    option, chosen_on = (selected.option, selected.chosen_on) if selected else (None, "")
    sizes = (len(rows.fit), len(rows.test), len(np.unique(groups)))
    return ProbeResult(name, protocol, low, high, option, chosen_on, *sizes, **scores, notes=notes)


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
    y, names, has_label = _parse_labels(labels, measured)
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


def _parse_labels(labels: Any, measured: bool) -> tuple[Array, Array, Array]:
    """Return class numbers (-1: no label) or floats, the sorted class names, and which rows have a label."""
    values = np.asarray(labels, object)
    if measured:
        try:
            y = np.array([np.nan if value in (None, "") else float(value) for value in values], np.float64)
        except ValueError as error:
            raise UserError(f"The label is not a number ({error}). Use the linear probe for classes.") from None
        return y, np.array([], str), np.isfinite(y)
    texts = np.array([label_text(value) for value in values], dtype=str)
    has_label, y = texts != "", np.full(len(texts), -1)
    names, y[has_label] = np.unique(texts[has_label], return_inverse=True)
    return y, names, has_label


def _listed(items: Array) -> str:
    return ", ".join(map(str, items[:10])) + (f" and {len(items) - 10} more" if len(items) > 10 else "")


def accuracy_difference(first: ProbeResult, second: ProbeResult) -> tuple[float, float | None, float | None]:
    """Return the accuracy of `first` minus that of `second` with its 95 % interval over groups, paired by test row.

    Two encoders err on the same hard recordings, so this is narrower than two separate intervals. Raises UserError if
    the two were not tested on the same rows.
    """
    a, b = first.outcome, second.outcome
    if a is None or b is None or not np.array_equal(a.rows, b.rows) or not np.array_equal(a.groups, b.groups):
        raise UserError(
            f"{first.probe!r} and {second.probe!r} were not tested on the same rows. Give both the same table."
        )
    change = a.correct.astype(np.float64) - b.correct
    return float(change.mean()), *statistics.mean_interval(change, a.groups)


def probe_json(results: Sequence[ProbeResult]) -> str:
    """Return the results as a JSON list of objects, without outcomes; a number that does not exist is null."""
    records = []
    for result in results:
        others = OF_CLASSES if result.measured else OF_NUMBERS
        records.append({name: value for name, value in statistics.plain(result).items() if name not in others})
    return json.dumps(records, indent=2, allow_nan=False)


def probe_table(results: Sequence[ProbeResult | Mapping[str, Any]], paper: float | None = None) -> str:
    """Return results, or rows of `score_tasks`, as one Markdown table, with the notes below.

    `paper`: the accuracy of AnyTouch in the paper.
    """
    lines, notes = list[dict[str, str]](), list[str]()
    for result in results:
        if isinstance(result, ProbeResult):
            lines += _result_lines(result)
            notes += [f"- {result.probe} ({result.protocol}): {note}" for note in result.notes]
        else:
            names = {name: result.get(name, "") for name in ("features", "task", "head", "protocol")}
            lines.append(names | _score_cells(result))
            notes += [f"- {result['task']}: {note}" for note in result["notes"]]
    if paper is not None:
        notes.append(f"- the paper reports {100 * paper:.2f} % for AnyTouch, its epoch chosen on test")
    header = list(dict.fromkeys(column for line in lines for column in line))
    table = statistics.markdown_table(header, [[line.get(column, "") for column in header] for line in lines])
    return "\n\n".join([table, *(["\n".join(dict.fromkeys(notes))] if notes else [])]) + "\n"


def _result_lines(result: ProbeResult) -> list[dict[str, str]]:
    """Return the cells of a result, and of its parts, by column."""
    line = {"probe": result.probe, "protocol": result.protocol} | _score_cells({
        "metric": "r2" if result.measured else "accuracy", "mean": result.r2 if result.measured else result.accuracy,
        "low": result.low, "high": result.high, "chance": result.baseline, "mae": result.mae, "unit": "",
        "chance_mae": result.baseline_mae, "train": result.n_train, "test": result.n_test, "groups": result.test_groups,
    })  # fmt: skip
    if result.measured:
        line["MAE 95 %"] = _interval(result.mae_low, result.mae_high, 1.0, 3)
    else:
        refits = f"{_share(result.refit_mean)} ± {100 * (result.refit_std or 0):.1f}" if result.seeds else "-"
        line |= {"balanced": _share(result.balanced_accuracy), "refits": refits, "classes": str(len(result.classes))}
    line["penalty or k"] = "-" if result.penalty is None else f"{result.penalty:g} ({result.chosen_on})"
    parts = [
        {"probe": f"{result.probe}: {part.name}", "protocol": result.protocol, "score": _share(part.accuracy),
         "95 %": _interval(part.low, part.high), "test (groups)": str(part.n_test)}
        for part in result.parts
    ]  # fmt: skip
    return [line, *parts]


def _score_cells(row: Mapping[str, Any]) -> dict[str, str]:
    """Return the cells of a row of `score_tasks` that every table has."""
    cells = {"score": _share(row["mean"]), "95 %": _interval(row["low"], row["high"]), "chance": _share(row["chance"])}
    if row["metric"] == "r2":
        mae, chance = (f"{row[name]:.3g} {row['unit']}".strip() for name in ("mae", "chance_mae"))
        interval = _interval(row["low"], row["high"], 1.0, 3)
        cells = {"score": f"R2 {row['mean']:.3f}, {mae}", "95 %": interval, "chance": chance}
    return cells | {"train": str(row["train"]), "test (groups)": f"{row['test']} ({row['groups']})"}


def _share(value: float | None) -> str:
    return "-" if value is None or np.isnan(value) else f"{100 * value:.1f} %"


def _interval(low: float | None, high: float | None, factor: float = 100.0, digits: int = 1) -> str:
    return "-" if low is None or high is None else f"{factor * low:.{digits}f} to {factor * high:.{digits}f}"
