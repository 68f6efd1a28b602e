"""Tables and records for people and programs: Markdown without HTML, percentages, plain JSON."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

# Fields of results with a value for each row or query: they are for tests that compare pairs, and
# would make a file of results a hundred times as long.
_PER_ROW = ("outcome", "per_query")


def plain(value: Any) -> Any:
    """Return a value for JSON: records as objects without their values per row.

    Numbers that are not finite are null, because JSON has none.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        names = [one.name for one in dataclasses.fields(value) if one.name not in _PER_ROW]
        return {name: plain(getattr(value, name)) for name in names}
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[Any]], align: str = "") -> str:
    """Return a Markdown table; use it wherever a page, a report or a command prints one.

    Cells are converted to text; bars, line breaks, HTML and links in them are escaped. `align` has
    a letter per column, l or r for left or right; without it the reader's program decides.

    >>> print(markdown_table(("sensor", "recall@1"), [("digit", 0.5)], "lr"))
    | sensor | recall@1 |
    | :--- | ---: |
    | digit | 0.5 |
    """
    marks = {"l": ":---", "r": "---:"}
    rule = [marks[letter] for letter in align] or ["---"] * len(header)
    lines = []
    for line in (header, rule, *rows):
        cells = [without_html(cell).replace("|", "\\|") for cell in line]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def without_html(value: Any) -> str:
    """Return one line of Markdown without HTML, links and attributes of elements.

    Names and captions come from files of strangers, and pages are shown in a browser.
    """
    one_line = " ".join(str(value).split())
    text = re.sub(r"&(?=#?\w+;)", "&amp;", one_line)
    text = re.sub(r"<(?=[A-Za-z/!?])", "&lt;", text)
    # "{" starts attributes in the documentation's dialect of Markdown
    return text.replace("](", "]\\(").replace("{", "&#123;")


def as_text(value: Any) -> str:
    """Return one line of Markdown that a reader sees as the value is written.

    It is for names and captions of a user.
    """
    # The brackets are escaped below, so the parenthesis after them needs nothing more.
    text = without_html(value).replace("]\\(", "](")
    # An underscore inside a word is no emphasis, and "my_cup" stays readable in the source.
    return re.sub(r"[\\`*\[\]~]|(?<![^\W_])_|_(?![^\W_])", r"\\\g<0>", text)


def fraction_text(value: float | None) -> str:
    """Return a fraction in percent as text, "-" if there is none."""
    if value is None or np.isnan(value):
        return "-"
    return f"{100 * value:.1f} %"


def interval_text(
    low: float | None, high: float | None, factor: float = 100.0, digits: int = 1
) -> str:
    """Return an interval as text, "-" if there is none; fractions are in points by default.

    Args:
        low: its lower end, None without an interval.
        high: its upper end.
        factor: of the numbers shown.
        digits: after the point.
    """
    if low is None or high is None:
        return "-"
    return f"{factor * low:.{digits}f} to {factor * high:.{digits}f}"


def score_text(
    value: float, low: float | None = None, high: float | None = None, *, difference: bool = False
) -> str:
    """Return a fraction in percent, or a difference in points with its sign, and its interval.

    Args:
        value: the fraction or difference.
        low: lower end of its interval, None without one.
        high: upper end.
        difference: whether it is a difference.
    """
    sign = "+" if difference else ""
    text = f"{100 * value:{sign}.1f}"
    if not difference:
        text += " %"
    if low is None or high is None:
        return text
    return f"{text} ({100 * low:{sign}.1f} to {100 * high:{sign}.1f})"


def listed_notes(notes: Sequence[str]) -> str:
    """Return notes as a Markdown list."""
    return "\n".join(f"- {as_text(note)}" for note in notes)
