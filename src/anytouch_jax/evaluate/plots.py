"""Charts as PNG files: losses and bars."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from anytouch_jax.config import parse_json
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.geometry import (
    Space,
    alignment,
    describe,
    silhouette,
    tsne,
    uniformity,
)
from anytouch_jax.files import atomic_write

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TERMS = ("reconstruction", "next_frame", "align", "match")  # the terms of a loss that get a curve
_DPI = 110


# The geometry of feature spaces was defined here.
__all__ = [
    "FractionBar",
    "Space",
    "alignment",
    "bars",
    "describe",
    "loss_curves",
    "panels",
    "read_metrics",
    "silhouette",
    "smoothed",
    "tsne",
    "uniformity",
    "write_figure",
]


class FractionBar(NamedTuple):
    """A fraction (0..1) with its interval and the chance level; None is not drawn."""

    value: float
    low: float | None = None
    high: float | None = None
    chance: float | None = None


def write_figure(path: Path, figure: Figure) -> None:
    """Write a figure as PNG; the same figure gives the same bytes. Raises OSError."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)  # without pyplot: no global state, no display
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=_DPI, metadata={"Software": None})
    atomic_write(path, data.getvalue())


def read_metrics(run: Path) -> list[dict[str, Any]]:
    """Return the lines of metrics.jsonl of a run folder, or of the file.

    Raises UserError if there are none.
    """
    file = run / "metrics.jsonl" if run.is_dir() else run
    try:
        lines = [parse_json(line) for line in file.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError) as error:
        raise UserError(
            f"{file} is not the metrics.jsonl of a run ({error}). Give a run folder."
        ) from None
    for number, line in enumerate(lines, 1):
        if not _is_step(line):
            raise UserError(
                f"Line {number} of {file} has no step, or a loss that is not a number. Remove the "
                "line."
            )
    if not lines:
        raise UserError(f"{file} has no step yet. Train first.")
    return lines


def _is_step(line: Any) -> bool:
    """Return whether a line of metrics.jsonl has a step, and losses that are numbers."""
    if not isinstance(line, dict):
        return False
    losses = [line[name] for name in (*TERMS, "loss") if line.get(name) is not None]
    return all(isinstance(value, int | float) for value in (line.get("step"), *losses))


def loss_curves(path: Path, runs: Mapping[str, Path]) -> None:
    """Draw loss against step, raw and smoothed, a panel for each run.

    `runs` is {title: run folder or metrics.jsonl}.
    """
    figure, axes = panels(1, len(runs), 5.0, 3.4)
    for axis, (title, run) in zip(axes[0], runs.items(), strict=True):
        lines = read_metrics(Path(run))
        names = [name for name in TERMS if any(name in line for line in lines)]
        for colour, name in enumerate(names or ["loss"]):
            points = [(line["step"], line[name]) for line in lines if line.get(name) is not None]
            steps, values = np.array(points, np.float64).reshape(-1, 2).T
            axis.plot(steps, values, color=f"C{colour}", alpha=0.25, linewidth=0.8)
            axis.plot(
                steps,
                smoothed(values),
                color=f"C{colour}",
                linewidth=1.6,
                label=name.replace("_", " "),
            )
        axis.set(title=title, xlabel="step", ylabel="loss term")
        axis.locator_params(axis="x", integer=True)
        axis.set_ylim(bottom=0)
        axis.legend(frameon=False)
        axis.grid(alpha=0.25)
    write_figure(path, figure)


def smoothed(values: Array) -> Array:
    """Return the running mean over a twentieth of the values; windows are cut at both ends."""
    width = max(1, len(values) // 20)
    if width == 1:
        return np.asarray(values)
    kernel = np.ones(width)
    return np.convolve(values, kernel, "same") / np.convolve(np.ones(len(values)), kernel, "same")


def bars(
    path: Path, series: Mapping[str, Mapping[str, FractionBar]], *, label: str = "fraction"
) -> None:
    """Draw horizontal bars of fractions with their intervals; dashes mark chance.

    `series` is {panel: {name: ShareBar}}.
    """
    longest = max(len(one) for one in series.values())
    figure, axes = panels(1, len(series), 4.2, 0.9 + 0.34 * longest, sharex=True, sharey=True)
    names = list(dict.fromkeys(name for one in series.values() for name in one))
    for axis, (title, values) in zip(axes[0], series.items(), strict=True):
        for name, bar in values.items():
            place = names.index(name)
            axis.barh(place, 100 * bar.value, color=f"C{place % 10}", alpha=0.85, height=0.7)
            if bar.low is not None and bar.high is not None:
                interval = [100 * bar.low, 100 * bar.high]
                axis.plot(interval, [place, place], color="#222222", linewidth=1.4)
            if bar.chance is not None:
                chance = [100 * bar.chance] * 2
                height = [place - 0.45, place + 0.45]
                axis.plot(chance, height, "--", color="#222222", linewidth=1)
        axis.set(title=title, xlabel=f"{label}, % (95 % interval)", axisbelow=True)
        axis.set_yticks(range(len(names)), names)
        axis.grid(axis="x", alpha=0.25)
    # after all panels, which share it: a limit ends its growth
    axes[0][0].set_xlim(left=0)
    axes[0][0].invert_yaxis()
    write_figure(path, figure)


def panels(
    rows: int, columns: int, width: float, height: float, **options: Any
) -> tuple[Figure, list[list[Axes]]]:
    """Return a figure and its grid of axes, each `width` x `height` inches.

    Raises UserError without any.

    Args:
        rows: of the grid.
        columns: of the grid.
        width: inches of one of its axes.
        height: inches of one of its axes.
        options: of the figure.
    """
    from matplotlib.figure import Figure

    if not rows or not columns:
        raise UserError("There is nothing to draw.")
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    return figure, figure.subplots(rows, columns, squeeze=False, **options).tolist()
