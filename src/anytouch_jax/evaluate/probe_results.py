"""Results of probes: records, paired differences, Markdown tables and JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.statistics import Protocol, markdown_table, mean_interval, plain

Array = npt.NDArray[Any]


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
    """Row numbers of the test rows, whether each was right, and its group.

    `fitted`: the linear model that was tested, and the names (K,) that its class numbers index.
    """

    rows: Array
    correct: Array
    groups: Array
    fitted: tuple[Any, Array] | None = None


@dataclass(frozen=True)
class ProbeResult:
    """A classification probe. Shares are in 0..1.

    `accuracy`, `balanced_accuracy`: of the model fitted on all of train, on the test rows. A test row of a class that
    train lacks counts as an error. `low`, `high`: 95 % interval of the accuracy under a bootstrap over the test groups
    (recordings), None with fewer than two. `refit_mean`, `refit_std`: accuracy of `seeds` models fitted on bootstraps
    of the train groups. Each has some 63 % of the groups, so the mean is a little below `accuracy`. `baseline`:
    accuracy of the most frequent class of train. `penalty` (k for kNN) was selected on `chosen_on`. If that is the test
    set (protocol "published"), the accuracy is an upper estimate.
    """

    probe: str
    protocol: Protocol
    accuracy: float
    balanced_accuracy: float
    low: float | None
    high: float | None
    baseline: float
    refit_mean: float | None
    refit_std: float | None
    seeds: int
    penalty: float | None
    chosen_on: str
    n_train: int
    n_test: int
    test_groups: int
    classes: tuple[str, ...]
    parts: tuple[SubsetResult, ...] = ()
    notes: tuple[str, ...] = ()
    outcome: Outcome | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True)
class RegressionResult:
    """A regression probe: `r2` (1 - squared error / variance of the test labels) and `mae` in units of the label.

    `low`, `high` bound R2 as in `ProbeResult`; `baseline_mae` is that of the mean of train.
    """

    probe: str
    protocol: Protocol
    r2: float
    low: float | None
    high: float | None
    mae: float
    mae_low: float | None
    mae_high: float | None
    baseline_mae: float
    penalty: float
    chosen_on: str
    n_train: int
    n_test: int
    test_groups: int
    notes: tuple[str, ...] = ()


Result = ProbeResult | RegressionResult


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
    return float(change.mean()), *mean_interval(change, a.groups)


def subset_results(
    correct: Array, groups: Array, subsets: Mapping[str, Array], test: Array
) -> tuple[SubsetResult, ...]:
    """Return the accuracy of each subset (a mask over all rows) of the test rows, whose row numbers are `test`."""
    results = []
    for name, mask in subsets.items():
        chosen = np.asarray(mask, bool)[test]
        interval = mean_interval(correct[chosen], groups[chosen])
        accuracy = float(correct[chosen].mean()) if chosen.any() else float("nan")
        results.append(SubsetResult(name, accuracy, *interval, int(chosen.sum())))
    return tuple(results)


def probe_json(results: Sequence[Result]) -> str:
    """Return the results as a JSON list of objects, without outcomes; a number that does not exist is null."""
    return json.dumps(plain(results), indent=2, allow_nan=False)


def probe_table(results: Sequence[Result]) -> str:
    """Return the results as Markdown: one table of classification, one of regression, then the notes."""
    blocks, classification, regression = [], list[tuple[str, ...]](), list[tuple[str, ...]]()
    for result in results:
        size = f"{result.n_test} ({result.test_groups})"
        chosen = "-" if result.penalty is None else f"{result.penalty:g} ({result.chosen_on})"
        if isinstance(result, RegressionResult):
            r2, mae = _interval(result.low, result.high, 1.0, 3), _interval(result.mae_low, result.mae_high, 1.0, 3)
            errors = (f"{result.r2:.3f}", r2, f"{result.mae:.4g}", mae, f"{result.baseline_mae:.4g}")
            regression.append((result.probe, result.protocol, *errors, str(result.n_train), size, chosen))
            continue
        spread = 100 * (result.refit_std or 0)
        refits = "-" if result.refit_mean is None else f"{_share(result.refit_mean)} ± {spread:.1f}"
        shares = (_share(result.accuracy), _interval(result.low, result.high), _share(result.balanced_accuracy))
        sizes = (str(result.n_train), size, str(len(result.classes)), chosen)
        classification.append((result.probe, result.protocol, *shares, _share(result.baseline), refits, *sizes))
        for part in result.parts:
            cells = (_share(part.accuracy), _interval(part.low, part.high), "", "", "", "", str(part.n_test), "", "")
            classification.append((f"{result.probe}: {part.name}", result.protocol, *cells))
    if classification:
        head = ("probe", "protocol", "accuracy", "95 % over test groups", "balanced", "commonest class", "refits")
        blocks.append(markdown_table((*head, "train", "test (groups)", "classes", "penalty or k"), classification))
    if regression:
        head = ("probe", "protocol", "R2", "95 % over test groups", "MAE", "MAE 95 %", "MAE of the mean")
        blocks.append(markdown_table((*head, "train", "test (groups)", "penalty"), regression))
    notes = [f"- {result.probe} ({result.protocol}): {note}" for result in results for note in result.notes]
    return _with_notes(blocks, notes)


def task_table(report: Mapping[str, Any]) -> str:
    """Return the report of `probe_tasks` or `probe_benchmark` as Markdown, with notes below."""
    head = ("features", "task", "head", "protocol", "score", "95 %", "chance", "train", "test (groups)")
    rows, notes = [], list[str]()
    for row in report["results"]:
        if row["metric"] == "r2":
            score, interval = f"R2 {row['mean']:.3f}, {row['mae']:.3g} {row['unit']}", (row["low"], row["high"], 1.0, 3)
            chance = f"{row['chance_mae']:.3g} {row['unit']}"
        else:
            score, interval, chance = _share(row["mean"]), (row["low"], row["high"], 100.0, 1), _share(row["chance"])
        names = (row["features"], row["task"], row["head"], row["protocol"])
        size = f"{row['test']} ({row['groups']})"
        rows.append((*names, score, _interval(*interval), chance, str(row["train"]), size))
        notes += [f"- {row['task']}: {note}" for note in row["notes"]]
    if report["paper"] is not None:
        notes.append(f"- the paper reports {100 * report['paper']:.2f} % for AnyTouch, its epoch chosen on test")
    return _with_notes([markdown_table(head, rows)], notes)


def _with_notes(blocks: Sequence[str], notes: Sequence[str]) -> str:
    """Return tables and then each note once."""
    return "\n\n".join([*blocks, *(["\n".join(dict.fromkeys(notes))] if notes else [])]) + "\n"


def _share(value: float) -> str:
    return "-" if np.isnan(value) else f"{100 * value:.1f} %"


def _interval(low: float | None, high: float | None, factor: float = 100.0, digits: int = 1) -> str:
    return "-" if low is None or high is None else f"{factor * low:.{digits}f} to {factor * high:.{digits}f}"
