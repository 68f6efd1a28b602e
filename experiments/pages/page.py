"""Pages of results: a question, one table, one sentence a finding, one figure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from anytouch_jax.evaluate.statistics import markdown_table
from experiments.verdicts import CLAIM, seed_interval

Cell = Any  # a word of a text column, or a Value, number or None of a Measure


class Value(NamedTuple):
    """A mean, its 95 % interval (None where there is none), and the number of seeds behind it."""

    mean: float
    low: float | None = None
    high: float | None = None
    seeds: int = CLAIM

    def times(self, factor: float) -> Value:
        """Return the value in another unit."""
        low, high = (None if side is None else factor * side for side in (self.low, self.high))
        return Value(factor * self.mean, low, high, self.seeds)


class Measure(NamedTuple):
    """A column of values. `interval` adds the columns "from" and "to"; `form` is a format of Python."""

    title: str
    form: str = ".1f"
    interval: bool = True


@dataclass(frozen=True)
class Page:
    """The content of a page. `head` has a word for a text column and a Measure for a column of values.

    `drawn` is the number of text columns that name a row in the figure. `figure` draws another picture than the rows:
    it is given the path. None draws the rows.
    """

    name: str
    question: str
    about: str
    head: Sequence[str | Measure]
    rows: Sequence[Sequence[Cell]]
    findings: Sequence[str]
    data: Sequence[str]
    command: str
    caption: str = "The values of the table with their intervals."
    figure: Any = None


def over_seeds(values: Sequence[float]) -> Value:
    """Return the mean over seeds with its interval (Student's t); of two seeds the interval is the two values."""
    low, high = (min(values), max(values)) if len(values) == 2 else seed_interval(values)
    return Value(float(np.mean(values)), low, high, len(values))


def compare(
    first: str, second: str, change: Value | None, what: str = "", unit: str = " points", form: str = ".1f"
) -> str:
    """Return a sentence that says whether `first` is above `second` on `what`. `change` is the paired difference."""
    what = f"{what}: " if what else ""
    if change is None:
        return f"{what}{first} was not compared with {second}."
    if change.seeds < CLAIM or change.low is None or change.high is None:
        return f"{what}there are too few seeds to compare {first} with {second}."
    if change.low <= 0 <= change.high:
        return f"{what}no difference is shown between {first} and {second}."
    word = "above" if change.low > 0 else "below"
    low, high = sorted((abs(change.low), abs(change.high)))
    return f"{what}{first} is {abs(change.mean):{form}}{unit} {word} {second} ({low:{form}} to {high:{form}})."


def text(page: Page) -> str:
    """Return a page as Markdown."""
    head = [column.title if isinstance(column, Measure) else column for column in _columns(page.head)]
    align = "".join("l" if isinstance(column, str) and column not in SIDES else "r" for column in _columns(page.head))
    rows = [_cells(page.head, row) for row in page.rows]
    files = ", ".join(f"[`{name}`]({name})" for name in page.data)
    findings = "\n".join(f"* {one[0].upper()}{one[1:]}" for one in page.findings)
    return (
        f"# {page.question}\n\n{page.about}\n\n## Findings\n\n{findings}\n\n## Values\n\n"
        f"{markdown_table(head, rows, align)}\n\n![{page.caption}](figures/{page.name}.png)\n\n{page.caption}\n\n"
        f"Data: {files}. Command: `{page.command}`.\n"
    )


SIDES = ("from", "to")


def _columns(head: Sequence[str | Measure]) -> list[str | Measure]:
    result: list[str | Measure] = []
    for column in head:
        result += [column, *(SIDES if isinstance(column, Measure) and column.interval else ())]
    return result


def _cells(head: Sequence[str | Measure], row: Sequence[Cell]) -> list[str]:
    result = []
    for column, cell in zip(head, row, strict=True):
        if isinstance(column, str):
            result.append(cell)
            continue
        value = cell if isinstance(cell, Value) else Value(*([cell] if cell is not None else [float("nan")]))
        sides = (value.mean, value.low, value.high) if column.interval else (value.mean,)
        result += ["-" if one is None or np.isnan(one) else f"{one:{column.form}}" for one in sides]
    return result


def draw(page: Page, path: Path) -> None:
    """Draw the figure of a page: its own, or a dot and an interval for each row, with a panel for each measure."""
    if page.figure is not None:
        page.figure(path)
        return
    from matplotlib.figure import Figure

    from anytouch_jax.evaluate.plots import write_figure

    texts = [i for i, column in enumerate(page.head) if isinstance(column, str)]
    panels = [(i, column) for i, column in enumerate(page.head) if isinstance(column, Measure) and column.interval]
    names = [", ".join(row[i] for i in texts if row[i]) for row in page.rows]
    size = (3.2 + 0.05 * max(map(len, names)) + 2.4 * len(panels), 0.9 + 0.2 * len(names))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
    colours = {name: f"C{i % 10}" for i, name in enumerate(dict.fromkeys(row[texts[-1]] for row in page.rows))}
    for axis, (column, measure) in zip(axes, panels, strict=True):
        for place, row in enumerate(page.rows):
            value = row[column]
            if isinstance(value, Value):
                colour = colours[row[texts[-1]]]
                axis.scatter(value.mean, place, s=22, color=colour, zorder=3)
                if value.low is not None and value.high is not None:
                    axis.plot([value.low, value.high], [place, place], color=colour, linewidth=1.4, zorder=2)
        axis.set_title(measure.title, fontsize=9)
        axis.tick_params(axis="x", labelsize=8)
        axis.grid(alpha=0.25)
        if "+" in measure.form:
            axis.axvline(0, color="#222222", linewidth=0.7)
    axes[0].set_yticks(range(len(names)), names, fontsize=8)
    axes[0].set_ylim(len(names) - 0.5, -0.5)
    write_figure(path, figure)
