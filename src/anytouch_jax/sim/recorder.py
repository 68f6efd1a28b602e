"""Simulation of touches and recordings: surface under the gel, contact, shear and image.

One clip is one program (`simulate_clip`), and `vmap` makes a batch of it. Three things call it:
`Recorder` for data sets on disk, `endless` for training, and `simulate_touch` for a user's own
surface.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from jax import Array

from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.sim import interpolation
from anytouch_jax.sim.contact import mechanics, shear
from anytouch_jax.sim.contact.mechanics import Fidelity, Gel, PressResult
from anytouch_jax.sim.draws import Leaf
from anytouch_jax.sim.scene import Recording, Scenes
from anytouch_jax.sim.sensing import optics
from anytouch_jax.sim.sensing.own import find_sensor
from anytouch_jax.sim.sensing.sensors import (
    Sensor,
    Unit,
    gel_to_object,
    identity_unit,
    rotated,
    unit_gel,
)
from anytouch_jax.sim.world import shapes
from anytouch_jax.sim.world.objects import Object

Tree = TypeVar("Tree")
SPACING = 0.1  # mm between pixels of a height map
RELIEF = 400  # pixels of a height map: 40 mm hold any rotated field and its motion
GRID = 96  # pixels of the solve grid on the field's short side, at most
FIELDS = ("displacement", "shear", "pressure")
NOTHING = 10.0  # mm below the lowest place of a user's map: where it has a hole, and around it
LEAST = 64  # with fidelity fast the grid has half the image's pixels, or as many as these


class ClipInput(NamedTuple):
    """The inputs of a simulated clip with T frames. Every array may have a leading batch axis.

    `start`, `motion`, `depth` and `tilt` are as in `scene.Recording`.
    """

    relief: Leaf  # (RELIEF, RELIEF) mm, the object's height map with SPACING mm between pixels
    place: Leaf  # (2,) mm, the touched place on it
    start: Leaf  # (3,) mm, mm, rad
    motion: Leaf  # (T, 3) mm, mm, rad
    depth: Leaf  # (T,) mm
    tilt: Leaf  # (2,) rise per mm
    modulus: Leaf  # kPa of the object
    friction: Leaf  # on the gel
    unit: Unit
    drift: Leaf  # (T, 3, 3) of the unit's light
    seed: Leaf  # u32, of the image noise


class ClipOutput(NamedTuple):
    """A simulated clip with T frames."""

    image: Leaf | None  # u8 (T, h, w, 3), or None for a field sensor
    background: Leaf | None  # u8 (h, w, 3), or None for a field sensor
    # f32 (T, 20, 20, 6) mm and N of a field sensor, or (T, h, w, channels) of requested fields, or
    # None
    field: Leaf | None
    # f32 (T,) each: normal force N, force_x and force_y N along the image, torque N mm about the
    # centre of pressure, depth mm of the deepest point, area mm2, x and y mm of the pressure in the
    # image, slip (fraction of the contact that slides). With fidelity exact also whether the solver
    # converged.
    labels: Mapping[str, Leaf]


def solve_grid(
    sensor: Sensor, size: int = 0, fidelity: Fidelity = "exact"
) -> tuple[tuple[int, int], float]:
    """Return (rows, columns) of the solve grid over a sensor's field, and its pitch in mm.

    Its pixels are square. Its sides are multiples of four, so that two coarser grids fit.
    """
    points = GRID
    if fidelity == "fast" and size:
        points = min(max(LEAST, size // 2), GRID)
    pitch = min(sensor.field) / points
    rows, columns = (4 * round(side / pitch / 4) for side in sensor.field)
    return (rows, columns), pitch


def surfaces(clip: ClipInput, x: Array, y: Array) -> Array:
    """Return heights (T, h, w) mm of the object under the gel's points `x`, `y` mm.

    The first contact is at 0. The object turns and slides about the middle of the gel. Its tilt is
    that of the sensor in the hand.
    """
    z = _heights(clip, x, y, interpolation.sample)
    return z - jnp.max(z[0])


def user_surfaces(clip: ClipInput, x: Array, y: Array) -> Array:
    """Return heights as `surfaces` of a map that may have cliffs, holes (NaN) and a near border.

    In a hole and beyond the border there is nothing. What lies farther below the highest pixel
    under the gel than twice the depth of the press is cut off there, in the map: the gel gives way
    by the depth at most and never reaches it, so how deep it is may not matter. -inf everywhere is
    no object under the gel.
    """
    known = jnp.isfinite(clip.relief)
    lowest = jnp.min(jnp.where(known, clip.relief, jnp.inf))
    nothing = lowest - NOTHING
    # The lowest value on the border is that of everything outside.
    relief = jnp.pad(jnp.where(known, clip.relief, nothing), 1, constant_values=nothing)
    first = clip._replace(relief=relief, motion=clip.motion[:1])
    top = jnp.max(_heights(first, x, y, interpolation.sample_nearest))
    floor = jax.lax.stop_gradient(top - 2 * jnp.maximum(jnp.max(clip.depth), 0))
    cut = clip._replace(relief=jnp.maximum(relief, floor))
    z = _heights(cut, x, y, interpolation.sample_sharp)
    return jnp.where(top >= lowest, z - jnp.max(z[0]), -jnp.inf)


def _heights(
    clip: ClipInput, x: Array, y: Array, look_up: Callable[[Leaf, float, Array, Array], Array]
) -> Array:
    """Return heights (T, h, w) mm of the object's map under the gel's points `x`, `y` mm."""
    x, y = gel_to_object(clip.unit, x, y)
    frames = len(clip.motion)
    halves = (2, -1, x.shape[-1])

    def under(part: tuple[Array, Array, Array]) -> Array:
        motion, x, y = part
        u, v = rotated(x - motion[0], y - motion[1], -motion[2])
        u, v = rotated(u - clip.start[0], v - clip.start[1], -clip.start[2])
        z = look_up(clip.relief, SPACING, u + clip.place[0], v + clip.place[1])
        return z + clip.tilt[0] * x + clip.tilt[1] * y

    # It has several users, and XLA would repeat the sixteen reads of a point for each of them,
    # clips five times slower. It cannot look into a loop, but it removes one of a single step: so a
    # still is two halves.
    parts = (
        jnp.repeat(clip.motion, 2, 0),
        *(jnp.tile(at.reshape(halves), (frames, 1, 1)) for at in (x, y)),
    )
    z: Array = jax.lax.map(under, parts).reshape(frames, *x.shape)
    return z


def gel_motion(clip: ClipInput) -> Array:
    """Return the motion (T, 3) mm, mm, rad of the object between frames, first since the touch.

    It is in the gel's frame.
    """
    steps = jnp.diff(clip.motion, axis=0, prepend=jnp.zeros((1, 3)))
    return jnp.stack([*rotated(steps[:, 0], steps[:, 1], clip.unit.rotation), steps[:, 2]], 1)


class View(NamedTuple):
    """How a sensor is solved and shown."""

    grid: tuple[int, int]  # (rows, columns) of the solve grid
    pitch: float | Array  # mm of the solve grid
    image: tuple[int, int]  # (height, width) in pixels
    photometry: optics.Photometry | None = None  # instead of that of the sensor
    stretched: bool = False  # as in `optics.pixel_positions`
    # (height, width) of the fields of the last frame. If it is None, all frames have fields, in the
    # size of the image.
    fields: tuple[int, int] | None = None


class _Contact(NamedTuple):
    """What the gel feels in every frame."""

    gel: Gel
    press: PressResult
    shear: shear.Shear  # its displacement includes the sideways motion by pressing
    labels: dict[str, Array]


def simulate_clip(
    clip: ClipInput,
    *,
    sensor: Sensor,
    fidelity: Fidelity,
    size: int = 0,
    fields: tuple[str, ...] = (),
    view: View | None = None,
    surface: Callable[[ClipInput, Array, Array], Array] = surfaces,
) -> ClipOutput:
    """Simulate one clip: contact of every frame, shear with its history, images and labels.

    Args:
        clip: What is touched, where and how.
        sensor: By what. With a `view` its numbers may be traced, so that one program serves many.
        fidelity: How contact is solved (`mechanics.press`).
        size: Short side of the image in pixels, 0 for the sensor's resolution.
        fields: Names of FIELDS to return.
        view: Replaces the grid and the image that follow from `size`.
        surface: Returns the heights of the object under the gel, as `surfaces`.
    """
    if view is None:
        grid, pitch = solve_grid(sensor, size, fidelity)
        view = View(grid, pitch, optics.image_size(sensor, size))
    contact = _touched(clip, sensor, view, fidelity, surface)
    labels = contact.labels
    if fidelity == "fast":
        del labels["converged"]  # a few iterations do not converge
    keys = jax.random.split(jax.random.key(clip.seed), len(clip.depth) + 1)
    if sensor.kind == "field":
        measured = _measured(contact, sensor, clip.unit.noise, view.pitch, keys[1:])
        return ClipOutput(None, None, measured, labels)
    behind = optics.backdrop(sensor, clip.unit, view.image, stretched=view.stretched)
    camera = optics.Rendering(sensor, clip.unit, view.image, view.photometry, view.stretched)

    def shown(dent: Array, moved: Array, key: Array, drift: Leaf) -> Array:
        skin = optics.Skin(dent, moved, view.pitch)
        return optics.show(skin, camera, key, behind=behind, drift=drift)

    image = jax.vmap(shown)(
        contact.press.displacement, contact.shear.displacement, keys[1:], clip.drift
    )
    background = optics.show(None, camera, keys[0], behind=behind)
    mapped = _fields(fields, contact, camera, view)
    return ClipOutput(image, background, mapped, labels)


def _touched(
    clip: ClipInput,
    sensor: Sensor,
    view: View,
    fidelity: Fidelity,
    surface: Callable[[ClipInput, Array, Array], Array],
) -> _Contact:
    """Return the normal contact, the tangential contact and the labels of every frame."""
    rows, columns = view.grid
    pitch = view.pitch
    y, x = jnp.meshgrid(
        *((jnp.arange(n) - (n - 1) / 2) * pitch for n in (rows, columns)), indexing="ij"
    )
    gel = unit_gel(sensor, clip.unit)
    press = partial(
        mechanics.press, gel=gel, pitch=pitch, fidelity=fidelity, modulus_object=clip.modulus
    )
    relief = surface(clip, x, y)
    contact = jax.vmap(press)(relief, clip.depth)
    squeezed = jax.vmap(
        lambda p: mechanics.sideways(p, gel, pitch, fidelity=fidelity, coarse=True)
    )(contact.pressure)
    sheared = _sheared(clip, contact, squeezed, gel, pitch, fidelity)
    # The traction resisted the sideways motion. The skin's motion is that by both.
    sheared = sheared._replace(displacement=sheared.displacement + squeezed)
    labels = _labels(clip, contact, sheared, pitch) | {"depth": _depth(clip, relief)}
    return _Contact(gel, contact, sheared, labels)


def _sheared(
    clip: ClipInput,
    contact: PressResult,
    squeezed: Array,
    gel: Gel,
    pitch: float | Array,
    fidelity: Fidelity,
) -> shear.Shear:
    """Return the tangential state of every frame, computed from the one before.

    Its motion is on the coarse grid, where markers and fields take it from.
    """
    interface = shear.Interface(
        gel,
        pitch,
        clip.friction,
        fidelity=fidelity,
        modulus_object=clip.modulus,
        centre=clip.unit.offset,
        coarse=True,
    )

    def step(traction: Array, frame: tuple[PressResult, Array, Array]) -> tuple[Array, shear.Shear]:
        press, motion, change = frame
        # Of the state before only the traction matters, so a scan carries no more.
        state = shear.slide(start._replace(traction=traction), press, motion, interface, change)
        return state.traction, state

    _, rows, columns = contact.pressure.shape
    start = shear.at_rest((rows, columns), contact.pressure.dtype)
    change = jnp.diff(squeezed, axis=0, prepend=jnp.zeros_like(squeezed[:1]))
    return jax.lax.scan(step, start.traction, (contact, gel_motion(clip), change))[1]


def _measured(
    contact: _Contact, sensor: Sensor, noise: Leaf, pitch: float | Array, keys: Array
) -> Array:
    """Return what a field sensor measures in every frame, (T, points, points, 6)."""
    points = sensor.resolution[0]
    measure = partial(
        optics.measure_field, pitch=pitch, points=points, noise=noise, gel=contact.gel
    )

    def frame(dent: Array, moved: Array, pressure: Array, traction: Array, key: Array) -> Array:
        return measure(dent, mechanics.enlarged(moved, dent.shape), pressure, traction, key=key)

    return jax.vmap(frame)(
        contact.press.displacement,
        contact.shear.displacement,
        contact.press.pressure,
        contact.shear.traction,
        keys,
    )


def _labels(
    clip: ClipInput, contact: PressResult, sheared: shear.Shear, pitch: float | Array
) -> dict[str, Array]:
    """Return labels (T,) of every frame, in the directions of the image, which may be mirrored."""
    centre = jax.vmap(lambda p: jnp.asarray(mechanics.centroid(p, pitch)))(contact.pressure)
    shown = (centre - clip.unit.window[None]) * clip.unit.mirror[None]
    area = jax.vmap(lambda p: mechanics.area(p, pitch))(contact.pressure)
    force_x, force_y = (sheared.force[:, axis] * clip.unit.mirror[axis] for axis in (0, 1))
    return {
        "force": contact.force,
        "area": area,
        "x": shown[:, 0],
        "y": shown[:, 1],
        "slip": sheared.slip_fraction,
        "force_x": force_x,
        "force_y": force_y,
        "torque": sheared.twist_torque * clip.unit.mirror[0] * clip.unit.mirror[1],
        "converged": (contact.converged & sheared.converged).astype(jnp.float32),
    }


def _depth(clip: ClipInput, relief: Array) -> Array:
    """Return the depth mm (T,) of the highest point under the gel, from heights (T, h, w).

    It is not that of the hand: the object may have moved to a lower place since the first frame.
    """
    return jnp.maximum(clip.depth + jnp.max(relief, axis=(1, 2)), 0)


def _fields(
    names: tuple[str, ...], contact: _Contact, camera: optics.Rendering, view: View
) -> Array | None:
    """Return the fields `names` at the image's pixels as channels.

    They are displacement mm, pressure kPa and shear (2) mm.
    """
    if not names:
        return None
    press = contact.press
    sheared = contact.shear
    if view.fields:
        press, sheared = jax.tree.map(lambda x: x[-1:], (press, sheared))
    onto_image = partial(
        optics.onto_image,
        pitch=view.pitch,
        sensor=camera.sensor,
        unit=camera.unit,
        resolution=view.fields or view.image,
        stretched=view.stretched,
    )
    grid = (press.pressure.shape[1], press.pressure.shape[2])
    channels = []
    for name in names:
        if name == "displacement":
            channels.append(onto_image(press.displacement[..., None]))
        elif name == "pressure":
            # A spline overshoots at an edge of the maps.
            channels.append(jnp.maximum(onto_image(press.pressure[..., None]), 0))
        else:
            channels.append(onto_image(sheared.displacement, vectors=True, grid=grid))
    return jnp.concatenate(channels, -1)


MAX_PIXELS = 24_000_000  # pixels of a batch; some dozen float32 planes of them are in memory


class Recorder:
    """Simulates recordings in batches of one size, so that each sensor is compiled once.

    It may be used by a thread for each sensor.
    """

    def __init__(self, scenes: Scenes, objects: Sequence[Object], batch: int = 8) -> None:
        self._scenes = scenes
        self._objects = objects
        self._batch = batch
        # Pixels of a recording: an image is at most twice as long as wide, and a sensor's at most
        # 480 pixels high.
        pixels = 2 * scenes.frames * (scenes.size or 480) ** 2
        self._at_once = max(1, min(batch, MAX_PIXELS // pixels))
        self._relief = lru_cache(512)(
            lambda number: shapes.relief(objects[number].shape, RELIEF, SPACING)
        )
        self._programs: dict[str, Callable[[ClipInput], ClipOutput]] = {}

    def record(self, recordings: Sequence[Recording]) -> list[ClipOutput]:
        """Return the clips of at most `batch` recordings of one sensor, as numpy.

        Raises ValueError for more.
        """
        refuse_forked()
        count = len(recordings)
        if not 0 < count <= self._batch or len({r.sensor for r in recordings}) > 1:
            raise ValueError(f"record takes 1 to {self._batch} recordings of one sensor")
        outputs = list[ClipOutput]()
        for first in range(0, count, self._at_once):
            outputs += self._simulate(recordings[first : first + self._at_once])
        return outputs

    def _simulate(self, recordings: Sequence[Recording]) -> list[ClipOutput]:
        """Return the clips of as many recordings as memory allows."""
        clips = [self._clip(recording) for recording in recordings]
        count = len(clips)
        # equal shapes compile once
        clips += clips[-1:] * (self._at_once - count)
        outputs = jax.device_get(self._program(recordings[0].sensor)(stack_trees(clips)))
        return [jax.tree.map(lambda x, i=i: x[i], outputs) for i in range(count)]

    def _program(self, name: str) -> Callable[[ClipInput], ClipOutput]:
        """Return the compiled simulation of a batch by a sensor."""
        if name not in self._programs:
            scenes = self._scenes
            one = partial(
                simulate_clip,
                sensor=find_sensor(name),
                fidelity=scenes.fidelity,
                size=scenes.size,
                fields=scenes.fields,
            )
            self._programs[name] = jax.jit(jax.vmap(one))
        return self._programs[name]

    def _clip(self, recording: Recording) -> ClipInput:
        touch = recording.touch
        material = self._objects[touch.object].material
        return ClipInput(
            relief=self._relief(touch.object),
            place=np.asarray(touch.place, np.float32),
            start=np.asarray(recording.start, np.float32),
            motion=np.asarray(recording.motion, np.float32),
            depth=np.asarray(recording.depth, np.float32),
            tilt=np.asarray(recording.tilt, np.float32),
            modulus=np.asarray(material.modulus, np.float32),
            friction=np.asarray(material.friction, np.float32),
            unit=recording.unit,
            drift=recording.drift,
            seed=np.asarray(recording.seed, np.uint32),
        )


def stack_trees(trees: Sequence[Tree]) -> Tree:
    """Stack units, or records with units, along a new leading axis for vmap."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


class SimulatedTouch(NamedTuple):
    """What the camera sees and the gel feels of B touches, at the image's pixels (h, w)."""

    image: Array  # u8 (B, h, w, 3)
    background: Leaf  # u8 (B, h, w, 3), of the untouched gel
    depth: Array  # (B, h, w) mm, the gel's displacement
    shear: Array  # (B, h, w, 2) mm along x and y of the image
    pressure: Array  # (B, h, w) kPa
    force: Array  # (B, 3) N along x, y and into the gel
    torque: Array  # (B,) N mm


def simulate_touch(  # noqa: PLR0913 - one public call, whose values are all optional but three
    height_map: npt.ArrayLike | Array,
    pose: npt.ArrayLike | Array,
    sensor: str = "digit",
    *,
    drag: npt.ArrayLike | Array = (0.0, 0.0, 0.0),
    size: int = 224,
    modulus: float | Array = 1e6,
    friction: float | Array = 0.6,
    fidelity: Fidelity = "fast",
    unit: Unit | None = None,
) -> SimulatedTouch:
    """Press a surface into the gel of a sensor: what the camera sees and the gel feels.

    Use it under jit. With fidelity "fast" all but the images can be differentiated with respect
    to pose and drag.

    Args:
        height_map: (H, W) mm, with 0.1 mm between pixels, its highest part nearest to the gel. NaN
            is a hole, and beyond the map there is nothing: end it at the background, or on all
            sides where the object ends.
        pose: (B, 4): the touched place x and y in mm from the map's centre, the turn in rad, and
            the depth in mm. Where the map has nothing under the gel, nothing is touched.
        sensor: A name, or a folder NAME.sensor.
        drag: (B, 3) mm, mm and rad, by which the object moves over the gel under the whole
            pressure.
        size: Short side of the image, pixels.
        modulus: Of the object, kPa.
        friction: Between object and gel.
        fidelity: How contact is solved (`mechanics.press`).
        unit: A device (`sensors.draw_unit`), by default the nominal one without markers.

    Raises:
        UserError: For a sensor without a camera, for arrays of other shapes, and for a map without
            a height.
    """
    kind = find_sensor(sensor)
    if kind.kind != "image":
        raise UserError(f"{sensor} has no camera; name a sensor that has one")
    refuse_forked()
    pose = jnp.atleast_2d(jnp.asarray(pose, jnp.float32))
    relief = jnp.asarray(height_map, jnp.float32)
    if relief.ndim != 2 or pose.shape[1] != 4:
        raise UserError(
            f"a height map is (H, W) mm with {SPACING} mm between pixels and a pose (B, 4), not "
            f"{relief.shape} and {pose.shape}"
        )
    _check_heights(height_map)
    moves = jnp.broadcast_to(jnp.atleast_2d(jnp.asarray(drag, jnp.float32)), (len(pose), 3))
    device = identity_unit(kind) if unit is None else unit
    # The device is a constant, so XLA would compute what depends on it alone while it compiles: by
    # an interpreter, which takes seconds for products of matrices, and prints alarms. Behind a
    # barrier they are a part of the program, which takes a millisecond for them. The tables of the
    # gel are for numpy (`elastic._library`), so its two numbers stay in front of the barrier.
    hidden, seed = jax.lax.optimization_barrier((device, jnp.uint32(0)))
    device = hidden._replace(thickness=device.thickness, modulus=device.modulus)
    hardness: Leaf
    if isinstance(modulus, jax.core.Tracer):
        hardness = jnp.asarray(modulus, jnp.float32)
    else:
        hardness = np.asarray(modulus, np.float32)

    def one(pose: Array, drag: Array) -> SimulatedTouch:
        clip = ClipInput(
            relief=relief,
            place=pose[:2],
            start=jnp.stack([0.0 * pose[0], 0.0 * pose[0], pose[2]]),
            motion=drag[None],
            depth=pose[3:],
            tilt=jnp.zeros(2),
            modulus=hardness,
            friction=jnp.float32(friction),
            unit=device,
            drift=jnp.zeros((1, 3, 3)),
            seed=seed,
        )
        out = simulate_clip(
            clip, sensor=kind, fidelity=fidelity, size=size, fields=FIELDS, surface=user_surfaces
        )
        assert out.image is not None and out.background is not None and out.field is not None
        force = jnp.stack([out.labels[name][-1] for name in ("force_x", "force_y", "force")])
        field = out.field[-1]
        return SimulatedTouch(
            image=out.image[-1],
            background=out.background,
            depth=field[..., 0],
            shear=field[..., 1:3],
            pressure=field[..., 3],
            force=force,
            torque=out.labels["torque"][-1],
        )

    return jax.vmap(one)(pose, moves)


def _check_heights(height_map: npt.ArrayLike | Array) -> None:
    """Raise UserError for a map without a height, unless it is traced and so not known yet."""
    if isinstance(height_map, jax.core.Tracer):
        return
    heights = np.asarray(height_map)
    if np.isposinf(heights).any() or not np.isfinite(heights).any():
        raise UserError(
            "a height map holds at least one height in mm, and NaN where the object has a hole; "
            "this one has no height, or +inf"
        )


def ball(diameter: float, pixels: int = 200) -> np.ndarray:
    """Return the height map (pixels, pixels) mm of a ball, 0 at its top."""
    line = (np.arange(pixels) - (pixels - 1) / 2) * SPACING
    away = np.hypot(*np.meshgrid(line, line))
    radius = diameter / 2
    return (np.sqrt(np.maximum(radius**2 - away**2, 0.0)) - radius).astype(np.float32)
