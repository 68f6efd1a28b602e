"""Saved linear heads: classes of touches from features, with their calibration."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.data.gels import gel_arrays, gels_of_arrays
from anytouch_jax.encoder import novelty
from anytouch_jax.encoder.arrays import Pooling
from anytouch_jax.encoder.novelty import Assessment, Calibration
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, check_array, read_arrays
from anytouch_jax.shown import described

Array = npt.NDArray[Any]
FORMATS = ("anytouch_jax.head.2", "anytouch_jax.head.1")  # the second has no calibration


@dataclass(frozen=True, eq=False)
class LinearHead:
    """A saved linear classifier of features, with its calibration (None in files of older versions).

    `classes` (K,) str; `weights` (d, columns) and `bias` (columns,), one column for two classes, else K; features minus
    `mean` (d,) are divided by `scale` (d,). It predicts `label` from features of `frames` a touch and `pooling` by the
    encoder with that `fingerprint`. `gels` are pictures of the untouched gel by unit that its touches were less.
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
            classes=f"{len(classes)}: {', '.join(classes[:8])}{f' and {more} more' if more > 0 else ''}",
            input=f"features of {len(self.mean)}, pooling {self.pooling}, frames {self.frames}",
            encoder=self.fingerprint,
            calibration="; ".join(self.promises()) or "none",
        )

    def __call__(self, features: npt.ArrayLike) -> tuple[Array, Array]:
        """Return the likeliest class (n,) str and probabilities f32 (n, K) of features (n, d)."""
        temperature = 1.0 if self.calibration is None else self.calibration.temperature
        p = novelty.probabilities(self.scaled(features) @ self.weights + self.bias, temperature)
        return self.classes[p.argmax(1)], p

    def scaled(self, features: npt.ArrayLike) -> Array:
        """Return features (n, d) minus the mean, over the scale. Raises UserError for another shape."""
        x = np.asarray(features, np.float32)
        if x.ndim != 2 or x.shape[1] != len(self.mean):
            raise UserError(f"This head reads features (n, {len(self.mean)}), not {x.shape}.")
        return (x - self.mean) / self.scale

    def assess(self, features: npt.ArrayLike) -> Assessment:
        """Return what the head predicts for features (n, d), and whether to believe it.

        Raises UserError for a head without calibration.
        """
        label, p = self(features)
        known = self.calibration
        if known is None:
            raise UserError("This head has no calibration. Save it again with `anytouch probe label --save`.")
        distance = known.novelty(self.scaled(features))
        return Assessment(label, p, 1 - p <= known.set_limit, distance, distance > known.novelty_limit)

    def calibrated(
        self, logits: Array, y: Array, held_out: Array, features: Array, groups: Array, sensors: Array, fit: Array,
        val: Array, *, coverage: float = novelty.COVERAGE, false_alarms: float = novelty.FALSE_ALARMS,
    ) -> LinearHead:  # fmt: skip
        """Return the head with a calibration from `logits` (n, columns) of rows that no fit saw.

        `y` (n,) str and `held_out` (n,) are their classes and groups. `features` (N, d), `groups` (N,) and `sensors`
        (N,) are of all rows, of which `fit` were fitted on and `val` were not. Raises UserError without a row of a
        known class.
        """
        known = np.isin(y, self.classes)
        if not known.any():
            raise UserError("No row is left to calibrate on. Give rows of split val, or classes of several groups.")
        z, held_out = logits[known].astype(np.float64), held_out[known]
        truth = np.searchsorted(self.classes, y[known])
        temperature = novelty.fit_temperature(z, truth, held_out)
        p = novelty.probabilities(z, temperature)
        limit = novelty.conformal_limit(1 - p[np.arange(len(truth)), truth], held_out, coverage)
        x, owners = self.scaled(features), groups[val]
        whitening, chosen, references = novelty.reference_space(x[fit], groups[fit])
        scores = novelty.novelty_scores(x[val] @ whitening, references, owners, groups[fit[chosen]])
        if len(np.unique(owners)) * false_alarms < 5:  # few for a limit: rows of `fit` help
            scores = np.concatenate([scores, novelty.left_out_scores(x[fit], groups[fit])])
            owners = np.concatenate([owners, groups[fit]])
        novel = novelty.conformal_limit(scores, owners, 1 - false_alarms)
        limits = (coverage, limit, false_alarms, novel, len(np.unique(held_out)))
        return replace(self, calibration=Calibration(temperature, *limits, whitening, references, sensors[fit[chosen]]))

    def promises(self) -> list[str]:
        """Return sentences on what the limits of the calibration promise, and on those that need more groups."""
        known = self.calibration
        if known is None:
            return []
        sets, novel = f"the true class in {known.coverage:.0%} of touches", f"{known.false_alarms:.0%} of known touches"
        about = f"calibrated on {known.recordings} groups (temperature {known.temperature:.2f})"
        return [f"{about}: sets hold {sets}, {novel} are called novel"] + [
            f"{share:.0%} takes {int(np.ceil(share / (1 - share) - 1e-9))} groups or more. With fewer {what}."
            for limit, share, what in (
                (known.set_limit, known.coverage, "sets hold every class"),
                (known.novelty_limit, 1 - known.false_alarms, "no touch is novel"),
            )
            if np.isinf(limit)
        ]

    def check(self, source: str, fingerprint: str, pooling: str, frames: int, join: str = "mean") -> None:
        """Raise UserError unless the head was fitted on features of that encoder, pooling and number of frames."""
        pairs = (("pooling", self.pooling, pooling), ("frames", self.frames, frames), ("join", "mean", join))
        wrong = [f"--{name} {own}" for name, own, other in pairs if own != other]
        if wrong:
            raise UserError(f"The head was fitted on other features. Give {' '.join(wrong)}.")
        if fingerprint != self.fingerprint:
            raise UserError(
                f"The head was fitted on features of another encoder ({self.fingerprint}) than {source} "
                f"({fingerprint}). Fit one with `anytouch probe label --save`."
            )


def save_head(path: str | Path, head: LinearHead) -> None:
    """Write a head as `.npz` atomically. Raises OSError."""
    known = head.calibration
    arrays = {"mark" if name == "fingerprint" else name: value for name, value in vars(head).items()}
    del arrays["calibration"]
    arrays |= gel_arrays(arrays.pop("gels"))
    arrays |= {} if known is None else {f"calibration/{name}": np.asarray(value) for name, value in vars(known).items()}
    with atomic_path(path) as part, open(part, "wb") as file:
        np.savez(file, format=FORMATS[known is None], **arrays)


def load_head(path: str | Path) -> LinearHead:
    """Load the head that `anytouch probe label --save` wrote. Raises UserError for any other file."""
    if not Path(path).is_file():
        raise UserError(f"There is no head {path}. `anytouch probe label --save` writes one.")
    try:
        arrays: dict[str, Any] = read_arrays(path)
        for name in ("format", "label", "pooling", "mark"):
            if arrays[name].shape != () or arrays[name].dtype.kind != "U" or arrays[name].dtype.itemsize > 4096:
                raise ValueError(f"{name} is not a short text")
            arrays[name] = str(arrays[name])
        if arrays.pop("format") not in FORMATS:
            raise ValueError("it has no format of a head")
        check_array("frames", arrays["frames"], (), "iu")
        known = Calibration.from_arrays(arrays, len(arrays["mean"]))
        gels = gels_of_arrays(arrays)
        arrays = {name: value for name, value in arrays.items() if not name.startswith(("calibration/", "gel"))}
        about = {"frames": int(arrays.pop("frames")), "fingerprint": arrays.pop("mark")}
        head = LinearHead(calibration=known, gels=gels, **about, **arrays)
        _check_head(head)
        return head
    except (OSError, ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else error
        raise UserError(
            f"{path} is not the head of a probe ({reason}). `anytouch probe label --save` writes one."
        ) from None


def _check_head(head: LinearHead) -> None:
    """Raise ValueError for arrays of a head that do not fit together or are not finite."""
    count, width = len(head.classes), len(head.mean)
    columns = 1 if count == 2 else count
    shapes = {"classes": (count,), "weights": (width, columns), "bias": (columns,), "mean": (width,), "scale": (width,)}
    for name, shape in shapes.items():
        check_array(name, getattr(head, name), shape, "U" if name == "classes" else "f")
    if count < 2 or not width or not (head.scale > 0).all() or not (head.label and head.fingerprint):
        raise ValueError("it needs two classes, features, scales above 0, a label and the mark of an encoder")
    if len(set(head.classes)) < count:
        raise ValueError("it has a class twice")
    if head.pooling not in ("class", "mean", "both") or not 0 < head.frames < 1 << 20:
        raise ValueError(f"it has pooling {head.pooling[:40]} and {head.frames} frames")
