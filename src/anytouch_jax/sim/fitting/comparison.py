"""Comparison of tokens: which held-out touches they find, with a paired interval over objects."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from anytouch_jax.evaluate.statistics import mean_interval
from anytouch_jax.sim.endless import SimulatedTouches


class Found(NamedTuple):
    """Held-out touches that are felt by your sensor and by a known one."""

    found: np.ndarray  # bool (N,): the nearest one by a known sensor is the same touch
    object: np.ndarray  # i32 (N,), what is touched


class Comparison(NamedTuple):
    """Fractions of the same held-out touches that are found, by universal and by trained tokens."""

    universal: float
    trained: float
    # 95 % interval of their difference under a bootstrap over objects; None with one object
    low: float | None
    high: float | None
    touches: int
    objects: int

    @property
    def shown(self) -> bool:
        """Whether the trained tokens are shown to find more."""
        return self.low is not None and self.low > 0


def compare_found(universal: Found, trained: Found) -> Comparison:
    """Compare two sets of tokens on the same touches.

    Touches are paired, because most of them are found by both or by neither. Objects are what is
    drawn again, because touches of one object are found or missed together.
    """
    gain = trained.found.astype(float) - universal.found
    low, high = mean_interval(gain, universal.object)
    return Comparison(
        universal=float(universal.found.mean()),
        trained=float(trained.found.mean()),
        low=low,
        high=high,
        touches=len(gain),
        objects=len(np.unique(universal.object)),
    )


def found_touches(
    held: list[SimulatedTouches], features: Callable[..., Any], train: dict[str, Any]
) -> Found:
    """Return which held-out touches are found: recall@1 from your sensor to a known one.

    A touch by your sensor is found if the nearest one by a known sensor is the same touch.
    """
    parts = [features(train, touches) for touches in held]
    own, other = (np.concatenate([np.asarray(part[i]) for part in parts]) for i in (0, 1))
    by_known = np.concatenate([np.asarray(touches.sensor[:, 0]) > 0 for touches in held])
    nearest = (own @ other[by_known].T).argmax(1)[by_known]
    touched = np.concatenate([np.asarray(touches.object) for touches in held])[by_known]
    return Found(nearest == np.arange(by_known.sum()), touched)
