"""Pages of results: a record of `pages.toml`, with the rows and findings that are made from its
data.
"""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from anytouch_jax.evaluate.tables import markdown_table, without_html
from experiments.values import Value

RECORDS = tomllib.loads(Path(__file__).with_name("pages.toml").read_text(encoding="utf-8"))
MOST = 5  # findings of a page
CAPTION = "The values of the first table with their intervals."
Row = Sequence[Any]  # a word for a text column, or a Value, number or None for a Measure


class Measure(NamedTuple):
    """A column of values. `form` is a format of Python."""

    title: str
    form: str = ".1f"


class Table(NamedTuple):
    """Rows under a head, which has a word for a text column and a Measure for a column of
    values.
    """

    title: str
    head: Sequence[str | Measure]
    rows: Sequence[Row]


class Finding(NamedTuple):
    """A comparison: `change` is `first` minus `second` on `what`."""

    first: str
    second: str
    change: Value | None
    what: str = ""
    unit: str = " points"
    form: str = ".1f"

    @property
    def differs(self) -> bool:
        """Whether a difference is shown."""
        return self.change is not None and self.change.differs

    @property
    def words(self) -> str:
        """What is found, without numbers."""
        what = f"{self.what}: " if self.what else ""
        if self.change is None or not self.differs:
            return f"{what}no difference is shown between {self.first} and {self.second}"
        return f"{what}{self.first} is {'above' if self.change.mean > 0 else 'below'} {self.second}"

    @property
    def figure(self) -> str:
        """The difference with its interval."""
        if self.change is None:
            return ""
        return f"{self.change.shown(f'+{self.form}')}{self.unit}"


@dataclass(frozen=True)
class Page:
    """What a page has beyond its record: rows of its tables, and findings, of which the first
    answers the question.

    A table is rows for the next table of the record, or a Table. Only findings that show a
    difference are printed. `answer` is another answer with its figure. The image has the first
    table, or is drawn by `figure`, which is given the path. `readme` has the values by name that
    the README repeats, and `words` what the record leaves open.
    """

    name: str
    tables: Sequence[Sequence[Row] | Table]
    findings: Sequence[Finding | str]
    answer: tuple[str, str] | None = None
    figure: Callable[[Path], object] | None = None
    readme: Mapping[str, Value] = field(default_factory=dict)
    words: Mapping[str, str] = field(default_factory=dict)

    @property
    def record(self) -> Mapping[str, Any]:
        """Its record."""
        result: Mapping[str, Any] = RECORDS[self.name]
        return result

    @property
    def whole(self) -> list[Table]:
        """Its tables under their heads."""
        known = iter(self.record["tables"])
        return [one if isinstance(one, Table) else _headed(next(known), one) for one in self.tables]


def _headed(record: Mapping[str, Any], rows: Sequence[Row]) -> Table:
    head = [column if isinstance(column, str) else Measure(*column) for column in record["head"]]
    return Table(record["title"], head, rows)


def sentences(page: Page) -> list[str]:
    """Return at most MOST findings; the last one counts comparisons without a difference."""
    compared = [one for one in page.findings if isinstance(one, Finding)]
    shown = [
        one if isinstance(one, str) else f"{one.words}, {one.figure}."
        for one in page.findings
        if isinstance(one, str) or one.differs
    ]
    if alike := sum(not one.differs for one in compared):
        shown = [*shown[: MOST - 1], f"{alike} of {len(compared)} comparisons show no difference."]
    return [one[0].upper() + one[1:] for one in shown[:MOST]]


def answer(page: Page) -> tuple[str, str]:
    """Return the answer of a page and its figure."""
    first = page.findings[0]
    words, figure = page.answer or (
        (first, "") if isinstance(first, str) else (f"{first.words}.", first.figure)
    )
    return words[0].upper() + words[1:], figure


def text(page: Page) -> str:
    """Return a page as Markdown."""
    one = page.record
    about = without_html(page.record["about"].format(**page.words))
    found = "\n".join(f"* {without_html(sentence)}" for sentence in sentences(page))
    tables = "\n".join(
        f"## {without_html(table.title)}\n\n{markdown(table)}\n" for table in page.whole
    )
    files = ", ".join(f"[`{name}`]({name})" for name in one["data"])
    return (
        f"# {one['question']}\n\n{about}\n\n## Findings\n\n{found}\n\n{tables}\n"
        f"![{one.get('caption', CAPTION)}](figures/{page.name}.png)\n\nData: {files}. Command: "
        f"`{one['command']}`.\n"
    )


def markdown(table: Table) -> str:
    """Return a table as Markdown. A cell has the mean and its interval."""
    titles = [column.title if isinstance(column, Measure) else column for column in table.head]
    align = "".join("r" if isinstance(column, Measure) else "l" for column in table.head)
    rows = [[_cell(*one) for one in zip(table.head, row, strict=True)] for row in table.rows]
    return markdown_table(titles, rows, align)


def _cell(column: str | Measure, cell: Any) -> str:
    if isinstance(column, str):
        return cell or ""
    value = (
        cell if isinstance(cell, Value) else Value(float("nan") if cell is None else float(cell))
    )
    if np.isnan(value.mean):
        return "-"
    return value.shown(column.form)


def draw(page: Page, path: Path) -> None:
    """Draw the figure of a page: its own, or a dot and an interval for each row, with a panel for
    each measure.
    """
    if page.figure is not None:
        page.figure(path)
        return
    from anytouch_jax.evaluate.plots import panels, write_figure

    _, head, rows = page.whole[0]
    texts = [i for i, column in enumerate(head) if isinstance(column, str)]
    shown = [
        (i, column)
        for i, column in enumerate(head)
        if isinstance(column, Measure) and any(isinstance(row[i], Value) for row in rows)
    ]
    names = [", ".join(row[i] for i in texts if row[i]) for row in rows]
    colours = {
        name: f"C{i % 10}" for i, name in enumerate(dict.fromkeys(row[texts[-1]] for row in rows))
    }
    width = 2.4 + (3 + 0.05 * max(map(len, names))) / len(shown)
    figure, (axes,) = panels(1, len(shown), width, 0.9 + 0.2 * len(names), sharey=True)
    for axis, (column, measure) in zip(axes, shown, strict=True):
        for place, row in enumerate(rows):
            if isinstance(value := row[column], Value):
                sides = [value.mean if side is None else side for side in (value.low, value.high)]
                axis.plot(sides, [place, place], color=colours[row[texts[-1]]], linewidth=1.4)
                axis.scatter(value.mean, place, s=22, color=colours[row[texts[-1]]], zorder=3)
        axis.set_title(measure.title, fontsize=9)
        axis.tick_params(axis="x", labelsize=8)
        axis.grid(alpha=0.25)
        if "+" in measure.form:
            axis.axvline(0, color="#222222", linewidth=0.7)
    axes[0].set_yticks(range(len(names)), names, fontsize=8)
    axes[0].set_ylim(len(names) - 0.5, -0.5)
    write_figure(path, figure)
