"""Recordings computed: surface under the gel, contact, shear, picture, for a batch of clips in one compiled program.

Only what is asked for is computed: a sensor of fields draws no picture, shear is solved where markers, fields or
labels need it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from anytouch_jax.sim.contact import mechanics, shear
from anytouch_jax.sim.contact.mechanics import Contact, Fidelity, Gel
from anytouch_jax.sim.scene import Recording, Scenes
from anytouch_jax.sim.sensing import optics
from anytouch_jax.sim.sensing.sensors import SENSORS, Sensor, look
from anytouch_jax.sim.sensing.units import from_gel, gel_of, stack, turned
from anytouch_jax.sim.world import shapes
from anytouch_jax.sim.world.objects import Object

SPACING = 0.1  # mm a pixel of a relief
RELIEF = 400  # pixels of a relief: 40 mm, more than any field turned by any angle, and its motion
GRID = 96  # pixels of the contact's grid on the field's short side


class Clip(NamedTuple):
    """What a recording needs of a scene, T frames; every array may have a leading batch axis.

    `relief` (RELIEF, RELIEF) mm, the object's height map of SPACING mm a pixel; `place` (2,) mm on it; `start`,
    `motion`, `depth`, `tilt` as in `scene.Recording`; `modulus` kPa of the object and its `friction` on the gel; `unit`
    of the sensor; `seed` u32 of the image noise.
    """

    relief: Any
    place: Any
    start: Any
    motion: Any
    depth: Any
    tilt: Any
    modulus: Any
    friction: Any
    unit: Any
    seed: Any


class Take(NamedTuple):
    """What a recording gives, T frames; as numpy, one a recording, from `Recorder.record`.

    `image` u8 (T, h, w, 3) and `background` u8 (h, w, 3), or None for a sensor of fields; `field` f32: (T, 20, 20, 6)
    of such a sensor, displacement mm and force N, or (T, h0, w0, channels) of the fields asked for, or None; `labels`
    f32 (T,): force N, depth mm of the deepest point, area mm2, x and y mm of the pressure's centroid in the picture,
    slip (share of the contact that slides), and for fidelity exact whether it converged.
    """

    image: Any
    background: Any
    field: Any
    labels: dict[str, Any]


def solve_grid(sensor: Sensor) -> tuple[tuple[int, int], float]:
    """Rows and columns of the contact's grid over a sensor's field, and its pitch in mm: square pixels."""
    pitch = min(sensor.field) / GRID
    rows, columns = (4 * round(side / pitch / 4) for side in sensor.field)
    return (rows, columns), pitch


def surfaces(clip: Clip, x: Array, y: Array) -> Array:
    """Heights (T, h0, w0) mm of the object under the gel's points `x`, `y` mm; 0 where it is met first.

    The object turns and slides about the middle of the gel; its tilt is that of the sensor in the hand. The unit's own
    mounting turns and moves all of it.
    """
    x, y = from_gel(clip.unit, x, y)

    def under(motion: Array) -> Array:
        u, v = turned(x - motion[0], y - motion[1], -motion[2])
        u, v = turned(u - clip.start[0], v - clip.start[1], -clip.start[2])
        z = shapes.sample(clip.relief, SPACING, u + clip.place[0], v + clip.place[1])
        return z + clip.tilt[0] * x + clip.tilt[1] * y

    # Several things are made of it: without the barrier XLA computes each of the sixteen reads of a point by itself.
    z = jax.lax.optimization_barrier(jax.vmap(under)(clip.motion))
    return z - jnp.max(z[0])


def gel_motion(clip: Clip) -> Array:
    """Motion (T, 3) mm, mm, rad of the object from frame to frame in the gel's own frame; 0 in the first."""
    steps = jnp.diff(clip.motion, axis=0, prepend=clip.motion[:1])
    return jnp.stack([*turned(steps[:, 0], steps[:, 1], clip.unit.rotation), steps[:, 2]], 1)


def record(
    clip: Clip, *, sensor: Sensor, fidelity: Fidelity, size: int, fields: tuple[str, ...] = (), slides: bool = True
) -> Take:
    """One recording by `sensor`: contact of every frame, shear with its history, pictures and labels.

    `size` pixels of the picture's short side; `slides` False leaves the shear out (stills, units without markers).
    """
    (rows, columns), pitch = solve_grid(sensor)
    y, x = jnp.meshgrid(*((jnp.arange(n) - (n - 1) / 2) * pitch for n in (rows, columns)), indexing="ij")
    gel = gel_of(sensor, clip.unit)
    press = partial(mechanics.press, gel=gel, pitch=pitch, fidelity=fidelity, modulus_object=clip.modulus)
    relief = surfaces(clip, x, y)
    contact = jax.vmap(press)(relief, clip.depth)
    squeezed = (
        jax.vmap(lambda p: mechanics.sideways(p, gel, pitch))(contact.pressure) if sensor.kind == "field" else None
    )
    sheared = _sheared(clip, contact, squeezed, gel, pitch, fidelity) if slides else _unsheared(contact)
    labels = _labels(clip, contact, sheared, pitch) | {"depth": _depth(clip, relief)}
    if fidelity == "fast":
        del labels["converged"]  # a few rounds are not meant to converge
    keys = jax.random.split(jax.random.key(clip.seed), len(clip.depth) + 1)
    if squeezed is not None:
        measure = partial(optics.field, pitch=pitch, points=sensor.resolution[0], noise=clip.unit.noise, gel=gel)
        measured = jax.vmap(lambda *maps: measure(*maps[:-1], key=maps[-1]))(
            contact.displacement, sheared.displacement + squeezed, contact.pressure, sheared.traction, keys[1:]
        )
        return Take(None, None, measured, labels)
    shape = optics.picture_size(sensor, size)
    draw = partial(optics.render, pitch=pitch, sensor=sensor, unit=clip.unit, resolution=shape)
    behind = optics.backdrop(sensor, clip.unit, shape)
    image = jax.vmap(lambda u, t, key: draw(u, t, key=key, behind=behind))(
        contact.displacement, sheared.displacement, keys[1:]
    )
    background = optics.background(sensor, clip.unit, keys[0], resolution=shape)
    seen = _fields(fields, contact, sheared, partial(optics.onto_picture, pitch=pitch, sensor=sensor, unit=clip.unit,
                                                     resolution=shape))  # fmt: skip
    return Take(image, background, seen, labels)


def _sheared(
    clip: Clip, contact: Contact, squeezed: Array | None, gel: Gel, pitch: float, fidelity: Fidelity
) -> shear.Shear:
    """The tangential state of every frame, each from the one before it."""

    def step(state: shear.Shear, frame: tuple[Contact, Array, Array | None]) -> tuple[shear.Shear, shear.Shear]:
        state = shear.shear_step(
            state,
            frame[0],
            frame[1],
            gel,
            pitch,
            clip.friction,
            fidelity=fidelity,
            modulus_object=clip.modulus,
            centre=clip.unit.offset,
            squeezed=frame[2],
        )
        return state, state

    start = shear.at_rest((contact.pressure.shape[1], contact.pressure.shape[2]), contact.pressure.dtype)
    change = None if squeezed is None else jnp.diff(squeezed, axis=0, prepend=jnp.zeros_like(squeezed[:1]))
    return jax.lax.scan(step, start, (contact, gel_motion(clip), change))[1]


def _unsheared(contact: Contact) -> shear.Shear:
    frames, rows, columns = contact.pressure.shape
    still = shear.at_rest((rows, columns), contact.pressure.dtype)
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (frames, *x.shape)), still)


def _labels(clip: Clip, contact: Contact, sheared: shear.Shear, pitch: float) -> dict[str, Array]:
    centre = jax.vmap(lambda p: jnp.asarray(mechanics.centroid(p, pitch)))(contact.pressure)
    shown = (centre - clip.unit.window[None]) * clip.unit.mirror[None]
    return {
        "force": contact.force,
        "area": jax.vmap(lambda p: mechanics.area(p, pitch))(contact.pressure),
        "x": shown[:, 0],
        "y": shown[:, 1],
        "slip": sheared.slip_fraction,
        "converged": (contact.converged & sheared.converged).astype(jnp.float32),
    }


def _depth(clip: Clip, relief: Array) -> Array:
    """How far the object's highest point under the gel (`relief` (T, h, w) mm) lies below the untouched skin, mm (T,).

    Tilt and sliding bring other points under the gel, so it is not the depth that the hand goes for.
    """
    return jnp.maximum(clip.depth + jnp.max(relief, axis=(1, 2)), 0)


def _fields(
    names: tuple[str, ...], contact: Contact, sheared: shear.Shear, onto_picture: Callable[..., Array]
) -> Array | None:
    """The fields asked for at the pixels of the picture, as channels: displacement mm, pressure kPa, shear (2) mm."""
    known = {
        "displacement": lambda: onto_picture(contact.displacement[..., None]),
        "pressure": lambda: jnp.maximum(onto_picture(contact.pressure[..., None]), 0),  # a spline swings at an edge
        "shear": lambda: onto_picture(sheared.displacement, vectors=True),
    }
    return jnp.concatenate([known[name]() for name in names], -1) if names else None


AT_ONCE = 24_000_000  # pixels that are computed at a time; some dozen float32 planes of them are in memory


class Recorder:
    """Computes recordings of a data set in batches of one size, so that each sensor is compiled once.

    Threads may share it, each with a sensor of its own.
    """

    def __init__(self, scenes: Scenes, objects: Sequence[Object], batch: int = 8) -> None:
        self._scenes, self._objects, self._batch = scenes, objects, batch
        # Of a recording: a picture is at most twice as long as wide, and a sensor's own at most 480 pixels high.
        pixels = 2 * scenes.frames * (scenes.size or 480) ** 2
        self._at_once = max(1, min(batch, AT_ONCE // pixels))
        self._relief = lru_cache(64)(lambda number: shapes.relief(objects[number].shape, RELIEF, SPACING))
        self._programs: dict[str, Any] = {}

    def record(self, recordings: Sequence[Recording]) -> list[Take]:
        """The takes of at most `batch` recordings of one sensor, as numpy. Raises ValueError for more."""
        count = len(recordings)
        if not 0 < count <= self._batch or len({r.sensor for r in recordings}) > 1:
            raise ValueError(f"record takes 1 to {self._batch} recordings of one sensor")
        return [take for first in range(0, count, self._at_once) for take in self._take(recordings, first)]

    def _take(self, recordings: Sequence[Recording], first: int) -> list[Take]:
        """The takes of as many recordings as memory allows, from the one of number `first` on."""
        clips = [self._clip(recording) for recording in recordings[first : first + self._at_once]]
        count = len(clips)
        clips += clips[-1:] * (self._at_once - count)  # one shape, one compilation
        takes = jax.device_get(self._program(recordings[0].sensor)(stack(clips)))
        return [jax.tree.map(lambda x, i=i: x[i], takes) for i in range(count)]

    def _program(self, name: str) -> Any:
        if name not in self._programs:
            scenes = self._scenes
            if SENSORS[name].kind == "image":
                look(SENSORS[name])  # fitted to real presses once, outside of the program
            one = partial(
                record,
                sensor=SENSORS[name],
                fidelity=scenes.fidelity,
                size=scenes.size,
                fields=scenes.fields,
                slides=scenes.frames > 1 or SENSORS[name].kind == "field",
            )
            self._programs[name] = jax.jit(jax.vmap(one))
        return self._programs[name]

    def _clip(self, recording: Recording) -> Clip:
        touch = recording.touch
        thing = self._objects[touch.object]
        return Clip(
            relief=self._relief(touch.object),
            place=np.asarray(touch.place, np.float32),
            start=np.asarray(recording.start, np.float32),
            motion=np.asarray(recording.motion, np.float32),
            depth=np.asarray(recording.depth, np.float32),
            tilt=np.asarray(recording.tilt, np.float32),
            modulus=np.float32(thing.material.modulus),
            friction=np.float32(thing.material.friction),
            unit=recording.unit,
            seed=np.uint32(recording.seed),
        )
