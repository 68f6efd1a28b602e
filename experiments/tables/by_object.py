"""Correct answers of sets of features by object, and their shares and paired differences over objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import probing, statistics
from anytouch_jax.evaluate.heads import ProbeHead
from anytouch_jax.evaluate.statistics import markdown_table

Right = dict[str, list[np.ndarray]]  # by name: for every seed, how many each object has right


def by_object(groups: np.ndarray, right: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """How many rows each object has, and the sum over them of every array of `right`."""
    names, ids = np.unique(groups, return_inverse=True)
    sums = {name: np.round(np.bincount(ids, np.asarray(one, float)), 6).tolist() for name, one in right.items()}
    return {"objects": dict(zip(names.tolist(), np.bincount(ids).tolist(), strict=True)), "right": sums}


def probed(
    features: Mapping[str, np.ndarray], labels: Mapping[str, Sequence[Any]], groups: np.ndarray, split: np.ndarray
) -> dict[str, Any]:
    """What linear probes of sets of features (principal components where they are `pixels`) get right of each object of
    the test split, by label; `commonest` is the commonest answer of train there."""
    result = {}
    for label, values in labels.items():
        results = {"commonest": probing.majority_baseline(values, groups, split)}
        for name, x in features.items():
            head = ProbeHead("linear", "common" if name == "pixels" else "column")
            results[name] = probing.probe_features(x, values, groups, split, head, name=name, seeds=0)
        outcomes = {name: one.outcome for name, one in results.items() if one.outcome is not None}
        result[label] = by_object(outcomes["commonest"].groups, {name: one.correct for name, one in outcomes.items()})
    return result


def gathered(several: Sequence[Mapping[str, Any]]) -> tuple[np.ndarray, Right]:
    """Rows of each object, and what each set of features got right of them, seed by seed. Raises UserError when the
    seeds were not scored on the same rows."""
    counts = [one["objects"] for one in several]
    if any(count != counts[0] for count in counts):
        raise UserError("the records of these seeds are of different data: run this page without TABLE=1")
    right = {name: [np.array(one["right"][name]) for one in several] for name in several[0]["right"]}
    return np.array(list(counts[0].values())), right


def ahead(counts: np.ndarray, first: np.ndarray, second: np.ndarray, *, interval: bool = True) -> str:
    """How many points `first` is above `second`, with the 95 % interval over objects."""
    change = np.repeat((first - second) / counts, counts)
    low, high = (
        statistics.mean_interval(change, np.repeat(np.arange(len(counts)), counts)) if interval else (None, None)
    )
    return f"{100 * change.mean():+.1f}" + (
        "" if low is None or high is None else f" ({100 * low:+.1f} to {100 * high:+.1f})"
    )


def _percent(counts: np.ndarray, several: Sequence[np.ndarray]) -> str:
    """The share that the seeds get right, in the mean, and its spread."""
    shares = [100 * one.sum() / counts.sum() for one in several]
    return f"{np.mean(shares):.1f} %" + (f" +- {np.std(shares, ddof=1):.1f}" if len(shares) > 1 else "")


def probe_table(
    result: Sequence[Mapping[str, Any]], names: Sequence[str], rivals: Sequence[str], named: Sequence[str],
    unnamed: Sequence[str],
) -> str:  # fmt: skip
    """Accuracies by label, and of all that captions name together; and how far the first of `names` is ahead of the
    rivals, seed by seed too: the interval over objects is of these encoders, not of others trained alike."""
    rows, best = [], names[0]
    for title, labels in [*((x, (x,)) for x in named), ("these three", tuple(named)), *((x, (x,)) for x in unnamed)]:
        each = [gathered([one[label] for one in result]) for label in labels]
        counts = each[0][0]
        right = {name: [np.mean(s, 0) for s in zip(*(r[name] for _, r in each), strict=True)] for name in names}
        changes = []
        for name in rivals:
            apart = zip(right[best], right[name], strict=True)
            seeds = ", ".join(ahead(counts, a, b, interval=False) for a, b in apart)
            changes.append(ahead(counts, np.mean(right[best], 0), np.mean(right[name], 0)) + "; " + seeds)
        rows.append((title, *(_percent(counts, right[name]) for name in names), *changes))
    head = ("label", *names, *(f"{best} ahead of {name} (points, 95 % over objects; by seed)" for name in rivals))
    return markdown_table(head, rows)
