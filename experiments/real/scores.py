"""Scores of whole recordings: a head is fitted on frames, and a recording gets the mean of its
frames' scores.

Every choice (the penalty, the number of neighbours) is made on validation recordings or on folds of
train.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.special import softmax

from anytouch_jax.encoder.embed import nearest
from anytouch_jax.evaluate import heads, statistics
from experiments.real.recordings import Recordings

Array = np.ndarray
PENALTIES = (10.0, 1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 0.001, 0.0003, 0.0001)
NEIGHBOURS = (50, 20, 10, 5, 1)
TRAINED = "trained with labels"  # the head of a network that is trained whole, on this task


class Score(NamedTuple):
    """Which recordings (or frames) were right, and their names, in one order for all encoders."""

    correct: Array
    groups: Array
    option: float

    @property
    def fraction(self) -> float:
        return float(self.correct.mean())

    def interval(self) -> tuple[float | None, float | None]:
        """95 % interval over recordings."""
        return statistics.mean_interval(self.correct, self.groups)

    def minus(self, other: Score) -> tuple[float, float | None, float | None]:
        """Difference of two encoders, paired by recording, with its 95 % interval."""
        change = self.correct.astype(float) - other.correct
        return float(change.mean()), *statistics.mean_interval(change, self.groups)


def linear_scores(
    x: Array, y: Array, classes: int, fit: Array, weights: Array
) -> list[tuple[float, Array]]:
    """Return (penalty, probabilities (n, classes)) of logistic regression on the rows `fit` for
    every penalty.

    All columns are divided by one number, which keeps the ranking of principal components.
    """
    mean, scale = x[fit].mean(0), np.sqrt(x[fit].var(0).mean())
    scaled = ((x - mean) / scale).astype(np.float32)
    path = heads.logistic_path(scaled[fit], y[fit], classes, PENALTIES, None, weights)
    results = []
    for penalty, model in zip(PENALTIES, path, strict=True):
        logits = scaled @ model.weights + model.bias
        if logits.shape[1] == 1:
            logits = np.concatenate([np.zeros_like(logits), logits], 1)
        results.append((penalty, softmax(logits, axis=1)))
    return results


def neighbour_scores(
    x: Array, y: Array, classes: int, fit: Array, weights: Array
) -> list[tuple[float, Array]]:
    """Return (k, fractions of the classes among the k nearest train frames (n, classes))."""
    centred = x - x[fit].mean(0)
    unit = centred / np.maximum(np.linalg.norm(centred, axis=1, keepdims=True), 1e-12)
    near, cosine = nearest(unit[fit], unit, max(NEIGHBOURS))
    results = []
    for k in NEIGHBOURS:
        votes = np.zeros((len(x), classes))
        some = y[fit][near[:, :k]]
        np.add.at(votes, (np.arange(len(x))[:, None], some), np.exp(cosine[:, :k] / 0.1))
        results.append((float(k), votes / votes.sum(1, keepdims=True)))
    return results


def _fraction_weights(groups: Array) -> Array:
    """Return weights of frames by which every recording counts once."""
    _, inverse, counts = np.unique(groups, return_inverse=True, return_counts=True)
    return 1.0 / counts[inverse]


def recording_score(
    x: Array,
    y: Array,
    groups: Array,
    split: Array,
    classes: int,
    score: Callable[..., list[tuple[float, Array]]] = linear_scores,
) -> Score:
    """Fit on train, choose on val, and score each recording of test. x (n, d), y class numbers
    (n,).
    """
    fit = np.flatnonzero(split == "train")
    options = score(x, y, classes, fit, _fraction_weights(groups[fit]))

    def rights(values: Array, part: Array) -> tuple[Array, Array, float]:
        names = np.unique(groups[part])
        means = np.stack([values[part & (groups == name)].mean(0) for name in names])
        truth = np.array([y[part & (groups == name)][0] for name in names])
        loss = -np.log(np.maximum(means[np.arange(len(names)), truth], 1e-9))
        return means.argmax(1) == truth, names, float(loss.mean())

    best = min(options, key=lambda option: rights(option[1], split == "val")[2])
    correct, names, _ = rights(best[1], split == "test")
    return Score(correct, names, best[0])


def object_score(x: Array, data: Recordings, score: Callable[..., Any] = linear_scores) -> Score:
    """Which of 39 objects is it? Test recordings are other grasps of objects in train."""
    y = np.searchsorted(data.names, data.object)
    return recording_score(x, y, data.recording, data.split, len(data.names), score)


def other_finger_score(
    x: Array, data: Recordings, score: Callable[..., Any] = linear_scores
) -> Score:
    """Which object is it, on test recordings of the finger whose camera the head never saw? Both
    directions.
    """
    y = np.searchsorted(data.names, data.object)
    parts = []
    for trained, tested in (("cam0", "cam2"), ("cam2", "cam0")):
        split = np.where(
            data.finger == np.where(data.split == "test", tested, trained), data.split, "unused"
        )
        parts.append(recording_score(x, y, data.recording, split, len(data.names), score))
    groups = np.concatenate([part.groups for part in parts])
    return Score(np.concatenate([part.correct for part in parts]), groups, parts[0].option)


def slip_score(x: Array, data: Recordings, score: Callable[..., Any] = linear_scores) -> Score:
    """Did it slip? Objects are left out by five folds; the next fold is for validation."""
    parts = []
    for fold in range(5):
        split = np.where(
            data.fold == fold, "test", np.where(data.fold == (fold + 1) % 5, "val", "train")
        )
        parts.append(recording_score(x, data.slip, data.recording, split, 2, score))
    return Score(
        np.concatenate([part.correct for part in parts]),
        np.concatenate([part.groups for part in parts]),
        float(np.median([part.option for part in parts])),
    )


TASKS = {
    "object": object_score,
    "object, other finger": other_finger_score,
    "slip, objects left out": slip_score,
}
HEADS = {"linear": linear_scores, "kNN": neighbour_scores}


def table(x: Array, data: Recordings) -> dict[str, Score]:
    """Return {task and head: score} of features (n, d)."""
    return {
        f"{task}, {head}": of(x, data, score)
        for task, of in TASKS.items()
        for head, score in HEADS.items()
    }
