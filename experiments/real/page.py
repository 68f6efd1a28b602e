"""The page about real recordings, made from the records alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.statistics import markdown_table
from experiments.real.scores import HEADS, TASKS, Score
from experiments.records import read_records

Record = dict[str, Any]
TRAINED = "trained with labels"


def page(results: Path) -> str:
    """Return the page of a file of results. Raises UserError without one, and for records of different data."""
    records = read_records(results)
    if not records:
        raise UserError(f"{results} has no record. Run `python -m experiments.real.run MODEL` first.")
    if len({record["data"] for record in records.values()}) > 1:
        raise UserError(f"The records of {results} are of different data. Run all of them again.")
    lines = [
        "# What is an encoder worth on real recordings?", "",
        "Made by `python -m experiments.real.run`. Each score is the share of whole recordings that are named right. "
        "A recording gets the mean of its frames' scores. The penalty and the number of neighbours were chosen on "
        "validation recordings. Intervals are 95 % over recordings. Differences are paired by recording.", "",
    ]  # fmt: skip
    for task in TASKS:
        lines += [f"## {task.capitalize()}", "", (TASKS[task].__doc__ or "").strip(), ""]
        lines += [_table(records, task), ""]
    lines += ["## Few labels", "", "Objects, linear head, with so many train recordings of each object:", ""]
    counts = ("1", "2", "5")
    rows = [
        (
            name,
            *(_percent(record["label_curve"][count]) for count in counts),
            _percent(record["tasks"]["object, linear"]["share"]),
        )
        for name, record in records.items()
        if "label_curve" in record
    ]
    lines += [markdown_table(("features", *counts, "all"), rows, "lrrrr"), ""]
    lines += ["## Time", "", "One frame, preprocessing included, on this machine: " + _machine(records), ""]
    lines += [
        markdown_table(
            ("encoder", "ms a frame"),
            [(name, f"{record['milliseconds']:.1f}") for name, record in records.items() if "milliseconds" in record],
            "lr",
        ),
        "",
    ]
    return "\n".join(lines)


def _table(records: dict[str, Record], task: str) -> str:
    """Return the rows of a task: score, interval, and the differences from pixels and from the untrained network."""
    rows = []
    for head in (*HEADS, TRAINED):
        key = f"{task}, {head}"
        scores = {name: _score(record["tasks"][key]) for name, record in records.items() if key in record["tasks"]}
        untrained = next((name for name in scores if name.startswith("untrained:")), None)
        for name, score in sorted(scores.items(), key=lambda item: -item[1].share):
            low, high = score.interval()
            rows.append((
                head, name, _percent(score.share), _range(low, high),
                *_difference(score, scores.get("pixels"), name), *_difference(score, scores.get(untrained or ""), name),
            ))  # fmt: skip
    header = ("head", "features", "right", "95 %", "minus pixels", "95 %", "minus untrained", "95 %")
    return markdown_table(header, rows, "llrrrrrr")


def _score(task: Record) -> Score:
    return Score(np.array(task["correct"], bool), np.array(task["groups"]), task["option"])


def _difference(score: Score, other: Score | None, name: str) -> tuple[str, str]:
    if other is None or np.array_equal(score.correct, other.correct):
        return "", ""
    mean, low, high = score.minus(other)
    return f"{100 * mean:+.1f}", _range(low, high, "+.1f")


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _range(low: float | None, high: float | None, form: str = ".1f") -> str:
    return "-" if low is None or high is None else f"{100 * low:{form}} to {100 * high:{form}}"


def _machine(records: dict[str, Record]) -> str:
    about = next(iter(records.values()))["machine"]
    return f"{about['processor']}, {about['cores']} cores, jax {about['jax']}."
