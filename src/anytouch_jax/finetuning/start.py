"""The start of fine-tuning: held-out recordings, and a linear head on the frozen encoder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import log_softmax

from anytouch_jax.encoder.arrays import Array
from anytouch_jax.encoder.calibration import fit_temperature, group_weights, probabilities
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import heads, splits
from anytouch_jax.evaluate.tasks import TaskRows

FIRM = 0.1  # the least penalty of a head that training starts from
_HELD_OUT = 5  # one of so many groups is held out where there is no split val


class Parts(NamedTuple):
    """Places of rows: those that are trained on, those that stop the training, and those of test.

    `what` says in words what is held out.
    """

    fit: Array
    val: Array
    test: Array
    what: str


@dataclass(frozen=True)
class Target:
    """What is predicted: classes by number, or numbers.

    Attributes:
        y: class numbers i64 (n,), -1 where train lacks the class, or f64 (n,).
        names: str (K,), empty for numbers.
        groups: str (n,).
    """

    y: Array
    names: Array
    groups: Array

    @property
    def is_number(self) -> bool:
        """Whether numbers are predicted."""
        return len(self.names) == 0


class Held(NamedTuple):
    """A score on held-out rows: `loss` is compared, and `shown` is what a user understands.

    `shown` is the accuracy, or minus the mean absolute error of numbers.
    """

    loss: float
    shown: float

    def beats(self, other: Held) -> bool:
        """Whether it is better: its loss is smaller, and what a user sees is not worse."""
        return self.loss < other.loss and self.shown >= other.shown

    def text(self, target: Target) -> str:
        """Return the score in words."""
        if target.is_number:
            return f"{-self.shown:.3g} mean absolute error"
        return f"{self.shown:.1%}"


class Linear(NamedTuple):
    """A linear function of features (n, d): (x - mean) / scale @ weights + bias.

    `weights` (d, columns) have one column for numbers and for two classes, and `penalty` is that of
    the fit.
    """

    weights: Array
    bias: Array
    mean: Array
    scale: Array
    penalty: float

    def __call__(self, x: Array) -> Array:
        """Return outputs (n, columns)."""
        return np.asarray((x - self.mean) / self.scale @ self.weights + self.bias)


class LinearStart(NamedTuple):
    """The linear head to beat with its held-out score, and the head that training starts from.

    Training starts from a head with a firm penalty. One without leans on directions in which
    features hardly vary, where the smallest change of the encoder would change its outputs most.
    """

    linear: Linear
    score: Held
    first: Linear


def deal_parts(rows: TaskRows, is_number: bool) -> Parts:
    """Return which rows are trained on, and which recordings are held out.

    Split val is held out if there is one, else a fifth of the groups of train. A group that is the
    only one of its class is trained on, since nothing else would show the class.

    Raises:
        UserError: nothing can be held out.
    """
    train = np.flatnonzero(rows.split == "train")
    val = np.flatnonzero(rows.split == "val")
    test = np.flatnonzero(rows.split == "test")
    if not len(train):
        raise UserError("No row of split 'train' has this label. Choose another label or manifest.")
    if len(val):
        return Parts(train, val, test, f"{len(np.unique(rows.groups[val]))} groups of split val")
    groups = rows.groups[train]
    may_be_out = np.ones(len(train), bool)
    classes = None
    if not is_number:
        names, classes = np.unique(rows.labels[train], return_inverse=True)
        pairs = np.unique(np.stack([classes, np.unique(groups, return_inverse=True)[1]]), axis=1)
        counts = np.bincount(pairs[0], minlength=len(names))
        may_be_out = counts[classes] > 1
    if len(np.unique(groups[may_be_out])) < 2:
        raise UserError(
            "Fine-tuning is stopped by recordings that it has not seen, and there are none to "
            "spare: record each class twice or more, or mark some as split val."
        )
    # Dealt over the groups of each class in turn, so that small classes are held out too.
    own = None if classes is None else classes[may_be_out]
    fold = splits.assign_folds(
        groups[may_be_out], own, np.random.default_rng([17, 0]), min(_HELD_OUT, len(groups))
    )
    is_out = np.zeros(len(train), bool)
    is_out[np.flatnonzero(may_be_out)[fold == 0]] = True
    count = len(np.unique(groups[is_out]))
    what = f"{count} of {len(np.unique(groups))} groups"
    return Parts(train[~is_out], train[is_out], test, what)


def target_of(rows: TaskRows, parts: Parts, is_number: bool) -> Target:
    """Return what is predicted. Raises UserError if train has one class or number only."""
    if is_number:
        y = np.asarray(rows.labels, np.float64)
        names = np.array([], str)
        count = len(np.unique(y[parts.fit]))
    else:
        names = np.unique(rows.labels[parts.fit])
        place = np.minimum(np.searchsorted(names, rows.labels), len(names) - 1)
        y = np.where(names[place] == rows.labels, place, -1)
        count = len(names)
    if count < 2:
        raise UserError("The label is the same on every row of train. There is nothing to learn.")
    target = Target(y, names, rows.groups)
    if not is_number and not (y[parts.val] >= 0).any():
        raise UserError("No class of the held-out rows is in train. Record each class twice.")
    return target


def held_score(outputs: Array, target: Target, places: Array) -> Held:
    """Return the score of outputs (n, columns) for rows at `places` (n,).

    Each group counts once. The temperature of classes is fitted, because confidence is calibrated
    later, and a confident network should not seem worse than one that names less.
    """
    known = np.ones(len(places), bool)
    if not target.is_number:
        known = target.y[places] >= 0
    places = places[known]
    outputs = outputs[known].astype(np.float64)
    groups = target.groups[places]
    weights = group_weights(groups)
    truth = target.y[places]
    if target.is_number:
        error = outputs[:, 0] - truth
        return Held(float(weights @ error**2), -float(weights @ np.abs(error)))
    temperature = fit_temperature(outputs, truth, groups)
    if outputs.shape[1] == 1:
        outputs = np.concatenate([np.zeros_like(outputs), outputs], axis=1)
    chances = log_softmax(outputs / temperature, axis=1)
    loss = -float(weights @ chances[np.arange(len(truth)), truth])
    return Held(loss, float(weights @ (outputs.argmax(1) == truth)))


def right_rows(outputs: Array, target: Target, places: Array) -> Array:
    """Return whether each row was named right, or minus its absolute error, f64 (n,)."""
    truth = target.y[places]
    if target.is_number:
        return -np.abs(outputs[:, 0] - truth)
    named = probabilities(outputs.astype(np.float64)).argmax(1)
    return (named == truth).astype(np.float64)


def linear_start(x: Array, target: Target, parts: Parts) -> LinearStart:
    """Fit the linear head on the frozen encoder, and the head that fine-tuning starts from.

    It is logistic or ridge regression, as `anytouch probe label` fits it, and its penalty is chosen
    on the held-out rows. `x` f32 (n, d) are the features of all rows.
    """
    fit = parts.fit
    path = _ridge_path if target.is_number else _class_path
    heads_of = path(x[fit], target.y[fit], len(target.names))
    scores = [held_score(one(x[parts.val]), target, parts.val) for one in heads_of]
    losses = [score.loss for score in scores]
    best = int(np.argmin(losses))
    firm = [place for place, one in enumerate(heads_of) if one.penalty >= FIRM]
    first = min(firm, key=lambda place: losses[place])
    return LinearStart(heads_of[best], scores[best], heads_of[first])


def _class_path(x: Array, y: Array, classes: int) -> list[Linear]:
    """Return logistic regression for each penalty."""
    models = heads.linear_path(x, y, heads.PENALTIES, total=classes)
    return [
        Linear(model.fit.weights, model.fit.bias, model.mean, model.scale, penalty)
        for model, penalty in zip(models, heads.PENALTIES, strict=True)
    ]


def _ridge_path(x: Array, y: Array, _: int) -> list[Linear]:
    """Return ridge regression for each penalty, from one eigendecomposition."""
    mean = x.mean(0)
    scale = np.where(x.std(0) > 1e-6, x.std(0), 1.0).astype(np.float32)
    scaled = ((x - mean) / scale).astype(np.float64)
    middle = float(y.mean())
    values, vectors = np.linalg.eigh(scaled.T @ scaled / len(x))
    along = vectors.T @ (scaled.T @ (y - middle)) / len(x)
    found = []
    for penalty in heads.RIDGE:
        weights = vectors @ (along / (np.maximum(values, 0) + penalty))
        column = np.asarray(weights[:, None], np.float32)
        found.append(Linear(column, np.array([middle], np.float32), mean, scale, penalty))
    return found
