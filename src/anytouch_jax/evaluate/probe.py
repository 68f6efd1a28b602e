"""Probes of frozen features: linear, nearest neighbours, regression, and groups left out.

They take arrays and know nothing of networks. Two protocols, always named in the result: `honest` chooses the
penalty (or k) on `val`, or by cross-validation over groups inside `train`, and looks at `test` once; `published`
chooses it on `test`, as the authors' released code chooses its epoch.

In all of them: `features` (n, d); `labels` (n,) of strings or whole numbers, where None, "" or NaN is a row without
label; `groups` (n,) names what belongs together (a recording, a grasp) and is never cut by a fold or a bootstrap;
`split` (n,) is "train", "val" or "test" for the rows that take part.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.choices import NEIGHBOURS, PENALTIES, RIDGE
from anytouch_jax.evaluate.probe_models import Linear, Scaling, commonest, nearest, path, ridge, vote
from anytouch_jax.evaluate.probe_rows import Rows, Scores, bootstraps, choose, folded, prepare
from anytouch_jax.evaluate.statistics import (
    Outcome,
    ProbeResult,
    Protocol,
    RegressionResult,
    mean_interval,
    parts_of,
    r2_interval,
)

Array = npt.NDArray[Any]


def linear_probe(
    features: Array,
    labels: Any,
    groups: Any,
    split: Any,
    *,
    protocol: Protocol = "honest",
    penalties: Sequence[float] = PENALTIES,
    seeds: int = 5,
    scaling: Scaling = "column",
    subsets: Mapping[str, Array] | None = None,
    name: str = "linear",
) -> ProbeResult:
    """Multinomial logistic regression on features standardised by train; see `ProbeResult` for what is reported.

    A penalty is the factor of half the squared weights beside the *mean* log loss, so that it means the same
    for any number of rows. `scaling`: "column" for features of a network, "common" for principal components.
    `subsets` (name -> mask over all rows) report parts of test apart. Raises UserError on features that are not
    finite, labels of one class, or an empty train or test.
    """
    rows = prepare(features, labels, groups, split)
    penalty, chosen_on, notes = choose(rows, _strongest_first(penalties), _linear_scores(rows, scaling), protocol)
    best = Linear(rows.x[rows.train], rows.y[rows.train], penalty, scaling=scaling)
    correct = best(rows.x[rows.test]) == rows.y[rows.test]
    refits = []
    for fit, weights in bootstraps(rows, seeds):
        model = Linear(rows.x[fit], rows.y[fit], penalty, weights=weights, start=best, scaling=scaling)
        refits.append(float(np.mean(model(rows.x[rows.test]) == rows.y[rows.test])))
    if not best.finished:
        notes += ("the fit stopped at its limit of iterations",)
    found = _result(name, protocol, rows, correct, refits, penalty, chosen_on, notes, subsets)
    assert found.outcome is not None
    return replace(found, outcome=replace(found.outcome, fitted=(best, rows.names)))


def knn_probe(
    features: Array,
    labels: Any,
    groups: Any,
    split: Any,
    *,
    protocol: Protocol = "honest",
    neighbours: Sequence[int] = NEIGHBOURS,
    seeds: int = 5,
    subsets: Mapping[str, Array] | None = None,
    name: str = "kNN",
) -> ProbeResult:
    """Vote of the k nearest rows of train by cosine, ties to the class nearer in sum; k is chosen like a penalty.

    Raises as `linear_probe`.
    """
    rows = prepare(features, labels, groups, split)
    unit = rows.x / np.maximum(np.linalg.norm(rows.x, axis=1, keepdims=True), 1e-12)

    def predicted(fit: Array, scored: Array, options: Sequence[float]) -> list[Array]:
        near, likeness = nearest(unit[fit], unit[scored], int(max(options)))
        return [vote(rows.y[fit][near[:, : int(k)]], likeness[:, : int(k)], len(rows.names)) for k in options]

    def scores(fit: Array, scored: Array, options: Sequence[float]) -> list[float]:
        return [float(np.mean(one == rows.y[scored])) for one in predicted(fit, scored, options)]

    k, chosen_on, notes = choose(rows, _strongest_first(neighbours), scores, protocol, edges=False)
    correct = predicted(rows.train, rows.test, [k])[0] == rows.y[rows.test]
    # A neighbour drawn several times by a bootstrap counts several times.
    refits = [
        scores(np.repeat(fit, weights.astype(np.int64)), rows.test, [k])[0] for fit, weights in bootstraps(rows, seeds)
    ]
    return _result(name, protocol, rows, correct, refits, k, chosen_on, notes, subsets)


def majority(labels: Any, groups: Any, split: Any, *, subsets: Mapping[str, Array] | None = None) -> ProbeResult:
    """Always the commonest class of train, on test."""
    rows = prepare(np.zeros((len(labels), 1), np.float32), labels, groups, split, least_classes=1)
    correct = rows.y[rows.test] == commonest(rows.y[rows.train])
    return _result("commonest class", "honest", rows, correct, [], None, "", (), subsets)


def leave_groups_out(
    features: Array,
    labels: Any,
    groups: Any,
    *,
    folds: int | None = 10,
    penalties: Sequence[float] = (10.0, *PENALTIES),
    scaling: Scaling = "column",
    subsets: Mapping[str, Array] | None = None,
    name: str = "linear, groups left out",
) -> ProbeResult:
    """Linear probe where each row is predicted by a fit that saw no row of its group, for instance of its object.

    The groups are dealt into `folds` folds (None: each group alone); the penalty of a fold is chosen by folds over
    the groups that remain. `baseline` names the commonest class of the same remaining rows. `low`, `high` are over
    the groups. Every row with a label is both train and test; there is no split. `subsets` as in `linear_probe`.
    """
    rows = prepare(features, labels, groups, np.full(len(labels), "train"), tested=False)
    used, predicted, common = rows.train, np.full(len(rows.y), -1), np.full(len(rows.y), -1)
    options, chosen = _strongest_first(penalties), []
    count = len(np.unique(rows.groups[used])) if folds is None else folds
    for fit, out in folded(rows, used, count):
        inside = Rows(rows.x, rows.y, rows.names, rows.groups, fit, fit[:0], out, ())
        penalty, _, _ = choose(inside, options, _linear_scores(rows, scaling), "honest")
        chosen.append(penalty)
        predicted[out] = Linear(rows.x[fit], rows.y[fit], penalty, scaling=scaling)(rows.x[out])
        common[out] = commonest(rows.y[fit])
    correct = (predicted == rows.y)[used]
    values, times = np.unique(chosen, return_counts=True)
    notes = ("penalties of the folds: " + ", ".join(f"{v:g} ({n} x)" for v, n in zip(values, times, strict=True)),)
    inside = Rows(rows.x, rows.y, rows.names, rows.groups, used, used[:0], used, rows.notes)
    how, baseline = "cross-validation, median of the folds", float(np.mean(common[used] == rows.y[used]))
    return _result(
        name, "honest", inside, correct, [], float(np.median(chosen)), how, notes, subsets, baseline=baseline
    )


def regression_probe(
    features: Array,
    labels: Any,
    groups: Any,
    split: Any,
    *,
    protocol: Protocol = "honest",
    penalties: Sequence[float] = RIDGE,
    name: str = "ridge",
) -> RegressionResult:
    """Ridge regression of a measured label (floats; NaN or None: no label) on features standardised by train.

    A penalty stands beside the mean squared error. Raises UserError as `linear_probe`, and on a constant label.
    """
    rows = prepare(features, labels, groups, split, measured=True)

    def scores(fit: Array, scored: Array, options: Sequence[float]) -> list[float]:
        guesses = ridge(rows.x[fit], rows.y[fit], rows.x[scored], options)
        return [-float(np.mean((guess - rows.y[scored]) ** 2)) for guess in guesses]

    penalty, chosen_on, notes = choose(rows, _strongest_first(penalties), scores, protocol)
    truth, groups_of = rows.y[rows.test], rows.groups[rows.test]
    error = ridge(rows.x[rows.train], rows.y[rows.train], rows.x[rows.test], [penalty])[0] - truth
    mae_low, mae_high = mean_interval(np.abs(error), groups_of)
    low, high = r2_interval(error, truth, groups_of)
    return RegressionResult(
        probe=name,
        protocol=protocol,
        r2=1 - float(np.sum(error**2) / np.sum((truth - truth.mean()) ** 2)),
        low=low,
        high=high,
        mae=float(np.abs(error).mean()),
        mae_low=mae_low,
        mae_high=mae_high,
        baseline_mae=float(np.abs(rows.y[rows.train].mean() - truth).mean()),
        penalty=penalty,
        chosen_on=chosen_on,
        n_train=len(rows.train),
        n_test=len(rows.test),
        test_groups=len(np.unique(groups_of)),
        notes=rows.notes + notes,
    )


def _strongest_first(options: Sequence[float]) -> list[float]:
    """Penalties (or k) in falling order, each once: a strong fit is a good start for the next weaker one. Raises
    UserError where there is none, and for one that is not above 0."""
    if not options or min(options) <= 0:
        raise UserError(f"penalties and numbers of neighbours are above 0, at least one of them, not {list(options)}")
    return sorted(set(options), reverse=True)


def _linear_scores(rows: Rows, scaling: Scaling) -> Scores:
    """Accuracy of logistic regression for each penalty, fitted on some rows and scored on others."""

    def scores(fit: Array, scored: Array, options: Sequence[float]) -> list[float]:
        models = path(rows.x[fit], rows.y[fit], options, scaling)
        return [float(np.mean(model(rows.x[scored]) == rows.y[scored])) for model in models]

    return scores


def _result(
    name: str,
    protocol: Protocol,
    rows: Rows,
    correct: Array,
    refits: Sequence[float],
    penalty: float | None,
    chosen_on: str,
    notes: tuple[str, ...],
    subsets: Mapping[str, Array] | None = None,
    baseline: float | None = None,
) -> ProbeResult:
    y, groups = rows.y[rows.test], rows.groups[rows.test]
    low, high = mean_interval(correct, groups)
    if low is None:
        notes += ("test has one group only: no interval",)
    return ProbeResult(
        probe=name,
        protocol=protocol,
        accuracy=float(correct.mean()),
        balanced_accuracy=float(np.mean([correct[y == one].mean() for one in np.unique(y)])),
        low=low,
        high=high,
        baseline=float(np.mean(y == commonest(rows.y[rows.train]))) if baseline is None else baseline,
        refit_mean=float(np.mean(refits)) if refits else None,
        refit_std=float(np.std(refits, ddof=1)) if len(refits) > 1 else None,
        seeds=len(refits),
        penalty=penalty,
        chosen_on=chosen_on,
        n_train=len(rows.train),
        n_test=len(rows.test),
        test_groups=len(np.unique(groups)),
        classes=tuple(map(str, rows.names[np.unique(rows.y[rows.train])])),
        parts=parts_of(correct, groups, subsets or {}, rows.test),
        notes=rows.notes + notes,
        outcome=Outcome(rows.test, correct, groups),
    )
