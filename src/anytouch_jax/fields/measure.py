"""Touch in millimetres and newtons: depth, shear, contact and force of frames.

The network's outputs are free of scale: lengths are fractions of the image's width, stresses
fractions of the gel's modulus. Here they get the scale of a sensor, and standard deviations.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from anytouch_jax.batch import FieldOutput
from anytouch_jax.data.background.dots import DotFlow
from anytouch_jax.data.transforms import Flip, orient_frame
from anytouch_jax.encoder.arrays import METADATA, Array, Log
from anytouch_jax.encoder.measured import Fields as Fields
from anytouch_jax.encoder.measured import missing as missing
from anytouch_jax.encoder.sensor_words import resolve_sensor
from anytouch_jax.errors import UserError
from anytouch_jax.fields.faults import faults_of as faults_of
from anytouch_jax.fields.images import depth_levels as depth_levels
from anytouch_jax.fields.images import overlay as overlay
from anytouch_jax.fields.images import write_surface as write_surface
from anytouch_jax.fields.outputs import FORCE, LENGTH, TORQUE
from anytouch_jax.fields.ruler import Ruler, another_encoder, read_ruler, ruler_of_today
from anytouch_jax.sensors import RECORDS


class KnownGel(NamedTuple):
    """What a sensor shows: mm of the image's width, its height over its width, the gel's kPa."""

    width: float
    shape: float
    modulus: float


GELS = {
    name: KnownGel(record.size_mm[1], record.proportions, record.modulus_kpa)
    for name, record in RECORDS.items()
    if record.size_mm and record.proportions and record.modulus_kpa
}
# kPa of an unknown gel, and its standard deviation as a fraction of it.
OTHER_MODULUS = 170.0
OTHER_SPREAD = 0.4
# Logarithms of the factors from a force to the ends of its interval, down and up, of a gel that was
# not calibrated. The deviation that the network gives comes on top. Coverage is measured by
# `experiments.encoders.intervals`. Of unknown devices the network reads deep presses too small.
INTERVALS = {
    "family": (0.35, 0.35),
    "unknown": (0.9, 1.7),
}
# What is added to the factor up, also as a logarithm, for a contact that covers the whole border of
# the image: how deep the gel is there cannot be seen, and cloth over a whole gel is read at half of
# its depth.
BEYOND_BORDER = 1.2
Z = 1.645  # standard deviations from the mean to 5 and 95 %
# The deviation of a normal force is a factor. Below this force, over modulus times width squared,
# it stays that of this force, or a force of nothing would be known exactly.
LEAST_FORCE = 1e-3
DRAG = 2.4  # see `_dragged`
# The deviation of the dragged force: a part over modulus times width squared, and a fraction of it.
DRAG_LEAST = 3e-4
DRAG_SPREAD = 0.4
_NAMES = ("depth", "shear", "normal", "tangential", "torque", "slip")
_MAPS = ("depth", "shear", "contact")


class Scale(NamedTuple):
    """What turns outputs into mm and N.

    Attributes:
        width: mm of the image, or None.
        modulus: kPa of the gel.
        spread: the modulus' standard deviation as a fraction of it.
        shape: height of the image over its width, None if nobody knows it.
        factors: by which deviations are multiplied, by name.
        case: what is known of the device: "calibrated" by a known force, a known "family", or
            "unknown".
    """

    width: float | None
    modulus: float
    spread: float
    shape: float | None
    factors: dict[str, float]
    case: str = "family"


def scale_of(metadata: Mapping[str, Any], sensor: str, width_mm: float | None = None) -> Scale:
    """Return the scale of a sensor.

    Args:
        metadata: of the weights, which may hold factors on deviations and moduli of sensors.
        sensor: its name, or the folder of a fitted one. GELS knows the width of some.
        width_mm: the mm that the image's width shows, if it is another one.

    Raises:
        UserError: a width that is no length, or damaged metadata.
    """
    if width_mm is not None and not 0 < width_mm < np.inf:
        raise UserError(f"the width of the image must be a number of mm above 0, not {width_mm:g}")
    try:
        stored = metadata.get(METADATA, {})
        stored = json.loads(stored) if isinstance(stored, str) else stored
        factors = {name: float(stored.get(name, 1.0)) for name in _NAMES}
        moduli = {name: float(value) for name, value in stored.get("modulus", {}).items()}
    except (ValueError, TypeError, AttributeError):
        raise UserError(
            "the calibration of fields in the weights is damaged; load the weights again"
        ) from None
    word = resolve_sensor(sensor)
    known = word.name if word.name in moduli or word.name in GELS else word.family
    gel = GELS.get(known)
    # Nobody has measured the stiffness of an own gel: sensor.json holds a usual one.
    spread = OTHER_SPREAD if gel is None and known not in moduli else 0.0
    case = "unknown" if spread else "family"
    if word.force_spread:
        spread = word.force_spread
        case = "calibrated"
    if word.width_mm is not None and word.shape is not None:
        gel = KnownGel(word.width_mm, word.shape, word.modulus_kpa or OTHER_MODULUS)
    if gel is None:
        modulus = moduli.get(known, OTHER_MODULUS)
        return Scale(width_mm, modulus, spread, shape=None, factors=factors, case=case)
    # Another width is that of a cropped image, whose shape nobody knows.
    shape = gel.shape if width_mm is None else None
    modulus = moduli.get(known, gel.modulus) * word.force_factor
    return Scale(width_mm or gel.width, modulus, spread, shape, factors, case)


_ARRAYS = tuple(
    one.name for one in fields(Fields) if one.name not in ("width_mm", "shape", "faults", "case")
)


def stacked(parts: Sequence[Fields]) -> dict[str, Array]:
    """Return the arrays of several `Fields` as one, by name, maps as float16.

    Unknown force is NaN.
    """
    arrays = {}
    for name in _ARRAYS:
        array = np.concatenate([_array_of(part, name) for part in parts])
        is_map = name.removesuffix("_std") in _MAPS
        arrays[name] = array.astype(np.float16) if is_map else array
    widths = [
        np.full(len(part), np.nan if part.width_mm is None else part.width_mm) for part in parts
    ]
    return arrays | {"width_mm": np.concatenate(widths)}


def _array_of(part: Fields, name: str) -> Array:
    """Return the array of that name, NaN for a force or torque that is unknown."""
    value: Array | None = getattr(part, name)
    if value is not None:
        return value
    axes = (3,) if name in ("force", "force_std") else ()
    return np.full((len(part), *axes), np.nan, np.float32)


def _deviation(log: Any) -> Array:
    """Return the standard deviation of a Laplace error from its logarithm.

    The logarithm is bent as in `ops.losses.laplace_loss`, so that none is beyond exp(5). A Laplace
    distribution of scale b has the standard deviation sqrt(2) b.
    """
    return np.asarray(np.sqrt(2) * np.exp(5 * np.tanh(log / 5)))


def _logistic(x: Any) -> Any:
    return 1 / (1 + np.exp(-x))


def fields_of(out: FieldOutput, scale: Scale, shape: float, faults: tuple[str, ...] = ()) -> Fields:
    """Return the output of the network in mm and N.

    Args:
        out: arrays (B, ...), see `batch.FieldOutput`.
        scale: that of the sensor.
        shape: the image's height over its width.
        faults: sentences. With some, no deviation is below the value itself.
    """
    out = FieldOutput._make(np.asarray(value, np.float32) for value in out)
    mm = scale.width or 1.0
    factors = scale.factors
    contact = _logistic(out.contact)
    area, area_std, centre, centre_std = _contact_of(contact, out.pressure, mm, shape)
    # 1 with contact, and NaN without: where nothing touches, nothing slips.
    touched = np.where(area > 0, 1, np.nan)
    values: dict[str, Any] = {
        "depth": mm * out.depth,
        "depth_std": mm * LENGTH * factors["depth"] * _deviation(out.depth_log),
        "shear": mm * out.shear,
        "shear_std": mm * LENGTH * factors["shear"] * _deviation(out.shear_log),
        "slip": touched * _logistic(out.slip),
        "slip_std": touched * np.minimum(factors["slip"] * _deviation(out.slip_log), 1),
        "area": area,
        "area_std": area_std,
        "centre": centre,
        "centre_std": centre_std,
        "force": None,
        "force_std": None,
        "force_low": None,
        "force_high": None,
        "torque": None,
        "torque_std": None,
    }
    if scale.width is not None:
        values |= _forces(out, scale, mm)
    if faults:
        _widen(values, scale, mm)
    values = {
        name: None if value is None else np.asarray(value, np.float32)
        for name, value in values.items()
    }
    return Fields(
        **values,
        contact=contact,
        width_mm=scale.width,
        shape=shape,
        faults=faults,
        case=scale.case,
    )


def _contact_of(
    contact: Array, pressure: Array, mm: float, shape: float
) -> tuple[Array, Array, Array, Array]:
    """Return area, centre of pressure (B, 2) and their deviations; without contact NaN for those.

    Args:
        contact: (B, h, w), its probability.
        pressure: (B, h, w).
        mm: width of the image.
        shape: its height over its width.
    """
    rows, columns = contact.shape[1:]
    inside = contact > 0.5
    cell = mm**2 * shape / (rows * columns)
    area = cell * inside.sum((1, 2))
    # A pixel that is in contact with probability p adds its area times the smaller of p and 1 - p.
    area_std = cell * np.minimum(contact, 1 - contact).sum((1, 2))
    # The length of the rim of a round contact of this area, which is uncertain by the area's
    # deviation over that length; and so is the centre.
    rim = np.sqrt(4 * np.pi * np.where(area > 0, area, np.nan))
    return area, area_std, mm * _centre(inside, pressure, area, shape), area_std / rim


def _centre(inside: Array, pressure: Array, area: Array, shape: float) -> Array:
    """Return the centre of pressure (B, 2) from the middle, in widths; NaN without contact."""
    rows, columns = inside.shape[1:]
    # A contact whose pressure is 0 everywhere still has a centre.
    weight = np.where(inside, pressure + 1e-9, 0)
    total = np.where(area > 0, weight.sum((1, 2)), np.nan)
    weight = weight / total[:, None, None]
    x = (np.arange(columns) + 0.5) / columns - 0.5
    y = ((np.arange(rows) + 0.5) / rows - 0.5) * shape
    return np.stack([weight.sum(1) @ x, weight.sum(2) @ y], axis=1)


def _forces(out: FieldOutput, scale: Scale, mm: float) -> dict[str, Array]:
    """Return force in N and torque in N mm with their deviations, of a sensor of known width."""
    factors = scale.factors
    newton = scale.modulus * mm**2 / 1000  # kPa mm2 are mN
    deviation = _deviation(out.force_log)
    sideways = np.repeat(factors["tangential"] * FORCE * deviation[:, :1], 2, axis=1)
    normal = factors["normal"] * (out.force[:, 2:] + LEAST_FORCE) * deviation[:, 1:]
    low, high = interval_of(
        out.force[:, 2],
        factors["normal"] * deviation[:, 1],
        scale.case,
        scale.spread,
        border_in_contact(_logistic(out.contact)),
    )
    values = {
        "force": newton * out.force,
        "force_low": newton * low,
        "force_high": newton * high,
        "force_std": newton * np.concatenate([sideways, normal], axis=1),
        "torque": newton * mm * out.torque,
        "torque_std": newton * mm * TORQUE * factors["torque"] * _deviation(out.torque_log),
    }
    # A guessed modulus is a factor on every force.
    for name in ("force", "torque"):
        values[f"{name}_std"] = np.hypot(values[f"{name}_std"], scale.spread * values[name])
    return values


def border_in_contact(contact: Array) -> Array:
    """Return which fraction of the image's border (B,) is in contact, of its probability
    (B, h, w).
    """
    inside = contact > 0.5
    edges = (inside[:, 0], inside[:, -1], inside[:, 1:-1, 0], inside[:, 1:-1, -1])
    return np.asarray(np.concatenate(edges, axis=1).mean(1))


def interval_of(
    force: Array, deviation: Array, case: str, spread: float, at_border: Array
) -> tuple[Array, Array]:
    """Return the ends of the 90 % intervals of normal forces (B,).

    Errors are factors. That of the network and what is not known of the device are independent.

    Args:
        force: over modulus times width squared.
        deviation: of their logarithms, by the network.
        case: what is known of the device, see INTERVALS, or "calibrated".
        spread: of a calibrated one, the deviation of the logarithm of its factor.
        at_border: the fraction of the border that is in contact (B,).
    """
    down, up = INTERVALS.get(case, (Z * spread, Z * spread))
    further = up + BEYOND_BORDER * at_border
    own = Z * deviation
    least = force + LEAST_FORCE
    low = least * np.exp(-np.hypot(own, down)) - LEAST_FORCE
    high = least * np.exp(np.hypot(own, further)) - LEAST_FORCE
    return np.maximum(low, 0), high


def _widen(values: dict[str, Any], scale: Scale, mm: float) -> None:
    """Widen deviations in place: no value is known better than its own size and a usual touch."""
    usual = {
        "depth": LENGTH * mm,
        "shear": LENGTH * mm,
        "slip": 1.0,
        "area": (mm / 4) ** 2,
        "centre": mm / 2,
        "force": FORCE * scale.modulus * mm**2 / 1000,
        "torque": TORQUE * scale.modulus * mm**3 / 1000,
    }
    for name, size in usual.items():
        if values[name] is None:
            continue
        value = np.abs(values[name])
        if name in ("shear", "centre"):  # two components have one deviation
            value = value.max(-1)
        values[f"{name}_std"] = np.hypot(values[f"{name}_std"], value + size)
    if values["force"] is not None:
        values["force_low"] = np.zeros(len(values["force"]))
        values["force_high"] = values["force"][:, 2] + Z * values["force_std"][:, 2]


def _dragged(measured: Fields, scale: Scale) -> Fields:
    """Return fields whose force along the gel is that which drags the contact by its `shear`.

    Without contact there is none. The force on a disc is the modulus times its shift times the root
    of its area, times a number (Johnson, "Contact Mechanics", 1985, Sec. 3.7). The number DRAG is
    fitted to simulated layers, because a gel is not a half-space.
    """
    assert measured.force is not None and measured.force_std is not None
    inside = (measured.contact > 0.5)[..., None]
    shift = (measured.shear * inside).sum((1, 2)) / np.maximum(inside.sum((1, 2)), 1)
    along = DRAG * scale.modulus / 1000 * shift * np.sqrt(measured.area)[:, None]
    least = DRAG_LEAST * scale.modulus / 1000 * (scale.width or 1.0) ** 2
    spread = np.hypot(DRAG_SPREAD, scale.spread)
    std = np.hypot(least, spread * np.linalg.norm(along, axis=1))
    force = measured.force.copy()
    deviation = measured.force_std.copy()
    force[:, :2] = along
    deviation[:, :2] = std[:, None]
    return replace(measured, force=force, force_std=deviation)


def _by_ruler(measured: Fields, ruler: Ruler, frames: Sequence[Array], pressure: Array) -> Fields:
    """Return fields whose depth, contact, area and centre are those of a ruler."""
    depth, deviation, contact = ruler.read(frames, measured.depth, measured.contact)
    if measured.faults:
        deviation = np.hypot(deviation, measured.depth_std)
    area, area_std, centre, centre_std = _contact_of(
        contact, pressure, measured.width_mm or 1.0, measured.shape
    )
    values: dict[str, Any] = {
        "depth": depth,
        "depth_std": deviation,
        "contact": contact,
        "area": area,
        "area_std": np.hypot(area_std, measured.area_std if measured.faults else 0),
        "centre": centre,
        "centre_std": np.hypot(centre_std, measured.centre_std if measured.faults else 0),
        "slip": np.where(area > 0, measured.slip, np.nan),
        "slip_std": np.where(area > 0, measured.slip_std, np.nan),
    }
    values = {name: value.astype(np.float32) for name, value in values.items()}
    return replace(measured, **values)


class Measure:
    """Turns outputs of the network for frames of one sensor into `Fields`.

    `background` is the image of its untouched gel. If that has dots, shear is their motion
    (`DotFlow`), and the force along the gel follows from it. A `ruler` measures depth and contact.
    `oriented` turns and mirrors images as `Preprocess` does. Faults of the first frame are logged
    once.
    """

    def __init__(
        self,
        scale: Scale,
        sensor: str,
        background: Array | None,
        log: Callable[[str], None],
        rotate: int,
        flip: Flip,
        ruler: Ruler | None = None,
    ) -> None:
        self.scale = scale
        self._ruler = ruler
        self.oriented = partial(orient_frame, rotate=rotate, flip=flip)
        self._sensor = sensor
        self._log = log
        self._background = None if background is None else self.oriented(background)
        self._flow = None if self._background is None else DotFlow(self._background)
        self._faults: tuple[str, ...] | None = None

    @property
    def width_mm(self) -> float | None:
        """The mm that the image's width shows, None if nobody knows it."""
        return self.scale.width

    def __call__(self, out: FieldOutput, frames: Sequence[Array]) -> Fields:
        """Return the fields of B frames RGB u8 (h, w, 3), oriented."""
        height, width = frames[0].shape[:2]
        if self._faults is None:
            self._faults = faults_of(frames[0], self._background, self._sensor, self.scale.shape)
            for fault in self._faults:
                self._log(f"do not trust what is measured, its deviations are wide: {fault}")
        measured = fields_of(out, self.scale, height / width, self._faults)
        if self._ruler is not None:
            measured = _by_ruler(measured, self._ruler, frames, out.pressure)
        # `DotFlow` is false for a gel without dots.
        if not self._flow or self._faults:
            return measured
        measured = self._with_dots(measured, frames)
        if measured.force is None:
            return measured
        return _dragged(measured, self.scale)

    def _with_dots(self, measured: Fields, frames: Sequence[Array]) -> Fields:
        """Return fields whose shear is the motion of dots, which is seen and not guessed."""
        assert self._flow is not None
        rows, columns = measured.depth.shape[1:]
        mm = self.scale.width or 1.0
        shears = []
        deviations = []
        for frame in frames:
            shear, std = self._flow(frame, rows, columns)
            shears.append(shear)
            deviations.append(std)
        return replace(
            measured,
            shear=(np.stack(shears) * mm).astype(np.float32),
            shear_std=(np.stack(deviations) * mm).astype(np.float32),
        )


def measure_of(
    metadata: Mapping[str, Any],
    sensor: str,
    background: Array | None,
    *,
    width_mm: float | None,
    log: Log,
    rotate: int,
    flip: Flip,
    weights: Callable[[], str] = str,
) -> Measure:
    """Return what turns outputs for frames of a sensor into `Fields`: the door of the encoder.

    Args:
        metadata: those of the weights, see `scale_of`.
        sensor: its name, or the folder of a fitted one.
        background: the untouched gel RGB u8 (h, w, 3), as the camera takes it.
        width_mm: the mm that the image's width shows, see `scale_of`.
        log: takes a sentence on each fault of the first frame.
        rotate: degrees by which frames are turned.
        flip: how they are mirrored after that.
        weights: returns the fingerprint of the network, which only a calibration asks for.

    Raises:
        UserError: the sensor was calibrated with another network, or the background is not one of
            it.
    """
    scale = scale_of(metadata, sensor, width_mm)
    word = resolve_sensor(sensor)
    ruler = None if word.folder is None else read_ruler(word.folder)
    if word.force_spread and weights() != word.force_encoder:
        raise another_encoder()
    if ruler is not None:
        ruler.check_network(weights())
        if background is not None:
            today = orient_frame(background, rotate, flip)
            ruler, holds = ruler_of_today(ruler, today, log)
            if not holds and scale.case == "calibrated":
                scale = scale._replace(case="unknown", spread=max(scale.spread, OTHER_SPREAD))
    return Measure(scale, word.family or word.name, background, log, rotate, flip, ruler)
