"""Rows of the pouring study from its records: errors, and paired differences."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError
from experiments.pages.page import Finding
from experiments.pouring.physics import Task
from experiments.pouring.trials import Trials, error
from experiments.records import read_records
from experiments.values import Value, over_seeds

Array = npt.NDArray[Any]
MODES = ("fine-tuned", "frozen")
TITLES = {
    "none": "no tactile pre-training",
    "t3": "T3-style",
    "static": "AnyTouch, static only",
    "anytouch": "AnyTouch",
    "blind": "blind: time and own actions",
    "count": "blind: the best number of pours",
    "load": "bound: knows the load, sees no picture",
    "expert": "expert: sees the scales",
}
PAPER = {"none": (5.22, 49.1), "t3": (2.33, 9.74), "static": (2.45, 9.60), "anytouch": (1.56, 8.22)}
BLIND = ("blind", "count")
SHOWN = "shown stills"  # of the run `anytouch` in place of one trained on stills: says nothing of such training
DYNAMIC = ("anytouch",)  # rows whose policy sees three-frame segments; the others see stills


class Row(NamedTuple):
    """One row and mode over all its seeds: `poured` g of each run, and `runs` names them ("seed/number")."""

    name: str
    mode: str
    poured: Array
    runs: tuple[str, ...]
    target: float

    @property
    def wrong(self) -> Array:
        """|poured - target| (n,) g."""
        return np.abs(self.poured - self.target)

    @property
    def error(self) -> Value:
        """Its mean, with the 95 % interval over seeds (Student's t), whose runs share one policy; of one seed over
        its runs."""
        each = _by_seed(self.wrong, self.runs)
        return over_seeds(each) if len(each) > 1 else error(self.poured, self.target)


def _by_seed(values: Array, runs: Sequence[str]) -> tuple[float, ...]:
    """The mean over each seed's runs ("seed/number")."""
    seed = np.array([run.split("/")[0] for run in runs])
    return tuple(float(values[seed == one].mean()) for one in np.unique(seed))


def record(
    name: str,
    mode: str,
    seed: int,
    trials: Trials,
    task: Task,
    source: str,
    settings: Mapping[str, Any],
    about: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the record of a row's trials with one seed; `about` adds seconds and the loss of learning."""
    result = error(trials.poured, task.target)
    values = {
        "row": name, "mode": mode, "seed": seed, "target": task.target, "source": source, "settings": dict(settings),
        "poured": [round(float(x), 3) for x in trials.poured], "steps": [int(x) for x in trials.steps],
        "mean_error": round(result.mean, 3), "limit": task.limit,
    }  # fmt: skip
    return values | dict(about)


def read_rows(path: Path) -> list[Row]:
    """Return the rows of a file of results. Raises UserError for a record that is no row, other settings, or no row."""
    result: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for key, one in read_records(path).items():
        try:
            result.setdefault((one["row"], one["mode"]), []).append(one)
        except KeyError as missing:
            raise UserError(f"{path}: the record {key} of a pouring row has no {missing}. Remove its line.") from None
    if not result:
        raise UserError(f"{path} has no result. Run python -m experiments.pouring.study.")
    for tuned in (False, True):
        common = {json.dumps(one, sort_keys=True) for one in _settings(result, tuned)}
        if len(common) > 1:
            raise UserError(
                f"rows of {path} were run with different settings ({'; '.join(sorted(common))}); remove the old"
            )
    return [_row(name, mode, parts) for (name, mode), parts in result.items()]


def _settings(result: Mapping[tuple[str, str], Sequence[Mapping[str, Any]]], tuned: bool) -> list[dict[str, Any]]:
    """The settings that rows must share to be compared: all those of fine-tuned ones; of all rows those but of that."""
    return [
        {name: value for name, value in one["settings"].items() if tuned or not name.startswith("tune")}
        for (_, mode), parts in result.items()
        for one in parts
        if mode == "fine-tuned" or not tuned
    ]


def _row(name: str, mode: str, parts: Sequence[Mapping[str, Any]]) -> Row:
    settings = {json.dumps(part["settings"], sort_keys=True) for part in parts}
    if len(settings) > 1:
        raise UserError(f"the seeds of row {name} ({mode}) were run with different settings; remove the old results")
    parts = sorted(parts, key=lambda part: part["seed"])
    runs = tuple(f"{part['seed']}/{number}" for part in parts for number in range(len(part["poured"])))
    poured = np.concatenate([np.asarray(part["poured"], np.float64) for part in parts])
    return Row(name, mode, poured, runs, float(parts[0]["target"]))


def difference(a: Row, b: Row) -> Value:
    """Return the error of `a` minus that of `b` in g over the runs that both have, with its interval over seeds.

    The runs of a seed share one learned policy. Raises UserError without a run in common.
    """
    shared = [run for run in a.runs if run in b.runs]
    if not shared:
        raise UserError(f"rows {a.name} and {b.name} have no run in common; run them with the same seeds")
    change = np.array([a.wrong[a.runs.index(run)] - b.wrong[b.runs.index(run)] for run in shared])
    return over_seeds(_by_seed(change, shared))


def compared(path: Path, data: str) -> tuple[list[tuple[Any, ...]], list[Finding]]:
    """Return the rows of a table of results, and AnyTouch compared with the others. `data` names the file."""
    found = {(row.name, row.mode): row for row in read_rows(path)}

    def change(first: tuple[str, str], other: str) -> Value | None:
        a, b = found.get(first), found.get((other, "bound" if other == "blind" else first[1]))
        return difference(a, b) if a and b else None

    rows: list[tuple[Any, ...]] = []
    for name, mode in ((name, mode) for name in TITLES for mode in (*MODES, "bound") if (name, mode) in found):
        tried = name in PAPER
        theirs = PAPER[name][MODES.index(mode)] if tried else None
        against = change((name, mode), "blind") if tried else None
        rows.append((data, TITLES[name], mode if tried else "", found[name, mode].error, against, theirs))
    others = [(other, mode) for other in ("blind", "t3", "none", "static") for mode in MODES]
    return rows, [
        Finding("AnyTouch", TITLES[other], change(("anytouch", mode), other), f"error, {data}, {mode}", " g")
        for other, mode in others
    ]
