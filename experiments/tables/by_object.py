"""Correct answers of sets of features by object, and their shares and paired differences over objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import probing
from anytouch_jax.evaluate.heads import ProbeHead

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
        raise UserError("the records of these seeds are of different data. Remove those of one")
    right = {name: [np.array(one["right"][name]) for one in several] for name in several[0]["right"]}
    return np.array(list(counts[0].values())), right
