"""What the runs of the translation study are of, and what they must share to make a table
together.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

TASKS = (("gelsight_mini", "duragel"), ("gelsight_mini", "tac3d"), ("digit", "tac3d"))
TRANSLATIONS = dict(
    zip(
        map("-".join, TASKS),
        ("GelSight Mini to DuraGel", "GelSight Mini to Tac3D", "DIGIT to Tac3D"),
        strict=True,
    )
)
PIXELS = "pixels"
TRANSLATORS = {
    "anytouch": "AnyTouch",
    "stage1": "AnyTouch, stage 1",
    "t3": "T3-style",
    PIXELS: "pixels, no encoder",
}
TUNES = {"frozen": "frozen", "fine": "fine-tuned", "scratch": "from scratch"}


def shared(about: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the settings of runs must share by name: the view of a touch, an encoder a seed,
    pairs a task.

    Errors of images of another size are no rivals.
    """
    task = f"{about['from']} to {about['to']}"
    fit = about["fit"]
    kinds = {
        name: about.get(name, 1) for name in ("touches", "size", "subtracts", "version", "steps1")
    }
    return kinds | {
        "steps": fit["steps"],
        f"encoder {about['name']} of seed {fit['seed']}": about["encoder"],
        f"pairs {task}": about["pairs"],
        f"simulator of {task}": about.get("simulator"),
    }
