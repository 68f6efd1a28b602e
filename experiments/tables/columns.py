"""What the tables of the paper have: columns, and models by name."""

from __future__ import annotations

from experiments.tables.results import Column

TITLES = {
    "untrained": "untrained encoder",
    "pixels": "raw pixels",
    "contact": "area, place and force alone",
    "no_pretraining": "no tactile pre-training",
    "anytouch": "AnyTouch",
    "unitouch": "UniTouch-style",
    "tlv_link": "TLV-Link-style",
    "t3": "T3-style",
    "static_only": "AnyTouch, stills only",
    "no_text": "without text",
    "no_vision": "without vision",
    "no_text_aligned": "without text in the aligned set",
    "no_stage1": "without the first stage",
    "no_stage2": "without the second stage",
    "no_matching": "without cross-sensor matching",
    "no_dynamic": "without dynamic perception",
    "no_universal": "without universal tokens",
    "masked": "masked modelling",
    "aligned": "alignment added",
    "matched": "matching added",
    "matched_mlp": "matching added, the paper's head",
}

# a column of the paper's tables each
VIEWS = ("seen", "seen, other data", "unseen", "unseen, other data")
FOUR, FORM = (tuple(Column(view, task) for view in VIEWS) for task in ("material", "indenter"))
SIX = (Column("seen", "roughness"), Column("seen", "hardness"), *FOUR)
MOVING = tuple(Column("clips", task) for task in ("slip", "twist", "slide"))


def title(name: str) -> str:
    """A model's name for people."""
    return TITLES.get(name, name.replace("+", ", "))
