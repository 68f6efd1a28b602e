"""Saved linear heads: classes of touches from features, with their calibration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.encoder import novelty
from anytouch_jax.encoder.novelty import Assessment, Calibration
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, read_arrays

if TYPE_CHECKING:
    from anytouch_jax.encoder.embed import Pooling

Array = npt.NDArray[Any]
FORMATS = ("anytouch_jax.head.2", "anytouch_jax.head.1")  # the second has no calibration


@dataclass(frozen=True, eq=False)
class LinearHead:
    """A saved linear classifier of features, with its calibration (None in files of older versions).

    `classes` (K,) str; `weights` (d, columns) and `bias` (columns,), one column for two classes, else K; features minus
    `mean` (d,) are divided by `scale` (d,). It predicts `label` from features of `frames` a touch and `pooling` by the
    encoder with that `fingerprint`.
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
    arrays |= {} if known is None else known.arrays()
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
        known = Calibration.from_arrays(arrays, len(arrays["mean"]))
        arrays = {name: value for name, value in arrays.items() if not name.startswith("calibration/")}
        head = LinearHead(frames=int(arrays.pop("frames")), fingerprint=arrays.pop("mark"), calibration=known, **arrays)
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
        array = getattr(head, name)
        if array.shape != shape or array.dtype.kind != ("U" if name == "classes" else "f"):
            raise ValueError(f"{name} is {array.dtype} {array.shape}, not of shape {shape}")
        if name != "classes" and not np.isfinite(array).all():
            raise ValueError(f"{name} has values that are not finite")
    if count < 2 or not width or not (head.scale > 0).all() or not (head.label and head.fingerprint):
        raise ValueError("it needs two classes, features, scales above 0, a label and the mark of an encoder")
    if len(set(head.classes)) < count:
        raise ValueError("it has a class twice")
    if head.pooling not in ("class", "mean", "both") or not 0 < head.frames < 1 << 20:
        raise ValueError(f"it has pooling {head.pooling[:40]} and {head.frames} frames")
