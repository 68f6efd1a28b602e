"""Figure 4: touches in four spaces, drawn from the records alone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from anytouch_jax.evaluate.plots import panels, write_figure
from experiments.tables.results import Run

STAGES = (
    ("untrained", "no pre-training"),
    ("masked", "+ masked modelling"),
    ("aligned", "+ alignment"),
    ("matched", "+ matching"),
)
MARKS = ("o", "s", "^", "D", "v")
COLOURED = 12  # touches that get a colour and their lines; the others are grey


def q2(runs: Sequence[Run], path: Path) -> None:
    """Touches by three sensors in four spaces (Figure 4): a mark a sensor, a colour and dashed
    lines a touch.

    All panels are of one seed, the smallest that every stage has. Without such a seed nothing is
    drawn.
    """
    every = {(run.name, run.seed): run.about["points"] for run in runs if run.question == "q2"}
    stages = [(name, text) for name, text in STAGES if any(name == one for one, _ in every)]
    seeds = [seed for _, seed in sorted(every) if all((name, seed) in every for name, _ in stages)]
    if not seeds:
        return
    of = {name: every[name, min(seeds)] for name, _ in stages}
    figure, (axes,) = panels(1, len(stages), 3.6, 3.8)
    sensors = sorted({point["sensor"] for name, _ in stages for point in of[name]})
    touches = sorted({point["touch"] for name, _ in stages for point in of[name]})
    colours = {
        touch: f"C{i}" if i < 10 else ("#222222", "#b5b35c")[i - 10]
        for i, touch in enumerate(touches[:COLOURED])
    }
    for axis, (name, text) in zip(axes, stages, strict=True):
        for touch in touches:
            mine = [point for point in of[name] if point["touch"] == touch]
            if not mine:  # this space has no point of it
                continue
            colour = colours.get(touch, "#c8c8c8")
            ring = [*mine, mine[0]]
            if touch in colours:
                axis.plot(
                    [p["x"] for p in ring],
                    [p["y"] for p in ring],
                    "--",
                    color=colour,
                    linewidth=0.7,
                    zorder=1,
                )
            for point in mine:
                style = {
                    "color": colour,
                    "marker": MARKS[sensors.index(point["sensor"])],
                    "linewidths": 0,
                }
                axis.scatter(point["x"], point["y"], s=26, zorder=2 + (touch in colours), **style)
        axis.set(title=text, xticks=[], yticks=[])
    marks = [
        axes[-1].scatter([], [], s=30, color="#555555", marker=MARKS[i])
        for i in range(len(sensors))
    ]
    legend = {"ncols": len(sensors), "frameon": False, "title": f"seed {min(seeds)}"}
    figure.legend(marks, sensors, loc="outside lower center", **legend)
    write_figure(path, figure)
