"""Calibration of a head: temperature, conformal sets, abstention, novelty, contact, and the sensor of a touch.

All limits come from touches that the head was not fitted on. Recordings are the unit of chance, since frames of one
recording are alike: every recording has the same weight. A limit holds for a frame of a new recording from the same
source as the calibration, on average over recordings (Lee, Barber and Willett 2023).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar
from scipy.special import expit, log_softmax, softmax

from anytouch_jax.data.prepare.contact import DEFAULT_THRESHOLD, THRESHOLDS
from anytouch_jax.data.prepare.untouched_gel import UntouchedGel
from anytouch_jax.errors import UserError
from anytouch_jax.files import check_array
from anytouch_jax.shown import shown_short

if TYPE_CHECKING:
    from anytouch_jax.encoder.base import Preprocess

Array = npt.NDArray[Any]

COVERAGE, FALSE_ALARMS = 0.9, 0.05  # defaults: share of sets that hold the class, share of known touches called novel
NEIGHBOURS = 5  # nearest training touches in the novelty score
REFERENCES = 2048  # training touches that a head stores; more change a score by less than its noise
_FEWEST, _OTHERS = 8, 0.5  # frames, and share of them that look like another sensor, until that is reported
_CHUNK = 1024


@shown_short
@dataclass(frozen=True, eq=False)
class Calibration:
    """What a head knows about its own errors.

    Logits are divided by `temperature`. A class is in the set if 1 - p is at most `set_limit`: such sets hold the true
    class in a share `coverage` of touches. A touch is novel above `novelty_limit`, which a share `false_alarms` of
    known touches exceed. `references` f32 (m, d) are training features, scaled and then multiplied by `whitening`
    f32 (d, d). `sensors` (m,) are theirs. `recordings`: how many the limits come from. With too few of them a limit is
    infinite.
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
        """Return the calibration among the arrays of a file, None if it has none.

        `width`: the number of features. Raises KeyError or ValueError for arrays that do not fit.
        """
        if not any(name.startswith("calibration/") for name in arrays):
            return None
        values: dict[str, Any] = {
            field.name: arrays[f"calibration/{field.name}"] for field in dataclasses.fields(Calibration)
        }
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
        """Return a sentence if scaled features (n, d) are not of the `sensor` that the user named, else "".

        Most frames must look like touches of another sensor, or of none.
        """
        if len(x) < _FEWEST:
            return ""
        known = np.unique(self.sensors)
        if sensor not in known:
            return f"The head was fitted on {', '.join(known)}, not on {sensor}. Do not trust its classes."
        away = [novelty_scores(x @ self.whitening, self.references[self.sensors == name]) for name in known]
        looks, counts = np.unique(known[np.argmin(away, axis=0)], return_counts=True)
        if (counts[looks == sensor].sum() <= (1 - _OTHERS) * len(x)) and looks[counts.argmax()] != sensor:
            return (
                f"{counts.max()} of {len(x)} frames look like {looks[counts.argmax()]}, not {sensor}. "
                "Check --sensor, --rotate and --flip."
            )
        novel = np.mean(self.novelty(x) > self.novelty_limit)
        if novel > max(_OTHERS, 4 * self.false_alarms):
            return (
                f"{novel:.0%} of the frames are unlike every touch of {sensor} that the head was fitted on. "
                "Check the sensor's name, its orientation and its background."
            )
        return ""


@shown_short
class Assessment(NamedTuple):
    """Predictions for n touches: likeliest class (n,) str, `p` f32 (n, K), conformal sets bool (n, K), novelty (n,).

    A touch whose set has not exactly one class is not decided: abstain. So is one that is `novel` (n,).
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


class ContactGate:
    """Contact of frames of one sensor, by the difference from the untouched gel (`data.prepare.contact`).

    `background` is a picture RGB u8 (h, w, 3), a `Preprocess`, whose running estimate is used after it was called with
    the frame, or None: then contact stays unknown.
    """

    def __init__(self, background: Array | Preprocess | None, sensor: str) -> None:
        self._source: Any = background
        self._picture: Array | None = None
        self._gel: UntouchedGel | None = None
        self.threshold = THRESHOLDS.get(sensor, DEFAULT_THRESHOLD)

    def __call__(self, frame: Array) -> float:
        """Return 1 (contact), 0 (none) or NaN (unknown) of a frame RGB u8 (h, w, 3)."""
        picture = getattr(self._source, "background", self._source)
        if picture is not self._picture:
            self._picture, self._gel = picture, None if picture is None else UntouchedGel(picture)
        try:
            return np.nan if self._gel is None else float(self._gel.score(frame) > self.threshold)
        except ValueError as error:
            raise UserError(f"Contact cannot be decided: {error}. Give a --background of this camera.") from None


def probabilities(logits: Array, temperature: float = 1.0) -> Array:
    """Return probabilities (n, K) of logits (n, K), or (n, 1) of two classes."""
    scaled = logits / temperature
    if scaled.shape[1] == 1:
        return np.concatenate([expit(-scaled), expit(scaled)], axis=1)
    return np.asarray(softmax(scaled, axis=1))


def fit_temperature(logits: Array, y: Array, groups: Array) -> float:
    """Return the temperature that minimises the log loss of class numbers `y` (n,), 0.05 to 20 (Guo et al. 2017).

    `logits` (n, K), or (n, 1) of two classes. Each of the `groups` (n,) has the same weight.
    """
    both = np.concatenate([np.zeros_like(logits), logits], axis=1) if logits.shape[1] == 1 else logits
    weights = group_weights(groups)

    def loss(power: float) -> float:
        return float(-(weights * log_softmax(both / np.exp(power), axis=1)[np.arange(len(y)), y]).sum())

    bounds = tuple(np.log((0.05, 20.0)))
    return float(np.exp(minimize_scalar(loss, bounds=bounds, method="bounded").x))


def group_weights(groups: Array) -> Array:
    """Return weights (n,) that sum to 1, equal for every group and for every row of a group."""
    _, ids, counts = np.unique(groups, return_inverse=True, return_counts=True)
    return 1 / (counts[ids] * len(counts))


def conformal_limit(scores: Array, groups: Array, share: float) -> float:
    """Return the limit that a score of a new group is at most with probability `share`.

    `scores` (n,) are calibration scores of rows in `groups` (n,), which have equal weight. The limit covers each group
    in turn by the others. At most it is the limit for groups of equal rows, with one more group that is infinite. It is
    infinite below share / (1 - share) groups. Raises UserError for a `share` outside 0..1, no scores or NaN.
    """
    scores, groups = np.asarray(scores, np.float64), np.asarray(groups)
    if not isinstance(share, int | float | np.number) or not 0 < share < 1:
        raise UserError(f"A coverage must lie between 0 and 1, not {share!r}.")
    if not scores.size or scores.shape != groups.shape or np.isnan(scores).any():
        raise UserError(
            f"A limit needs scores (n,) without NaN and as many groups, not {scores.shape}, {groups.shape}."
        )
    order = np.argsort(scores, kind="stable")
    scores, ids = scores[order], np.unique(groups, return_inverse=True)[1][order]
    count, weights = ids.max() + 1, group_weights(ids)
    mass = np.cumsum(weights)
    place = int(np.searchsorted(mass * count / (count + 1), share - 1e-12))
    if place == len(scores):
        return np.inf
    own, by_group = np.empty(len(ids)), np.argsort(ids, kind="stable")
    own[by_group] = np.cumsum(weights[by_group]) - ids[by_group] / count  # mass of the row's group up to it
    below = (mass - own) * count / max(count - 1, 1)  # mass of the others below each row
    turn = np.argsort(below, kind="stable")
    level = below[turn][min(int(np.searchsorted(np.cumsum(weights[turn]), share - 1e-12)) + 1, len(turn) - 1)]
    return float(scores[min(place, int(np.searchsorted(mass, level - 1e-12)))])


def novelty_scores(x: Array, references: Array, groups: Array | None = None, reference_groups: Any = None) -> Array:
    """Return the mean distance f64 (n,) of rows (n, d) to their nearest `references` (m, d).

    References of a row's own group (n,), (m,) are left out. A row without any reference gets infinity.
    """
    scores, references = np.empty(len(x)), references.astype(np.float64)  # once: live touch waits for it
    squares = np.einsum("ij,ij->i", references, references)
    for start in range(0, len(x), _CHUNK):
        part = x[start : start + _CHUNK].astype(np.float64)
        square = np.square(part).sum(1)[:, None] + squares - 2 * part @ references.T
        if groups is not None:
            square[groups[start : start + _CHUNK, None] == np.asarray(reference_groups)[None]] = np.inf
        k = min(NEIGHBOURS, square.shape[1])
        scores[start : start + _CHUNK] = np.sqrt(np.maximum(np.partition(square, k - 1, axis=1)[:, :k], 0)).mean(1)
    return scores


def reference_space(x: Array, groups: Array) -> tuple[Array, Array, Array]:
    """Return a whitening f32 (d, d) by scaled features (n, d), numbers (m,) of reference rows, and these, whitened."""
    whitening, chosen = fit_whitening(x), choose_references(groups)
    return whitening, chosen, x[chosen] @ whitening


def left_out_scores(x: Array, groups: Array) -> Array:
    """Return the novelty (n,) of scaled features (n, d) by other groups alone: a fifth is left out in turn."""
    # A whitening that has seen a row stretches its direction less, and the row looks too familiar.
    part, scores = np.unique(groups, return_inverse=True)[1] % 5, np.full(len(x), np.inf)
    for out in (part == number for number in range(5)):
        if (~out).sum() > 1 and out.any():
            whitening, _, references = reference_space(x[~out], groups[~out])
            scores[out] = novelty_scores(x[out] @ whitening, references)
    return scores


def fit_whitening(x: Array) -> Array:
    """Return the matrix f32 (d, d) after which scaled features (n, d) have equal spread in every direction.

    Directions of almost no spread are not stretched further than a hundredth of the mean variance.
    """
    values, vectors = np.linalg.eigh(np.cov(x.astype(np.float64), rowvar=False).reshape(x.shape[1], x.shape[1]))
    return np.asarray(vectors / np.sqrt(np.maximum(values, 0) + max(0.01 * values.mean(), 1e-12)), np.float32)


def choose_references(groups: Array, most: int = REFERENCES) -> Array:
    """Return at most `most` row numbers, in order, evenly spread over the `groups` (n,)."""
    order = np.argsort(groups, kind="stable")
    return np.sort(order[np.unique(np.linspace(0, len(order) - 1, min(most, len(order))).astype(int))])
