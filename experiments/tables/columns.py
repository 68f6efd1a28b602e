"""What the tables of the paper have: columns, models by name, and the answer of one class for all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from experiments.tables.results import Column, Run

TITLES = {
    "untrained": "untrained encoder", "pixels": "raw pixels",
    "contact": "area, place and force alone",
    "no_pretraining": "no tactile pre-training",
    "anytouch": "AnyTouch", "unitouch": "UniTouch-style", "tlv_link": "TLV-Link-style", "t3": "T3-style",
    "static_only": "AnyTouch, stills only", "no_text": "without text", "no_vision": "without vision",
    "no_text_aligned": "without text in the aligned set", "no_stage1": "without the first stage",
    "no_stage2": "without the second stage",
    "no_matching": "without cross-sensor matching", "no_dynamic": "without dynamic perception",
    "no_universal": "without universal tokens", "masked": "masked modelling", "aligned": "alignment added",
    "matched": "matching added", "matched_mlp": "matching added, the paper's head",
    "no_flips": "AnyTouch, touches never flipped",
    "universal, 0 unlabelled": "universal, no frame", "left_out": "left out of training",
    "seen": "trained on the sensor",
}  # fmt: skip


UNSEEDED = ("pixels", "contact")  # models that nothing is drawn for


def four(task: str) -> tuple[Column, ...]:
    """The columns of the paper's tables, of one task."""
    return (
        Column("seen", "seen", task), Column("seen sensor, other data", "seen, other data", task),
        Column("unseen sensor", "unseen", task), Column("unseen sensor, other data", "unseen, other data", task),
    )  # fmt: skip


FOUR, FORM = four("material"), four("indenter")
FOUR_PAPER = ("TAG", "Feel", "OF 1.0", "OF 2.0")
SIX = (
    Column("material", "seen", "material"),
    Column("roughness", "seen", "roughness"),
    Column("hardness", "seen", "hardness"),
    *FOUR[1:],
)
SIX_PAPER = ("TAG material", "roughness", "hardness", "Feel", "OF 1.0", "OF 2.0")


def dynamic(view: str) -> tuple[Column, ...]:
    """The columns of the dynamic tasks under one view."""
    return (
        Column("slip", view, "slip"), Column("force (R2)", view, "force", "r2"), Column("twist", view, "twist"),
        Column("slide", view, "slide"),
    )  # fmt: skip


SPACE = (
    Column("top-1", "class token", "top-1", "share"),
    Column("top-5", "class token", "top-5", "share"),
    Column("silhouette by sensor", "class token", "silhouette by sensor", "silhouette by sensor", 1.0, -1, 3),
    Column("silhouette by object", "class token", "silhouette by object", "silhouette by object", 1.0, 1, 3),
    Column("alignment", "class token", "alignment", "alignment", 1.0, -1, 3),
    Column("uniformity", "class token", "uniformity", "uniformity", 1.0, -1, 3),
)
STATIC = tuple(Column(task, "static", task) for task in ("material", "roughness", "hardness"))
ANY = "any"
GRASP = (Column("during the grasp", "during", "grasp"), Column("after the grasp", "after", "grasp"))


def title(name: str) -> str:
    """A model's name for people."""
    return TITLES.get(name, name.replace("+", ", "))


def commonest(runs: Sequence[Run], question: str, column: Column) -> float | None:
    """What one answer for all gives on the test rows of a column of accuracies, as printed; 0 for R2."""
    if column.metric == "r2":
        return 0.0
    result = [
        row["chance"] for run in runs if run.question == question and (row := run.row(column)) and "chance" in row
    ]
    return column.factor * float(np.mean(result)) if result and column.metric == "accuracy" else None
