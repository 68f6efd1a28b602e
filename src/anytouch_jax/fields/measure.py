"""Touch in millimetres and newtons: depth, shear, contact and force of frames, with standard
deviations.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from anytouch_jax.data.background.dots import DotFlow
from anytouch_jax.data.background.layout import UnitFrames, check_layout, known_gels
from anytouch_jax.data.transforms import Flip, orient_frame
from anytouch_jax.encoder.arrays import METADATA, Array
from anytouch_jax.errors import UserError
from anytouch_jax.fields.outputs import FORCE, LENGTH, TORQUE, FieldOutput
from anytouch_jax.files import atomic_write
from anytouch_jax.shown import shown_short


class KnownGel(NamedTuple):
    """What a sensor shows: mm of the picture's width, its height over its width, and kPa of the
    gel's modulus.
    """

    width: float
    shape: float
    modulus: float


GELS = {
    "gelsight": KnownGel(18.88, 0.75, 150),
    "gelsight_mini": KnownGel(18.88, 0.75, 180),
    "gelslim": KnownGel(20.0, 0.75, 220),
    "digit": KnownGel(14.25, 4 / 3, 120),
    "9dtact": KnownGel(24.0, 0.75, 120),
    "duragel": KnownGel(18.7, 0.75, 350),
}
# kPa of an unknown gel, and its deviation as a share
OTHER_MODULUS = 170.0
OTHER_SPREAD = 0.4
# over modulus times width squared: the deviation of a smaller normal force is that of this one
LEAST_FORCE = 1e-3
DRAG = 2.4  # see `_dragged`
# deviation of its force as a share of modulus times width squared, and of it
DRAG_LEAST = 3e-4
DRAG_SPREAD = 0.4
SHAPE_LIMIT = 0.1  # difference of proportions that shows a turned or cropped picture
_NAMES = ("depth", "shear", "normal", "tangential", "torque", "slip")
_SIDE = 40  # pixels of a picture's width, when compared with its background
_EDGE = 4  # pixels, along each side, of one vertex of a surface


class Scale(NamedTuple):
    """What turns outputs into mm and N: `width` mm of the picture or None, and the gel's `modulus`
    in kPa.

    `spread` is the modulus' deviation as a share, `shape` height over width. `factors` multiply
    deviations, by name.
    """

    width: float | None
    modulus: float
    spread: float
    shape: float | None
    factors: dict[str, float]


def scale_of(metadata: Mapping[str, Any], sensor: str, width_mm: float | None = None) -> Scale:
    """Return the scale of a sensor: that of GELS, of the weights' `metadata`, or of `width_mm`.

    Raises UserError.
    """
    if width_mm is not None and not 0 < width_mm < np.inf:
        raise UserError(
            f"the width of the picture must be a number of mm above 0, not {width_mm:g}"
        )
    try:
        stored = metadata.get(METADATA, {})
        stored = json.loads(stored) if isinstance(stored, str) else stored
        factors = {name: float(stored.get(name, 1.0)) for name in _NAMES}
        moduli = {name: float(value) for name, value in stored.get("modulus", {}).items()}
    except (ValueError, TypeError, AttributeError):
        raise UserError(
            "the calibration of fields in the weights is damaged; load the weights again"
        ) from None
    gel = GELS.get(sensor)
    shape = gel.shape if gel and width_mm is None else None
    if gel is None:
        spread = 0.0 if sensor in moduli else OTHER_SPREAD
        return Scale(width_mm, moduli.get(sensor, OTHER_MODULUS), spread, shape, factors)
    return Scale(width_mm or gel.width, moduli.get(sensor, gel.modulus), 0.0, shape, factors)


@shown_short
@dataclass(frozen=True, eq=False)
class Fields:
    """What B frames measure, each value with its standard deviation, as maps (B, h, w) over the
    whole picture.

    `depth` mm into the gel. `shear` (B, h, w, 2) mm along x and y of the picture, and one deviation
    for both: that of the dots, or a guess without them. `contact` is a probability. `force` (B, 3)
    N along x, along y and into the gel. `torque` (B,) N mm about the centre of pressure. `slip`
    (B,) share of the contact that slides. `area` (B,) mm2. `centre` (B, 2) mm of the pressure from
    the middle of the picture, x to the right and y down, NaN without contact. Without a width
    (`width_mm` None) lengths are shares of the picture's width, areas of its square, and force and
    torque are None. `shape` is height over width. With `faults` the deviations are wide.
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

    def __len__(self) -> int:
        return len(self.depth)

    def __getitem__(self, row: int) -> Fields:
        """Return the fields of one frame, still with an axis of 1."""
        at = range(len(self))[row]  # raises IndexError
        return self._each(lambda name, value: value[at : at + 1])

    def _each(self, change: Callable[[str, Array], Array]) -> Fields:
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        arrays: Any = {
            name: change(name, value)
            for name, value in values.items()
            if isinstance(value, np.ndarray)
        }
        return replace(self, **arrays)

    def at(self, height: int, width: int) -> Fields:
        """Return the same fields with maps (B, height, width), such as the frame's."""

        def resized(name: str, value: Array) -> Array:
            if value.ndim < 3:
                return value
            return np.stack(
                [cv2.resize(one, (width, height), interpolation=cv2.INTER_LINEAR) for one in value]
            )

        return self._each(resized)

    def points(self) -> Array:
        """Return the surface of the gel f32 (B, h, w, 3), x to the right and y down from the
        middle, z into the gel.
        """
        height, width = self.depth.shape[1:]
        mm = self.width_mm or 1.0
        y, x = np.mgrid[:height, :width] + 0.5
        flat = (x / width - 0.5) * mm, (y / height - 0.5) * mm * self.shape
        return np.stack(
            [*(np.broadcast_to(axis, self.depth.shape) for axis in flat), self.depth], -1
        ).astype("f4")

    def summary(self, row: int = 0) -> dict[str, Any]:
        """Return the numbers of a frame by name, each with its deviation `*_std`; None for what is
        unknown.
        """
        y, x = np.unravel_index(np.argmax(self.depth[row]), self.depth.shape[1:])

        def at(name: str, *place: Any) -> dict[str, Any]:
            pair = {end: getattr(self, f"{name}{end}") for end in ("", "_std")}
            return {
                f"{name}{end}": None if value is None else value[(row, *place)]
                for end, value in pair.items()
            }

        forces = {f"force_{axis}": at("force", place) for place, axis in enumerate("xyz")}
        values = {
            name.replace("force", axis): value
            for axis, pair in forces.items()
            for name, value in pair.items()
        }
        values |= at("torque") | at("depth", y, x) | at("area")
        values |= {"centre_x": self.centre[row, 0], "centre_y": self.centre[row, 1]}
        values |= {"centre_std": self.centre_std[row]} | at("slip")
        numbers = {
            name: None if value is None else round(float(value), 5)
            for name, value in values.items()
        }
        return {name: None if value != value else value for name, value in numbers.items()}


_ARRAYS = tuple(
    one.name for one in fields(Fields) if one.name not in ("width_mm", "shape", "faults")
)


def stacked(parts: Sequence[Fields]) -> dict[str, Array]:
    """Return the arrays of several `Fields` as one, by name, maps as float16.

    Unknown force is NaN.
    """
    arrays = {}
    for name in _ARRAYS:
        values = [getattr(part, name) for part in parts]
        width = (3,) if name.startswith("force") else ()
        whole = [
            np.full((len(part), *width), np.nan, np.float32) if value is None else value
            for part, value in zip(parts, values, strict=True)
        ]
        array = np.concatenate(whole)
        arrays[name] = (
            array.astype(np.float16)
            if name.removesuffix("_std") in ("depth", "shear", "contact")
            else array
        )
    widths = [
        np.full(len(part), np.nan if part.width_mm is None else part.width_mm) for part in parts
    ]
    return arrays | {"width_mm": np.concatenate(widths)}


def _deviation(log: Any) -> Array:
    """Return the standard deviation of a Laplace error from its bent logarithm, as
    `ops.losses.laplace_loss`.
    """
    return np.asarray(np.sqrt(2) * np.exp(5 * np.tanh(log / 5)))


def fields_of(out: FieldOutput, scale: Scale, shape: float, faults: tuple[str, ...] = ()) -> Fields:
    """Return the output of the network, as numpy arrays, in mm and N. `shape` is the picture's
    height over width.
    """
    out = FieldOutput._make(np.asarray(value, np.float32) for value in out)
    mm = scale.width or 1.0
    own = scale.factors
    rows, columns = out.depth.shape[1:]
    contact = 1 / (1 + np.exp(-out.contact))
    inside = contact > 0.5
    cell = mm**2 * shape / (rows * columns)
    area = cell * inside.sum((1, 2))
    area_std = cell * np.minimum(contact, 1 - contact).sum((1, 2))
    weight = np.where(inside, out.pressure + 1e-9, 0)
    weight = weight / np.where(area > 0, weight.sum((1, 2)), np.nan)[:, None, None]
    x = (np.arange(columns) + 0.5) / columns - 0.5
    y = ((np.arange(rows) + 0.5) / rows - 0.5) * shape
    centre = mm * np.stack([weight.sum(1) @ x, weight.sum(2) @ y], axis=1)
    round_edge = np.sqrt(4 * np.pi * np.where(area > 0, area, np.nan))
    slip = 1 / (1 + np.exp(-out.slip))
    values: dict[str, Any] = {
        "depth": mm * out.depth,
        "depth_std": mm * LENGTH * own["depth"] * _deviation(out.depth_log),
        "shear": mm * out.shear,
        "shear_std": mm * LENGTH * own["shear"] * _deviation(out.shear_log),
        "slip": slip,
        "slip_std": np.minimum(own["slip"] * _deviation(out.slip_log), 1),
        "area": area,
        "area_std": area_std,
        "centre": centre,
        "centre_std": area_std / round_edge,
        "force": None,
        "force_std": None,
        "torque": None,
        "torque_std": None,
    }
    if scale.width is not None:
        newton = scale.modulus * mm**2 / 1000  # kPa mm2 are mN
        deviation = _deviation(out.force_log)
        sideways = np.repeat(own["tangential"] * FORCE * deviation[:, :1], 2, axis=1)
        normal = own["normal"] * (out.force[:, 2:] + LEAST_FORCE) * deviation[:, 1:]
        values |= {
            "force": newton * out.force,
            "force_std": newton * np.concatenate([sideways, normal], axis=1),
            "torque": newton * mm * out.torque,
            "torque_std": newton * mm * TORQUE * own["torque"] * _deviation(out.torque_log),
        }
        for name in ("force", "torque"):
            values[f"{name}_std"] = np.hypot(values[f"{name}_std"], scale.spread * values[name])
    if faults:  # no value is known better than its own size, nor than a usual touch
        usual = {
            "depth": LENGTH * mm,
            "shear": LENGTH * mm,
            "slip": 1.0,
            "area": (mm / 4) ** 2,
            "centre": mm / 2,
        }
        usual |= {
            "force": FORCE * scale.modulus * mm**2 / 1000,
            "torque": TORQUE * scale.modulus * mm**3 / 1000,
        }
        for name, size in usual.items():
            if values[name] is not None:
                value = (
                    np.abs(values[name]).max(-1)
                    if name in ("shear", "centre")
                    else np.abs(values[name])
                )
                values[f"{name}_std"] = np.hypot(values[f"{name}_std"], value + size)
    values = {
        name: None if value is None else np.asarray(value, np.float32)
        for name, value in values.items()
    }
    return Fields(**values, contact=contact, width_mm=scale.width, shape=shape, faults=faults)


def _dragged(measured: Fields, scale: Scale) -> Fields:
    """Return fields whose force along the gel is that which drags the contact by its `shear`: none
    without contact.

    The force on a disc is the modulus times its shift times the root of its area, times a number
    (Johnson 1985, "Contact Mechanics", 3.7). The number is fitted to simulated layers.
    """
    assert measured.force is not None and measured.force_std is not None
    inside = (measured.contact > 0.5)[..., None]
    shift = (measured.shear * inside).sum((1, 2)) / np.maximum(inside.sum((1, 2)), 1)
    along = DRAG * scale.modulus / 1000 * shift * np.sqrt(measured.area)[:, None]
    least = DRAG_LEAST * scale.modulus / 1000 * (scale.width or 1.0) ** 2
    std = np.hypot(least, np.hypot(DRAG_SPREAD, scale.spread) * np.linalg.norm(along, axis=1))
    force = measured.force.copy()
    deviation = measured.force_std.copy()
    force[:, :2] = along
    deviation[:, :2] = std[:, None]
    return replace(measured, force=force, force_std=deviation)


class Measure:
    """Turns outputs of the network for frames of one sensor into `Fields`, and logs faults of the
    first frame once.

    `background` is the picture of its untouched gel. If that has dots, shear is their motion
    (`DotFlow`), and the force along the gel follows from it. `oriented` turns and mirrors pictures
    as `Preprocess` does.
    """

    def __init__(
        self,
        scale: Scale,
        sensor: str,
        background: Array | None,
        log: Callable[[str], None],
        rotate: int,
        flip: Flip,
    ) -> None:
        self.scale = scale
        self.oriented = partial(orient_frame, rotate=rotate, flip=flip)
        self._sensor = sensor
        self._log = log
        self._background = None if background is None else self.oriented(background)
        self._flow = None if self._background is None else DotFlow(self._background)
        self._faults: tuple[str, ...] | None = None

    def __call__(self, out: FieldOutput, frames: Sequence[Array]) -> Fields:
        """Return the fields of B frames RGB u8 (h, w, 3), oriented."""
        height, width = frames[0].shape[:2]
        if self._faults is None:
            self._faults = faults_of(frames[0], self._background, self._sensor, self.scale.shape)
            for fault in self._faults:
                self._log(f"do not trust what is measured, its deviations are wide: {fault}")
        measured = fields_of(out, self.scale, height / width, self._faults)
        if not self._flow or self._faults:
            return measured
        shifts = [self._flow(frame, *measured.depth.shape[1:]) for frame in frames]
        shear, std = (
            np.stack(part) * (self.scale.width or 1.0) for part in zip(*shifts, strict=True)
        )
        measured = replace(
            measured, shear=shear.astype(np.float32), shear_std=std.astype(np.float32)
        )
        if measured.force is None:
            return measured
        return _dragged(measured, self.scale)


def faults_of(
    frame: Array, background: Array | None, sensor: str, shape: float | None
) -> tuple[str, ...]:
    """Return sentences on a frame RGB u8 (h, w, 3) that a sensor in order does not give.

    UserError if parts differ.
    """
    (height, width) = frame.shape[:2]
    faults = list[str]()
    if (
        background is not None
        and abs(np.log(background.shape[0] * width / (background.shape[1] * height))) > 0.03
    ):
        raise UserError(
            f"the frame has {width} x {height} pixels and its background {background.shape[1]} x "
            f"{background.shape[0]}: they show different parts of the gel. Take both with one "
            "setting of the camera."
        )
    if shape is not None and abs(np.log(height / (width * shape))) > SHAPE_LIMIT:
        faults.append(
            f"a picture of {sensor} has a height of {shape:.3g} widths, and this one has {width} x "
            f"{height} pixels. "
            "Turn it, or name the width that it shows (width_mm)."
        )
    few = frame[::4, ::4].astype(np.int16)
    if np.abs(few - few[..., :1]).max() <= 2:
        faults.append("the picture is grey, and colours show the slopes. Read it in colour.")
        return tuple(faults)
    if background is not None and (turned := _unlike(frame, background)):
        faults.append(
            f"it looks {turned} when compared with its background. Read both in the same way."
        )
    known = known_gels(sensor)
    check = check_layout(UnitFrames(sensor, "", [[frame]], background), known)
    if check.ok is False:
        faults.append(f"unlike other units of {sensor} it looks {check.value}. {check.advice}")
    return tuple(faults)


def _unlike(frame: Array, background: Array) -> str:
    """Return how a frame was turned or recoloured against its background, "" if it was not.

    A press covers the smaller part of a picture. Of simulated presses 4 % look exchanged by a
    factor of up to 1.17.
    """
    size = (_SIDE, max(1, round(_SIDE * frame.shape[0] / frame.shape[1])))
    small, gel = (
        cv2.resize(one, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        for one in (frame, background)
    )

    def differs(other: Array) -> float:
        change = other - gel
        return float(np.median(np.abs(change - np.median(change, axis=(0, 1))).max(2)))

    others = {
        "mirrored left to right": small[:, ::-1],
        "mirrored top to bottom": small[::-1],
        "upside down": small[::-1, ::-1],
        "as with red and blue exchanged": small[..., ::-1],
    }
    nearest = min(others, key=lambda name: differs(others[name]))
    if 1.2 * differs(others[nearest]) + 1 < differs(small):
        return nearest
    return ""


def depth_levels(depth: Array, width_mm: float | None) -> tuple[Array, float]:
    """Return a map of depth as u8, and the depth of 255: the deepest place, but no less than a
    usual touch.
    """
    deepest = max(float(depth.max()), LENGTH * (width_mm or 1.0))
    return np.clip(255 * depth / deepest, 0, 255).astype(np.uint8), deepest


def overlay(frame: Array, measured: Fields, row: int = 0, *, text: bool = True) -> Array:
    """Return a picture u8 (h, w, 3) of a frame: depth in colour, rim of contact, sure shear, and
    force as `text`.
    """
    height, width = frame.shape[:2]
    one = measured[row].at(height, width)
    level, _ = depth_levels(one.depth[0], one.width_mm)
    colours = cv2.cvtColor(cv2.applyColorMap(level, cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB)
    share = np.minimum(level, 64) * np.float32(0.7 / 64)
    view = cv2.blendLinear(np.ascontiguousarray(frame), colours, 1 - share, share)
    inside = (one.contact[0] > 0.5).astype(np.uint8)
    rims = cv2.findContours(inside, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    cv2.drawContours(view, rims, -1, (255, 255, 255), 1, cv2.LINE_AA)
    # arrows four times their length
    step = max(min(height, width) // 14, 1)
    long = 4 * width / (one.width_mm or 1.0)
    for y in range(step // 2, height, step):
        for x in range(step // 2, width, step):
            if inside[y, x] and np.linalg.norm(one.shear[0, y, x]) > one.shear_std[0, y, x]:
                tip = np.rint((x, y) + long * one.shear[0, y, x]).astype(int)
                cv2.arrowedLine(
                    view,
                    (x, y),
                    tuple(tip.tolist()),
                    (120, 255, 120),
                    1,
                    cv2.LINE_AA,
                    tipLength=0.3,
                )
    if not text:
        return view
    about = one.summary()
    unit = "" if one.width_mm is None else " mm"
    force = about["force_z"]
    line = f"{about['depth']:.2f}+-{about['depth_std']:.2f}{unit}"
    line += "" if force is None else f"  {force:.2f}+-{about['force_z_std']:.2f} N"
    font = cv2.FONT_HERSHEY_SIMPLEX
    white = (255, 255, 255)
    cv2.putText(view, line, (6, height - 8), font, width / 800 + 0.1, white, 1, cv2.LINE_AA)
    return view


def write_surface(path: Path, frame: Array, measured: Fields, row: int = 0) -> None:
    """Write the surface of the gel as a PLY mesh in mm, coloured by the frame.

    Depth goes down along z.
    """
    height, width = (max(side // _EDGE, 2) for side in frame.shape[:2])
    kinds = [(axis, "<f4") for axis in "xyz"] + [
        (colour, "u1") for colour in ("red", "green", "blue")
    ]
    points = np.empty((height, width), kinds)
    # y and z up, as in space
    at = measured[row].at(height, width).points()[0] * (1, -1, -1)
    points["x"], points["y"], points["z"] = np.moveaxis(at, -1, 0)
    small = cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)
    for place, colour in enumerate(("red", "green", "blue")):
        points[colour] = small[..., place]
    grid = np.arange(height * width, dtype="<i4").reshape(height, width)
    corners = [
        grid[:-1, :-1],
        grid[1:, :-1],
        grid[:-1, 1:],
        grid[:-1, 1:],
        grid[1:, :-1],
        grid[1:, 1:],
    ]
    triangles = np.stack(corners, -1).reshape(-1, 3)
    faces = np.empty(len(triangles), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"], faces["corners"] = 3, triangles
    properties = "".join(
        f"property {'float' if kind == '<f4' else 'uchar'} {name}\n" for name, kind in kinds
    )
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {points.size}\n{properties}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    atomic_write(path, header.encode() + points.tobytes() + faces.tobytes())


def missing(source: str) -> UserError:
    """Return the error of an encoder without a decoder of fields."""
    return UserError(
        f"{source} does not measure depth and force: its weights have no fields. Use "
        "anytouch-tiny, or train with "
        "--model.fields 32"
    )
