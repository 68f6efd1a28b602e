"""Verdicts on features against raw pixels, and intervals and shares as text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from anytouch_jax.evaluate import statistics
from anytouch_jax.evaluate.feature_cache import RANDOM, RAW


def verdict(name: str, gain: Mapping[str, float | None], task: str = "") -> str:
    """Return a sentence on features against raw pixels, from a `statistics.paired_gain`."""
    points, low, high = (100 * (gain[key] or 0.0) for key in ("difference", "low", "high"))
    of = f"{task}: " if task else ""
    if gain["low"] is None:
        return f"{of}{name} is {points:+.0f} points from raw pixels, by too few test recordings to be sure."
    interval = f"({low:.0f} to {high:.0f})"
    if low > 0:
        return f"{of}{name} is {points:.0f} points above raw pixels {interval}."
    return (
        f"{of}{name} is no better than raw pixels: {points:+.0f} points {interval}. Try --pooling both, more "
        "recordings, or another encoder, and look at the untouched gel with `anytouch view`."
    )


def label_verdicts(results: Sequence[Any]) -> list[str]:
    """Return a sentence on each source of features of `probe_label` against raw pixels, by its first head.

    `results` are `ProbeResult`s.
    """
    first: dict[str, Any] = {}
    for result in results:
        first.setdefault(result.probe.partition(": ")[0], result)
    sums = {
        name: statistics.classification_sums(one.outcome.correct, one.outcome.groups)
        for name, one in first.items() if one.outcome is not None and ": " in one.probe
    }  # fmt: skip
    raw = sums.pop(RAW, None)
    sums.pop(RANDOM, None)
    return [] if raw is None else [
        verdict(name, statistics.paired_gain([one], [raw], False)) for name, one in sums.items()
    ]  # fmt: skip


def share_text(value: float | None) -> str:
    """Return a share in percent as text, "-" if there is none."""
    return "-" if value is None or np.isnan(value) else f"{100 * value:.1f} %"


def interval_text(low: float | None, high: float | None, factor: float = 100.0, digits: int = 1) -> str:
    """Return an interval as text, "-" if there is none; shares are in points by default."""
    return "-" if low is None or high is None else f"{factor * low:.{digits}f} to {factor * high:.{digits}f}"
