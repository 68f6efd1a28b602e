"""Rows of the pouring study from its records: errors, and paired differences."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.errors import UserError
from experiments.pages.page import Finding
from experiments.pouring.physics import Task
from experiments.pouring.trials import Trials, error
from experiments.records import check_alike, read_records
from experiments.tables.paper import TABLE4
from experiments.values import Seeds, Value, over_seeds, shared_difference

MODES = ("fine-tuned", "frozen")
TITLES = {
    "none": "no tactile pre-training",
    "t3": "T3-style",
    "static": "AnyTouch, static only",
    "anytouch": "AnyTouch",
    "blind": "blind: time and own actions",
    "load": "bound: knows the load, sees no image",
    "expert": "expert: sees the scales",
}
# of the run `anytouch` in place of one trained on stills: says nothing of such training
SHOWN = "shown stills"
DYNAMIC = ("anytouch",)  # rows whose policy sees three-frame segments; the others see stills


def record(trials: Trials, task: Task, **about: Any) -> dict[str, Any]:
    """Return the record of a row's trials with one seed; `about` has its row, mode, seed, source
    and settings.
    """
    poured = np.asarray(trials.poured, np.float64)
    about |= {
        "target": task.target,
        "limit": task.limit,
        "mean_error": round(error(poured, task.target).mean, 3),
    }
    return about | {"poured": poured.round(3).tolist(), "steps": trials.steps.tolist()}


def errors_of(path: Path) -> dict[tuple[str, str], Seeds]:
    """Return {(row, mode): {seed: mean error, g}} of a file of results. Raises UserError."""
    result: dict[tuple[str, str], Seeds] = {}
    records = read_records(path)
    for key, one in records.items():
        try:
            wrong = np.abs(np.asarray(one["poured"], np.float64) - one["target"])
            result.setdefault((one["row"], one["mode"]), {})[one["seed"]] = float(wrong.mean())
        except KeyError as missing:
            raise UserError(
                f"{path}: the record {key} of a pouring row has no {missing}. Remove its line."
            ) from None
    check_alike(path, [one["settings"] for one in records.values()])
    return result


def compared(path: Path, data: str) -> tuple[list[tuple[Any, ...]], list[Finding]]:
    """Return the rows of a table of results, and AnyTouch compared with the others.

    `data` names the file.

    The runs of a seed share one learned policy, so intervals are over seeds.
    """
    found = errors_of(path)

    def change(first: tuple[str, str], other: str) -> Value | None:
        second = other, "bound" if other == "blind" else first[1]
        return shared_difference(found.get(first, {}), found.get(second, {}))

    rows: list[tuple[Any, ...]] = []
    for name, mode in (
        (name, mode) for name in TITLES for mode in (*MODES, "bound") if (name, mode) in found
    ):
        row = (
            data,
            TITLES[name],
            mode if name in TABLE4 else "",
            over_seeds([*found[name, mode].values()]),
        )
        theirs = TABLE4[name][MODES.index(mode)] if name in TABLE4 else None
        rows.append((*row, change((name, mode), "blind") if name in TABLE4 else None, theirs))
    others = [(other, mode) for other in ("blind", "t3", "none", "static") for mode in MODES]
    return rows, [
        Finding(
            "AnyTouch",
            TITLES[other],
            change(("anytouch", mode), other),
            f"error, {data}, {mode}",
            " g",
        )
        for other, mode in others
    ]
