"""Rows and findings of touch in MuJoCo: parity, speed, and the two tasks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from experiments.pages.page import Finding, Measure, Page, Table
from experiments.records import Record, read_records
from experiments.values import Value, over_seeds

KINDS = ("blind", "shuffled", "touch", "oracle")
COSTS = {"hold": "grip over need", "align": "degrees from level"}


def mujoco(folder: Path) -> Page:
    """Parity with `simulate_touch`, cost, and what touch is worth to a gripper."""
    records = read_records(folder / "mujoco.jsonl")
    tasks = read_records(folder / "mujoco_tasks.jsonl")
    tables: list[Any] = []
    findings: list[Finding | str] = []
    closed = {name: _closed(tasks, name) for name in COSTS}
    for name, parts in closed.items():
        if parts:
            touch, shuffled = (parts[kind].shown(".0f") for kind in ("touch", "shuffled"))
            findings.append(
                f"*{name.capitalize()}*: touch closes {touch} % of the gap from blind to oracle, "
                f"and shuffled touch {shuffled} %."
            )
    tables.append(
        [
            (name, kind, _cost(tasks, name, kind), _success(tasks, name, kind), part)
            for name, parts in closed.items()
            for kind in KINDS
            if parts
            for part in [parts.get(kind)]
        ]
    )
    tables.append(
        [
            (sensor, shape, *(found[name] for name in ("grey", "grey_most", "rigid")))
            for sensor, one in records.items()
            if one["kind"] == "parity"
            for shape, found in one["shapes"].items()
        ]
    )
    rows = tables[1]
    mean = float(np.mean([row[2] for row in rows]))
    worst = max(rows, key=lambda row: row[2])
    count = sum(
        found["poses"]
        for one in records.values()
        if one["kind"] == "parity"
        for found in one["shapes"].values()
    )
    findings.append(
        f"Over {count} presses images differ from those of `simulate_touch` by {mean:.2f} grey "
        f"levels in the contact, and by {worst[2]:.2f} for the worst shape and sensor "
        f"({worst[1]}, {worst[0]})."
    )
    slide = records["friction"]["degrees"]
    findings.append(
        f"While a ball slides, friction is within {slide['velocity']:.2f} degrees of its velocity."
    )
    if "speed" in records:
        tables.append(_speeds(records["speed"]))
    words = "Presses in MuJoCo and by `simulate_touch` differ by this much in the contact."
    for name, parts in closed.items():
        if parts:
            mean = parts["touch"].mean
            words += f" In *{name.capitalize()}* touch closes {mean:.0f} % of the gap."
    seeds = {name: len(_seeds(tasks, name, "oracle")) for name in COSTS}
    about = "; ".join(f"*{name.capitalize()}* has {count}" for name, count in seeds.items())
    return Page(
        "mujoco",
        tables,
        findings,
        (words, f"{mean:.2f} grey levels"),
        figure=lambda path: _draw(tasks, path),
        words={"seeds": about},
    )


def _seeds(tasks: dict[str, Record], name: str, kind: str) -> list[Record]:
    """Return the records of a policy, by seed."""
    found = [one for one in tasks.values() if (one["task"], one["policy"]) == (name, kind)]
    return sorted(found, key=lambda one: one["seed"])


def _cost(tasks: dict[str, Record], name: str, kind: str) -> Value:
    return over_seeds([float(np.mean(one["cost"])) for one in _seeds(tasks, name, kind)])


def _success(tasks: dict[str, Record], name: str, kind: str) -> Value:
    return over_seeds([100 * float(np.mean(one["success"])) for one in _seeds(tasks, name, kind)])


def _closed(tasks: dict[str, Record], name: str) -> dict[str, Value]:
    """Return by policy the percent of the gap from blind to oracle that it closes, over seeds."""
    costs = {
        kind: np.array([np.mean(one["cost"]) for one in _seeds(tasks, name, kind)])
        for kind in KINDS
    }
    if not len(costs["oracle"]):
        return {}
    gap = costs["blind"] - costs["oracle"]
    return {
        kind: over_seeds((100 * (costs["blind"] - costs[kind]) / gap).tolist())
        for kind in ("shuffled", "touch")
    }


def _speeds(record: Record) -> Table:
    """Return the table of times."""
    words = {
        "step_112": "a step and its reading, 112 pixels",
        "step_224": "a step and its reading, 224 pixels",
        "batch_112": "contact and image in a batch of 32, two threads, 112 pixels",
        "untouched_112": "an untouched pad, 112 pixels",
        "untouched_224": "an untouched pad, 224 pixels",
    }
    rows = [
        (
            text,
            1e3 * record[name]["processor"],
            1e3 * record[name]["least"],
            1e3 * record[name]["seconds"],
        )
        for name, text in words.items()
    ]
    rows += [
        (f"a height map of 84 x 64 points, {name}", 1e3 * value, None, None)
        for name, value in record["rays"].items()
    ]
    head = (
        "what",
        Measure("processor, ms", ".2f"),
        Measure("least, ms", ".2f"),
        Measure("median, ms", ".2f"),
    )
    return Table("Time", head, rows)


def _draw(tasks: dict[str, Record], path: Path) -> None:
    """Draw the cost of each policy, a mark a seed."""
    from anytouch_jax.evaluate.plots import panels, write_figure

    known = {name: title for name, title in COSTS.items() if _seeds(tasks, name, "oracle")}
    figure, (axes,) = panels(1, max(len(known), 1), 3.6, 2.6)
    for axis, (name, title) in zip(axes, known.items(), strict=False):
        for place, kind in enumerate(KINDS):
            costs = [float(np.mean(one["cost"])) for one in _seeds(tasks, name, kind)]
            axis.scatter([place] * len(costs), costs, s=18, color=f"C{place}")
            if costs:
                axis.bar(place, np.mean(costs), color=f"C{place}", alpha=0.35)
        axis.set_xticks(range(len(KINDS)), KINDS, fontsize=8)
        axis.set_title(f"{name}: {title}", fontsize=9)
        axis.tick_params(axis="y", labelsize=8)
    write_figure(path, figure)
