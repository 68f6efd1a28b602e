"""Doors between the core and the rings: tables of names, imported when they are used.

The core (AnyTouch: trained, loaded, probed) imports no ring (`sim`, `fields`, `datasets`, `live`,
`zoo`, `export`). Where it needs one, it asks here by name. So `load_encoder` on an AnyTouch run and
`pretrain` on a manifest load no module of a ring, and a plain install needs no package of one.

To join in, add a row to a table. A row is "module:attribute" below `anytouch_jax`, and the extra
of `pip install "anytouch_jax[extra]"` that brings what the module imports.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, NamedTuple

from anytouch_jax.errors import UserError


class Door(NamedTuple):
    """Where a ring's object is found: "module:attribute", and the extra that it needs, if any."""

    target: str
    extra: str = ""


# Readers of weights that are not in AnyTouch's own layouts. `family` is asked about every file.
WEIGHTS = {
    "family": Door("zoo.families:load_family"),
    "family encoder": Door("zoo.encoder:family_encoder"),
    "image encoder": Door("zoo.start:touch_of_rgb_images"),
    "torch": Door("zoo.torch_file:read_torch"),
}
# What reads sensor.json of a fitted sensor, a folder NAME.sensor.
SENSORS = {
    "fitted": Door("sim.sensing.own:read_numbers"),
}
# Sources of training batches, by the word of --data. Each has the interface of `batch.BatchSource`.
BATCHES = {
    "simulated": Door("sim.batches:SimulatedLoader"),
}
# Heads beside the embedding. Each is a `nn.heads.Head`; its loss is a row of OBJECTIVES.
HEADS = {
    "fields": Door("fields.head:HEAD"),
    "fields measure": Door("fields.measure:measure_of"),
    "fields units": Door("fields.units:describe_units"),
    "fields older": Door("fields.older:with_gradient"),
}
# Further terms of the loss, weighted by `objective.terms`. Each is an `objectives.Objective`.
OBJECTIVES = {
    "fields": Door("fields.loss:OBJECTIVE"),
}
# What computes the features of touch instead of XLA.
ENGINES = {
    "cached": Door("export.cache:cached_export"),
    "onnx": Door("export.encoder:load_engine", "engines"),
}


def enter(door: Door) -> Any:
    """Import and return what lies behind a door.

    Raises UserError with the command that installs what is missing.
    """
    module, _, attribute = door.target.partition(":")
    try:
        return getattr(import_module(f"anytouch_jax.{module}"), attribute)
    except ModuleNotFoundError as error:
        if not door.extra or (error.name or "").startswith("anytouch_jax"):
            raise
        raise lacking(module, error.name or "", door.extra) from None


def lacking(what: str, package: str, extra: str) -> UserError:
    """Return the error of a package that is not installed, with the command that installs it."""
    return UserError(
        f"{what} needs the package {package}, which is not installed: "
        f'pip install "anytouch_jax[{extra}]"'
    )
