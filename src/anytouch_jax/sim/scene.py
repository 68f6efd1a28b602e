"""Which touches are made: objects, places, motions and sensor units, drawn from a seed (numpy; nothing is computed).

A touch is a place on an object; a recording is one sensor's clip of it: press, hold, slide or twist, release.
One gesture fills a clip, whatever its number of frames: ten, at the 30 Hz of the sensors, are a third of a second.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.sim.sensing.sensors import SENSORS
from anytouch_jax.sim.sensing.units import THINNEST, Unit, draw_unit
from anytouch_jax.sim.world.objects import Object, catalogue, hold_out

Array = np.ndarray
Grade = Literal["fine", "coarse"]
Motion = Literal["hold", "slide", "twist"]

FIELDS = ("displacement", "pressure", "shear")
LARGEST = 4096  # pixels of a side
# Tags that keep the random streams of a seed apart.
_OBJECTS, _TOUCH, _RECORDING, _PHOTO, _CAPTION, _UNIT = 1, 2, 3, 4, 5, 6


@dataclass(frozen=True)
class Scenes:
    """What to simulate: `touches` places on `objects` objects, each felt by every sensor for `frames` frames.

    `grade` fine: one place, depth and motion for all sensors, so that frames correspond one to one; coarse: by hand,
    with tilt, twist, offset, speed and motion of each sensor's own, only the place is shared. `depth` mm, the range of
    the deepest press; `vision` and `text`, the shares of recordings that have a photograph and a caption; `held_out`,
    the share of objects held out for test, by whole (primitive, texture) pairs (and half that share of the rest for
    val, where enough are left; fewer than 12 objects are all trained on); `fields` of FIELDS are written
    beside the images. `units` each: every recording by a device of its own; one: one device of each sensor for all,
    mounted straight, as on the paper's calibrated platform. `first`: the number of the first touch; data sets of one
    seed, number of objects and share held out whose numbers do not overlap share objects and splits, and no touch.
    Raises UserError for what cannot be simulated.
    """

    touches: int = 400
    sensors: tuple[str, ...] = ("gelsight_mini", "digit", "duragel")
    seed: int = 0
    grade: Grade = "fine"
    fidelity: Literal["exact", "fast"] = "fast"
    frames: int = 10
    objects: int = 200
    depth: tuple[float, float] = (0.3, 1.0)
    vision: float = 0.7
    text: float = 0.7
    held_out: float = 0.25
    fields: tuple[str, ...] = ()
    size: int = 224
    units: Literal["each", "one"] = "each"
    first: int = 0

    def __post_init__(self) -> None:
        for name in self.sensors:
            if name not in SENSORS:
                raise UserError(f"there is no sensor {name!r} to simulate; choose among {', '.join(SENSORS)}")
        if not self.sensors or len(set(self.sensors)) != len(self.sensors):
            raise UserError(f"name each sensor once, and at least one, not {', '.join(self.sensors) or 'none'}")
        if len(set(self.fields)) != len(self.fields):
            raise UserError(f"name each field once, not {', '.join(self.fields)}")
        for name in self.fields:
            if name not in FIELDS:
                raise UserError(f"there is no field {name!r}; choose among {', '.join(FIELDS)}")
        for name, least in (("touches", 1), ("frames", 1), ("objects", 1)):
            if getattr(self, name) < least:
                raise UserError(f"{name} must be at least {least}, not {getattr(self, name)}")
        if self.size and not 16 <= self.size <= LARGEST:
            raise UserError(f"size is 16 to {LARGEST} pixels, or 0 for each sensor's own resolution, not {self.size}")
        if self.fields and all(SENSORS[name].kind == "field" for name in self.sensors):
            raise UserError("fields are written beside pictures, and none of the sensors has a camera: leave them away")
        if not (0 <= self.depth[0] <= self.depth[1] < math.inf):
            raise UserError(
                f"depth is a range of mm from 0 on, lowest first, not {self.depth[0]:g} to {self.depth[1]:g}"
            )
        thin = min(self.sensors, key=lambda name: SENSORS[name].gel.thickness)
        thinnest = SENSORS[thin].gel.thickness * (THINNEST if self.units == "each" else 1.0)
        if self.depth[1] >= thinnest:
            raise UserError(f"depth {self.depth[1]:g} mm may go through the gel of {thin}: stay below {thinnest:g} mm")
        if not 0 <= self.held_out < 1:
            raise UserError(f"held_out is a share from 0 to below 1, not {self.held_out:g}")
        for name in ("vision", "text"):
            if not 0 <= getattr(self, name) <= 1:
                raise UserError(f"{name} is a share between 0 and 1, not {getattr(self, name):g}")
        if self.grade not in ("fine", "coarse") or self.fidelity not in ("exact", "fast"):
            raise UserError(f"grade is fine or coarse and fidelity exact or fast, not {self.grade} and {self.fidelity}")
        for name in ("seed", "first"):
            if getattr(self, name) < 0:
                raise UserError(f"{name} must be at least 0, not {getattr(self, name)}")
        if self.units not in ("each", "one"):
            raise UserError(f"units is each or one, not {self.units}")


class Touch(NamedTuple):
    """A place: which object (number), `split`, place (2,) mm and `yaw` rad of the sensor on it, and the motion."""

    number: int
    object: int
    split: str
    place: Array
    yaw: float
    gesture: Gesture


class Gesture(NamedTuple):
    """How the sensor moves: deepest `depth` mm; `slide` (2,) mm and `twist` rad in all; `pace` 1 is the usual speed."""

    depth: float
    motion: Motion
    slide: Array
    twist: float
    pace: float


class Recording(NamedTuple):
    """One sensor's clip of a touch by a unit of its own.

    `start` (3,): where the touched place lies in the gel's frame, mm, mm, and the object's turn, rad; `motion` (T, 3)
    mm, mm, rad moves it from there, about the middle of the gel; `depth` (T,) mm; `tilt` (2,) rise per mm; `gesture` as
    it was made; `seed` of its noise.
    """

    touch: Touch
    sensor: str
    unit: Unit
    start: Array
    motion: Array
    depth: Array
    tilt: Array
    gesture: Gesture
    has_photo: bool
    has_text: bool
    seed: int


def cast(scenes: Scenes) -> tuple[tuple[Object, ...], tuple[str, ...]]:
    """The objects of a data set and the split of each; the splits share no (primitive, texture) pair."""
    objects = catalogue(scenes.seed, scenes.objects)
    if scenes.held_out <= 0 or scenes.objects < 12:  # too few to hold out whole pairs
        return objects, ("train",) * len(objects)
    try:
        seen, unseen = hold_out(objects, scenes.held_out, scenes.seed)
    except UserError as error:
        raise UserError(f"--objects {scenes.objects} and --held-out {scenes.held_out:g}: {error}") from None
    held = {thing.name: "test" for thing in unseen}
    with contextlib.suppress(UserError):  # too few are left for a validation set
        held |= {thing.name: "val" for thing in hold_out(seen, scenes.held_out / 2, scenes.seed + 1)[1]}
    return objects, tuple(held.get(thing.name, "train") for thing in objects)


def draw_touch(scenes: Scenes, number: int, splits: Sequence[str]) -> Touch:
    """Touch `number` of a data set: objects take turns in a seeded order, the place lies within the object's middle."""
    rng = np.random.default_rng([scenes.seed, _TOUCH, number])
    turn, place = divmod(number, len(splits))
    thing = int(np.random.default_rng([scenes.seed, _OBJECTS, turn]).permutation(len(splits))[place])
    angle, away = rng.uniform(0, 2 * math.pi), 3.0 * math.sqrt(rng.uniform())
    where = np.array([math.cos(angle), math.sin(angle)]) * away
    yaw = float(rng.uniform(-math.pi, math.pi))
    return Touch(number, thing, splits[thing], where, yaw, _draw_gesture(scenes, rng))


def _draw_gesture(scenes: Scenes, rng: np.random.Generator, like: Gesture | None = None) -> Gesture:
    """A gesture, or one by hand at the place of `like`: depth and speed near it, a motion of its own."""
    low, high = scenes.depth
    depth = (
        float(rng.uniform(low, high)) if like is None else float(np.clip(like.depth * rng.uniform(0.7, 1.3), low, high))
    )
    motion: Motion = ("hold", "slide", "slide", "twist", "twist")[int(rng.integers(5))]
    angle, length = rng.uniform(0, 2 * math.pi), rng.uniform(0.4, 2.5)
    turn = rng.choice([-1, 1]) * rng.uniform(math.radians(4), math.radians(20))
    slide = np.array([math.cos(angle), math.sin(angle)]) * length * (motion == "slide")
    pace = 1.0 if like is None else float(rng.uniform(0.6, 1.5))
    return Gesture(depth, motion, slide, float(turn) * (motion == "twist"), pace)


def draw_recording(scenes: Scenes, touch: Touch, sensor: str) -> Recording:
    """The clip of `touch` by `sensor`, with a unit of its own; other sensors do not change the draws."""
    rng = np.random.default_rng([scenes.seed, _RECORDING, touch.number, list(SENSORS).index(sensor)])
    unit = draw_unit(SENSORS[sensor], rng)
    if scenes.units == "one":
        unit = device(scenes, sensor)
    if SENSORS[sensor].kind == "field":  # no camera looks at it
        plain = {"mirror": np.ones(2, np.float32), "window": np.zeros(2, np.float32), "zoom": np.float32(1)}
        unit = unit._replace(**plain)
    gesture, yaw, offset, tilt = touch.gesture, touch.yaw, np.zeros(2), np.zeros(2)
    if scenes.grade == "coarse":
        gesture = _draw_gesture(scenes, rng, gesture)
        yaw += math.radians(12) * rng.standard_normal()
        offset = 0.8 * rng.standard_normal(2)
        tilt = math.tan(math.radians(2.5)) * rng.standard_normal(2)
    motion, depth = trajectory(scenes.frames, gesture)
    start = np.array([*offset, yaw])
    has_photo, has_text = (bool(rng.random() < share) for share in (scenes.vision, scenes.text))
    seed = int(rng.integers(2**31))
    return Recording(touch, sensor, unit, start, motion, depth, tilt, gesture, has_photo, has_text, seed)


def device(scenes: Scenes, sensor: str) -> Unit:
    """The one unit of `sensor` in a data set of units "one": not mirrored, not turned, not moved."""
    rng = np.random.default_rng([scenes.seed, _UNIT, list(SENSORS).index(sensor)])
    straight = {"mirror": np.ones(2, np.float32), "rotation": np.float32(0), "offset": np.zeros(2, np.float32)}
    return draw_unit(SENSORS[sensor], rng)._replace(**straight)


def trajectory(frames: int, gesture: Gesture) -> tuple[Array, Array]:
    """Motion (T, 3) and depth (T,) of a gesture: press for a third, move, release in the last fifth.

    Depth and displacement are smooth; a still (T = 1) is the press at its deepest.
    """
    if frames == 1:
        return np.zeros((1, 3)), np.array([gesture.depth])
    t = np.linspace(0, 1, frames)
    t = np.clip(t * gesture.pace, 0, 1)
    smooth = lambda x: np.clip(x, 0, 1) ** 2 * (3 - 2 * np.clip(x, 0, 1))  # noqa: E731
    depth = gesture.depth * (0.1 + 0.9 * smooth(t / 0.35)) * (1 - 0.6 * smooth((t - 0.8) / 0.2))
    moved = smooth((t - 0.35) / 0.5)[:, None]
    return moved * np.array([*gesture.slide, gesture.twist]), depth


def directions(recording: Recording) -> dict[str, str]:
    """Labels of the motion as the picture shows it: `label.motion` (hold, slide, twist), `label.twist` (clockwise,
    counterclockwise, none) and `label.slide` (right, down, left, up, none), the nearest of four."""
    unit, gesture = recording.unit, recording.gesture
    turn = gesture.twist * float(unit.mirror[0] * unit.mirror[1])
    moves = len(recording.depth) > 1  # a still shows none
    twist = "none" if gesture.motion != "twist" or not moves else "clockwise" if turn > 0 else "counterclockwise"
    slide = "none"
    if gesture.motion == "slide" and moves:
        c, s = math.cos(float(unit.rotation)), math.sin(float(unit.rotation))
        x, y = np.array([[c, -s], [s, c]]) @ gesture.slide * np.asarray(unit.mirror)
        slide = ("right", "down", "left", "up")[round(math.atan2(y, x) / (math.pi / 2)) % 4]
    return {"label.motion": gesture.motion if moves else "hold", "label.twist": twist, "label.slide": slide}


def photo_rng(scenes: Scenes, recording: Recording) -> np.random.Generator:
    """The generator of a recording's photograph: another view for each."""
    return np.random.default_rng([scenes.seed, _PHOTO, recording.seed])


def caption_rng(scenes: Scenes, recording: Recording) -> np.random.Generator:
    """The generator of a recording's caption: other words for each."""
    return np.random.default_rng([scenes.seed, _CAPTION, recording.seed])
