"""Calibration of one device: presses of a ball of known size, and presses of known force.

Both are written into the folder NAME.sensor, which is taken wherever the name of a sensor is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from anytouch_jax.config import OWN_SENSOR, UNIVERSAL
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.errors import UserError
from anytouch_jax.fields.measure import GELS, OTHER_MODULUS, scale_of
from anytouch_jax.fields.ruler import Ruler, fit_ruler, pressed_frames, write_ruler
from anytouch_jax.sim.fitting.fit import check_name
from anytouch_jax.sim.sensing.own import NUMBERS, OwnSensor, read_numbers, write_numbers

if TYPE_CHECKING:
    from anytouch_jax.encoder.encoder import Encoder

# Deviation of the logarithm of the factor between objects: what one object sets holds for others
# so well. On a real unit, one factor for all objects leaves a median error of 30 %.
AMONG_OBJECTS = 0.35
_LEAST_NEWTON = 0.02  # read of a press: with less, nothing is pressed
_NOISE = 1.0  # grey levels of a pixel, until `sensor fit` has seen it


def sensor_numbers(
    sensor: str | Path, out: Path, shape: tuple[int, ...], width_mm: float | None
) -> OwnSensor:
    """Return the numbers of a sensor that is to be calibrated.

    Args:
        sensor: a folder NAME.sensor, or the name of a known or unknown sensor.
        out: the folder to write.
        shape: of an image, (height, width, 3).
        width_mm: what its width shows. Known sensors need none.

    Raises:
        UserError: a sensor whose width nobody knows, and a name that cannot be used.
    """
    if out.suffix != OWN_SENSOR:
        raise UserError(f"{out} must end in {OWN_SENSOR}. Choose another --out.")
    if Path(sensor).suffix == OWN_SENSOR:
        numbers = read_numbers(Path(sensor).expanduser())
        if width_mm is None or width_mm == numbers.width_mm:
            return numbers
        height_mm = numbers.height_mm * width_mm / numbers.width_mm
        return replace(numbers, width_mm=width_mm, height_mm=round(height_mm, 4))
    check_name(out.stem)
    gel = GELS.get(str(sensor))
    if width_mm is None:
        if gel is None:
            raise UserError(
                f"nobody knows what an image of {sensor} shows. Give the mm of its width: "
                "--width-mm 16"
            )
        width_mm = gel.width
    height, width = shape[:2]
    return OwnSensor(
        out.stem,
        float(width_mm),
        round(width_mm * height / width, 4),
        (height, width),
        _NOISE,
        modulus_kpa=OTHER_MODULUS if gel is None else gel.modulus,
        family=str(sensor) if gel is not None else "",
        sure={"size": "as given", "modulus_kpa": "a usual value"},
    )


def calibrate_depth(
    encoder: Encoder, frames: Sequence[Array], background: Array, numbers: OwnSensor, ball_mm: float
) -> Ruler:
    """Return the ruler of presses of a ball.

    Args:
        encoder: one that measures.
        frames: RGB u8 (h, w, 3) of one device, pressed or not.
        background: its untouched gel.
        numbers: of the sensor.
        ball_mm: diameter of the ball.

    Raises:
        UserError: presses that no ball of this size can make.
    """
    pressed = pressed_frames(frames, background)
    family = numbers.family or UNIVERSAL
    read = encoder.measure(
        np.stack(pressed), background, family, width_mm=numbers.width_mm, log=_silent
    )
    return fit_ruler(
        pressed,
        read.depth,
        background,
        width_mm=numbers.width_mm,
        ball_mm=ball_mm,
        family=family,
        weights=encoder.fields_fingerprint,
    )


def calibrate_force(
    encoder: Encoder,
    frames: Sequence[Array],
    background: Array,
    numbers: OwnSensor,
    newtons: Sequence[float],
) -> OwnSensor:
    """Return the numbers of a sensor with the factor on its forces.

    The factor is the median over presses, because one press may be off.

    Args:
        encoder: one that measures.
        frames: presses RGB u8 (h, w, 3).
        background: the untouched gel.
        numbers: of the sensor.
        newtons: the known force of each, N into the gel.

    Raises:
        UserError: a force that is none, and an image without a press.
    """
    if not all(0 < one < np.inf for one in newtons):
        raise UserError("a known force is a number of N above 0. Check --newton.")
    family = numbers.family or UNIVERSAL
    read = encoder.measure(
        np.stack(frames), background, family, width_mm=numbers.width_mm, log=_silent
    )
    assert read.force is not None
    # With the modulus of sensor.json, which the user may have edited.
    own = numbers.modulus_kpa / scale_of(encoder.metadata, family).modulus
    forces = read.force[:, 2].astype(float) * (own if not numbers.family else 1.0)
    empty = int((forces < _LEAST_NEWTON).sum())
    if empty:
        raise UserError(
            f"{empty} of {len(frames)} images show no press. Leave them out, or check the "
            "background."
        )
    ratios = np.log(np.asarray(newtons, float) / forces)
    scatter = float(np.std(ratios, ddof=1)) if len(ratios) > 1 else 0.0
    spread = float(np.hypot(AMONG_OBJECTS, scatter / np.sqrt(len(ratios))))
    factor = float(np.exp(np.median(ratios)))
    sure = dict(numbers.sure)
    sure["force_factor"] = (
        f"{factor:.3g} from {len(ratios)} presses of {min(newtons):g} to {max(newtons):g} N, which "
        f"differ by {scatter:.0%}. Other objects differ by {AMONG_OBJECTS:.0%} more"
    )
    return replace(
        numbers,
        force_factor=factor,
        force_spread=spread,
        force_encoder=encoder.fields_fingerprint,
        sure=sure,
    )


def write_calibration(out: Path, numbers: OwnSensor, ruler: Ruler | None) -> None:
    """Write the numbers of a sensor, and its new ruler, into its folder."""
    out.mkdir(parents=True, exist_ok=True)
    if ruler is not None:
        numbers = replace(numbers, sure={**numbers.sure, **ruler.describe()})
        write_ruler(out, ruler)
    write_numbers(out / NUMBERS, numbers)


def _silent(_: str) -> None:
    """Say nothing: a calibration has sentences of its own."""
