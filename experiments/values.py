"""Values with 95 % intervals, and what a paired difference shows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import t

Seeds = dict[int, float]  # a score of each seed
CLAIM = 3  # seeds from which a sign is claimed


class Value(NamedTuple):
    """A mean, its 95 % interval (None for none), and the number of seeds behind it."""

    mean: float
    low: float | None = None
    high: float | None = None
    seeds: int = CLAIM

    @property
    def differs(self) -> bool:
        """Whether the interval of a difference leaves zero out, over enough seeds."""
        inside = self.low is None or self.high is None or self.low <= 0 <= self.high
        return not inside and self.seeds >= CLAIM

    def times(self, factor: float) -> Value:
        """Return the value in another unit."""
        low, high = (None if side is None else factor * side for side in (self.low, self.high))
        return Value(factor * self.mean, low, high, self.seeds)

    def shown(self, form: str = ".1f") -> str:
        """Return `mean [low, high]` in a format of Python."""
        sides = (
            ""
            if self.low is None or self.high is None
            else f" [{self.low:{form}}, {self.high:{form}}]"
        )
        return f"{self.mean:{form}}{sides}"


def over_seeds(values: Sequence[float]) -> Value:
    """Return the mean over seeds with its interval (Student's t); of two seeds the interval is the
    two values.
    """
    mean = float(np.mean(values))
    count = len(values)
    if count < CLAIM:
        return Value(mean, *((min(values), max(values)) if count == 2 else (None, None)), count)
    half = float(t.ppf(0.975, count - 1) * np.std(values, ddof=1) / np.sqrt(count))
    return Value(mean, mean - half, mean + half, count)


def shared_difference(first: Seeds, second: Seeds) -> Value | None:
    """Return `first` minus `second` over the seeds that both have, None without any."""
    shared = sorted(first.keys() & second.keys())
    if shared:
        return over_seeds([first[seed] - second[seed] for seed in shared])
    return None


def percent(several: Sequence[Any]) -> Value:
    """Return (mean, low, high) in percent."""
    return Value(*several[:3]).times(100)
