"""Tables of the paper from the records of the runs: the paper's numbers next to ours, and whether signs agree."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from anytouch_jax.evaluate.statistics import markdown_table
from experiments.tables import paper
from experiments.tables.results import CLAIM, NO_SIGN, Change, Column, Run, Seeds, change, spread, together, values

TITLES = {
    "untrained": "untrained encoder", "pixels": "raw pixels, no encoder",
    "contact": "area, place and force alone",
    "no_pretraining": "no tactile pre-training (image tower)",
    "anytouch": "AnyTouch", "unitouch": "UniTouch-style", "tlv_link": "TLV-Link-style", "t3": "T3-style",
    "static_only": "AnyTouch, stills only", "no_text": "w/o text", "no_vision": "w/o vision",
    "no_text_aligned": "w/o text in the aligned set", "no_stage1": "w/o stage 1", "no_stage2": "w/o stage 2",
    "no_matching": "w/o cross-sensor matching", "no_dynamic": "w/o dynamic perception",
    "no_universal": "w/o universal tokens", "masked": "+ masked modelling", "aligned": "+ alignment",
    "matched": "+ matching", "matched_mlp": "+ matching by the paper's head",
    "no_flips": "AnyTouch, touches never flipped",
    "universal, 0 unlabelled": "universal, no frame", "left_out": "left out of training", "seen": "trained on",
}  # fmt: skip


UNSEEDED = ("pixels", "contact")  # models that nothing is drawn for


class Table(NamedTuple):
    """What a table shows of a question: models, columns, the paper's rows for some of them, its column names."""

    question: str
    names: Sequence[str]
    columns: Sequence[Column]
    paper: Mapping[str, paper.Row] = {}
    paper_titles: Sequence[str] = ()


class Pair(NamedTuple):
    """A sign to be tested: `first` against `second`; `expected` a sign for each column (None: the paper has none).

    `whole` are the numbers of the columns whose mean stands for the row; None is all of them.
    """

    label: str
    first: str
    second: str
    expected: Sequence[float | None]
    whole: Sequence[int] | None = None


class Statement(NamedTuple):
    """The outcome of a pair: of the row as a whole (the mean of `over`), and of its columns {title: change}."""

    label: str
    row: Change
    columns: Mapping[str, Change]
    over: Sequence[str] = ()


def judge(runs: Sequence[Run], question: str, columns: Sequence[Column], pairs: Sequence[Pair]) -> list[Statement]:
    """The statements of a table."""
    result = []
    for pair in pairs:
        sides = [
            (mine := values(runs, question, pair.first, one), _opponent(runs, question, pair.second, one, mine),
             one.better)
            for one in columns
        ]  # fmt: skip
        by_column = {
            column.title: change(first, second, expected, better)
            for column, (first, second, better), expected in zip(columns, sides, pair.expected, strict=True)
        }
        whole = [i for i in (range(len(columns)) if pair.whole is None else pair.whole) if pair.expected[i]]
        over = [columns[i].title for i in whole]
        if not whole:
            run = any(one.word != "not run" for one in by_column.values())
            row = Change(NO_SIGN if run else "not run")
        elif len(whole) == 1:
            row = by_column[over[0]]
        else:
            row = together([sides[i] for i in whole], sum(np.sign(pair.expected[i] or 0) for i in whole) or None)
        result.append(Statement(pair.label, row, by_column, over))
    return result


def _opponent(runs: Sequence[Run], question: str, name: str, column: Column, first: Seeds) -> Seeds:
    """The values of the second of a pair; what is not trained is one number, the same for every seed of the first."""
    result = values(runs, question, name, column)
    return dict.fromkeys(first, next(iter(result.values()))) if result and name in UNSEEDED else result


def against(table: Table, first: str | None, second: str | None) -> list[Pair]:
    """Pairs of every other model of a table with `first` (or `second`) held: the paper's differences are expected."""
    result = []
    for name in table.names:
        one, two = first or name, second or name
        if one == two:
            continue
        ours, theirs = (table.paper.get(model, (None,) * len(table.columns)) for model in (one, two))
        expected = [None if a is None or b is None else float(a - b) for a, b in zip(ours, theirs, strict=True)]
        result.append(Pair(f"{title(one)} against {title(two)}", one, two, expected))
    return result


def title(name: str) -> str:
    """A model's name for people."""
    return TITLES.get(name, name.replace("+", ", "))


def block(runs: Sequence[Run], table: Table, statements: Sequence[Statement]) -> str:
    """Return the table, that of the published protocol, and the statements, as Markdown."""
    parts = [_ours(runs, table)]
    parts += [on_test] if (on_test := published(runs, table)) else []
    if statements:
        parts.append("\n".join(map(sentence, statements)))
    return "\n\n".join(parts)


def _ours(runs: Sequence[Run], table: Table) -> str:
    head = ["model", "seeds", *(column.title for column in table.columns)]
    head += [f"paper: {one}" for one in table.paper_titles]
    lines = []
    for name in table.names:
        seeds = {run.seed for run in runs if (run.question, run.name) == (table.question, name)}
        cells = [cell(runs, table.question, name, column) for column in table.columns]
        if not seeds:
            cells = ["not run"] * len(table.columns)
        theirs = table.paper.get(name, (None,) * len(table.paper_titles))
        lines.append((title(name), str(len(seeds)), *cells, *("-" if one is None else f"{one:.2f}" for one in theirs)))
    chances = [commonest(runs, table.question, column) for column in table.columns]
    if any(one is not None for one in chances):
        pairs = zip(chances, table.columns, strict=True)
        shown = ["-" if one is None else f"{one:.{column.digits}f}" for one, column in pairs]
        lines.append(("*the commonest answer*", "-", *shown, *("-" for _ in table.paper_titles)))
    return markdown_table(head, lines)


def commonest(runs: Sequence[Run], question: str, column: Column) -> float | None:
    """What one answer for all gives on the test rows of a column of accuracies, as printed; 0 for R2."""
    if column.metric == "r2":
        return 0.0
    result = [
        row["chance"] for run in runs if run.question == question and (row := run.row(column)) and "chance" in row
    ]
    return column.factor * float(np.mean(result)) if result and column.metric == "accuracy" else None


def published(runs: Sequence[Run], table: Table) -> str:
    """Means under the published protocol; nothing where no run has it."""
    lines = []
    for name in table.names:
        result = [values(runs, table.question, name, column, "published") for column in table.columns]
        if any(result):
            pairs = zip(result, table.columns, strict=True)
            cells = [f"{np.mean(list(one.values())):.{column.digits}f}" if one else "-" for one, column in pairs]
            lines.append((title(name), str(max(map(len, result))), *cells))
    if not lines:
        return ""
    head = ("published protocol (chosen on test)", "seeds", *(column.title for column in table.columns))
    return markdown_table(head, lines)


def cell(runs: Sequence[Run], question: str, name: str, column: Column) -> str:
    """Mean and interval of a cell."""
    result = spread(runs, question, name, column)
    if result is None:
        return "-"
    mean, low, high = result
    between = "" if low is None or high is None else f" ({low:.{column.digits}f} to {high:.{column.digits}f})"
    return f"{mean:.{column.digits}f}{between}"


def sentence(one: Statement) -> str:
    """Return a statement as a line of a list. Only the row has a sign: of many columns some differ by chance."""
    if one.row.word == "not run":
        return f"- {one.label}: **not run**."
    columns = "; ".join(f"{name} {_signed(part)}" for name, part in one.columns.items())
    row = one.row
    if row.word == NO_SIGN:
        return f"- {one.label}: **{NO_SIGN}**. By column: {columns}."
    word = {"agrees": "the sign agrees", "disagrees": "the sign does not agree"}.get(row.word, row.word)
    if len(one.columns) == 1:
        return f"- {one.label}: **{word}**, {_signed(row)}."
    wrong = [name for name, part in one.columns.items() if part.word == "disagrees" and row.word != "disagrees"]
    against = "Below it" if "our control" in one.label else "Against the paper's sign"
    columns += f". **{against}: {', '.join(wrong)}**" if wrong else ""
    over = "all columns together" if len(one.over) == len(one.columns) else " and ".join(one.over)
    return f"- {one.label}: **{word}**, {over} {_signed(row)}. By column: {columns}."


def _signed(one: Change) -> str:
    if one.mean is None:
        return "not run"
    between = "" if one.low is None or one.high is None else f" ({one.low:+.2f} to {one.high:+.2f})"
    return f"{one.mean:+.2f}{between}"


def by_chance(statements: Sequence[Statement]) -> str:
    """How many intervals by column there are, and how many of them would leave zero out if nothing differed."""
    decided = ("agrees", "disagrees", "undecided")
    columns = sum(part.word in decided for one in statements for part in one.columns.values())
    rows = sum(one.row.word in decided for one in statements)
    few = f"about {columns / 20:.0f}" if columns >= 20 else "less than one"
    return (
        f"Of {columns} columns a sign is expected (the paper's, or that of a control of ours) and there is an\n"
        f"interval; {few} of so many leave zero out by chance alone. So a sign is given for a row, {rows} times,\n"
        "and nothing is corrected for that number."
    )


def tally(statements: Mapping[str, Sequence[Statement]]) -> str:
    """How many rows of each table agree, of those for which the paper has a sign."""
    words = ("agrees", "disagrees", "undecided", "no claim", "not run")
    lines = []
    for name, several in statements.items():
        counts = Counter("no claim" if "claim" in one.row.word else one.row.word for one in several)
        lines.append((name, *(str(counts.get(word, 0)) for word in words)))
    return markdown_table(
        ("rows of", "sign agrees", "does not", "undecided", f"fewer than {CLAIM} seeds", "not run"), lines
    )
