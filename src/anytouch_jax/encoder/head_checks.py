"""What all saved heads share: their input, and the check that features are of their encoder."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from anytouch_jax.encoder.arrays import Array, Pooling
from anytouch_jax.errors import UserError


class FittedOn(Protocol):
    """What a head knows of the features that it was fitted on."""

    @property
    def pooling(self) -> Pooling: ...
    @property
    def frames(self) -> int: ...
    @property
    def fingerprint(self) -> str: ...


def scaled_features(features: npt.ArrayLike, mean: Array, scale: Array) -> Array:
    """Return features (n, d) minus the mean (d,), over the scale (d,).

    Raises UserError for another shape.
    """
    x = np.asarray(features, np.float32)
    if x.ndim != 2 or x.shape[1] != len(mean):
        raise UserError(f"This head reads features (n, {len(mean)}), not {x.shape}.")
    return (x - mean) / scale


def check_features_of(
    head: FittedOn, source: str, fingerprint: str, pooling: str, frames: int, aggregation: str
) -> None:
    """Raise UserError unless a head was fitted on such features, see `LinearHead.check`."""
    wrong = []
    if pooling != head.pooling:
        wrong.append(f"--pooling {head.pooling}")
    if frames != head.frames:
        wrong.append(f"--frames {head.frames}")
    if aggregation != "mean":  # heads are fitted on no other
        wrong.append("--aggregation mean")
    if wrong:
        raise UserError(f"The head was fitted on other features. Give {' '.join(wrong)}.")
    if fingerprint != head.fingerprint:
        raise UserError(
            f"The head was fitted on features of another encoder ({head.fingerprint}) than "
            f"{source} ({fingerprint}). Fit one with `anytouch probe label --save`."
        )
