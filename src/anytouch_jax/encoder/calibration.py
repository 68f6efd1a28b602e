"""Calibration of linear heads: temperature, conformal sets, abstention, novelty.

All limits come from touches that the head was not fitted on. Every recording (group) has the same
weight, because its frames are alike: ten times as many frames of one press are not ten times as
much evidence. A limit holds for a frame of a new recording from the same source, on average over
recordings (Lee, Barber and Willett, "Distribution-free inference with hierarchical data", 2023).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import brentq, minimize_scalar
from scipy.special import expit, log_softmax, softmax
from threadpoolctl import threadpool_limits

from anytouch_jax.encoder.arrays import Array
from anytouch_jax.errors import UserError
from anytouch_jax.files import check_array
from anytouch_jax.shown import shown_short

# Defaults: probability that a set holds the class, and that a known touch is called novel.
COVERAGE = 0.9
FALSE_ALARMS = 0.05
NEIGHBOURS = 5  # nearest training touches in the novelty score
# Training touches that a head stores. Measured: more change a score by less than its noise.
REFERENCES = 2048
# Frames, and the fraction of them that look like another sensor, until that is reported.
_FEWEST = 8
_OTHERS = 0.5
_CHUNK = 1024
# Sums of 1/n are a few units in the last place off, and a limit must not move by a row for that.
_ROUNDING = 1e-12


@shown_short
@dataclass(frozen=True, eq=False)
class Calibration:
    """What a head knows about its own errors.

    With too few `recordings` a limit is infinite.

    Attributes:
        temperature: logits are divided by it.
        coverage: the probability with which a set holds the true class.
        set_limit: a class is in the set if 1 - p is at most this.
        false_alarms: the probability with which a known touch is called novel.
        novelty_limit: a touch is novel above it.
        recordings: how many groups the limits come from.
        whitening: f32 (d, d), see `reference_space`.
        references: f32 (m, d), scaled training features times `whitening`.
        sensors: (m,), those of the references.
    """

    temperature: float
    coverage: float
    set_limit: float
    false_alarms: float
    novelty_limit: float
    recordings: int
    whitening: Array
    references: Array
    sensors: Array

    def novelty(self, x: Array) -> Array:
        """Return the novelty f64 (n,) of scaled features (n, d): about 0 for a training touch."""
        return novelty_scores(x @ self.whitening, self.references)

    @staticmethod
    def from_arrays(arrays: Mapping[str, Array], width: int) -> Calibration | None:
        """Return the calibration among the arrays of a head for `width` features, or None.

        Raises KeyError or ValueError for arrays that do not fit.
        """
        if not any(name.startswith("calibration/") for name in arrays):
            return None
        names = [field.name for field in dataclasses.fields(Calibration)]
        values: dict[str, Any] = {name: arrays[f"calibration/{name}"] for name in names}
        count = max(len(values["references"]), 1)
        shapes = {"whitening": (width, width), "references": (count, width), "sensors": (count,)}
        for name, value in values.items():
            if name in shapes:
                check_array(name, value, shapes[name], "U" if name == "sensors" else "f")
            elif value.shape != () or value.dtype.kind not in "fi" or np.isnan(value):
                raise ValueError(f"its {name} is no number")
            else:
                values[name] = value.item()
        if not 0 < values["temperature"] < np.inf:
            raise ValueError(f"its temperature is {values['temperature']}")
        return Calibration(**values)

    def sensor_warning(self, x: Array, sensor: str) -> str:
        """Return a sentence if most scaled features (n, d) are not of the `sensor` that was named.

        Else it is "". Each feature looks like the sensor whose references are nearest.
        """
        if len(x) < _FEWEST:
            return ""
        known = np.unique(self.sensors)
        if sensor not in known:
            return (
                f"The head was fitted on {', '.join(known)}, not on {sensor}. Do not trust its "
                "classes."
            )
        whitened = x @ self.whitening
        away = [novelty_scores(whitened, self.references[self.sensors == name]) for name in known]
        looks, counts = np.unique(known[np.argmin(away, axis=0)], return_counts=True)
        commonest = looks[counts.argmax()]
        own = counts[looks == sensor].sum()
        if own <= (1 - _OTHERS) * len(x) and commonest != sensor:
            return (
                f"{counts.max()} of {len(x)} frames look like {commonest}, not {sensor}. Check "
                "--sensor, --rotate and --flip."
            )
        novel = np.mean(self.novelty(x) > self.novelty_limit)
        # Four times the false alarms: frames of one recording are novel together.
        if novel > max(_OTHERS, 4 * self.false_alarms):
            return (
                f"{novel:.0%} of the frames are unlike every touch of {sensor} that the head was "
                "fitted on. Check the sensor's name, its orientation and its background."
            )
        return ""

    def promises(self) -> list[str]:
        """Return sentences on what the limits promise, and on those that need more groups."""
        novel_limit = 1 - self.false_alarms
        sentences = [
            f"calibrated on {self.recordings} groups (temperature {self.temperature:.2f}): "
            f"sets hold the true class in {self.coverage:.0%} of touches, "
            f"{self.false_alarms:.0%} of known touches are called novel"
        ]
        for limit, level, what in (
            (self.set_limit, self.coverage, "sets hold every class"),
            (self.novelty_limit, novel_limit, "no touch is novel"),
        ):
            if np.isinf(limit):
                fewest = int(np.ceil(level / (1 - level) - 1e-9))
                sentences.append(f"{level:.0%} takes {fewest} groups or more. With fewer {what}.")
        return sentences


@shown_short
class Assessment(NamedTuple):
    """Predictions for n touches, and whether to believe them.

    A touch whose set has not exactly one class is not decided: abstain. So is one that is `novel`.

    Attributes:
        label: (n,) str, the likeliest class.
        p: (n, K), probabilities.
        in_set: bool (n, K), conformal sets.
        novelty: (n,), distance from known touches.
        novel: bool (n,).
    """

    label: Array
    p: Array
    in_set: Array
    novelty: Array
    novel: Array

    @property
    def abstains(self) -> Array:
        """Whether the head should not be believed, bool (n,)."""
        return (self.in_set.sum(1) != 1) | self.novel


class CalibrationRows(NamedTuple):
    """The rows that a head is calibrated on.

    Attributes:
        logits: (n, columns) of rows that no fit saw.
        y: (n,) str, their classes.
        held_out: (n,), their groups.
        features: (N, d) of all rows, of which `fit` were fitted on and `val` were not.
        groups: (N,), groups of all rows.
        sensors: (N,), sensors of all rows.
        fit: row numbers.
        val: row numbers.
        tuned: the encoder was trained on the rows of `fit`, whose features are thus no sample of
            those to come.
    """

    logits: Array
    y: Array
    held_out: Array
    features: Array
    groups: Array
    sensors: Array
    fit: Array
    val: Array
    tuned: bool = False


def calibrate(
    rows: CalibrationRows,
    classes: Array,
    x: Array,
    *,
    coverage: float = COVERAGE,
    false_alarms: float = FALSE_ALARMS,
) -> Calibration:
    """Return the calibration of a head.

    Args:
        rows: what it is calibrated on.
        classes: (K,) str, sorted, those of the head.
        x: f32 (N, d), `rows.features` scaled as the head does.
        coverage: the probability with which sets shall hold the true class.
        false_alarms: the probability with which a known touch may be called novel.

    Raises:
        UserError: no row has a known class.
    """
    known = np.isin(rows.y, classes)
    if not known.any():
        raise UserError(
            "No row is left to calibrate on. Give rows of split val, or classes of several groups."
        )
    z = rows.logits[known].astype(np.float64)
    held_out = rows.held_out[known]
    truth = np.searchsorted(classes, rows.y[known])
    temperature = modest_temperature(z, held_out, fit_temperature(z, truth, held_out))
    p = probabilities(z, temperature)
    # The score of a row is what its true class lacks to certainty. Sets are those of Sadinle, Lei
    # and Wasserman (2019): every class whose score is at most the limit.
    set_limit = conformal_limit(1 - p[np.arange(len(truth)), truth], held_out, coverage)

    return Calibration(
        temperature=temperature,
        recordings=len(np.unique(held_out)),
        coverage=coverage,
        set_limit=set_limit,
        **known_touches(rows, x, false_alarms),
    )


def calibrate_number(
    rows: CalibrationRows, x: Array, *, coverage: float, false_alarms: float
) -> Calibration:
    """Return the calibration of a head of numbers, whose `set_limit` is half of an interval.

    The errors of held-out groups are the scores of split conformal prediction (Lei et al.,
    "Distribution-free predictive inference for regression", 2018).

    Args:
        rows: `logits` (n, 1) are predictions, and `y` f64 (n,) the truth.
        x: f32 (N, d), `rows.features` scaled as the head does.
        coverage: the probability with which an interval shall hold the truth.
        false_alarms: the probability with which a known touch may be called novel.
    """
    errors = np.abs(rows.logits[:, 0] - rows.y)
    half = conformal_limit(errors, rows.held_out, coverage)
    return Calibration(
        temperature=1.0,
        recordings=len(np.unique(rows.held_out)),
        coverage=coverage,
        set_limit=half,
        **known_touches(rows, x, false_alarms),
    )


def known_touches(rows: CalibrationRows, x: Array, false_alarms: float) -> dict[str, Any]:
    """Return the fields of a calibration that tell new touches from known ones.

    `x` f32 (N, d) are the scaled features.
    """
    fit_groups = rows.groups[rows.fit]
    owners = rows.groups[rows.val]
    whitening, chosen, references = reference_space(x[rows.fit], fit_groups)
    scores = novelty_scores(x[rows.val] @ whitening, references, owners, fit_groups[chosen])
    # Fewer than five groups are expected above the limit, so it would be noise. Rows of `fit` help,
    # if each is scored by groups that it does not belong to.
    if len(np.unique(owners)) * false_alarms < 5 and not rows.tuned:
        scores = np.concatenate([scores, left_out_scores(x[rows.fit], fit_groups)])
        owners = np.concatenate([owners, fit_groups])
    return {
        "false_alarms": false_alarms,
        "novelty_limit": conformal_limit(scores, owners, 1 - false_alarms),
        "whitening": whitening,
        "references": references,
        "sensors": rows.sensors[rows.fit[chosen]],
    }


def probabilities(logits: Array, temperature: float = 1.0) -> Array:
    """Return probabilities (n, K) of logits (n, K), or (n, 1) of two classes."""
    scaled = logits / temperature
    if scaled.shape[1] == 1:
        return np.concatenate([expit(-scaled), expit(scaled)], axis=1)
    return np.asarray(softmax(scaled, axis=1))


def fit_temperature(logits: Array, y: Array, groups: Array) -> float:
    """Return the temperature, 0.05 to 20, that minimises the log loss.

    One number for all classes does not change which class is likeliest (Guo et al., "On calibration
    of modern neural networks", 2017).

    Args:
        logits: (n, K), or (n, 1) of two classes.
        y: (n,), class numbers.
        groups: (n,), each of which has the same weight.
    """
    both = logits
    if logits.shape[1] == 1:
        both = np.concatenate([np.zeros_like(logits), logits], axis=1)
    weights = group_weights(groups)
    rows = np.arange(len(y))

    def loss(power: float) -> float:
        of_class = log_softmax(both / np.exp(power), axis=1)[rows, y]
        return float(-(weights * of_class).sum())

    # The loss is convex in the inverse temperature, so it has one minimum in the logarithm too.
    bounds = tuple(np.log((0.05, 20.0)))
    return float(np.exp(minimize_scalar(loss, bounds=bounds, method="bounded").x))


def support(groups: int) -> float:
    """Return the probability that the next group is right, when all of some `groups` were.

    It is Laplace's rule of succession: seven recordings that were all right support 8/9.
    """
    return (groups + 1) / (groups + 2)


def modest_temperature(logits: Array, groups: Array, least: float) -> float:
    """Return a temperature of at least `least` whose confidence the groups support.

    The log loss of a few groups that are all right falls as long as confidence rises, so its
    minimum is as sure as the bounds allow. The mean confidence shall not exceed `support`.

    Args:
        logits: (n, K), or (n, 1) of two classes.
        groups: (n,), each of which has the same weight.
        least: the temperature that was fitted.
    """
    weights = group_weights(groups)
    most = support(len(np.unique(groups)))

    def excess(power: float) -> float:
        p = probabilities(logits, float(np.exp(power)))
        return float((weights * p.max(axis=1)).sum()) - most

    low = float(np.log(least))
    if excess(low) <= 0:
        return least
    high = low + 1.0
    # At an infinite temperature all classes are equal, and `support` is at least 2/3.
    while excess(high) > 0:
        high += 1.0
    return float(np.exp(brentq(excess, low, high)))


def group_weights(groups: Array) -> Array:
    """Return weights (n,) that sum to 1, equal for every group and for every row of a group."""
    _, ids, counts = np.unique(groups, return_inverse=True, return_counts=True)
    return 1 / (counts[ids] * len(counts))


def conformal_limit(scores: Array, groups: Array, fraction: float) -> float:
    """Return the limit that a score of a new group is at most with probability `fraction`.

    Groups have equal weight. Two limits are computed, and the lower one counts:

    * the hierarchical conformal limit (Lee, Barber and Willett 2023): the weighted quantile of all
      scores, with one more group that is infinite. With one row a group it is the split conformal
      limit, the score of rank ceil((n + 1) * share). It is infinite below share / (1 - share)
      groups, and covers more than asked if the rows of a group differ.
    * the limit at which each group in turn is covered by the others as often as asked, on average.

    Args:
        scores: (n,), finite or infinite.
        groups: (n,).
        fraction: the probability, between 0 and 1.

    Raises:
        UserError: a `fraction` outside 0..1, no scores, or NaN.
    """
    scores = np.asarray(scores, np.float64)
    groups = np.asarray(groups)
    if not isinstance(fraction, int | float | np.number) or not 0 < fraction < 1:
        raise UserError(f"A coverage must lie between 0 and 1, not {fraction!r}.")
    if not scores.size or scores.shape != groups.shape or np.isnan(scores).any():
        raise UserError(
            f"A limit needs scores (n,) without NaN and as many groups, not {scores.shape} "
            f"{groups.shape}."
        )
    order = np.argsort(scores, kind="stable")
    scores = scores[order]
    ids = np.unique(groups, return_inverse=True)[1][order]
    count = ids.max() + 1
    weights = group_weights(ids)
    mass = np.cumsum(weights)  # of all rows up to each
    # The further group takes 1 / (count + 1) of the mass, and lies behind all scores.
    with_one_more = mass * count / (count + 1)
    place = int(np.searchsorted(with_one_more, fraction - _ROUNDING))
    if place == len(scores):
        return np.inf

    # The mass of a row's own group up to it. Rows by group have one cumulative sum, from which the
    # whole groups before are taken away: each of these has 1 / count.
    own = np.empty(len(ids))
    by_group = np.argsort(ids, kind="stable")
    own[by_group] = np.cumsum(weights[by_group]) - ids[by_group] / count
    # The mass of the others up to each row, where the others alone are the whole.
    below = (mass - own) * count / max(count - 1, 1)
    # `level` is the mass of the others up to which a limit must reach, so that of all rows, weighed
    # by group, `fraction` lie below the limit of their group.
    turn = np.argsort(below, kind="stable")
    covered = np.cumsum(weights[turn])
    last = int(np.searchsorted(covered, fraction - _ROUNDING))
    level = below[turn][min(last + 1, len(turn) - 1)]
    by_others = int(np.searchsorted(mass, level - _ROUNDING))
    return float(scores[min(place, by_others)])


def novelty_scores(
    x: Array,
    references: Array,
    groups: Array | None = None,
    reference_groups: Array | None = None,
) -> Array:
    """Return the mean distance f64 (n,) of rows to their nearest references.

    Distances to nearest neighbours tell new from known without a model of either (Sun et al.,
    "Out-of-distribution detection with deep nearest neighbors", 2022).

    Args:
        x: (n, d), in the space of `reference_space`.
        references: (m, d).
        groups: (n,), if references of a row's own group do not count. A row without any other is at
            an infinite distance.
        reference_groups: (m,).
    """
    scores = np.empty(len(x))
    # Converted and squared once, because live touch waits for each frame.
    references = references.astype(np.float64)
    squares = np.einsum("ij,ij->i", references, references)
    for start in range(0, len(x), _CHUNK):
        part = x[start : start + _CHUNK].astype(np.float64)
        square = np.square(part).sum(1)[:, None] + squares - 2 * part @ references.T
        if groups is not None:
            same = groups[start : start + _CHUNK, None] == np.asarray(reference_groups)[None]
            square[same] = np.inf
        k = min(NEIGHBOURS, square.shape[1])
        nearest = np.partition(square, k - 1, axis=1)[:, :k]
        # The difference of two large numbers may be just below zero.
        scores[start : start + _CHUNK] = np.sqrt(np.maximum(nearest, 0)).mean(1)
    return scores


def reference_space(x: Array, groups: Array) -> tuple[Array, Array, Array]:
    """Return the space in which distances are novelty, and the references in it.

    Whitened features make a Euclidean distance a Mahalanobis one (Lee et al., "A simple unified
    framework for detecting out-of-distribution samples", 2018). Every direction gets equal spread,
    but those of almost none only a tenth: there a touch differs by noise.

    Args:
        x: (n, d), scaled features.
        groups: (n,).

    Returns:
        The whitening f32 (d, d), numbers (m,) of reference rows, and these, whitened. At most
        REFERENCES rows are references, evenly spread over the groups.
    """
    width = x.shape[1]
    covariance = np.cov(x.astype(np.float64), rowvar=False).reshape(width, width)
    # One thread: beside a live page several wait for each other, which took ten times as long.
    with threadpool_limits(1):
        values, vectors = np.linalg.eigh(covariance)
    # A hundredth of the mean variance is a tenth of the spread.
    spread = np.sqrt(np.maximum(values, 0) + max(0.01 * values.mean(), 1e-12))
    whitening = np.asarray(vectors / spread, np.float32)
    order = np.argsort(groups, kind="stable")
    places = np.linspace(0, len(order) - 1, min(REFERENCES, len(order))).astype(int)
    chosen = np.sort(order[np.unique(places)])
    return whitening, chosen, x[chosen] @ whitening


def left_out_scores(x: Array, groups: Array) -> Array:
    """Return the novelty (n,) of scaled features (n, d) by other groups alone.

    A fifth of the groups is left out in turn. Leaving out their references is not enough: a
    whitening that has seen a row stretches its direction less, and the row looks too familiar.
    """
    part = np.unique(groups, return_inverse=True)[1] % 5
    scores = np.full(len(x), np.inf)
    for number in range(5):
        out = part == number
        if (~out).sum() > 1 and out.any():
            whitening, _, references = reference_space(x[~out], groups[~out])
            scores[out] = novelty_scores(x[out] @ whitening, references)
    return scores
