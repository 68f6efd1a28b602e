"""The first sentences of a report: what was learned, what was not, and what more steps bring."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from anytouch_jax.encoder.arrays import Array
from anytouch_jax.evaluate import plots

LAST = 5  # a run's last part, by which more steps are judged, is one in so many


class Claim(NamedTuple):
    """A score beside that of its best guess without training, both in words.

    `low` and `high` are the 95 % interval of how much better the score is, None without one.
    """

    what: str
    score: str
    guess: str
    low: float | None
    high: float | None

    def told(self) -> str:
        """Return the claim in words."""
        return f"{self.what} {self.score}, where {self.guess}"


def opening(claims: Sequence[Claim], runs: Mapping[str, Path]) -> list[str]:
    """Return the three sentences of a report on some claims and run folders."""
    better = [claim.told() for claim in claims if claim.low is not None and claim.low > 0]
    others = [claim.told() for claim in claims if claim.low is None or claim.low <= 0]
    learned = "Learned: nothing that is shown to be better than a guess without training."
    if better:
        learned = f"Learned: {'; '.join(better)}."
    not_learned = "Not learned: nothing of what was scored."
    if others:
        not_learned = f"Not shown to be learned: {'; '.join(others)}."
    trends = [trend for title, run in runs.items() if (trend := _trend(title, run))]
    more = "More steps: the runs are too short to tell."
    if trends:
        more = f"More steps: {'; '.join(trends)}."
    return [learned, not_learned, more]


def _trend(title: str, run: Path) -> str:
    """Return how the loss changed in the last part of a run, with its interval, or nothing."""
    losses = np.array([line["loss"] for line in plots.read_metrics(run) if line.get("loss")])
    size = len(losses) // LAST
    if size < LAST:
        return ""
    last = losses[-size:]
    before = losses[-2 * size : -size]
    change = float(last.mean() - before.mean())
    # Steps are noisy and nearly independent: each has a batch of its own.
    wide = 1.96 * float(np.sqrt(_variance(last) + _variance(before)))
    word = "falls"
    if abs(change) <= wide:
        word = "is not shown to fall"
    elif change > 0:
        word = "rises"
    low, high = (100 * (change + side) / before.mean() for side in (-wide, wide))
    ratio = 100 * change / before.mean()
    return (
        f"the loss of {title} {word} in the last fifth of its steps, {ratio:+.1f} % "
        f"[{low:+.1f}, {high:+.1f}] against the fifth before"
    )


def _variance(values: Array) -> float:
    """Return the variance of the mean of values."""
    return float(np.var(values, ddof=1) / len(values))
