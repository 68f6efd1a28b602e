"""Saved linear heads: a classifier of features, with its calibration, in one .npz file.

The file of a head of numbers is read here too.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.data.background.rule import background_arrays, backgrounds_of_arrays
from anytouch_jax.encoder.arrays import Array, Pooling
from anytouch_jax.encoder.calibration import COVERAGE as COVERAGE
from anytouch_jax.encoder.calibration import FALSE_ALARMS as FALSE_ALARMS
from anytouch_jax.encoder.calibration import (
    Assessment,
    Calibration,
    CalibrationRows,
    calibrate,
    probabilities,
)
from anytouch_jax.encoder.calibration import conformal_limit as conformal_limit
from anytouch_jax.encoder.calibration import fit_temperature as fit_temperature
from anytouch_jax.encoder.contact_gate import ContactGate as ContactGate
from anytouch_jax.encoder.head_checks import check_features_of, scaled_features
from anytouch_jax.encoder.number_head import NumberHead as NumberHead
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, check_array, read_arrays
from anytouch_jax.shown import described

FORMATS = ("anytouch_jax.head.2", "anytouch_jax.head.1")  # the second has no calibration
NUMBER_FORMAT = "anytouch_jax.number_head.1"
HEAD = "head.npz"  # in the folder of an encoder that was tuned with it
_SHOWN = 8  # classes in a repr
_LETTERS = 4096  # bytes of a text in a file


@dataclass(frozen=True, eq=False)
class LinearHead:
    """A saved linear classifier of features, with its calibration.

    It predicts `label` from features of `frames` a touch and `pooling` by the encoder with that
    `fingerprint`.

    Attributes:
        classes: (K,) str, sorted.
        weights: (d, columns), one column for two classes, else K.
        bias: (columns,).
        mean: (d,), which is subtracted from features.
        scale: (d,), by which they are divided after that.
        calibration: None in files of older versions.
        backgrounds: images of the untouched gel by unit.
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
    backgrounds: dict[str, Array] = field(default_factory=dict)

    def __repr__(self) -> str:
        classes = self.classes.tolist()
        names = ", ".join(classes[:_SHOWN])
        if len(classes) > _SHOWN:
            names += f" and {len(classes) - _SHOWN} more"
        return described(
            f"LinearHead for {self.label}",
            classes=f"{len(classes)}: {names}",
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
        return scaled_features(features, self.mean, self.scale)

    def assess(self, features: npt.ArrayLike) -> Assessment:
        """Return what the head predicts for features (n, d), and whether to believe it.

        Raises UserError if it is not calibrated.
        """
        label, p = self(features)
        known = self.calibration
        if known is None:
            raise UserError(
                "This head has no calibration. Save it again with `anytouch probe label --save`."
            )
        distance = known.novelty(self.scaled(features))
        return Assessment(
            label=label,
            p=p,
            in_set=1 - p <= known.set_limit,
            novelty=distance,
            novel=distance > known.novelty_limit,
        )

    def calibrated_on(
        self,
        rows: CalibrationRows,
        *,
        coverage: float = COVERAGE,
        false_alarms: float = FALSE_ALARMS,
    ) -> LinearHead:
        """Return the head with a calibration from rows that no fit saw.

        Raises UserError without a row of a known class.
        """
        known = calibrate(
            rows,
            self.classes,
            self.scaled(rows.features),
            coverage=coverage,
            false_alarms=false_alarms,
        )
        return replace(self, calibration=known)

    def calibrated(  # noqa: PLR0913  the call of version 0.2; `calibrated_on` takes the record
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
        """Return the head with a calibration, as `calibrated_on`, of the same rows one by one."""
        rows = CalibrationRows(logits, y, held_out, features, groups, sensors, fit, val)
        return self.calibrated_on(rows, coverage=coverage, false_alarms=false_alarms)

    def promises(self) -> list[str]:
        """Return sentences on what the limits of the calibration promise, none without one."""
        if self.calibration is None:
            return []
        return self.calibration.promises()

    def check(
        self, source: str, fingerprint: str, pooling: str, frames: int, aggregation: str = "mean"
    ) -> None:
        """Raise UserError unless the head was fitted on such features.

        Args:
            source: the name of the encoder, for the sentence.
            fingerprint: that of the encoder.
            pooling: that of the features.
            frames: those of a touch.
            aggregation: the temporal aggregation of a long clip.
        """
        check_features_of(self, source, fingerprint, pooling, frames, aggregation)

    def predictions(self, features: Array) -> dict[str, Array]:
        """Return the arrays that the head adds to features (n, d) in a file.

        These are label and p, and of a calibrated head set, classes and novelty.
        """
        if self.calibration is None:
            label, p = self(features)
            return {"label": label, "p": p.max(1)}
        one = self.assess(features)
        return {
            "label": one.label,
            "p": one.p.max(1),
            "set": one.in_set,
            "classes": self.classes,
            "novelty": one.novelty,
            "novel": one.novel,
        }

    def summary(self, features: Array) -> dict[str, Any]:
        """Return what the head says of one touch (1, d), for a line of JSON."""
        if self.calibration is None:
            (label,), p = self(features)
            return {"label": str(label), "p": round(float(p.max()), 6)}
        one = self.assess(features)
        return {
            "label": str(one.label[0]),
            "p": round(float(one.p.max()), 6),
            "set": self.classes[one.in_set[0]].tolist(),
            "novel": bool(one.novel[0]),
        }


Head = LinearHead | NumberHead


def save_head(path: str | Path, head: Head) -> None:
    """Write a head as `.npz` atomically. Raises OSError."""
    kind = FORMATS[head.calibration is None]
    if isinstance(head, NumberHead):
        kind = NUMBER_FORMAT
    arrays = dict(vars(head))
    known = arrays.pop("calibration")
    images = arrays.pop("backgrounds")
    # Files name the fingerprint "mark" since the first version.
    arrays = {"mark" if name == "fingerprint" else name: value for name, value in arrays.items()}
    arrays |= background_arrays(images)
    if known is not None:
        for name, value in vars(known).items():
            arrays[f"calibration/{name}"] = np.asarray(value)
    with atomic_path(path) as part, open(part, "wb") as file:
        np.savez(file, format=kind, **arrays)


def find_head(model: str | Path) -> Path | None:
    """Return the file of the head that belongs to an encoder, None if it has none.

    It lies in the folder of `anytouch finetune`, and beside an export of such an encoder.
    """
    path = Path(model)
    beside = path / HEAD if path.is_dir() else path.with_suffix(f".{HEAD}")
    return beside if beside.is_file() else None


def load_head(path: str | Path) -> Head:
    """Load the head that `anytouch probe label --save` or `anytouch finetune` wrote.

    Args:
        path: its file, or the folder of `anytouch finetune`.

    Raises:
        UserError: there is none, or it is damaged.
    """
    path = find_head(path) or path
    if not Path(path).is_file():
        raise UserError(f"There is no head {path}. `anytouch probe label --save` writes one.")
    try:
        arrays = read_arrays(path)
        if str(arrays.get("format")) == NUMBER_FORMAT:
            return _number_head_of(arrays)
        head = _head_of(arrays)
        _check_head(head)
        return head
    # Whatever an array of a foreign file is, what fails on it is one of these.
    except (OSError, ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else error
        message = (
            f"{path} is not the head of a probe ({reason}). `anytouch probe label --save` writes "
            "one."
        )
        raise UserError(message) from None


def _head_of(arrays: dict[str, Any]) -> LinearHead:
    """Return the head of the arrays of a file. Raises many types for others."""
    return LinearHead(**_fields_of(arrays, FORMATS))


def _number_head_of(arrays: dict[str, Any]) -> NumberHead:
    """Return the head of a number of the arrays of a file. Raises many types for others."""
    head = NumberHead(**_fields_of(arrays, (NUMBER_FORMAT,)))
    width = len(head.mean)
    for name, shape in {
        "weights": (width,),
        "bias": (),
        "mean": (width,),
        "scale": (width,),
    }.items():
        check_array(name, getattr(head, name), shape, "f")
    _check_input(head)
    return head


def _fields_of(arrays: dict[str, Any], formats: tuple[str, ...]) -> dict[str, Any]:
    """Return the fields of a head by name. Raises many types for arrays of anything else."""
    for name in ("format", "label", "pooling", "mark"):
        text = arrays[name]
        if text.shape != () or text.dtype.kind != "U" or text.dtype.itemsize > _LETTERS:
            raise ValueError(f"{name} is not a short text")
        arrays[name] = str(text)
    if arrays.pop("format") not in formats:
        raise ValueError("it has no format of a head")
    check_array("frames", arrays["frames"], (), "iu")
    own = {
        name: value
        for name, value in arrays.items()
        if not name.startswith(("calibration/", "gel"))
    }
    own["calibration"] = Calibration.from_arrays(arrays, len(arrays["mean"]))
    own["backgrounds"] = backgrounds_of_arrays(arrays)
    own["frames"] = int(own["frames"])
    own["fingerprint"] = own.pop("mark")
    return own


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
    if count < 2:
        raise ValueError("it needs two classes")
    if len(set(head.classes)) < count:
        raise ValueError("it has a class twice")
    _check_input(head)


def _check_input(head: Head) -> None:
    """Raise ValueError for a head without features, a label or an encoder."""
    is_named = head.label and head.fingerprint
    if not len(head.mean) or not (head.scale > 0).all() or not is_named:
        raise ValueError("it needs features, scales above 0, a label and the mark of an encoder")
    if head.pooling not in ("class", "mean", "both") or not 0 < head.frames < 1 << 20:
        raise ValueError(f"it has pooling {head.pooling[:40]} and {head.frames} frames")
