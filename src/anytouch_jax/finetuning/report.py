"""What came of a fine-tuning, in sentences and in scores on split test."""

from __future__ import annotations

from typing import Any

import numpy as np

from anytouch_jax.encoder.arrays import Array
from anytouch_jax.evaluate.statistics import mean_interval
from anytouch_jax.finetuning import start
from anytouch_jax.finetuning.beat import TuneResult
from anytouch_jax.finetuning.rows import Chosen


def sentence_of(result: TuneResult, chosen: Chosen, model: str) -> str:
    """Return what came of it, for a user."""
    before = result.before.text(chosen.target)
    if result.improved:
        return (
            f"On held-out recordings ({chosen.parts.what}) fine-tuning has "
            f"{result.after.text(chosen.target)}, the linear head on the frozen encoder {before}."
        )
    return (
        f"{result.note or 'Fine-tuning was not better on held-out recordings.'} The folder has the "
        f"linear head ({before}) and the encoder of {model} as it was."
    )


def scores_on_test(result: TuneResult, chosen: Chosen) -> dict[str, Any] | None:
    """Return the scores of both on split test, paired by group, or None without one."""
    places = chosen.parts.test
    if not len(places):
        return None
    target = chosen.target
    groups = chosen.rows.groups[places]
    first = start.right_rows(result.first(result.x[places]), target, places)
    last = start.right_rows(result.linear(result.given.x[places]), target, places)
    before = _group_mean(first, groups)
    after = _group_mean(last, groups)
    low, high = mean_interval(last - first, groups)
    about: dict[str, Any] = {"before": before, "after": after, "low": low, "high": high}
    about["groups"] = len(np.unique(groups))
    unit = 1.0 if target.is_number else 100.0
    change = f"{unit * (after - before):+.3g}"
    if low is not None and high is not None:
        change += f" [{unit * low:+.3g}, {unit * high:+.3g}]"
    about["sentence"] = (
        f"On split test ({about['groups']} groups): {unit * after:.3g}, the linear head "
        f"{unit * before:.3g}, difference {change}."
    )
    return about


def _group_mean(values: Array, groups: Array) -> float:
    numbers = np.unique(groups, return_inverse=True)[1]
    return float((np.bincount(numbers, values) / np.bincount(numbers)).mean())
