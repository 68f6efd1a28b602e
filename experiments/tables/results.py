"""Runs of the matrix as tables read them, and what paired seeds say of a sign."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from anytouch_jax.errors import UserError
from experiments.records import read_records
from experiments.tables.plan import LABELS
from experiments.verdicts import CLAIM, verdict
from experiments.verdicts import seed_interval as interval

NO_SIGN = "no sign in the paper"
NOT_NOTED = "not noted"
Seeds = dict[int, float]


@dataclass(frozen=True)
class Run:
    """One record of the matrix."""

    question: str
    name: str
    seed: int
    about: Mapping[str, Any]

    def row(self, column: Column, protocol: str = "honest") -> Mapping[str, Any] | None:
        """The row of a column, if it was measured."""
        for one in self.about["rows"]:
            key = one["view"], one["task"], one["metric"], one["protocol"]
            if key == (column.view, column.task, column.metric, protocol) and one["mean"] is not None:
                return one  # type: ignore[no-any-return]
        return None


class Column(NamedTuple):
    """What a column of a table reads: `view`, `task` and `metric` of a row; `factor` brings it to what is printed.

    `better` is -1 where less is better.
    """

    title: str
    view: str
    task: str
    metric: str = "accuracy"
    factor: float = 100.0
    better: int = 1
    digits: int = 1


class Change(NamedTuple):
    """A difference over seeds: mean, 95 % interval (Student's t), and a word for its sign."""

    word: str
    mean: float | None = None
    low: float | None = None
    high: float | None = None
    seeds: int = 0


def read(path: Path) -> list[Run]:
    """Return the runs of a file of results, in the order of their keys.

    Raises UserError for a record that is no run of the matrix.
    """
    runs = []
    for key, about in read_records(path).items():
        try:
            runs.append(Run(about["question"], about["name"], int(about["seed"]), about))
        except (ValueError, KeyError, TypeError) as error:
            raise UserError(f"{path}: {key} is no run of the matrix ({error!r}). Remove its line.") from None
    return runs


def noted(path: Path) -> dict[str, Any]:
    """Return the content of a file of notes, {} for a missing or broken one."""
    try:
        result = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return result if isinstance(result, dict) else {}


def simulated(about: Mapping[str, Any]) -> int:
    """The version of the simulator that a record is of; those that note none are of the first."""
    return int(about.get("simulator", 1))


def differences(records: Sequence[Mapping[str, Any]]) -> str:
    """What records of one table must share and do not, in words; empty where they can be compared.

    Simulator, scoring, settings, and, within a seed, the content of every data set by its name: signs are taken seed by
    seed. The data of another seed may be of another processor, where the same scenes gave another content hash. Records
    without settings are distinguished by the name of their size.
    """
    result: dict[str, set[str]] = {}
    names = {name for about in records for name in about.get("settings") or {} if name not in LABELS}
    untold = any(not about.get("settings") for about in records)
    for about in records:
        result.setdefault("simulator version", set()).add(str(simulated(about)))
        result.setdefault("scoring version", set()).add(str(about.get("scoring", 1)))
        for name in names if about.get("settings") else ():  # a setting that one does not know is another value
            result.setdefault(name, set()).add(str(about["settings"].get(name, NOT_NOTED)))
        for name, value in about.get("data", {}).items():
            result.setdefault(f"data set {name} of seed {about.get('seed')}", set()).add(value[:8])
        if untold:
            result.setdefault("size", set()).add(str(about.get("size")))
    return "; ".join(f"{name} {' and '.join(sorted(several))}" for name, several in result.items() if len(several) > 1)


def values(runs: Sequence[Run], question: str, name: str, column: Column, protocol: str = "honest") -> Seeds:
    """Return {seed: printed value} of a cell."""
    return {
        run.seed: column.factor * float(row["mean"])
        for run in runs
        if (run.question, run.name) == (question, name) and (row := run.row(column, protocol)) is not None
    }


def over_seeds(several: list[float]) -> tuple[float | None, float | None]:
    """The 95 % interval of Student's t; of two seeds, where it is as wide as the scale, the two themselves."""
    return (min(several), max(several)) if len(several) == 2 else interval(several)


def spread(
    runs: Sequence[Run], question: str, name: str, column: Column, protocol: str = "honest"
) -> tuple[float, float | None, float | None] | None:
    """Mean of a cell and its interval: over seeds, with one seed that of the run itself (over test objects)."""
    result = values(runs, question, name, column, protocol)
    if not result:
        return None
    mean, (low, high) = float(np.mean(list(result.values()))), over_seeds(list(result.values()))
    if len(result) == 1:
        run = next(one for one in runs if (one.question, one.name, one.seed) == (question, name, *result))
        row = run.row(column, protocol) or {}
        low, high = (None if row.get(side) is None else column.factor * row[side] for side in ("low", "high"))
    return mean, low, high


def change(first: Seeds, second: Seeds, expected: float | None, better: int = 1) -> Change:
    """`first` minus `second`, seed by seed, against the sign `expected` (of what is better, None: none is known).

    "agrees" and "disagrees" need an interval that leaves zero out, and CLAIM seeds; otherwise "undecided", "1 seed, no
    claim", or "not run".
    """
    seeds = sorted(first.keys() & second.keys())
    if not seeds:
        return Change("not run")
    several = [better * (first[seed] - second[seed]) for seed in seeds]
    mean, (low, high) = float(np.mean(several)), over_seeds(several)
    shown = [None if one is None else better * one for one in (mean, low, high)]
    sides = shown if better > 0 else [shown[0], shown[2], shown[1]]
    word = NO_SIGN if not expected and len(seeds) >= CLAIM else verdict(low, high, len(seeds), wanted=expected or 1.0)
    return Change(word, *sides, len(seeds))  # type: ignore[arg-type]
