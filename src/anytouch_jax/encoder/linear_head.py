"""Saved linear heads, and their calibration: temperature, conformal sets, abstention, novelty,
contact and sensor.

All limits come from touches that the head was not fitted on. Every recording has the same weight,
since its frames are alike. A limit holds for a frame of a new recording from the same source, on
average over recordings (Lee, Barber and Willett 2023).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import minimize_scalar
from scipy.special import expit, log_softmax, softmax

from anytouch_jax.data.background.contact import DEFAULT_THRESHOLD, THRESHOLDS
from anytouch_jax.data.background.estimate import UntouchedGel
from anytouch_jax.data.background.rule import gel_arrays, gels_of_arrays
from anytouch_jax.encoder.arrays import Array, Pooling
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, check_array, read_arrays
from anytouch_jax.shown import described, shown_short

if TYPE_CHECKING:
    from anytouch_jax.encoder.base import Preprocess

FORMATS = ("anytouch_jax.head.2", "anytouch_jax.head.1")  # the second has no calibration
# defaults: share of sets that hold the class, share of known touches called novel
COVERAGE = 0.9
FALSE_ALARMS = 0.05
NEIGHBOURS = 5  # nearest training touches in the novelty score
# training touches that a head stores; more change a score by less than its noise
REFERENCES = 2048
# frames, and share of them that look like another sensor, until that is reported
_FEWEST = 8
_OTHERS = 0.5
_CHUNK = 1024


@shown_short
@dataclass(frozen=True, eq=False)
class Calibration:
    """What a head knows about its own errors.

    Logits are divided by `temperature`. A class is in the set if 1 - p is at most `set_limit`: such
    sets hold the true class in a share `coverage` of touches. A touch is novel above
    `novelty_limit`, which a share `false_alarms` of known touches exceed. `references` f32 (m, d)
    are scaled training features times `whitening` f32 (d, d), of `sensors` (m,). With too few
    `recordings` a limit is infinite.
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
        """Return the calibration among arrays for `width` features, or None.

        Raises KeyError or ValueError.
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
        """Return a sentence if most scaled features (n, d) are not of the `sensor` that the user
        named, else "".
        """
        if len(x) < _FEWEST:
            return ""
        known = np.unique(self.sensors)
        if sensor not in known:
            return (
                f"The head was fitted on {', '.join(known)}, not on {sensor}. Do not trust its "
                "classes."
            )
        away = [
            novelty_scores(x @ self.whitening, self.references[self.sensors == name])
            for name in known
        ]
        looks, counts = np.unique(known[np.argmin(away, axis=0)], return_counts=True)
        if (counts[looks == sensor].sum() <= (1 - _OTHERS) * len(x)) and looks[
            counts.argmax()
        ] != sensor:
            return (
                f"{counts.max()} of {len(x)} frames look like {looks[counts.argmax()]}, not "
                f"{sensor}. "
                "Check --sensor, --rotate and --flip."
            )
        novel = np.mean(self.novelty(x) > self.novelty_limit)
        if novel > max(_OTHERS, 4 * self.false_alarms):
            return (
                f"{novel:.0%} of the frames are unlike every touch of {sensor} that the head was "
                "fitted on. "
                "Check the sensor's name, its orientation and its background."
            )
        return ""


@shown_short
class Assessment(NamedTuple):
    """Predictions for n touches: likeliest class (n,) str, `p` f32 (n, K), conformal sets bool (n,
    K), novelty (n,).

    A touch whose set has not exactly one class is not decided: abstain. So is one that is `novel`
    (n,).
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


@dataclass(frozen=True, eq=False)
class LinearHead:
    """A saved linear classifier of features, with its calibration (None in files of older
    versions).

    `classes` (K,) str; `weights` (d, columns) and `bias` (columns,), one column for two classes,
    else K; features minus `mean` (d,) are divided by `scale` (d,). It predicts `label` from
    features of `frames` a touch and `pooling` by the encoder with that `fingerprint`. `gels` are
    pictures of the untouched gel by unit.
    """

    classes: Array
    weights: Array
    bias: Array
    mean: Array
    scale: Array
    label: str
    pooling: Pooling
    frames: int
    fingerprint: str
    calibration: Calibration | None = None
    gels: dict[str, Array] = field(default_factory=dict)

    def __repr__(self) -> str:
        classes, more = self.classes.tolist(), len(self.classes) - 8
        return described(
            f"LinearHead for {self.label}",
            classes=(
                f"{len(classes)}: {', '.join(classes[:8])}{f' and {more} more' if more > 0 else ''}"
            ),
            input=f"features of {len(self.mean)}, pooling {self.pooling}, frames {self.frames}",
            encoder=self.fingerprint,
            calibration="; ".join(self.promises()) or "none",
        )

    def __call__(self, features: npt.ArrayLike) -> tuple[Array, Array]:
        """Return the likeliest class (n,) str and probabilities f32 (n, K) of features (n, d)."""
        temperature = 1.0 if self.calibration is None else self.calibration.temperature
        p = probabilities(self.scaled(features) @ self.weights + self.bias, temperature)
        return self.classes[p.argmax(1)], p

    def scaled(self, features: npt.ArrayLike) -> Array:
        """Return features (n, d) minus the mean, over the scale.

        Raises UserError for another shape.
        """
        x = np.asarray(features, np.float32)
        if x.ndim != 2 or x.shape[1] != len(self.mean):
            raise UserError(f"This head reads features (n, {len(self.mean)}), not {x.shape}.")
        return (x - self.mean) / self.scale

    def assess(self, features: npt.ArrayLike) -> Assessment:
        """Return what the head predicts for features (n, d), and whether to believe it.

        UserError if uncalibrated.
        """
        label, p = self(features)
        known = self.calibration
        if known is None:
            raise UserError(
                "This head has no calibration. Save it again with `anytouch probe label --save`."
            )
        distance = known.novelty(self.scaled(features))
        return Assessment(
            label, p, 1 - p <= known.set_limit, distance, distance > known.novelty_limit
        )

    def calibrated(
        self,
        logits: Array,
        y: Array,
        held_out: Array,
        features: Array,
        groups: Array,
        sensors: Array,
        fit: Array,
        val: Array,
        *,
        coverage: float = COVERAGE,
        false_alarms: float = FALSE_ALARMS,
    ) -> LinearHead:
        """Return the head with a calibration from `logits` (n, columns) of rows that no fit saw.

        `y` (n,) str and `held_out` (n,) are their classes and groups. `features` (N, d), `groups`
        (N,) and `sensors` (N,) are of all rows, of which `fit` were fitted on and `val` were not.
        Raises UserError without a known class.
        """
        known = np.isin(y, self.classes)
        if not known.any():
            raise UserError(
                "No row is left to calibrate on. Give rows of split val, or classes of several "
                "groups."
            )
        z = logits[known].astype(np.float64)
        held_out = held_out[known]
        truth = np.searchsorted(self.classes, y[known])
        temperature = fit_temperature(z, truth, held_out)
        p = probabilities(z, temperature)
        limit = conformal_limit(1 - p[np.arange(len(truth)), truth], held_out, coverage)
        x = self.scaled(features)
        owners = groups[val]
        whitening, chosen, references = reference_space(x[fit], groups[fit])
        scores = novelty_scores(x[val] @ whitening, references, owners, groups[fit[chosen]])
        if len(np.unique(owners)) * false_alarms < 5:  # few for a limit: rows of `fit` help
            scores = np.concatenate([scores, left_out_scores(x[fit], groups[fit])])
            owners = np.concatenate([owners, groups[fit]])
        novel = conformal_limit(scores, owners, 1 - false_alarms)
        limits = (coverage, limit, false_alarms, novel, len(np.unique(held_out)))
        return replace(
            self,
            calibration=Calibration(
                temperature, *limits, whitening, references, sensors[fit[chosen]]
            ),
        )

    def promises(self) -> list[str]:
        """Return sentences on what the limits of the calibration promise, and on those that need
        more groups.
        """
        known = self.calibration
        if known is None:
            return []
        sets = f"the true class in {known.coverage:.0%} of touches"
        novel = f"{known.false_alarms:.0%} of known touches"
        about = f"calibrated on {known.recordings} groups (temperature {known.temperature:.2f})"
        return [f"{about}: sets hold {sets}, {novel} are called novel"] + [
            f"{share:.0%} takes {int(np.ceil(share / (1 - share) - 1e-9))} groups or more. With "
            f"fewer {what}."
            for limit, share, what in (
                (known.set_limit, known.coverage, "sets hold every class"),
                (known.novelty_limit, 1 - known.false_alarms, "no touch is novel"),
            )
            if np.isinf(limit)
        ]

    def check(
        self, source: str, fingerprint: str, pooling: str, frames: int, join: str = "mean"
    ) -> None:
        """Raise UserError unless the head was fitted on features of that encoder, pooling and
        number of frames.
        """
        pairs = (
            ("pooling", self.pooling, pooling),
            ("frames", self.frames, frames),
            ("join", "mean", join),
        )
        wrong = [f"--{name} {own}" for name, own, other in pairs if own != other]
        if wrong:
            raise UserError(f"The head was fitted on other features. Give {' '.join(wrong)}.")
        if fingerprint != self.fingerprint:
            raise UserError(
                f"The head was fitted on features of another encoder ({self.fingerprint}) than "
                f"{source} "
                f"({fingerprint}). Fit one with `anytouch probe label --save`."
            )


def save_head(path: str | Path, head: LinearHead) -> None:
    """Write a head as `.npz` atomically. Raises OSError."""
    known = head.calibration
    arrays = {
        "mark" if name == "fingerprint" else name: value for name, value in vars(head).items()
    }
    del arrays["calibration"]
    arrays |= gel_arrays(arrays.pop("gels"))
    arrays |= (
        {}
        if known is None
        else {f"calibration/{name}": np.asarray(value) for name, value in vars(known).items()}
    )
    with atomic_path(path) as part, open(part, "wb") as file:
        np.savez(file, format=FORMATS[known is None], **arrays)


def load_head(path: str | Path) -> LinearHead:
    """Load the head that `anytouch probe label --save` wrote.

    Raises UserError for any other file.
    """
    if not Path(path).is_file():
        raise UserError(f"There is no head {path}. `anytouch probe label --save` writes one.")
    try:
        arrays: dict[str, Any] = read_arrays(path)
        for name in ("format", "label", "pooling", "mark"):
            if (
                arrays[name].shape != ()
                or arrays[name].dtype.kind != "U"
                or arrays[name].dtype.itemsize > 4096
            ):
                raise ValueError(f"{name} is not a short text")
            arrays[name] = str(arrays[name])
        if arrays.pop("format") not in FORMATS:
            raise ValueError("it has no format of a head")
        check_array("frames", arrays["frames"], (), "iu")
        known = Calibration.from_arrays(arrays, len(arrays["mean"]))
        gels = gels_of_arrays(arrays)
        arrays = {
            name: value
            for name, value in arrays.items()
            if not name.startswith(("calibration/", "gel"))
        }
        about = {"frames": int(arrays.pop("frames")), "fingerprint": arrays.pop("mark")}
        head = LinearHead(calibration=known, gels=gels, **about, **arrays)
        _check_head(head)
        return head
    except (OSError, ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else error
        message = (
            f"{path} is not the head of a probe ({reason}). `anytouch probe label --save` writes "
            "one."
        )
        raise UserError(message) from None


def _check_head(head: LinearHead) -> None:
    """Raise ValueError for arrays of a head that do not fit together or are not finite."""
    count = len(head.classes)
    width = len(head.mean)
    columns = 1 if count == 2 else count
    shapes = {
        "classes": (count,),
        "weights": (width, columns),
        "bias": (columns,),
        "mean": (width,),
        "scale": (width,),
    }
    for name, shape in shapes.items():
        check_array(name, getattr(head, name), shape, "U" if name == "classes" else "f")
    if (
        count < 2
        or not width
        or not (head.scale > 0).all()
        or not (head.label and head.fingerprint)
    ):
        raise ValueError(
            "it needs two classes, features, scales above 0, a label and the mark of an encoder"
        )
    if len(set(head.classes)) < count:
        raise ValueError("it has a class twice")
    if head.pooling not in ("class", "mean", "both") or not 0 < head.frames < 1 << 20:
        raise ValueError(f"it has pooling {head.pooling[:40]} and {head.frames} frames")


class ContactGate:
    """Contact of frames of one sensor, by the difference from `background`: a picture, a
    `Preprocess`, or None.
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
            self._picture = picture
            self._gel = None if picture is None else UntouchedGel(picture)
        try:
            if self._gel is None:
                return np.nan
            return float(self._gel.score(frame) > self.threshold)
        except ValueError as error:
            raise UserError(
                f"Contact cannot be decided: {error}. Give a --background of this camera."
            ) from None


def probabilities(logits: Array, temperature: float = 1.0) -> Array:
    """Return probabilities (n, K) of logits (n, K), or (n, 1) of two classes."""
    scaled = logits / temperature
    if scaled.shape[1] == 1:
        return np.concatenate([expit(-scaled), expit(scaled)], axis=1)
    return np.asarray(softmax(scaled, axis=1))


def fit_temperature(logits: Array, y: Array, groups: Array) -> float:
    """Return the temperature that minimises the log loss of class numbers `y` (n,), 0.05 to 20 (Guo
    et al. 2017).

    `logits` (n, K), or (n, 1) of two classes. Each of the `groups` (n,) has the same weight.
    """
    both = (
        np.concatenate([np.zeros_like(logits), logits], axis=1) if logits.shape[1] == 1 else logits
    )
    weights = group_weights(groups)

    def loss(power: float) -> float:
        return float(
            -(weights * log_softmax(both / np.exp(power), axis=1)[np.arange(len(y)), y]).sum()
        )

    bounds = tuple(np.log((0.05, 20.0)))
    return float(np.exp(minimize_scalar(loss, bounds=bounds, method="bounded").x))


def group_weights(groups: Array) -> Array:
    """Return weights (n,) that sum to 1, equal for every group and for every row of a group."""
    _, ids, counts = np.unique(groups, return_inverse=True, return_counts=True)
    return 1 / (counts[ids] * len(counts))


def conformal_limit(scores: Array, groups: Array, share: float) -> float:
    """Return the limit that a score of a new group is at most with probability `share`.

    `scores` (n,) are of rows in `groups` (n,), which have equal weight. The limit covers each group
    in turn by the others. At most it is the limit for groups of equal rows, with one more group
    that is infinite. It is infinite below share / (1 - share) groups. Raises UserError for a
    `share` outside 0..1, no scores or NaN.
    """
    scores = np.asarray(scores, np.float64)
    groups = np.asarray(groups)
    if not isinstance(share, int | float | np.number) or not 0 < share < 1:
        raise UserError(f"A coverage must lie between 0 and 1, not {share!r}.")
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
    mass = np.cumsum(weights)
    place = int(np.searchsorted(mass * count / (count + 1), share - 1e-12))
    if place == len(scores):
        return np.inf
    own = np.empty(len(ids))
    by_group = np.argsort(ids, kind="stable")
    # mass of the row's group up to it
    own[by_group] = np.cumsum(weights[by_group]) - ids[by_group] / count
    # mass of the others below each row
    below = (mass - own) * count / max(count - 1, 1)
    turn = np.argsort(below, kind="stable")
    level = below[turn][
        min(int(np.searchsorted(np.cumsum(weights[turn]), share - 1e-12)) + 1, len(turn) - 1)
    ]
    return float(scores[min(place, int(np.searchsorted(mass, level - 1e-12)))])


def novelty_scores(
    x: Array, references: Array, groups: Array | None = None, reference_groups: Any = None
) -> Array:
    """Return the mean distance f64 (n,) of rows (n, d) to their nearest `references` (m, d) of
    other groups, or inf.
    """
    # once: live touch waits for it
    scores = np.empty(len(x))
    references = references.astype(np.float64)
    squares = np.einsum("ij,ij->i", references, references)
    for start in range(0, len(x), _CHUNK):
        part = x[start : start + _CHUNK].astype(np.float64)
        square = np.square(part).sum(1)[:, None] + squares - 2 * part @ references.T
        if groups is not None:
            square[groups[start : start + _CHUNK, None] == np.asarray(reference_groups)[None]] = (
                np.inf
            )
        k = min(NEIGHBOURS, square.shape[1])
        scores[start : start + _CHUNK] = np.sqrt(
            np.maximum(np.partition(square, k - 1, axis=1)[:, :k], 0)
        ).mean(1)
    return scores


def reference_space(x: Array, groups: Array) -> tuple[Array, Array, Array]:
    """Return a whitening f32 (d, d) by scaled features (n, d), numbers (m,) of reference rows, and
    these, whitened.

    It gives every direction equal spread, but those of almost none only a tenth. At most REFERENCES
    rows, evenly spread over the `groups` (n,), are references.
    """
    values, vectors = np.linalg.eigh(
        np.cov(x.astype(np.float64), rowvar=False).reshape(x.shape[1], x.shape[1])
    )
    spread = np.sqrt(np.maximum(values, 0) + max(0.01 * values.mean(), 1e-12))
    whitening = np.asarray(vectors / spread, np.float32)
    order = np.argsort(groups, kind="stable")
    chosen = np.linspace(0, len(order) - 1, min(REFERENCES, len(order))).astype(int)
    chosen = np.sort(order[np.unique(chosen)])
    return whitening, chosen, x[chosen] @ whitening


def left_out_scores(x: Array, groups: Array) -> Array:
    """Return the novelty (n,) of scaled features (n, d) by other groups alone: a fifth is left out
    in turn.
    """
    # A whitening that has seen a row stretches its direction less, and the row looks too familiar.
    part = np.unique(groups, return_inverse=True)[1] % 5
    scores = np.full(len(x), np.inf)
    for out in (part == number for number in range(5)):
        if (~out).sum() > 1 and out.any():
            whitening, _, references = reference_space(x[~out], groups[~out])
            scores[out] = novelty_scores(x[out] @ whitening, references)
    return scores
