"""The linear head of a probe as a file: what `anytouch probe --save` keeps and `anytouch embed --head` applies."""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from scipy.special import expit, softmax

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.probe_models import Linear
from anytouch_jax.files import atomic_path

if TYPE_CHECKING:
    from anytouch_jax.encoder.encoder import Pooling

Array = npt.NDArray[Any]
FORMAT = "anytouch_jax.head.1"


@dataclass(frozen=True, eq=False)
class Head:
    """A linear classifier of features: `classes` (K,) str, `weights` (d, columns) and `bias` (columns,) (one column for
    two classes, else K) of features less `mean` (d,) over `scale` (d,).

    `label` it tells; the features are of `frames` a touch, `pooling`, and of the encoder with that `mark`.
    """

    classes: Array
    weights: Array
    bias: Array
    mean: Array
    scale: Array
    label: str
    pooling: Pooling
    frames: int
    mark: str

    def __call__(self, features: npt.ArrayLike) -> tuple[Array, Array]:
        """(the likeliest class (n,) str, probabilities f32 (n, K) in the order of `classes`) of features (n, d)."""
        x = np.asarray(features, np.float32)
        if x.ndim != 2 or x.shape[1] != len(self.mean):
            raise UserError(f"this head reads features (n, {len(self.mean)}), not {x.shape}")
        logits = ((x - self.mean) / self.scale) @ self.weights + self.bias
        p = np.concatenate([expit(-logits), expit(logits)], axis=1) if logits.shape[1] == 1 else softmax(logits, axis=1)
        return self.classes[p.argmax(1)], p

    def check(self, source: str, mark: str, pooling: str, frames: int, join: str = "mean") -> None:
        """Raise UserError unless it was fitted on such features: of that encoder, pooling and number of frames."""
        wrong = [
            f"--{name} {one}" for name, one, other in (
                ("pooling", self.pooling, pooling), ("frames", self.frames, frames), ("join", "mean", join),
            ) if one != other
        ]  # fmt: skip
        if wrong:
            raise UserError(f"the head was fitted on other features than these: give {' '.join(wrong)}")
        if mark != self.mark:
            raise UserError(
                f"the head was fitted on features of another encoder ({self.mark}) than {source} ({mark}); "
                "fit one with `anytouch probe --save`"
            )


def head_of(model: Linear, names: Array, *, label: str, pooling: Pooling, frames: int, mark: str) -> Head:
    """The head of a fitted `Linear`, whose class numbers count in `names`."""
    assert model.fit is not None  # a probe needs two classes
    classes = np.asarray(names)[model.classes].astype(str)
    return Head(classes, model.fit.weights, model.fit.bias, model.mean, model.scale, label, pooling, frames, mark)


def save_head(path: str | Path, head: Head) -> None:
    """Write a head as `.npz`, whole or not at all. Raises OSError."""
    arrays: dict[str, Any] = {"format": FORMAT} | vars(head)
    with atomic_path(path) as part, open(part, "wb") as file:
        np.savez(file, **arrays)


def load_head(path: str | Path) -> Head:
    """The head that `anytouch probe --save` wrote: features (n, d) -> (classes (n,), probabilities (n, K)).

    Raises UserError for a file that is not there or that is no such head.
    """
    if not Path(path).is_file():
        raise UserError(f"there is no head {path}; `anytouch probe --save` writes one")
    try:
        with np.load(path, allow_pickle=False) as file:
            told = {name: file[name] for name in file.files}
        if str(told.pop("format")) != FORMAT:
            raise KeyError("format")
        words: dict[str, Any] = {name: str(told.pop(name)) for name in ("label", "pooling", "mark")}
        return Head(frames=int(told.pop("frames")), **words, **told)
    except (OSError, ValueError, TypeError, KeyError, EOFError, AttributeError, zipfile.BadZipFile):
        raise UserError(f"{path} is not the head of a probe (`anytouch probe --save`)") from None
