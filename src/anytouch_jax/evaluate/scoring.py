"""Scores of one head on one split: its selection, its predictions for test rows, its result."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from anytouch_jax.evaluate import splits, statistics
from anytouch_jax.evaluate.heads import LinearModel, ProbeHead
from anytouch_jax.evaluate.results import NAN, Outcome, ProbeResult, SubsetResult
from anytouch_jax.evaluate.splits import LabelledFeatures, Selection, Split
from anytouch_jax.evaluate.statistics import Array, GroupSums, Protocol

# name -> mask over all rows
Subsets = Mapping[str, Array]


class Prediction(NamedTuple):
    """What a selected head predicts for the test rows; `model` is None for other than logistic."""

    selected: Selection
    model: LinearModel | None
    predicted: Array


def predict(
    data: LabelledFeatures, cut: Split, head: ProbeHead, protocol: Protocol, *, refit: bool = False
) -> Prediction:
    """Select an option of a head, fit it, and predict the test rows of the split.

    Args:
        data: features, labels and groups of all rows.
        cut: rows of train, val and test.
        head: kind of head.
        protocol: how the option is selected.
        refit: fit again without a start, so that the weights do not depend on the other
            options. Otherwise the fit of the selection serves if it has seen all rows of train.
    """
    selected = splits.select_option(head, data, cut, protocol)
    fitted = selected.fitted
    place = selected.place
    # The epochs of the gradient head come from one fit on all rows; a penalty was selected on at
    # most SELECT_ROWS, and the reported fit has all.
    saw_some = head.name != "gradient" and len(cut.fit) > splits.SELECT_ROWS
    if refit or fitted is None or saw_some:
        start = None
        if not refit and fitted is not None and fitted.models:
            start = fitted.models[place]
        chosen = replace(head, options=(selected.option,))
        fitted = data.fit(chosen, cut.fit, start=start)
        place = 0
    model = fitted.models[place] if fitted.models else None
    return Prediction(selected, model, fitted.predict(data.x[cut.test])[place])


def constant_prediction(data: LabelledFeatures, cut: Split) -> Array:
    """Return what needs no features, for each test row.

    It is the most frequent class of the fitted rows (the smallest of equals), or their mean.
    """
    y = data.y[cut.fit]
    value = np.bincount(y).argmax() if len(data.names) else y.mean()
    return np.full(len(cut.test), value)


def score_sums(data: LabelledFeatures, predicted: Array, tested: Array) -> GroupSums:
    """Return the sums by which predictions for the rows `tested` are scored."""
    truth = data.y[tested]
    groups = data.groups[tested]
    if len(data.names):
        return statistics.classification_sums(predicted == truth, groups)
    centred = truth - truth.mean()
    return statistics.regression_sums(predicted - truth, centred, groups, predicted)


class Scored(NamedTuple):
    """The rows of a probe with what its head and a constant predict for those of test.

    `selected` is None where nothing was selected.
    """

    rows: Split
    predicted: Array
    constant: Array
    selected: Selection | None = None


def result_of(
    name: str,
    protocol: Protocol,
    data: LabelledFeatures,
    scored: Scored,
    notes: tuple[str, ...] = (),
    subsets: Subsets | None = None,
) -> ProbeResult:
    """Return the result of a probe.

    Args:
        name: of the probe in tables.
        protocol: how the option was selected.
        data: features, labels and groups of all rows.
        scored: the rows of the probe and what was predicted for those of test.
        notes: what a reader should know.
        subsets: parts of the test rows that are scored too, as masks over all rows.
    """
    tested = scored.rows.test
    truth = data.y[tested]
    groups = data.groups[tested]
    regression = not len(data.names)
    sums = score_sums(data, scored.predicted, tested)
    constant = score_sums(data, scored.constant, tested)
    scores = statistics.scores([sums], [constant], regression)
    option = None
    chosen_on = ""
    if scored.selected is not None:
        option = scored.selected.option
        chosen_on = scored.selected.chosen_on
    more: dict[str, Any] = {}
    correct = np.zeros(0, bool)
    if regression:
        names = ("mae", "mae_low", "mae_high", "spearman", "spearman_low", "spearman_high")
        more = {key: scores[key] for key in names}
        more |= {"r2": scores["mean"], "baseline_mae": scores["chance_mae"]}
    else:
        correct = scored.predicted == truth
        by_class = [correct[truth == number].mean() for number in np.unique(truth)]
        learned = np.unique(data.y[scored.rows.fit])
        more = {
            "accuracy": scores["mean"],
            "baseline": scores["chance"],
            "parts": _parts(subsets or {}, tested, correct, groups),
            "balanced_accuracy": float(np.mean(by_class)),
            "classes": tuple(map(str, data.names[learned])),
        }
        if scores["low"] is None:
            notes = (*notes, "test has one group only: no interval")
    return ProbeResult(
        probe=name,
        protocol=protocol,
        low=scores["low"],
        high=scores["high"],
        penalty=option,
        chosen_on=chosen_on,
        n_train=len(scored.rows.fit),
        n_test=len(tested),
        test_groups=len(np.unique(groups)),
        notes=notes,
        outcome=Outcome(tested, correct, groups, sums),
        **more,
    )


def _parts(
    subsets: Subsets, tested: Array, correct: Array, groups: Array
) -> tuple[SubsetResult, ...]:
    """Return the accuracy on each part of the test rows."""
    parts = []
    for part, mask in subsets.items():
        kept = np.asarray(mask, bool)[tested]
        low, high = statistics.fraction_interval(correct[kept], groups[kept])
        accuracy = float(correct[kept].mean()) if kept.any() else NAN
        parts.append(SubsetResult(part, accuracy, low, high, int(kept.sum())))
    return tuple(parts)
