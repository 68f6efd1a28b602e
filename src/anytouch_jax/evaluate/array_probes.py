"""Probes of arrays: a head fitted on features and labels that are given.

They take `features` (n, d); `labels` (n,), where None, "" or NaN is no label; `groups` (n,), which
no fold or bootstrap cuts; and `split` (n,), "train", "val" or "test" for the rows that take part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.evaluate import heads, splits
from anytouch_jax.evaluate.heads import LinearModel, ProbeHead, Scaling
from anytouch_jax.evaluate.results import ProbeResult
from anytouch_jax.evaluate.scoring import (
    Prediction,
    Scored,
    Subsets,
    constant_prediction,
    predict,
    result_of,
)
from anytouch_jax.evaluate.splits import LabelledFeatures, Selection, Split
from anytouch_jax.evaluate.statistics import Array, Protocol
from anytouch_jax.progress import tracked
from anytouch_jax.renamed import PROTOCOLS, keywords


@keywords({"protocol": PROTOCOLS}, measured="regression")
def probe_features(  # noqa: PLR0913 - four arrays, and settings that are each used alone
    features: Array,
    labels: npt.ArrayLike,
    groups: npt.ArrayLike,
    split: npt.ArrayLike,
    head: ProbeHead | None = None,
    *,
    regression: bool = False,
    protocol: Protocol = "grouped",
    seeds: int = 5,
    subsets: Subsets | None = None,
    name: str = "linear",
) -> ProbeResult:
    """Probe with a head that is selected and fitted on train, and tested on test.

    Args:
        features: f32 (n, d), frozen.
        labels: (n,) classes or numbers; None, "" and NaN are no label.
        groups: (n,) names of what was sampled independently, such as recordings or objects.
        split: (n,) "train", "val" or "test"; rows of other splits take no part.
        head: linear by default.
        regression: the labels are continuous, so the head is a regression.
        protocol: "grouped" selects on val or by cross-validation, "released" on test.
        seeds: how many heads of classes are fitted on bootstraps of the train groups too.
        subsets: parts of test that are scored too, name -> mask over all rows.
        name: of the probe in tables.

    Raises:
        UserError: as `splits.check_rows` does.
    """
    data, rows, notes = splits.check_rows(features, labels, groups, split, regression=regression)
    head = head or ProbeHead()
    found = predict(data, rows, head, protocol, refit=True)
    notes += _fit_notes(found, head)
    scored = Scored(rows, found.predicted, constant_prediction(data, rows), found.selected)
    result = result_of(name, protocol, data, scored, notes, subsets)
    if not regression:
        chosen = replace(head, options=(found.selected.option,))
        result = replace(result, **_refits(data, rows, chosen, found.model, seeds))
    if result.outcome is not None:
        outcome = replace(result.outcome, fitted=(found.model, data.names))
        result = replace(result, outcome=outcome)
    return result


def _fit_notes(found: Prediction, head: ProbeHead) -> tuple[str, ...]:
    """Return what a reader should know of a selection and its fit."""
    notes = []
    selected = found.selected
    if selected.chosen_on == "test":
        notes.append("chosen on test, as the authors' code does: an upper estimate")
    scores = np.asarray(selected.scores)
    if len(scores) and head.name == "linear":
        is_end = selected.place in (0, len(scores) - 1)
        # A plateau that reaches the end hides nothing: only a single best one may go on beyond it.
        is_alone = np.sum(scores == scores.max()) == 1
        if is_end and is_alone:
            notes.append(f"the chosen penalty {selected.option:g} lies at the edge of those tried")
    if found.model is not None and not found.model.fit.finished:
        notes.append("the fit stopped at its limit of iterations")
    return tuple(notes)


def _refits(
    data: LabelledFeatures, rows: Split, head: ProbeHead, start: LinearModel | None, seeds: int
) -> dict[str, Any]:
    """Return how heads score that are fitted on bootstraps of the train groups.

    Their spread shows how much a score depends on which objects were recorded for training. The
    interval of a result, by contrast, is of the test groups with this one fit.
    """
    accuracies = []
    bootstraps = list(splits.group_bootstraps(rows.fit, data.groups, seeds))
    for ids, weights in tracked(bootstraps, "refits"):
        (again,) = data.fit(head, ids, weights=weights, start=start).predict(data.x[rows.test])
        accuracies.append(float(np.mean(again == data.y[rows.test])))
    if not accuracies:
        return {}
    deviation = None
    if len(accuracies) > 1:
        deviation = float(np.std(accuracies, ddof=1))
    mean = float(np.mean(accuracies))
    return {"refit_mean": mean, "refit_std": deviation, "seeds": len(accuracies)}


def _single_group_note(data: LabelledFeatures, used: Array) -> tuple[str, ...]:
    """Return a note on classes of one group, which no head knows when that group is left out."""
    pairs = np.unique(np.stack([data.y[used], _codes(data.groups[used])]), axis=1)
    classes, groups = np.unique(pairs[0], return_counts=True)
    single = data.names[classes[groups == 1]]
    if not len(single):
        return ()
    listed = ", ".join(map(str, single[:10]))
    if len(single) > 10:
        listed += f" and {len(single) - 10} more"
    return (f"classes of one group alone count as errors when it is left out: {listed}",)


def _codes(names: Array) -> Array:
    return np.unique(names, return_inverse=True)[1]


@keywords(measured="regression")
def leave_groups_out(  # noqa: PLR0913 - three arrays, and settings that are each used alone
    features: Array,
    labels: npt.ArrayLike,
    groups: npt.ArrayLike,
    *,
    regression: bool = False,
    folds: int | None = 10,
    penalties: Sequence[float] | None = None,
    scaling: Scaling = "column",
    subsets: Subsets | None = None,
    name: str = "linear, groups left out",
) -> ProbeResult:
    """Probe each row with a linear fit on no row of its group, for instance on held-out objects.

    The choice of the penalty is nested: in each fold the groups that are left select it, by
    cross-validation among themselves, so no row has a part in the choice by which it is scored.
    Their commonest class is the baseline.

    Args:
        features: f32 (n, d), frozen.
        labels: (n,) classes or numbers.
        groups: (n,) names of what is left out together.
        regression: the labels are continuous, so the head is a regression.
        folds: into so many the groups are dealt; None leaves each group out alone.
        penalties: of the head; by default from 10 down for classes, from 100 for numbers.
        scaling: of the features; see `ProbeHead`.
        subsets: parts that are scored too, name -> mask over all rows.
        name: of the probe in tables.

    Raises:
        UserError: as `splits.check_rows` does.
    """
    everywhere = np.full(len(np.asarray(labels, object)), "train")
    data, rows, notes = splits.check_rows(
        features, labels, groups, everywhere, regression=regression, tested=False
    )
    used = rows.fit
    if penalties is None:
        penalties = heads.RIDGE if regression else (10.0, *heads.PENALTIES)
    head = ProbeHead("linear", scaling, tuple(penalties))
    count = folds
    if count is None:
        count = len(np.unique(data.groups[used]))
    parts = splits.group_folds(used, data.groups, None if regression else data.y, count)
    cuts = [Split(fit, fit[:0], out) for fit, out in parts]
    if not regression:
        notes += _single_group_note(data, used)
    return probe_cuts(data, cuts, head, name=name, notes=notes, subsets=subsets)


def probe_cuts(
    data: LabelledFeatures,
    cuts: Sequence[Split],
    head: ProbeHead,
    *,
    name: str,
    protocol: Protocol = "grouped",
    notes: tuple[str, ...] = (),
    subsets: Subsets | None = None,
) -> ProbeResult:
    """Probe by several splits, which test every row at most once, and score all tested rows.

    Args:
        data: features, labels and groups of all rows.
        cuts: the splits, each with a head of its own.
        head: with the options to select from, in each split anew.
        name: of the probe in tables.
        protocol: how they are selected.
        notes: what a reader should know.
        subsets: parts that are scored too, name -> mask over all rows.
    """
    chosen = []
    predicted = np.full(len(data.y), -1, data.y.dtype)
    baseline = np.full(len(data.y), -1, data.y.dtype)
    for cut in tracked(cuts, "folds"):
        found = predict(data, cut, head, protocol, refit=True)
        chosen.append(found.selected.option)
        predicted[cut.test] = found.predicted
        baseline[cut.test] = constant_prediction(data, cut)
    selected = found.selected
    if len(cuts) > 1:
        values, times = np.unique(chosen, return_counts=True)
        listed = ", ".join(f"{value:g} ({n} x)" for value, n in zip(values, times, strict=True))
        what = "penalties" if head.name == "linear" else "numbers of neighbours"
        notes += (f"{what} of the folds: {listed}",)
        median = float(np.median(chosen))
        selected = Selection(0, median, "cross-validation, median of the folds")
    fitted = np.unique(np.concatenate([[*cut.fit, *cut.val] for cut in cuts]))
    tested = np.sort(np.concatenate([cut.test for cut in cuts]))
    scored = Scored(
        Split(fitted, fitted[:0], tested), predicted[tested], baseline[tested], selected
    )
    return result_of(name, protocol, data, scored, notes, subsets)
