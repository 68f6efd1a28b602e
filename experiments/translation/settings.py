"""What the runs of the translation study are of, and which of them make a table together."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from anytouch_jax.errors import UserError
from experiments.records import Record, read_records

TASKS = (("gelsight_mini", "duragel"), ("gelsight_mini", "tac3d"), ("digit", "tac3d"))
TRANSLATIONS = {
    "gelsight_mini-duragel": "GelSight Mini to DuraGel",
    "gelsight_mini-tac3d": "GelSight Mini to Tac3D",
    "digit-tac3d": "DIGIT to Tac3D",
}
PIXELS = "pixels"
TRANSLATORS = {
    "anytouch": "AnyTouch", "anytouch_between": "AnyTouch, half-way to stage 2", "stage1": "AnyTouch, stage 1",
    "anytouch_layer_decay": "AnyTouch, layer decay", "t3": "T3-style", PIXELS: "pixels, no encoder",
}  # fmt: skip
TUNES = {"frozen": "frozen", "fine": "fine-tuned", "scratch": "from scratch"}
OURS = ("anytouch", "stage1")  # its variants, and its stage 1


def runs_of(results: Path) -> dict[str, Record]:
    """Return the records of translations by key."""
    return read_records(results)


def one_table(several: Sequence[dict[str, Any]], results: Path) -> None:
    """Raise UserError for settings of runs that make no table together: other pairs or steps, another view of the touch
    (errors of pictures of another size are no rivals), two encoders of one name and seed."""
    kinds = ("touches", "size", "subtracts", "version", "steps1")
    ways = {(*(one.get(kind, 1) for kind in kinds), one["fit"]["steps"]) for one in several}
    known = {(one["name"], one["fit"]["seed"], one["encoder"]) for one in several}
    made = {(one["from"], one["to"], one["pairs"], one.get("simulator")) for one in several}
    if len(ways) > 1 or len(known) > len({one[:2] for one in known}) or len(made) > len({one[:2] for one in made}):
        raise UserError(
            f"{results}: runs on other pairs, of other steps, size or background, or of two encoders of one name "
            f"make no table together ({sorted(map(str, ways | known | made))}): choose another OUT"
        )
