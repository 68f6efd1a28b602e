"""Touch scenes: objects, places, motions and sensor units, drawn from a seed by numpy.

A touch is a place on an object. A recording is one sensor's clip of it: a part of press, hold,
slide or twist, release.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Literal, NamedTuple

import numpy as np

from anytouch_jax.config import SimulatedConfig
from anytouch_jax.config.parsing import check
from anytouch_jax.config.scenes import SceneOptions
from anytouch_jax.errors import UserError
from anytouch_jax.sim.draws import Leaf, Rng, Scalar, either, namespace_of
from anytouch_jax.sim.sensing.own import find_sensor, sensor_number
from anytouch_jax.sim.sensing.sensors import THINNEST, Sensor, Unit, draw_drift, draw_unit
from anytouch_jax.sim.world.objects import Object, catalogue, hold_out

Array = np.ndarray
Grade = Literal["fine", "coarse"]
# a gesture has the number of one, each as likely
MOTIONS = ("hold", "slide", "slide", "twist", "twist")

FIELDS = ("displacement", "pressure", "shear")
_MAX_SIZE = 4096  # pixels of a side
# Tags that separate the random streams of a seed.
_OBJECTS = 1
_TOUCH = 2
_RECORDING = 3
PHOTO = 4
CAPTION = 5
_UNIT = 6


@dataclass(frozen=True)
class Scenes(SceneOptions):
    """A simulated data set: the options of `SceneOptions`, checked.

    `touches` places on `objects` objects are each recorded by every sensor for `frames` frames.
    Half of the held-out fraction of the remaining objects is for validation, if enough objects are
    left. With fewer than 12 objects all are for training. Raises UserError for a scene that cannot
    be simulated.
    """

    def __post_init__(self) -> None:
        kinds = self._checked_sensors()
        self._check_depth(kinds)
        if self.size and not 16 <= self.size <= _MAX_SIZE:
            raise UserError(
                f"size is 16 to {_MAX_SIZE} pixels, or 0 for each sensor's own resolution, not "
                f"{self.size}"
            )
        check(self)

    def _checked_sensors(self) -> list[Sensor]:
        """Return the sensors, after a check of their names and of those of the fields."""
        for name in self.fields:
            if name not in FIELDS:
                raise UserError(
                    f"there is no simulated field {name!r}; choose among {', '.join(FIELDS)}"
                )
        kinds = [find_sensor(name) for name in self.sensors]
        for what, names in (("sensor", [one.name for one in kinds]), ("field", self.fields)):
            if len(set(names)) != len(names):
                raise UserError(f"name each {what} once, not {', '.join(names)}")
        if not self.sensors:
            raise UserError("name at least one sensor")
        if self.fields and all(one.kind == "field" for one in kinds):
            raise UserError(
                "fields are written next to images, and no sensor has a camera: omit --fields"
            )
        return kinds

    def _check_depth(self, kinds: Sequence[Sensor]) -> None:
        """Raise UserError for a range of depths that is none, or that goes through a gel."""
        low, high = self.depth
        if not 0 <= low <= high < math.inf:
            raise UserError(
                f"depth is a range of mm from 0 on, lowest first, not {low:g} to {high:g}"
            )
        thin = min(kinds, key=lambda one: one.gel.thickness)
        thinnest = thin.gel.thickness
        if self.units == "each":
            thinnest = thinnest * THINNEST
        if high >= thinnest:
            raise UserError(
                f"depth {high:g} mm may go through the gel of {thin.name}: stay below {thinnest:g} "
                "mm"
            )


def training_scenes(simulated: SimulatedConfig) -> Scenes:
    """Return the scenes whose objects and splits training on simulated touches has."""
    return Scenes(objects=simulated.objects, seed=simulated.seed, depth=simulated.depth)


class Touch(NamedTuple):
    """A place to touch on an object, and the motion there."""

    number: int
    object: int  # number of the object
    split: str
    place: Leaf  # (2,) mm in the object's frame
    yaw: Scalar  # rad of the sensor
    gesture: Gesture


class Gesture(NamedTuple):
    """A motion of the sensor. Times are in parts of the whole gesture, 0 to 1."""

    depth: Scalar  # mm, deepest
    motion: Scalar  # a number of MOTIONS
    slide: Leaf  # (2,) mm in total
    twist: Scalar  # rad in total
    phases: Leaf  # (7,) durations of lift, press, pause, move, pause, release and lift
    shown: Scalar  # duration of the clip
    middle: Scalar  # time in the middle of the clip
    lift: Scalar  # time at which the sensor is off for a moment, -1 for never
    regrasp: Leaf  # (3,) mm, mm, rad by which it comes back moved


class Recording(NamedTuple):
    """One sensor's clip of a touch with T frames, by one sensor unit."""

    touch: Touch
    sensor: str
    unit: Unit
    start: Array  # (3,) mm, mm, rad: the touched place in the gel's frame, and the object's turn
    motion: Leaf  # (T, 3) mm, mm, rad from there, about the middle of the gel
    depth: Leaf  # (T,) mm, negative without contact
    tilt: Leaf  # (2,) rise per mm
    gesture: Gesture
    drift: Leaf  # (T, 3, 3) of the light
    has_photo: bool
    has_text: bool
    seed: int  # of the image noise


def objects_and_splits(scenes: Scenes) -> tuple[tuple[Object, ...], tuple[str, ...]]:
    """Return the objects of a data set and their splits, which share no (primitive, texture) pair.

    Raises UserError.
    """
    objects = catalogue(scenes.seed, scenes.objects)
    if scenes.held_out <= 0 or scenes.objects < 12:  # too few to hold out whole pairs
        return objects, ("train",) * len(objects)
    try:
        training, test = hold_out(objects, scenes.held_out, scenes.seed)
    except UserError as error:
        raise UserError(
            f"--objects {scenes.objects} and --held-out {scenes.held_out:g}: {error}"
        ) from None
    split = {thing.name: "test" for thing in test}
    # Too few may remain for a validation set. Then there is none.
    with contextlib.suppress(UserError):
        _, validation = hold_out(training, scenes.held_out / 2, scenes.seed + 1)
        split |= {thing.name: "val" for thing in validation}
    return objects, tuple(split.get(thing.name, "train") for thing in objects)


def draw_touch(scenes: Scenes, number: int, splits: Sequence[str]) -> Touch:
    """Return touch `number`.

    Objects take turns in a seeded order. Places are within 3 mm of the middle.
    """
    rng = np.random.default_rng([scenes.seed, _TOUCH, number])
    turn, place_in_turn = divmod(number, len(splits))
    order = np.random.default_rng([scenes.seed, _OBJECTS, turn]).permutation(len(splits))
    thing = int(order[place_in_turn])
    place, yaw = draw_place(rng)
    return Touch(number, thing, splits[thing], place, yaw, draw_gesture(scenes.depth, rng))


def draw_place(rng: Rng) -> tuple[Leaf, Scalar]:
    """Return a place (2,) mm within 3 mm of an object's middle, and the yaw of the sensor there."""
    xp = namespace_of(rng)
    angle = rng.uniform(0, 2 * math.pi)
    # The root makes places as dense at the rim of the disc as in its middle.
    away = 3.0 * xp.sqrt(rng.uniform())
    return xp.stack([xp.cos(angle), xp.sin(angle)]) * away, rng.uniform(-math.pi, math.pi)


def draw_gesture(depths: tuple[float, float], rng: Rng, like: Gesture | None = None) -> Gesture:
    """Return a gesture. With `like`, its depth is similar and its speed and motion are drawn."""
    xp = namespace_of(rng)
    low, high = depths
    if like is None:
        depth = rng.uniform(low, high)
    else:
        depth = xp.clip(like.depth * rng.uniform(0.7, 1.3), low, high)
    motion = rng.integers(len(MOTIONS))
    angle = rng.uniform(0, 2 * math.pi)
    length = rng.uniform(0.4, 2.5)
    turn = rng.choice([-1, 1]) * rng.uniform(math.radians(4), math.radians(20))
    slides, twists = ((motion >= first) & (motion <= first + 1) for first in (1, 3))
    slide = xp.stack([xp.cos(angle), xp.sin(angle)]) * length * slides
    phases = rng.uniform([0, 0.1, 0, 0.25, 0, 0.08, 0], [0.15, 0.35, 0.15, 0.5, 0.2, 0.2, 0.1])
    phases = phases / phases.sum()
    # A clip's middle and a regrasp lie between the end of the press and the start of the release.
    first = phases[:2].sum() * 0.8
    last = 1 - phases[5:].sum()
    shown = xp.exp(rng.uniform(math.log(0.35), math.log(1.2)))
    middle = rng.uniform(first, last)
    lift = either(rng, rng.uniform() < 0.12, lambda: rng.uniform(first, last), -1.0)
    regrasp = rng.normal(0, 1, 3) * np.array([0.8, 0.8, math.radians(8)])
    return Gesture(depth, motion, slide, turn * twists, phases, shown, middle, lift, regrasp)


def draw_by_hand(
    depths: tuple[float, float], rng: Rng, gesture: Gesture, yaw: Scalar
) -> tuple[Gesture, Scalar, Leaf, Leaf]:
    """Return another sensor's gesture, yaw, offset and tilt at a touch of grade coarse.

    The offset is (2,) mm, the tilt (2,) in rise per mm.

    Args:
        depths: range of the depth, mm.
        rng: of the recording.
        gesture: of the touch.
        yaw: of the touch, rad.
    """
    gesture = draw_gesture(depths, rng, gesture)
    yaw = yaw + math.radians(12) * rng.standard_normal()
    offset = 0.8 * rng.standard_normal(2)
    tilt = math.tan(math.radians(2.5)) * rng.standard_normal(2)
    return gesture, yaw, offset, tilt


def draw_recording(scenes: Scenes, touch: Touch, sensor: str) -> Recording:
    """Return the clip of `touch` by `sensor`. Draws do not depend on the other sensors."""
    kind = find_sensor(sensor)
    rng = np.random.default_rng([scenes.seed, _RECORDING, touch.number, sensor_number(kind)])
    # It is drawn with units "one" too, so that the rest of the recording is the same.
    unit = draw_unit(kind, rng)
    if scenes.units == "one":
        unit = _mounted_straight(scenes, kind)
    if kind.kind == "field":  # it has no camera
        unit = unit._replace(
            mirror=np.ones(2, np.float32),
            window=np.zeros(2, np.float32),
            zoom=np.ones((), np.float32),
        )
    gesture = touch.gesture
    yaw = touch.yaw
    offset: Leaf = np.zeros(2)
    tilt: Leaf = np.zeros(2)
    if scenes.grade == "coarse":
        gesture, yaw, offset, tilt = draw_by_hand(scenes.depth, rng, gesture, yaw)
    motion, depth = trajectory(scenes.frames, gesture)
    start = np.array([*offset, yaw])
    has_photo, has_text = (
        bool(rng.random() < fraction) for fraction in (scenes.vision, scenes.text)
    )
    seed = int(rng.integers(2**31))
    drift = draw_drift(scenes.frames, rng)
    return Recording(
        touch, sensor, unit, start, motion, depth, tilt, gesture, drift, has_photo, has_text, seed
    )


def _mounted_straight(scenes: Scenes, kind: Sensor) -> Unit:
    """Return the one unit of a sensor: not mirrored, not rotated, not moved."""
    unit = draw_unit(kind, np.random.default_rng([scenes.seed, _UNIT, sensor_number(kind)]))
    return unit._replace(
        mirror=np.ones(2, np.float32),
        rotation=np.zeros((), np.float32),
        offset=np.zeros(2, np.float32),
    )


def trajectory(frames: int, gesture: Gesture) -> tuple[Leaf, Leaf]:
    """Return motion (T, 3) since the touch, and depth (T,), negative without contact.

    A still is the deepest press.
    """
    if frames == 1:
        return np.zeros((1, 3)), np.array([gesture.depth])
    times = gesture.middle + gesture.shown * np.linspace(-0.5, 0.5, frames)
    # A lift shorter than a frame would not be seen.
    gap = max(0.04, gesture.shown / (frames - 1) / 2)
    return trajectory_at(gesture, times, gap, np)


def trajectory_at(gesture: Gesture, times: Leaf, gap: Scalar, xp: ModuleType) -> tuple[Leaf, Leaf]:
    """Return motion (T, 3) and depth (T,) as `trajectory` at `times` (T,).

    Args:
        gesture: phases, slide, twist and lift.
        times: (T,), 0 to 1 over the gesture.
        gap: time that a lift lasts to both sides.
        xp: numpy or jax.numpy.
    """
    ends = xp.cumsum(gesture.phases)

    def smooth(phase: int) -> Leaf:
        """Return how much of a phase is over, 0 to 1, with no jump of the speed at its ends."""
        x = xp.clip((times - ends[phase - 1]) / gesture.phases[phase], 0, 1)
        return x**2 * (3 - 2 * x)

    depth = gesture.depth * (0.05 + 0.95 * smooth(1)) * (1 - 0.95 * smooth(5))
    motion = smooth(3)[:, None] * xp.stack([*gesture.slide, gesture.twist])[None]
    lifted = gesture.lift >= 0
    off = (times < ends[0]) | (times > ends[5]) | (lifted & (xp.abs(times - gesture.lift) <= gap))
    motion = motion + (lifted & (times > gesture.lift))[:, None] * gesture.regrasp[None]
    return motion, xp.where(off, -1.0, depth)


MOVES = (0.1, math.radians(1))  # mm and rad that the gel must be moved to be labelled so


def directions(recording: Recording) -> dict[str, str]:
    """Return labels of the motion in contact as the image shows it.

    They are `label.motion`, `label.twist` and `label.slide`. A regrasp is not in contact, so the
    motion is that of the gesture without its lift.
    """
    unit = recording.unit
    touching = recording.depth > 0
    steps = np.diff(trajectory(len(touching), recording.gesture._replace(lift=-1.0))[0], axis=0)
    *slid, turn = steps[touching[1:] & touching[:-1]].sum(0)
    # A mirror image turns the other way, and one mirrored twice does not.
    turn *= float(unit.mirror[0] * unit.mirror[1])
    motion = "hold"
    twist = "none"
    slide = "none"
    if MOTIONS[int(recording.gesture.motion)] == "twist" and abs(turn) > MOVES[1]:
        motion = "twist"
        twist = "clockwise" if turn > 0 else "counterclockwise"
    elif MOTIONS[int(recording.gesture.motion)] == "slide" and math.hypot(*slid) > MOVES[0]:
        motion = "slide"
        c = math.cos(float(unit.rotation))
        s = math.sin(float(unit.rotation))
        x, y = np.array([[c, -s], [s, c]]) @ np.asarray(slid) * np.asarray(unit.mirror)
        slide = ("right", "down", "left", "up")[round(math.atan2(y, x) / (math.pi / 2)) % 4]
    return {"label.motion": motion, "label.twist": twist, "label.slide": slide}
