"""Saved heads of a number: ridge regression of features, with intervals and novelty."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from anytouch_jax.encoder.arrays import Array, Pooling
from anytouch_jax.encoder.calibration import Calibration
from anytouch_jax.encoder.head_checks import check_features_of, scaled_features
from anytouch_jax.shown import described, shown_short


@shown_short
class Estimate(NamedTuple):
    """Numbers that a head reads from n touches, and whether to believe them.

    Attributes:
        value: f32 (n,), in the unit of the label.
        low: (n,), the lower end of an interval that holds the truth as often as promised.
        high: (n,), its upper end.
        novelty: (n,), distance from known touches.
        novel: bool (n,).
    """

    value: Array
    low: Array
    high: Array
    novelty: Array
    novel: Array


@dataclass(frozen=True, eq=False)
class NumberHead:
    """A saved linear function from features to a number, with its calibration.

    `calibration.set_limit` is half of an interval's width.

    Attributes:
        weights: (d,).
        bias: ().
        mean: (d,), which is subtracted from features.
        scale: (d,), by which they are divided after that.
        calibration: None where no recording was left for it.
        backgrounds: backgrounds by unit.
    """

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
        return described(
            f"NumberHead for {self.label}",
            input=f"features of {len(self.mean)}, pooling {self.pooling}, frames {self.frames}",
            encoder=self.fingerprint,
            calibration="; ".join(self.promises()) or "none",
        )

    def __call__(self, features: npt.ArrayLike) -> Array:
        """Return numbers f32 (n,) of features (n, d)."""
        values = self.scaled(features) @ self.weights + self.bias
        return np.asarray(values, np.float32)

    def scaled(self, features: npt.ArrayLike) -> Array:
        """Return features (n, d) minus the mean, over the scale. Raises UserError."""
        return scaled_features(features, self.mean, self.scale)

    def assess(self, features: npt.ArrayLike) -> Estimate:
        """Return the numbers of features (n, d), their intervals, and what is novel.

        Without a calibration intervals are infinite, and nothing is novel.
        """
        value = self(features)
        known = self.calibration
        half = np.inf
        novelty = np.full(len(value), np.nan)
        limit = np.inf
        if known is not None:
            half = known.set_limit
            novelty = known.novelty(self.scaled(features))
            limit = known.novelty_limit
        return Estimate(value, value - half, value + half, novelty, novelty > limit)

    def promises(self) -> list[str]:
        """Return sentences on what the calibration promises, none without one."""
        known = self.calibration
        if known is None:
            return []
        return [
            f"calibrated on {known.recordings} groups: {known.coverage:.0%} of touches lie within "
            f"{known.set_limit:.3g} of their number, {known.false_alarms:.0%} of known touches "
            "are called novel"
        ]

    def check(
        self, source: str, fingerprint: str, pooling: str, frames: int, aggregation: str = "mean"
    ) -> None:
        """Raise UserError unless the head was fitted on such features, see `LinearHead.check`."""
        check_features_of(self, source, fingerprint, pooling, frames, aggregation)

    def predictions(self, features: Array) -> dict[str, Array]:
        """Return the arrays that the head adds to features (n, d) in a file."""
        one = self.assess(features)
        arrays = {"value": one.value}
        if self.calibration is not None:
            arrays |= {
                "low": one.low,
                "high": one.high,
                "novelty": one.novelty,
                "novel": one.novel,
            }
        return arrays

    def summary(self, features: Array) -> dict[str, Any]:
        """Return what the head says of one touch (1, d), for a line of JSON."""
        one = self.assess(features)
        line: dict[str, Any] = {"value": float(one.value[0])}
        if np.isfinite(one.high[0]):
            line |= {"low": float(one.low[0]), "high": float(one.high[0])}
        if self.calibration is not None:
            line["novel"] = bool(one.novel[0])
        return line
