"""The pictures of the results, drawn from the records alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.evaluate import plots
from experiments.tables import columns, paper, scores
from experiments.tables.columns import commonest, title
from experiments.tables.results import Column, Run, change, spread, values

STAGES = (
    ("untrained", "no pre-training"),
    ("masked", "+ masked modelling"),
    ("aligned", "+ alignment"),
    ("matched", "+ matching"),
)
MARKS = ("o", "s", "^", "D", "v")
COLOURED = 12  # touches that get a colour and their lines; the others are grey


def q2(runs: Sequence[Run], path: Path, *, seed: int | None = None) -> Path | None:
    """Touches by three sensors in four spaces (Figure 4): a mark a sensor, a colour and dashed lines a touch.

    All panels are of one `seed`: the smallest that every stage there has, else (no common one) nothing is drawn.
    """
    every = {(run.name, run.seed): run.about["points"] for run in runs if run.question == "q2"}
    stages = [(name, text) for name, text in STAGES if any(name == one for one, _ in every)]
    common = [{number for one, number in every if one == name} for name, _ in stages]
    seeds = set.intersection(*common) if common else set()
    if seed is None and seeds:
        seed = min(seeds)
    if seed is None or seed not in seeds:
        return None
    of = {name: every[name, seed] for name, _ in stages}
    figure, axes = _panels(1, len(stages), 3.6, 3.8)
    sensors = sorted({point["sensor"] for name, _ in stages for point in of[name]})
    touches = sorted({point["touch"] for name, _ in stages for point in of[name]})
    colours = {
        touch: f"C{i}" if i < 10 else ("#222222", "#b5b35c")[i - 10] for i, touch in enumerate(touches[:COLOURED])
    }
    for axis, (name, text) in zip(axes, stages, strict=True):
        for touch in touches:
            mine = [point for point in of[name] if point["touch"] == touch]
            if not mine:  # this space has no point of it
                continue
            colour = colours.get(touch, "#c8c8c8")
            ring = [*mine, mine[0]]
            if touch in colours:
                axis.plot([p["x"] for p in ring], [p["y"] for p in ring], "--", color=colour, linewidth=0.7, zorder=1)
            for point in mine:
                mark = MARKS[sensors.index(point["sensor"])]
                axis.scatter(
                    point["x"], point["y"], s=26, color=colour, marker=mark, linewidths=0, zorder=2 + (touch in colours)
                )
        axis.set(title=text, xticks=[], yticks=[])
    marks = [axes[-1].scatter([], [], s=30, color="#555555", marker=MARKS[i]) for i in range(len(sensors))]
    title = f"seed {seed}"
    figure.legend(marks, sensors, loc="outside lower center", ncols=len(sensors), frameon=False, title=title)
    plots.write_figure(path, figure)
    return path


def q1(runs: Sequence[Run], path: Path) -> Path:
    """The columns of Table 1 as sensors are added: the material, as there, and the form of the indenter."""
    names = list(paper.TABLE1)
    figure, axes = _panels(1, len(columns.FOUR), 3.0, 3.2)
    for axis, column, form, theirs in zip(axes, columns.FOUR, columns.FORM, columns.FOUR_PAPER, strict=True):
        _line(axis, [spread(runs, "q1", name, column) for name in names], "material", "C0")
        _line(axis, [spread(runs, "q1", name, form) for name in names], "form", "C1")
        axis.set_title(f"{column.title}\n(grey, right axis: paper, {theirs})", fontsize=8)
        axis.set_xticks(
            range(len(names)),
            ["none", *(f"+{name.split('+')[-1]}" for name in names[1:])],
            rotation=40,
            ha="right",
            fontsize=7,
        )
        right = axis.twinx()
        right.plot(
            [paper.TABLE1[name][columns.FOUR.index(column)] for name in names], "--", color="#999999", linewidth=1
        )
        right.tick_params(labelsize=7, colors="#999999")
    axes[0].set_ylabel("accuracy, %")
    axes[0].legend(frameon=False, fontsize=7, loc="lower right")
    plots.write_figure(path, figure)
    return path


def q3(runs: Sequence[Run], path: Path) -> Path:
    """Static and dynamic tasks, a panel a task, a line a model: mean and interval; dotted, one answer for all."""
    names = ("pixels", "untrained", "no_pretraining", "unitouch", "tlv_link", "t3", "static_only", "anytouch")
    shown = (*columns.SIX[:3], columns.FOUR[2], *columns.dynamic("clips"))
    figure, axes = _lines(names, shown)
    for axis, column in zip(axes, shown, strict=False):
        for place, name in enumerate(names):
            _dot(axis, place, spread(runs, "q3", name, column), "C0" if name == "anytouch" else "#7a94b0")
        chance = commonest(runs, "q3", column)
        if chance is not None:
            axis.axvline(chance, linestyle=":", color="#222222", linewidth=1)
    plots.write_figure(path, figure)
    return path


def ablations(runs: Sequence[Run], path: Path) -> Path:
    """What leaving out a part changes, in points: the material and the paper's change, and the form."""
    names = [name for name in paper.TABLE6 if name != "anytouch"]
    figure, axes = _lines(names, columns.FOUR)
    for number, (axis, column) in enumerate(zip(axes, columns.FOUR, strict=True)):
        for place, name in enumerate(names):
            for shift, colour, one in ((-0.15, "C0", column), (0.15, "C1", columns.FORM[number])):
                whole = values(runs, "ablations", "anytouch", one)
                result = change(values(runs, "ablations", name, one), whole, None)
                if result.mean is not None:
                    _dot(axis, place + shift, (result.mean, result.low, result.high), colour)
            theirs = paper.TABLE6[name][number] - paper.TABLE6["anytouch"][number]  # type: ignore[operator]
            axis.scatter(theirs, place, s=22, marker="D", color="#bbbbbb", zorder=1)
        axis.axvline(0, color="#222222", linewidth=0.7)
        axis.set_xlabel(
            f"blue: material, orange: form, points\ndiamonds: paper, {columns.FOUR_PAPER[number]}", fontsize=7
        )
    plots.write_figure(path, figure)
    return path


def dynamics(runs: Sequence[Run], path: Path) -> Path:
    """The dynamic tasks of AnyTouch from clips, stills, shuffled and repeated frames."""
    figure, axes = _panels(1, 4, 2.7, 3.0)
    views = ("clips", "stills", "shuffled", "repeated")
    for i, axis in enumerate(axes):
        for place, view in enumerate(views):
            for shift, name in ((-0.2, "anytouch"), (0.2, "static_only")):
                result = spread(runs, "dynamics", name, columns.dynamic(view)[i])
                if result is not None:
                    _bar(axis, place + shift, result, 0.38, "C0" if name == "anytouch" else "#bbbbbb")
        axis.set_title(columns.dynamic("clips")[i].title, fontsize=9)
        axis.set_xticks(range(len(views)), views, rotation=30, fontsize=8)
        axis.axhline(0, color="#222222", linewidth=0.6)
        chance = commonest(runs, "dynamics", columns.dynamic("clips")[i])
        if chance:
            axis.axhline(chance, linestyle=":", color="#222222", linewidth=1)
    axes[0].set_ylabel("%; blue: AnyTouch, grey: stills only")
    plots.write_figure(path, figure)
    return path


def new_sensor(runs: Sequence[Run], path: Path) -> Path:
    """Accuracy on a sensor left out against how many frames of it there are."""
    figure, axes = _panels(1, len(scores.STATIC), 3.4, 3.2)
    counts = (0, *scores.FRAMES)
    for axis, task in zip(axes, scores.STATIC, strict=True):
        zero = spread(runs, "new_sensor", "left_out", Column(task, scores.NOTHING, task))
        for number, kind in enumerate(("universal, {} labelled", "fitted, {} labelled")):
            later = [spread(runs, "new_sensor", "left_out", Column(task, kind.format(n), task)) for n in counts[1:]]
            _line(axis, [zero, *later], kind.replace(" {}", ""), f"C{number}", bars=False)
        goal = spread(runs, "new_sensor", "seen", Column(task, "seen", task))
        if goal is not None:
            axis.axhline(goal[0], linestyle="--", color="#222222", linewidth=1)
        axis.set(title=f"{task} (dashes: trained on the sensor)", xlabel="frames of the new sensor")
        axis.title.set_fontsize(8)
        axis.set_xticks(range(len(counts)), list(map(str, counts)))
    axes[0].set_ylabel("accuracy, %")
    axes[-1].legend(frameon=False, fontsize=7)
    plots.write_figure(path, figure)
    return path


def _lines(names: Sequence[str], columns: Sequence[Column]) -> tuple[Any, list[Any]]:
    """Panels of four in a row, a column each, with a line for each model."""
    across = min(4, len(columns))
    figure, axes = _panels(-(-len(columns) // across), across, 3.0, 0.7 + 0.28 * len(names))
    for number, (axis, column) in enumerate(zip(axes, columns, strict=False)):
        axis.set_title(column.title, fontsize=9)
        axis.set_yticks(range(len(names)), [title(name) for name in names] if number % across == 0 else [], fontsize=7)
        axis.set_ylim(len(names) - 0.5, -0.5)
        axis.grid(alpha=0.25)
    return figure, axes


def _dot(axis: Any, place: float, result: tuple[float, float | None, float | None] | None, colour: str) -> None:
    if result is not None:
        mean, low, high = result
        axis.scatter(mean, place, s=26, color=colour, zorder=3)
        if low is not None and high is not None:
            axis.plot([low, high], [place, place], color=colour, linewidth=1.4, zorder=2)


def _bar(axis: Any, place: float, result: tuple[float, float | None, float | None], width: float, colour: str) -> None:
    mean, low, high = result
    axis.bar(place, mean, width, color=colour)
    if low is not None and high is not None:
        axis.plot([place, place], [low, high], color="#222222", linewidth=1.2)


def _line(
    axis: Any,
    result: Sequence[tuple[float, float | None, float | None] | None],
    label: str,
    colour: str,
    *,
    bars: bool = True,
) -> None:
    there = [(i, one) for i, one in enumerate(result) if one is not None]
    axis.plot([i for i, _ in there], [one[0] for _, one in there], "o-", color=colour, label=label, markersize=4)
    for i, (_, low, high) in there if bars else ():
        if low is not None and high is not None:
            axis.plot([i, i], [low, high], color=colour, linewidth=1)


def _panels(rows: int, columns: int, width: float, height: float) -> tuple[Any, list[Any]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    return figure, list(np.ravel(figure.subplots(rows, columns, squeeze=False)))
