"""Verdicts: a sentence on each set of features against the controls of a probe."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from anytouch_jax.evaluate.statistics import (
    RANDOM,
    RAW,
    GroupSums,
    classification_sums,
    paired_gain,
)

if TYPE_CHECKING:
    from anytouch_jax.evaluate.results import ProbeResult


# the test rows of every seed, by (features, task, head, protocol)
Runs = dict[tuple[str, ...], list[GroupSums]]


def verdict(name: str, gain: Mapping[str, float | None], task: str = "") -> str:
    """Return a sentence on features against raw pixels, from a `paired_gain`."""
    points, low, high = (100 * (gain[key] or 0.0) for key in ("difference", "low", "high"))
    of = f"{task}: " if task else ""
    if gain["low"] is None:
        return (
            f"{of}{name} is {points:+.0f} points from raw pixels, by too few test recordings to be "
            "sure."
        )
    interval = f"({low:.0f} to {high:.0f})"
    if low > 0:
        return f"{of}{name} is {points:.0f} points above raw pixels {interval}."
    return (
        f"{of}{name} is no better than raw pixels: {points:+.0f} points {interval}. Try --pooling "
        "both, more "
        "recordings, or another encoder, and look at the untouched gel with `anytouch view`."
    )


def label_verdicts(results: Sequence[ProbeResult]) -> list[str]:
    """Return a sentence on each source of features of `probe_label` against raw pixels.

    Each source is judged by its first head, which is the linear one.
    """
    first: dict[str, ProbeResult] = {}
    for result in results:
        first.setdefault(result.probe.partition(": ")[0], result)
    sums = {
        name: classification_sums(one.outcome.correct, one.outcome.groups)
        for name, one in first.items()
        if one.outcome is not None and ": " in one.probe
    }
    raw = sums.pop(RAW, None)
    sums.pop(RANDOM, None)
    if raw is None:
        return []
    return [verdict(name, paired_gain([one], [raw], False)) for name, one in sums.items()]


def task_verdicts(runs: Runs, kinds: dict[str, bool]) -> list[str]:
    """Return a sentence on each source, task, head and protocol against raw pixels."""
    sentences = []
    for (name, task, head, protocol), own in runs.items():
        raw = runs.get((RAW, task, head, protocol))
        if name not in (RAW, RANDOM) and raw is not None:
            gain = paired_gain(own, raw, kinds[task])
            sentences.append(verdict(name, gain, f"{task}, {head}"))
    return sentences
