"""Endless touch: simulated touches as a pure function of a key, for training without a data set.

A `World` holds what is drawn once: height maps, materials and the families of sensors.
`sample_touches` draws touches from it inside a compiled program, with the distributions of `scene`
and `sensors`. All camera sensors share one program: they are solved on one square grid and shown at
one size, as `encoder.preprocess` shows a real picture.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import permutations
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from anytouch_jax.errors import UserError
from anytouch_jax.sim.contact.mechanics import Fidelity, Gel
from anytouch_jax.sim.draws import Draws
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
    Scenes,
    draw_by_hand,
    draw_gesture,
    draw_place,
    moved,
    objects_and_splits,
)
from anytouch_jax.sim.sensing.optics import Photometry
from anytouch_jax.sim.sensing.own import find_sensor
from anytouch_jax.sim.sensing.sensors import (
    MOST_BASES,
    SENSORS,
    Markers,
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
LEAST_DEPTH = 0.08  # mm of a touch that counts as contact
CLIP_OF = 5  # a gesture is shown in so many steps between frames, of which a clip shows some
_ORDERS = np.eye(3, dtype=np.float32)[list(permutations(range(3)))]  # (6, 3, 3) of colours
_PLACES = 7  # tag of the random stream of photographed places
_BASE = 40  # pixels of an untouched gel's side


class SensorFamily(NamedTuple):
    """The numbers of a family of sensors, as arrays: `sensors.Sensor` and its look."""

    field: Any  # (2,) mm
    gel: Any  # (2,) modulus kPa, thickness mm
    shade: Any  # (6,) skin mm, contrast, vignette, halo mm, noise, spread
    markers: Any  # (5,) pitch mm, radius mm, aspect, share, bend
    ink: Any  # (3,)
    photometry: Photometry


class World(NamedTuple):
    """Objects and sensors to draw from, as arrays on the device."""

    relief: Any  # f16 (n, RELIEF, RELIEF) mm
    material: Any  # f32 (n, 2) modulus kPa, friction
    families: SensorFamily  # stacked over the sensors
    # f32 (sensors, MOST_BASES, 40, 40, 3) untouched gels in 0..1, black where there are fewer
    gels: Any
    places: Any  # f32 (n, P, 2) mm, places of each object of which there is a photograph


@dataclass(frozen=True)
class Sampling:
    """What to sample: clips of `frames` frames of `size` pixels, by `takes` sensors for each touch.

    `coarse` is the share of touches at which every sensor touches as by hand. `free` is the share
    of takes without contact, `vision` the share of touches at a photographed place. `wild` is the
    share of takes by a sensor that mixes two families, with other lights and markers. The `fields`
    of `recorder.simulate_clip` are of the last frame, at `field_size` pixels.
    """

    frames: int = 1
    takes: int = 1
    size: int = 112
    coarse: float = 0.3
    free: float = 0.0
    vision: float = 0.0
    wild: float = 0.0
    depth: tuple[float, float] = (0.15, 1.0)
    fidelity: Fidelity = "fast"
    fields: tuple[str, ...] = ()
    field_size: int = 56


class SimulatedTouches(NamedTuple):
    """Touches of B places by M takes each, with T frames."""

    clip: Any  # u8 (B, M, T, S, S, 3)
    background: Any  # u8 (B, M, S, S, 3)
    sensor: Any  # i32 (B, M), number of the family, or the number of families for a wild one
    object: Any  # i32 (B,)
    photo: Any  # i32 (B,), number of the photographed place, or -1
    fields: Any  # f32 (B, M, h, w, channels) of the last frame, or None
    width: Any  # f32 (B, M) mm that the picture's width shows
    aspect: Any  # f32 (B, M) logarithm of the height over the width that the picture shows
    modulus: Any  # f32 (B, M) kPa of the family's gel
    labels: dict[str, Any]  # f32 (B, M, T) each, see `recorder.ClipOutput`


class DrawnTouches(NamedTuple):
    """What is simulated for touches of B places by M takes each.

    `sensor`, `object` and `photo` are as above.
    """

    sensor: Any
    object: Any
    photo: Any
    clip: ClipInput  # this and the next two have leading axes (B, M)
    numbers: SensorFamily
    pitch: Any  # mm of the solve grid


def family(sensor: Sensor) -> SensorFamily:
    """Return the numbers of a camera sensor. Raises UserError for a field sensor."""
    photometry = look(sensor)
    markers = sensor.markers or Markers(pitch=2.0, radius=0.3, share=0.0)
    shade = (
        sensor.skin,
        sensor.contrast,
        sensor.vignette,
        sensor.halo,
        sensor.noise,
        sensor.spread,
    )
    lattice = (markers.pitch, markers.radius, markers.aspect, markers.share, markers.bend)
    widest = np.minimum(photometry.widest, 1e3)
    numbers = (
        sensor.field,
        (sensor.gel.modulus, sensor.gel.thickness),
        shade,
        lattice,
        markers.ink,
    )
    field, gel, shades, dots, ink = (np.asarray(x, np.float32) for x in numbers)
    light = jax.tree.map(lambda x: np.asarray(x, np.float32), photometry._replace(widest=widest))
    return SensorFamily(field, gel, shades, dots, ink, light)


def untouched(sensor: Sensor) -> np.ndarray:
    """Return the untouched gels of a sensor as f32 (MOST_BASES, 40, 40, 3) in 0..1, black where
    there are fewer.
    """
    real = bases(sensor)[:MOST_BASES]
    gels = np.zeros((MOST_BASES, _BASE, _BASE, 3), np.float32)
    rows, columns = (np.rint(np.linspace(0, n - 1, _BASE)).astype(int) for n in real.shape[1:3])
    gels[: len(real)] = np.maximum(real[:, rows][:, :, columns], 1e-3)
    return gels


def as_sensor(numbers: SensorFamily) -> Sensor:
    """Return a `Sensor` of these numbers, which may be traced."""
    skin, contrast, vignette, halo, noise, spread = numbers.shade
    pitch, radius, aspect, share, bend = numbers.markers
    gel = Gel(modulus=numbers.gel[0], poisson=0.48, thickness=numbers.gel[1])
    markers = Markers(pitch, radius, aspect, share, tuple(numbers.ink), bend)
    return Sensor(
        "family",
        (numbers.field[0], numbers.field[1]),
        (0, 0),
        gel,
        markers,
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
    """Return the objects of a split of `scenes`, and `variants` - 1 more of each kind, with other
    sizes and phases.

    So kinds that are held out never occur in another split. Raises UserError for a split without
    objects.
    """
    things, splits = objects_and_splits(scenes)
    own = [thing for thing, name in zip(things, splits, strict=True) if name == split]
    if not own:
        raise UserError(
            f"no object of {len(things)} is in split {split}; draw more objects, or hold out more"
        )
    return (
        *own,
        *(
            draw_object(
                thing.shape.primitive,
                thing.shape.texture,
                thing.material.name,
                thing.seed ^ (number << 20),
            )
            for number in range(1, variants)
            for thing in own
        ),
    )


def make_world(
    things: Sequence[Object], sensors: Sequence[str] = CAMERAS, *, places: int = 1, seed: int = 0
) -> World:
    """Return the world of these objects and sensors, as numpy arrays.

    `places` of each object can be photographed.
    """
    reliefs = over_cores(
        partial(shapes.relief, pixels=RELIEF, pitch=SPACING), [thing.shape for thing in things]
    )
    relief = np.stack([np.asarray(one, np.float16) for one in reliefs])
    material = np.array(
        [(thing.material.modulus, thing.material.friction) for thing in things], np.float32
    )
    rng = np.random.default_rng([seed, _PLACES])
    spots = np.stack([[draw_place(rng)[0] for _ in range(places)] for _ in things]).astype(
        np.float32
    )
    kinds = [find_sensor(name) for name in sensors]
    return World(
        relief,
        material,
        stack_trees([family(one) for one in kinds]),
        np.stack([*map(untouched, kinds)]),
        spots,
    )


def over_cores(work: Callable[[Any], Any], items: Sequence[Any]) -> list[Any]:
    """Return `work` of every item, by threads: numpy and OpenCV leave the interpreter free for most
    of the time.
    """
    with ThreadPoolExecutor(len(os.sched_getaffinity(0))) as pool:
        return list(pool.map(work, items))


def sample_touches(
    key: Array, world: World, sampling: Sampling, count: int, gallery: Array | None = None
) -> SimulatedTouches:
    """Return `count` touches drawn from `key`. `sampling` and `count` are static under jit.

    The second take is by the family `gallery`, if given. A key gives the same touches on one
    machine.
    """
    return simulate_drawn(draw_touches(key, world, sampling, count, gallery), sampling)


def simulate_drawn(drawn: DrawnTouches, sampling: Sampling) -> SimulatedTouches:
    """Return what `sample_touches` returns of drawn touches."""
    out = jax.vmap(jax.vmap(partial(_simulate_take, sampling=sampling)))(
        drawn.clip, drawn.numbers, drawn.pitch
    )
    field = drawn.numbers.field
    fields = None if out.field is None else out.field[:, :, -1]
    return SimulatedTouches(
        out.image,
        out.background,
        drawn.sensor,
        drawn.object,
        drawn.photo,
        fields,
        field[..., 1] * drawn.clip.unit.zoom,
        jnp.log(field[..., 0] / field[..., 1]),
        drawn.numbers.gel[..., 0],
        out.labels,
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
    """Return the simulated clip of one take by a sensor of these numbers, on a grid of `pitch`
    mm.
    """
    side = (sampling.field_size, sampling.field_size)
    view = View((GRID, GRID), pitch, (sampling.size, sampling.size), numbers.photometry, True, side)
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
    steps = sampling.frames - 1
    relief = world.relief[thing]

    def take(key: Array, number: Array) -> tuple[Array, ClipInput, SensorFamily, Array]:
        # blotches are 1,600 values
        rng = Draws(key, 2048)
        families = len(world.gels)
        sensor = rng.integers(families)
        if gallery is not None:
            sensor = jnp.where(number == 1, gallery, sensor)
        own_gels = sensor
        numbers = jax.tree.map(lambda x: x[sensor], world.families)
        if sampling.wild:
            is_wild = rng.uniform() < sampling.wild
            other = jax.tree.map(lambda x: x[rng.integers(families)], world.families)
            numbers = jax.tree.map(partial(jnp.where, is_wild), wild(numbers, other, rng), numbers)
            sensor = jnp.where(is_wild, families, sensor)
        pitch = jnp.max(numbers.field) / GRID
        # one device, which is not cropped or upside down
        whole = numbers.shade[5] < 1
        numbers = numbers._replace(field=numbers.field * jnp.where(whole, 1.0, _cropped(rng)))
        unit = draw_unit(as_sensor(numbers), rng, world.gels, own_gels)
        down = jnp.where(whole, 1.0, rng.choice([-1.0, 1.0]))
        unit = unit._replace(mirror=unit.mirror * jnp.stack([jnp.float32(1), down]))
        hand = draw_by_hand(sampling.depth, rng, gesture, yaw)
        straight = (gesture, yaw, jnp.zeros(2), jnp.zeros(2))
        own, turn, offset, tilt = jax.tree.map(partial(jnp.where, by_hand), hand, straight)
        shown = own.shown * (steps / CLIP_OF if steps else rng.uniform(-0.5, 0.5) * 2)
        times = own.middle + (
            shown * jnp.linspace(-0.5, 0.5, steps + 1) if steps else shown[None] / 2
        )
        motion, depth = moved(own, times, 0.04, jnp)
        # something is touched
        depth = jnp.where(jnp.max(depth) < LEAST_DEPTH, own.depth, depth)
        depth = jnp.where(rng.uniform() < sampling.free, -1.0, depth)
        clip = ClipInput(
            relief,
            place,
            jnp.stack([*offset, turn]),
            motion,
            depth,
            tilt,
            world.material[thing, 0],
            world.material[thing, 1],
            unit,
            draw_drift(sampling.frames, rng),
            rng.integers(2**23).astype(jnp.uint32),
        )
        return sensor, clip, numbers, pitch

    number = jnp.arange(sampling.takes)
    keys = jax.vmap(lambda n: jax.random.fold_in(jax.random.fold_in(key, 0), n))(number)
    sensor, clip, numbers, pitch = jax.vmap(take)(keys, number)
    return DrawnTouches(sensor, thing, photo, clip, numbers, pitch)


def _cropped(rng: Draws) -> Array:
    """Return the share (2,) of the field's height and width that is shown: a camera may cut one
    side.
    """
    share = jnp.where(rng.uniform() < 0.5, rng.uniform(0.7, 1.0), 1.0)
    return (
        jnp.where(rng.uniform() < 0.5, jnp.array([1.0, 0.0]), jnp.array([0.0, 1.0])) * (share - 1)
        + 1
    )


def wild(one: SensorFamily, other: SensorFamily, rng: Draws) -> SensorFamily:
    """Return a family between two, with lights of other colours, and dots of another size, distance
    and ink.
    """
    share = rng.uniform()
    mixed: SensorFamily = jax.tree.map(lambda a, b: share * a + (1 - share) * b, one, other)
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
