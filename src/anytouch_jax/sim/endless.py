"""Endless touch: simulated touches as a pure function of a key, for training without a data set.

A `World` holds what is drawn once: height maps, materials and the families of sensors.
`sample_touches` draws touches from it inside a compiled program, with the distributions of `scene`
and `sensors`. So no touch repeats, none is stored, and a batch depends on its key alone.

All camera sensors share one program: they are solved on one square grid and shown at one size, as
`encoder.preprocess` shows a real image. That is why the numbers of a sensor are arrays here
(`SensorFamily`): a program for each sensor would be compiled six times, and could not mix sensors
in a batch.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import permutations
from typing import Any, Literal, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from anytouch_jax.errors import UserError
from anytouch_jax.sensors import Markers
from anytouch_jax.sim.contact.mechanics import Fidelity, Gel
from anytouch_jax.sim.draws import Draws, Leaf, Scalar
from anytouch_jax.sim.recorder import (
    RELIEF,
    SPACING,
    ClipInput,
    ClipOutput,
    View,
    simulate_clip,
    stack_trees,
)
from anytouch_jax.sim.scene import (
    Gesture,
    Scenes,
    draw_by_hand,
    draw_gesture,
    draw_place,
    objects_and_splits,
    trajectory_at,
)
from anytouch_jax.sim.sensing.optics import Photometry
from anytouch_jax.sim.sensing.own import find_sensor
from anytouch_jax.sim.sensing.sensors import (
    MOST_BASES,
    POISSON,
    SENSORS,
    Sensor,
    bases,
    draw_drift,
    draw_unit,
    look,
)
from anytouch_jax.sim.world import shapes
from anytouch_jax.sim.world.objects import Object, draw_object

CAMERAS = tuple(name for name, sensor in SENSORS.items() if sensor.kind == "image")
GRID = 84  # points of the solve grid's side, over the longer side of the field
_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
LEAST_DEPTH = 0.08  # mm of a touch that counts as contact
CLIP_OF = 5  # a gesture is shown in so many steps between frames, of which a clip shows some
_ORDERS = np.eye(3, dtype=np.float32)[list(permutations(range(3)))]  # (6, 3, 3) of colours
_PLACES = 7  # tag of the random stream of photographed places
_BASE = 40  # pixels of an untouched gel's side


class SensorFamily(NamedTuple):
    """The numbers of a family of sensors, as arrays: `sensors.Sensor` and its photometry."""

    field: Leaf  # (2,) mm, height and width
    gel: Leaf  # (2,) modulus kPa, thickness mm
    shade: Leaf  # (6,) skin mm, contrast, vignette, halo mm, noise, spread
    markers: Leaf  # (5,) pitch mm, radius mm, aspect, share, bend
    ink: Leaf  # (3,)
    photometry: Photometry


class World(NamedTuple):
    """Objects and sensors to draw from, as arrays on the device."""

    relief: Leaf  # f16 (n, RELIEF, RELIEF) mm
    material: Leaf  # f32 (n, 2) modulus kPa, friction
    families: SensorFamily  # stacked over the sensors
    # f32 (sensors, MOST_BASES, 40, 40, 3) untouched gels in 0..1, black where there are fewer
    backgrounds: Leaf
    places: Leaf  # f32 (n, P, 2) mm, places of each object of which there is an RGB image


@dataclass(frozen=True)
class Sampling:
    """What to sample. It is static under jit."""

    frames: int = 1  # of a clip
    takes: int = 1  # sensors that feel each touch
    size: int = 112  # pixels of a side
    coarse: float = 0.3  # fraction of touches at which every sensor touches as by hand
    free: float = 0.0  # fraction of takes without contact
    vision: float = 0.0  # fraction of touches at a photographed place
    # fraction of takes by a sensor that mixes two families, with other lights and markers
    wild: float = 0.0
    depth: tuple[float, float] = (0.15, 1.0)  # mm
    fidelity: Fidelity = "fast"
    fields: tuple[str, ...] = ()  # of `recorder.FIELDS`, of the last frame
    field_size: int = 56  # pixels of their side


class SimulatedTouches(NamedTuple):
    """Touches of B places by M takes each, with T frames."""

    clip: Leaf  # u8 (B, M, T, S, S, 3)
    background: Leaf  # u8 (B, M, S, S, 3)
    sensor: Leaf  # i32 (B, M), number of the family, or the number of families for a wild one
    object: Leaf  # i32 (B,)
    photo: Leaf  # i32 (B,), number of the photographed place, or -1
    fields: Leaf | None  # f32 (B, M, h, w, channels) of the last frame
    width: Leaf  # f32 (B, M) mm that the image's width shows
    aspect: Leaf  # f32 (B, M) logarithm of the height over the width that the image shows
    modulus: Leaf  # f32 (B, M) kPa of the family's gel
    labels: dict[str, Leaf]  # f32 (B, M, T) each, see `recorder.ClipOutput`


class DrawnTouches(NamedTuple):
    """What is simulated for touches of B places by M takes each.

    `sensor`, `object` and `photo` are as in `SimulatedTouches`.
    """

    sensor: Array
    object: Array
    photo: Array
    clip: ClipInput  # this and the next two have leading axes (B, M)
    numbers: SensorFamily
    pitch: Array  # mm of the solve grid


class _Place(NamedTuple):
    """What all takes of one touch share."""

    thing: Array  # number of the object
    relief: Array  # its height map
    place: Leaf  # (2,) mm
    yaw: Scalar
    gesture: Gesture
    by_hand: Array  # bool


def family(sensor: Sensor) -> SensorFamily:
    """Return the numbers of a camera sensor. Raises UserError for a field sensor."""
    photometry = look(sensor)
    markers = sensor.markers or Markers(pitch=2.0, radius=0.3, fraction=0.0)
    # A limit of infinity could not be mixed with another one (`wild`).
    limited = photometry._replace(widest=np.minimum(photometry.widest, 1e3))
    shade = (
        sensor.skin,
        sensor.contrast,
        sensor.vignette,
        sensor.halo,
        sensor.noise,
        sensor.spread,
    )
    lattice = (markers.pitch, markers.radius, markers.aspect, markers.fraction, markers.bend)
    return SensorFamily(
        field=np.asarray(sensor.field, np.float32),
        gel=np.asarray((sensor.gel.modulus, sensor.gel.thickness), np.float32),
        shade=np.asarray(shade, np.float32),
        markers=np.asarray(lattice, np.float32),
        ink=np.asarray(markers.ink, np.float32),
        photometry=jax.tree.map(lambda x: np.asarray(x, np.float32), limited),
    )


def untouched(sensor: Sensor) -> np.ndarray:
    """Return the untouched gels of a sensor as f32 (MOST_BASES, 40, 40, 3) in 0..1.

    They are black where there are fewer.
    """
    real = bases(sensor)[:MOST_BASES]
    backgrounds = np.zeros((MOST_BASES, _BASE, _BASE, 3), np.float32)
    rows, columns = (np.rint(np.linspace(0, n - 1, _BASE)).astype(int) for n in real.shape[1:3])
    # A real gel is nowhere quite black, so `draw_unit` knows which ones are real.
    backgrounds[: len(real)] = np.maximum(real[:, rows][:, :, columns], 1e-3)
    return backgrounds


def as_sensor(numbers: SensorFamily) -> Sensor:
    """Return a `Sensor` of these numbers, which may be traced."""
    skin, contrast, vignette, halo, noise, spread = numbers.shade
    pitch, radius, aspect, fraction, bend = numbers.markers
    field: Any = (numbers.field[0], numbers.field[1])
    return Sensor(
        "family",
        field,
        (0, 0),
        Gel(modulus=numbers.gel[0], poisson=POISSON, thickness=numbers.gel[1]),
        Markers(pitch, radius, aspect, fraction, tuple(numbers.ink), bend),
        "image",
        skin,
        contrast,
        vignette,
        halo,
        noise,
        spread=spread,
    )


def objects_of(
    scenes: Scenes, split: Literal["train", "val", "test"] = "train", *, variants: int = 1
) -> tuple[Object, ...]:
    """Return the objects of a split of `scenes`, and `variants` - 1 more of each kind.

    Those have other sizes and phases. So kinds that are held out never occur in another split.
    Raises UserError for a split without objects.
    """
    things, splits = objects_and_splits(scenes)
    own = [thing for thing, name in zip(things, splits, strict=True) if name == split]
    if not own:
        raise UserError(
            f"no object of {len(things)} is in split {split}; draw more objects, or hold out more"
        )
    more = [_variant(thing, number) for number in range(1, variants) for thing in own]
    return (*own, *more)


def _variant(thing: Object, number: int) -> Object:
    """Return another object of the same kind and material."""
    seed = thing.seed ^ (number << 20)
    return draw_object(thing.shape.primitive, thing.shape.texture, thing.material.name, seed)


def make_world(
    things: Sequence[Object], sensors: Sequence[str] = CAMERAS, *, places: int = 1, seed: int = 0
) -> World:
    """Return the world of these objects and sensors, as numpy arrays.

    Args:
        things: the objects.
        sensors: names of the table, or folders of fitted ones.
        places: of each object that can be photographed.
        seed: of the places.
    """
    reliefs = over_cores(
        partial(shapes.relief, pixels=RELIEF, pitch=SPACING), [thing.shape for thing in things]
    )
    # Half floats are exact to a micrometre or two, and a world of 480 objects takes 150 MB.
    relief = np.stack([np.asarray(one, np.float16) for one in reliefs])
    material = [(thing.material.modulus, thing.material.friction) for thing in things]
    rng = np.random.default_rng([seed, _PLACES])
    spots = np.stack([[draw_place(rng)[0] for _ in range(places)] for _ in things])
    kinds = [find_sensor(name) for name in sensors]
    return World(
        relief=relief,
        material=np.array(material, np.float32),
        families=stack_trees([family(one) for one in kinds]),
        backgrounds=np.stack([untouched(one) for one in kinds]),
        places=spots.astype(np.float32),
    )


def over_cores(work: Callable[[_Item], _Result], items: Sequence[_Item]) -> list[_Result]:
    """Return `work` of every item, by threads.

    numpy and OpenCV leave the interpreter free for most of the time.
    """
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        return list(pool.map(work, items))


def sample_touches(
    key: Array, world: World, sampling: Sampling, count: int, gallery: Array | None = None
) -> SimulatedTouches:
    """Return `count` touches drawn from `key`.

    A key gives the same touches on one machine.

    Args:
        key: of the draws.
        world: objects and sensors.
        sampling: how touches are drawn; static under jit.
        count: of touches; static under jit.
        gallery: number of the family that takes the second take, if given.
    """
    return simulate_drawn(draw_touches(key, world, sampling, count, gallery), sampling)


def simulate_drawn(drawn: DrawnTouches, sampling: Sampling) -> SimulatedTouches:
    """Return what `sample_touches` returns of drawn touches."""
    simulate = jax.vmap(jax.vmap(partial(_simulate_take, sampling=sampling)))
    out: ClipOutput = simulate(drawn.clip, drawn.numbers, drawn.pitch)
    assert out.image is not None and out.background is not None
    field = drawn.numbers.field
    return SimulatedTouches(
        clip=out.image,
        background=out.background,
        sensor=drawn.sensor,
        object=drawn.object,
        photo=drawn.photo,
        fields=None if out.field is None else out.field[:, :, -1],
        width=field[..., 1] * drawn.clip.unit.zoom,
        aspect=jnp.log(field[..., 0] / field[..., 1]),
        modulus=drawn.numbers.gel[..., 0],
        labels=dict(out.labels),
    )


def draw_touches(
    key: Array, world: World, sampling: Sampling, count: int, gallery: Array | None = None
) -> DrawnTouches:
    """Return what `sample_touches` simulates for the same arguments."""
    keys = jax.random.split(key, count)
    return jax.vmap(partial(_draw, world=world, sampling=sampling, gallery=gallery))(keys)


def _simulate_take(
    clip: ClipInput, numbers: SensorFamily, pitch: Array, sampling: Sampling
) -> ClipOutput:
    """Return the simulated clip of one take by a sensor of these numbers."""
    view = View(
        grid=(GRID, GRID),
        pitch=pitch,
        image=(sampling.size, sampling.size),
        photometry=numbers.photometry,
        stretched=True,
        fields=(sampling.field_size, sampling.field_size),
    )
    return simulate_clip(
        clip,
        sensor=as_sensor(numbers),
        fidelity=sampling.fidelity,
        fields=sampling.fields,
        view=view,
    )


def _draw(key: Array, world: World, sampling: Sampling, gallery: Array | None) -> DrawnTouches:
    """Return what is simulated for all takes of one touch."""
    rng = Draws(key)
    thing = rng.integers(len(world.relief))
    place, yaw = draw_place(rng)
    photo = jnp.int32(-1)
    if sampling.vision:
        number = rng.integers(world.places.shape[1])
        photo = jnp.where(rng.uniform() < sampling.vision, number, -1)
        place = jnp.where(photo >= 0, world.places[thing, number], place)
    gesture = draw_gesture(sampling.depth, rng)
    by_hand = rng.uniform() < sampling.coarse
    shared = _Place(thing, world.relief[thing], place, yaw, gesture, by_hand)
    number = jnp.arange(sampling.takes)
    keys = jax.vmap(lambda n: jax.random.fold_in(jax.random.fold_in(key, 0), n))(number)
    take = partial(_draw_take, shared=shared, world=world, sampling=sampling, gallery=gallery)
    sensor, clip, numbers, pitch = jax.vmap(take)(keys, number)
    return DrawnTouches(sensor, thing, photo, clip, numbers, pitch)


def _draw_take(
    key: Array,
    number: Array,
    shared: _Place,
    world: World,
    sampling: Sampling,
    gallery: Array | None,
) -> tuple[Array, ClipInput, SensorFamily, Array]:
    """Return the sensor, the clip, the sensor's numbers and the pitch of one take of a touch."""
    # blotches are 1,600 values
    rng = Draws(key, 2048)
    families = len(world.backgrounds)
    sensor = rng.integers(families)
    if gallery is not None:
        sensor = jnp.where(number == 1, gallery, sensor)
    own_backgrounds = sensor
    numbers = jax.tree.map(lambda x: x[sensor], world.families)
    if sampling.wild:
        is_wild = rng.uniform() < sampling.wild
        # Each group of numbers is that of another family, so a wild sensor may have the size of
        # one, the gel of a second and the lights of a third.
        other = jax.tree.map(lambda x: x[rng.integers(families)], world.families)
        numbers = jax.tree.map(partial(jnp.where, is_wild), wild(numbers, other, rng), numbers)
        sensor = jnp.where(is_wild, families, sensor)
    pitch = jnp.max(numbers.field) / GRID
    # A family of small spread is one device, which is not cropped or upside down.
    whole = numbers.shade[5] < 1
    numbers = numbers._replace(field=numbers.field * jnp.where(whole, 1.0, _cropped(rng)))
    unit = draw_unit(as_sensor(numbers), rng, world.backgrounds, own_backgrounds)
    down = jnp.where(whole, 1.0, rng.choice([-1.0, 1.0]))
    unit = unit._replace(mirror=unit.mirror * jnp.stack([jnp.float32(1), down]))
    hand = draw_by_hand(sampling.depth, rng, shared.gesture, shared.yaw)
    straight = (shared.gesture, shared.yaw, jnp.zeros(2), jnp.zeros(2))
    own, turn, offset, tilt = jax.tree.map(partial(jnp.where, shared.by_hand), hand, straight)
    motion, depth = trajectory_at(own, _times(own, sampling.frames, rng), 0.04, jnp)
    # A clip that would show no contact shows the deepest press instead.
    depth = jnp.where(jnp.max(depth) < LEAST_DEPTH, own.depth, depth)
    depth = jnp.where(rng.uniform() < sampling.free, -1.0, depth)
    clip = ClipInput(
        relief=shared.relief,
        place=shared.place,
        start=jnp.stack([*offset, turn]),
        motion=motion,
        depth=depth,
        tilt=tilt,
        modulus=world.material[shared.thing, 0],
        friction=world.material[shared.thing, 1],
        unit=unit,
        drift=draw_drift(sampling.frames, rng),
        seed=rng.integers(2**23).astype(jnp.uint32),
    )
    return sensor, clip, numbers, pitch


def _times(gesture: Gesture, frames: int, rng: Draws) -> Leaf:
    """Return the times (T,) of a clip's frames. A still is at any time that a clip may show."""
    if frames == 1:
        shown = gesture.shown * (rng.uniform(-0.5, 0.5) * 2)
        return gesture.middle + shown[None] / 2
    steps = frames - 1
    duration = gesture.shown * (steps / CLIP_OF)
    return gesture.middle + duration * jnp.linspace(-0.5, 0.5, steps + 1)


def _cropped(rng: Draws) -> Array:
    """Return the fraction (2,) of the field's height and width that is shown.

    A camera may cut one side.
    """
    fraction = jnp.where(rng.uniform() < 0.5, rng.uniform(0.7, 1.0), 1.0)
    side = jnp.where(rng.uniform() < 0.5, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0]))
    return side * (fraction - 1) + 1


def wild(one: SensorFamily, other: SensorFamily, rng: Draws) -> SensorFamily:
    """Return a family between two, with lights of other colours and other dots.

    Photometry is linear in the light, so a mix of two photometries is that of a gel under a mix of
    their lights.
    """
    fraction = rng.uniform()
    mixed: SensorFamily = jax.tree.map(lambda a, b: fraction * a + (1 - fraction) * b, one, other)
    # lights that change places, or a side
    turn = jnp.asarray(_ORDERS)[rng.integers(len(_ORDERS))] * rng.choice([-1.0, 1.0])
    photometry = mixed.photometry._replace(
        normal=mixed.photometry.normal @ turn, halo=mixed.photometry.halo @ turn
    )
    pitch = rng.uniform(0.9, 2.6)
    radius = pitch * rng.uniform(0.08, 0.28)
    markers = jnp.stack(
        [pitch, radius, rng.uniform(0.7, 1.6), rng.uniform(0.2, 0.9), rng.uniform(0.0, 0.15)]
    )
    ink = rng.choice([0.1, 0.1, 0.9]) + rng.uniform(-0.1, 0.1, (3,))
    return mixed._replace(photometry=photometry, markers=markers, ink=ink)
