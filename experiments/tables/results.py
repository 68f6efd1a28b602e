"""Runs of the matrix as the pages read them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from anytouch_jax.errors import UserError
from experiments.records import check_alike, read_records
from experiments.tables.plan import LABELS
from experiments.values import Seeds, Value, over_seeds, shared_difference

UNSEEDED = ("pixels", "contact")  # models that nothing is drawn for
NOT_NOTED = "not noted"


@dataclass(frozen=True)
class Run:
    """One record of the matrix."""

    question: str
    name: str
    seed: int
    about: Mapping[str, Any]

    def row(self, column: Column, protocol: str = "grouped") -> Mapping[str, Any] | None:
        """The row of a column, if it was measured."""
        for one in self.about["rows"]:
            key = one["view"], one["task"], one["metric"], one["protocol"]
            if (
                key == (column.view, column.task, column.metric, protocol)
                and one["mean"] is not None
            ):
                return one  # type: ignore[no-any-return]
        return None


class Column(NamedTuple):
    """What a column of a table reads: `view`, `task` and `metric` of a row; `factor` brings it to
    what is printed.
    """

    view: str
    task: str
    metric: str = "accuracy"
    factor: float = 100.0


def read(path: Path) -> list[Run]:
    """Return the runs of a file of results, in the order of keys.

    Raises UserError for a record that is no run.
    """
    runs = []
    for key, about in read_records(path).items():
        try:
            runs.append(Run(about["question"], about["name"], int(about["seed"]), about))
        except (ValueError, KeyError, TypeError) as error:
            raise UserError(
                f"{path}: {key} is no run of the matrix ({error!r}). Remove its line."
            ) from None
    return runs


def noted(path: Path) -> dict[str, Any]:
    """Return the content of a file of notes, {} for a missing or broken one."""
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    if isinstance(result, dict):
        return result
    return {}


def simulated(about: Mapping[str, Any]) -> int:
    """The version of the simulator that a record is of; those that note none are of the first."""
    return int(about.get("simulator", 1))


def compared(records: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return what records of one table must share, by name.

    That is simulator, scoring, settings, and, within a seed, the content of every data set by its
    name: signs are taken seed by seed. The data of another seed may be of another processor, where
    the same scenes gave another content hash.
    """
    names = {name for about in records for name in about["settings"] if name not in LABELS}
    return [
        {"simulator version": simulated(about), "scoring version": about.get("scoring", 1)}
        | {name: about["settings"].get(name, NOT_NOTED) for name in names}
        | {
            f"data set {name} of seed {about.get('seed')}": value[:8]
            for name, value in about.get("data", {}).items()
        }
        for about in records
    ]


class Matrix:
    """The runs of one question. Raises UserError for runs that make no table together."""

    def __init__(self, path: Path, question: str) -> None:
        self.runs = [run for run in read(path) if run.question == question]
        check_alike(path, compared([run.about for run in self.runs]))

    def seeds(self, name: str, columns: Sequence[Column]) -> Seeds:
        """Return {seed: mean over columns of one unit}, for seeds that have all of them."""
        found = {
            run.seed: [run.row(column) for column in columns]
            for run in self.runs
            if run.name == name
        }
        return {
            seed: columns[0].factor
            * float(np.mean([row["mean"] for row in rows if row is not None]))
            for seed, rows in sorted(found.items())
            if None not in rows
        }

    def value(self, name: str, columns: Sequence[Column]) -> Value | None:
        """Return the score of a model; what is not trained has one value and no interval."""
        several = [*self.seeds(name, columns).values()]
        if several:
            return Value(several[0]) if name in UNSEEDED else over_seeds(several)
        return None

    def change(self, first: str, second: str, columns: Sequence[Column]) -> Value | None:
        """Return the score of `first` minus that of `second`, seed by seed."""
        a = self.seeds(first, columns)
        b = self.seeds(second, columns)
        b = dict.fromkeys(a, next(iter(b.values()))) if second in UNSEEDED and b else b
        if first != second:
            return shared_difference(a, b)
        return None
