"""Claims of the studies: intervals over seeds, paired differences, and whether they support a sign."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import t

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.probing import ProbeResult
from anytouch_jax.evaluate.statistics import mean_interval

CLAIM = 3  # seeds from which a sign is claimed


def seed_interval(several: Sequence[float]) -> tuple[float | None, float | None]:
    """Return the 95 % interval of the mean over seeds, by Student's t; (None, None) below two seeds."""
    if len(several) < 2:
        return None, None
    half = float(t.ppf(0.975, len(several) - 1) * np.std(several, ddof=1) / np.sqrt(len(several)))
    return float(np.mean(several)) - half, float(np.mean(several)) + half


def verdict(low: float | None, high: float | None, seeds: int, *, wanted: float = 1.0) -> str:
    """Return whether the interval of a difference supports the claim that it has the sign of `wanted`.

    "agrees" or "disagrees" if zero is outside of the interval, else "undecided". Below CLAIM seeds "1 seed, no claim".
    """
    if seeds < CLAIM:
        return f"{seeds} seed{'s' if seeds > 1 else ''}, no claim"
    if low is None or high is None or low <= 0 <= high:
        return "undecided"
    return "agrees" if (low > 0) == (wanted > 0) else "disagrees"


def accuracy_difference(first: ProbeResult, second: ProbeResult) -> tuple[float, float | None, float | None]:
    """Return the accuracy of `first` minus that of `second` with its 95 % interval over groups, paired by test row.

    Two encoders err on the same hard recordings, so this is narrower than two separate intervals. Raises UserError if
    the two were not tested on the same rows.
    """
    a, b = first.outcome, second.outcome
    if a is None or b is None or not np.array_equal(a.rows, b.rows) or not np.array_equal(a.groups, b.groups):
        raise UserError(
            f"{first.probe!r} and {second.probe!r} were not tested on the same rows. Give both the same table."
        )
    change = a.correct.astype(np.float64) - b.correct
    return float(change.mean()), *mean_interval(change, a.groups)
