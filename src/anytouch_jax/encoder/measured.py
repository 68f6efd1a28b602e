"""Fields of touch in millimetres and newtons: what `Encoder.measure` returns.

The record belongs to the core, because the head of fields makes it, and live touch, the page and
the commands pass it on. How the outputs of the network become these values is told in
`fields.measure`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import cv2
import numpy as np

from anytouch_jax.batch import FieldOutput
from anytouch_jax.doors import HEADS, enter
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.errors import UserError
from anytouch_jax.shown import shown_short


@shown_short
@dataclass(frozen=True, eq=False)
class Fields:
    """What B frames measure, each value with its standard deviation.

    Maps are (B, h, w) over the whole image. Without a width (`width_mm` None) lengths are
    fractions of the image's width, areas of its square, and force and torque are None. With
    `faults` the deviations are wide.

    Attributes:
        depth: mm into the gel.
        shear: (B, h, w, 2), mm along x and y of the image, with one deviation for both: that of
            the dots, or a guess without them.
        contact: probability.
        force: (B, 3), N along x, along y and into the gel.
        force_low: (B,), N into the gel that 5 % of true forces are below. Errors of force are
            factors, so the interval is not symmetric.
        force_high: (B,), N into the gel that 5 % of true forces are above.
        torque: (B,), N mm about the centre of pressure.
        slip: (B,), fraction of the contact that slides, NaN without contact.
        area: (B,), mm2.
        centre: (B, 2), mm of the pressure from the middle of the image, x to the right and y
            down, NaN without contact.
        shape: height of the image over its width.
        case: what is known of the device: "calibrated", "family" or "unknown". It decides how wide
            the interval of force is.
    """

    depth: Array
    depth_std: Array
    shear: Array
    shear_std: Array
    contact: Array
    force: Array | None
    force_std: Array | None
    torque: Array | None
    torque_std: Array | None
    slip: Array
    slip_std: Array
    area: Array
    area_std: Array
    centre: Array
    centre_std: Array
    width_mm: float | None
    shape: float
    faults: tuple[str, ...] = ()
    case: str = "unknown"
    force_low: Array | None = None
    force_high: Array | None = None

    def __len__(self) -> int:
        return len(self.depth)

    def __getitem__(self, row: int) -> Fields:
        """Return the fields of one frame, still with an axis of 1."""
        at = range(len(self))[row]  # raises IndexError
        return self._each(lambda value: value[at : at + 1])

    def _each(self, change: Callable[[Array], Array]) -> Fields:
        """Return the same fields with every array changed."""
        arrays: dict[str, Any] = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                arrays[field.name] = change(value)
        return replace(self, **arrays)

    def at(self, height: int, width: int) -> Fields:
        """Return the same fields with maps (B, height, width), such as the frame's."""

        def resized(value: Array) -> Array:
            if value.ndim < 3:  # no map
                return value
            maps = [
                cv2.resize(one, (width, height), interpolation=cv2.INTER_LINEAR) for one in value
            ]
            return np.stack(maps)

        return self._each(resized)

    def points(self) -> Array:
        """Return the surface of the gel f32 (B, h, w, 3) in mm, in a right-handed frame.

        It is the optical frame of a camera (REP 103): from the middle of the image, x goes to the
        right, y down, and z away from the camera. The untouched gel lies at z = 0, and a press
        brings its surface nearer to the camera, so z is minus the depth.
        """
        height, width = self.depth.shape[1:]
        mm = self.width_mm or 1.0
        y, x = np.mgrid[:height, :width] + 0.5
        across = (x / width - 0.5) * mm
        down = (y / height - 0.5) * mm * self.shape
        flat = [np.broadcast_to(axis, self.depth.shape) for axis in (across, down)]
        return np.stack([*flat, -self.depth], -1).astype("f4")

    def summary(self, row: int = 0) -> dict[str, float | None]:
        """Return the numbers of a frame by name, each with its deviation `*_std`.

        What is unknown is None. The names and their order are those of the columns in a CSV file.
        """
        y, x = np.unravel_index(np.argmax(self.depth[row]), self.depth.shape[1:])
        values: dict[str, Any] = {}
        for place, axis in enumerate("xyz"):
            values[f"force_{axis}"] = _value_at(self.force, row, place)
            values[f"force_{axis}_std"] = _value_at(self.force_std, row, place)
        values["force_low"] = _value_at(self.force_low, row)
        values["force_high"] = _value_at(self.force_high, row)
        values["torque"] = _value_at(self.torque, row)
        values["torque_std"] = _value_at(self.torque_std, row)
        values["depth"] = self.depth[row, y, x]
        values["depth_std"] = self.depth_std[row, y, x]
        values["area"] = self.area[row]
        values["area_std"] = self.area_std[row]
        values["centre_x"] = self.centre[row, 0]
        values["centre_y"] = self.centre[row, 1]
        values["centre_std"] = self.centre_std[row]
        values["slip"] = self.slip[row]
        values["slip_std"] = self.slip_std[row]
        return {name: _number(value) for name, value in values.items()}


def _value_at(values: Array | None, *place: int) -> Any:
    return None if values is None else values[place]


def _number(value: Any) -> float | None:
    """Return a value with five decimals, None for NaN."""
    if value is None or np.isnan(value):
        return None
    return round(float(value), 5)


class Measure(Protocol):
    """What turns outputs of the network for frames of one sensor into `Fields`."""

    @property
    def width_mm(self) -> float | None:
        """The mm that the image's width shows, None if nobody knows it."""

    def oriented(self, image: Array) -> Array:
        """Return an image as the camera takes it, turned and mirrored like those measured."""

    def __call__(self, out: FieldOutput, frames: Sequence[Array]) -> Fields:
        """Return the fields of B frames RGB u8 (h, w, 3), oriented."""


def open_measure(metadata: Mapping[str, Any], sensor: str, *given: Any, **more: Any) -> Measure:
    """Return what turns outputs for frames of a sensor into `Fields`.

    `metadata` are those of the weights. The rest goes to `fields.measure.measure_of`.
    """
    measure_of: Callable[..., Measure] = enter(HEADS["fields measure"])
    return measure_of(metadata, sensor, *given, **more)


def missing(source: str) -> UserError:
    """Return the error of an encoder without a decoder of fields."""
    return UserError(
        f"{source} does not measure depth and force: its weights have no fields. Use "
        "anytouch-tiny, or train with --model.fields 32"
    )
