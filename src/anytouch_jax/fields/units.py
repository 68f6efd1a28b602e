"""Units of the outputs of an exported decoder, as formulas for a program without this package.

The outputs are free of scale. `fields.measure` computes the same values, and a test compares both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from anytouch_jax.fields.measure import LEAST_FORCE, Scale, scale_of
from anytouch_jax.fields.outputs import FORCE, LENGTH, TORQUE

DEVIATION = "sqrt(2) * exp(5 * tanh(x / 5))"
# of the example for a table without a sensor of known width
_USUAL = {"width_mm": 20.0, "modulus_kpa": 170.0, "aspect": round(math.log(0.75), 4)}


class Quantity(NamedTuple):
    """A value with its unit, and its formula in Python by outputs of the model.

    A formula uses the width that the image shows, `width_mm`, the modulus of the gel,
    `modulus_kpa`, and functions of numpy. `deviation(x)` is DEVIATION.
    """

    unit: str
    formula: str


def units_of(scale: Scale) -> dict[str, Quantity]:
    """Return the values by name, with the factors on deviations of a scale."""
    factors = {name: f"{factor:.6g}" for name, factor in scale.factors.items()}
    newton = "modulus_kpa * width_mm**2 / 1000"
    newton_mm = "modulus_kpa * width_mm**3 / 1000"
    length = f"width_mm * {LENGTH}"
    tangential = f"{newton} * {FORCE} * {factors['tangential']} * deviation(force_log[:, :1])"
    normal = (
        f"{newton} * (force[:, 2:] + {LEAST_FORCE}) * {factors['normal']} * "
        "deviation(force_log[:, 1:])"
    )
    return {
        "depth": Quantity("mm into the gel", "width_mm * depth"),
        "depth_std": Quantity("mm", f"{length} * {factors['depth']} * deviation(depth_log)"),
        "shear": Quantity("mm along x and y of the image", "width_mm * shear"),
        "shear_std": Quantity("mm", f"{length} * {factors['shear']} * deviation(shear_log)"),
        "contact": Quantity("probability", "1 / (1 + exp(-contact))"),
        "pressure": Quantity("kPa", "modulus_kpa * pressure"),
        "force": Quantity("N along x, along y and into the gel", f"{newton} * force"),
        "tangential_std": Quantity("N, of the first two", tangential),
        "normal_std": Quantity("N, of the third", normal),
        "torque": Quantity("N mm, from x to y", f"{newton_mm} * torque"),
        "torque_std": Quantity(
            "N mm", f"{newton_mm} * {TORQUE} * {factors['torque']} * deviation(torque_log)"
        ),
        "slip": Quantity("fraction of the contact that slides", "1 / (1 + exp(-slip))"),
        "slip_std": Quantity("fraction", f"minimum({factors['slip']} * deviation(slip_log), 1)"),
    }


def describe_units(metadata: Mapping[str, Any], sensors: Sequence[str]) -> dict[str, Any]:
    """Return what OUT.json says of units: formulas, and the numbers of known sensors for them.

    Args:
        metadata: those of the weights, which may hold moduli and factors.
        sensors: the names of the table.
    """
    scales = {name: scale_of(metadata, name) for name in sensors}
    numbers = {}
    for name, scale in scales.items():
        if scale.width is not None and scale.shape is not None:
            numbers[name] = {
                "width_mm": scale.width,
                "modulus_kpa": scale.modulus,
                "aspect": round(math.log(scale.shape), 4),
            }
    units = units_of(scale_of(metadata, ""))
    shown = next(iter(numbers), "")
    example = numbers.get(shown, _USUAL)
    return {
        "units": {name: unit._asdict() for name, unit in units.items()},
        "deviation(x)": DEVIATION,
        "sensors": numbers,
        "example": example | {"sensor": shown or "your sensor"},
    }
