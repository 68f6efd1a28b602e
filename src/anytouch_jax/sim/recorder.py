"""Simulation of single touches and of recordings: surface under the gel, contact, shear and image,
in one program.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.sim import interpolation
from anytouch_jax.sim.contact import mechanics, shear
from anytouch_jax.sim.contact.mechanics import Fidelity, Gel, PressResult
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
LEAST = 64  # with fidelity fast the grid has half the image's pixels, or as many as these


class ClipInput(NamedTuple):
    """The inputs of a simulated clip with T frames. Every array may have a leading batch axis.

    `relief` (RELIEF, RELIEF) mm is the object's height map with SPACING mm between pixels, and
    `place` (2,) mm the touched place on it. `start`, `motion`, `depth` and `tilt` are as in
    `scene.Recording`. `modulus` is the object's in kPa, `friction` that on the gel, `unit` the
    sensor unit, `drift` its light's, `seed` u32 the image noise's.
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
    drift: Any
    seed: Any


class ClipOutput(NamedTuple):
    """A simulated clip with T frames."""

    image: Any  # u8 (T, h, w, 3), or None for a field sensor
    background: Any  # u8 (h, w, 3), or None for a field sensor
    # f32 (T, 20, 20, 6) mm and N of a field sensor, or (T, h, w, channels) of requested fields, or
    # None
    field: Any
    # f32 (T,) each: normal force N, force_x and force_y N along the image, torque N mm about the
    # centre of pressure, depth mm of the deepest point, area mm2, x and y mm of the pressure in the
    # image, slip (share of the contact that slides). With fidelity exact also whether the solver
    # converged.
    labels: dict[str, Any]


def solve_grid(
    sensor: Sensor, size: int = 0, fidelity: Fidelity = "exact"
) -> tuple[tuple[int, int], float]:
    """Return (rows, columns) of the solve grid over a sensor's field, and its pitch in mm.

    Its pixels are square.
    """
    pitch = min(sensor.field) / (
        min(max(LEAST, size // 2), GRID) if fidelity == "fast" and size else GRID
    )
    rows, columns = (4 * round(side / pitch / 4) for side in sensor.field)
    return (rows, columns), pitch


def surfaces(clip: ClipInput, x: Array, y: Array) -> Array:
    """Return heights (T, h, w) mm of the object under the gel's points `x`, `y` mm.

    The first contact is at 0.

    The object turns and slides about the middle of the gel. Its tilt is that of the sensor in the
    hand.
    """
    x, y = gel_to_object(clip.unit, x, y)
    frames = len(clip.motion)
    halves = (2, -1, x.shape[-1])

    def under(part: tuple[Array, Array, Array]) -> Array:
        motion, x, y = part
        u, v = rotated(x - motion[0], y - motion[1], -motion[2])
        u, v = rotated(u - clip.start[0], v - clip.start[1], -clip.start[2])
        z = interpolation.sample(clip.relief, SPACING, u + clip.place[0], v + clip.place[1])
        return z + clip.tilt[0] * x + clip.tilt[1] * y

    # It has several users, and XLA would repeat the sixteen reads of a point for each of them,
    # clips five times slower. It cannot look into a loop, but it removes one of a single step: so a
    # still is two halves.
    parts = (
        jnp.repeat(clip.motion, 2, 0),
        *(jnp.tile(at.reshape(halves), (frames, 1, 1)) for at in (x, y)),
    )
    z = jax.lax.map(under, parts).reshape(frames, *x.shape)
    return z - jnp.max(z[0])


def gel_motion(clip: ClipInput) -> Array:
    """Return the motion (T, 3) mm, mm, rad of the object between frames in the gel's frame, first
    since the touch.
    """
    steps = jnp.diff(clip.motion, axis=0, prepend=jnp.zeros((1, 3)))
    return jnp.stack([*rotated(steps[:, 0], steps[:, 1], clip.unit.rotation), steps[:, 2]], 1)


class View(NamedTuple):
    """How a sensor is solved and shown: the grid (rows, columns), its `pitch` mm, and the image
    (height, width).

    `photometry` replaces that of the sensor. `stretched` is as in `optics.picture_view`. `fields`
    is the (height, width) of the fields of the last frame. If it is None, all frames have fields,
    in the size of the image.
    """

    grid: tuple[int, int]
    pitch: Any
    image: tuple[int, int]
    photometry: optics.Photometry | None = None
    stretched: bool = False
    fields: tuple[int, int] | None = None


def simulate_clip(
    clip: ClipInput,
    *,
    sensor: Sensor,
    fidelity: Fidelity,
    size: int = 0,
    fields: tuple[str, ...] = (),
    view: View | None = None,
) -> ClipOutput:
    """Simulate one clip by `sensor`: contact of every frame, shear with its history, images and
    labels.

    `size` is the short side of the image in pixels, 0 for the sensor's resolution. `view` replaces
    the grid and the image that follow from `size`. With it, the numbers of `sensor` may be traced,
    so that one program serves many.
    """
    view = (
        View(*solve_grid(sensor, size, fidelity), optics.picture_size(sensor, size))
        if view is None
        else view
    )
    (rows, columns) = view.grid
    pitch = view.pitch
    y, x = jnp.meshgrid(
        *((jnp.arange(n) - (n - 1) / 2) * pitch for n in (rows, columns)), indexing="ij"
    )
    gel = unit_gel(sensor, clip.unit)
    press = partial(
        mechanics.press, gel=gel, pitch=pitch, fidelity=fidelity, modulus_object=clip.modulus
    )
    relief = surfaces(clip, x, y)
    contact = jax.vmap(press)(relief, clip.depth)
    squeezed = jax.vmap(
        lambda p: mechanics.sideways(p, gel, pitch, fidelity=fidelity, coarse=True)
    )(contact.pressure)
    sheared = _sheared(clip, contact, squeezed, gel, pitch, fidelity)
    sheared = sheared._replace(displacement=sheared.displacement + squeezed)
    labels = _labels(clip, contact, sheared, pitch) | {"depth": _depth(clip, relief)}
    if fidelity == "fast":
        del labels["converged"]  # a few iterations do not converge
    keys = jax.random.split(jax.random.key(clip.seed), len(clip.depth) + 1)
    if sensor.kind == "field":
        points = sensor.resolution[0]
        noise = clip.unit.noise
        measure = partial(optics.measure_field, pitch=pitch, points=points, noise=noise, gel=gel)
        measured = jax.vmap(
            lambda z, xy, *maps: measure(
                z, mechanics.enlarged(xy, z.shape), *maps[:-1], key=maps[-1]
            )
        )(contact.displacement, sheared.displacement, contact.pressure, sheared.traction, keys[1:])
        return ClipOutput(None, None, measured, labels)
    shown: dict[str, Any] = {"sensor": sensor, "unit": clip.unit, "stretched": view.stretched}
    behind = optics.backdrop(resolution=view.image, **shown)
    look = {"resolution": view.image, "photometry": view.photometry, "behind": behind} | shown
    image = jax.vmap(
        lambda u, t, key, drift: optics.render(u, t, pitch, key=key, drift=drift, **look)
    )(contact.displacement, sheared.displacement, keys[1:], clip.drift)
    background = optics.background(key=keys[0], **look)
    onto_picture = partial(
        optics.onto_picture, pitch=pitch, resolution=view.fields or view.image, **shown
    )
    if view.fields:
        contact, sheared = jax.tree.map(lambda x: x[-1:], (contact, sheared))
    mapped = _fields(fields, contact, sheared, onto_picture)
    return ClipOutput(image, background, mapped, labels)


def _sheared(
    clip: ClipInput,
    contact: PressResult,
    squeezed: Array,
    gel: Gel,
    pitch: float,
    fidelity: Fidelity,
) -> shear.Shear:
    """Return the tangential state of every frame, computed from the previous one, its motion on the
    coarse grid.
    """

    slide = partial(
        shear.shear_step,
        gel=gel,
        pitch=pitch,
        friction=clip.friction,
        fidelity=fidelity,
        modulus_object=clip.modulus,
        centre=clip.unit.offset,
        coarse=True,
    )

    def step(traction: Array, frame: tuple[PressResult, Array, Array]) -> tuple[Array, shear.Shear]:
        state = slide(start._replace(traction=traction), frame[0], frame[1], squeezed=frame[2])
        return state.traction, state

    _, rows, columns = contact.pressure.shape
    start = shear.at_rest((rows, columns), contact.pressure.dtype)
    change = jnp.diff(squeezed, axis=0, prepend=jnp.zeros_like(squeezed[:1]))
    return jax.lax.scan(step, start.traction, (contact, gel_motion(clip), change))[1]


def _labels(
    clip: ClipInput, contact: PressResult, sheared: shear.Shear, pitch: float
) -> dict[str, Array]:
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
    """Return the depth mm (T,) of the highest point under the gel, from `relief` (T, h, w): not
    that of the hand.
    """
    return jnp.maximum(clip.depth + jnp.max(relief, axis=(1, 2)), 0)


def _fields(
    names: tuple[str, ...],
    contact: PressResult,
    sheared: shear.Shear,
    onto_picture: Callable[..., Array],
) -> Array | None:
    """Return the fields `names` at the image's pixels as channels: displacement mm, pressure kPa,
    shear (2) mm.
    """
    compute = {
        "displacement": lambda: onto_picture(contact.displacement[..., None]),
        "pressure": lambda: jnp.maximum(
            onto_picture(contact.pressure[..., None]), 0
        ),  # a spline overshoots at an edge
        "shear": lambda: onto_picture(
            sheared.displacement, vectors=True, grid=contact.pressure.shape[1:]
        ),
    }
    if names:
        return jnp.concatenate([compute[name]() for name in names], -1)
    return None


MAX_PIXELS = 24_000_000  # pixels of a batch; some dozen float32 planes of them are in memory


class Recorder:
    """Simulates recordings in batches of one size, so that each sensor is compiled once; a thread
    for each sensor.
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
        self._programs: dict[str, Any] = {}

    def record(self, recordings: Sequence[Recording]) -> list[ClipOutput]:
        """Return the clips of at most `batch` recordings of one sensor, as numpy.

        Raises ValueError for more.
        """
        refuse_forked()
        count = len(recordings)
        if not 0 < count <= self._batch or len({r.sensor for r in recordings}) > 1:
            raise ValueError(f"record takes 1 to {self._batch} recordings of one sensor")
        return [
            output
            for first in range(0, count, self._at_once)
            for output in self._simulate(recordings, first)
        ]

    def _simulate(self, recordings: Sequence[Recording], first: int) -> list[ClipOutput]:
        """Return the clips of as many recordings as memory allows, from number `first` on."""
        clips = [self._clip(recording) for recording in recordings[first : first + self._at_once]]
        count = len(clips)
        # equal shapes compile once
        clips += clips[-1:] * (self._at_once - count)
        outputs = jax.device_get(self._program(recordings[0].sensor)(stack_trees(clips)))
        return [jax.tree.map(lambda x, i=i: x[i], outputs) for i in range(count)]

    def _program(self, name: str) -> Any:
        if name not in self._programs:
            scenes = self._scenes
            about: dict[str, Any] = {
                "fidelity": scenes.fidelity,
                "size": scenes.size,
                "fields": scenes.fields,
            }
            self._programs[name] = jax.jit(
                jax.vmap(partial(simulate_clip, sensor=find_sensor(name), **about))
            )
        return self._programs[name]

    def _clip(self, recording: Recording) -> ClipInput:
        touch = recording.touch
        thing = self._objects[touch.object]
        given = (touch.place, recording.start, recording.motion, recording.depth, recording.tilt)
        place, start, motion, depth, tilt = (np.asarray(each, np.float32) for each in given)
        return ClipInput(
            self._relief(touch.object),
            place,
            start,
            motion,
            depth,
            tilt,
            np.float32(thing.material.modulus),
            np.float32(thing.material.friction),
            recording.unit,
            recording.drift,
            np.uint32(recording.seed),
        )


def stack_trees(trees: Sequence[Tree]) -> Tree:
    """Stack units, or records with units, along a new leading axis for vmap."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


class SimulatedTouch(NamedTuple):
    """Pictures u8 (B, h, w, 3), the gel's `background`, and fields of B touches at the picture's
    pixels.

    `depth` (B, h, w) is the gel's displacement in mm. `shear` (B, h, w, 2) is in mm along x and y
    of the picture. `pressure` (B, h, w) is in kPa, `force` (B, 3) in N along x, y and into the gel,
    `torque` (B,) in N mm.
    """

    image: Any
    background: Any
    depth: Any
    shear: Any
    pressure: Any
    force: Any
    torque: Any


def simulate_touch(
    height_map: Any,
    pose: Any,
    sensor: str = "digit",
    *,
    drag: Any = (0.0, 0.0, 0.0),
    size: int = 224,
    modulus: float = 1e6,
    friction: float = 0.6,
    fidelity: Fidelity = "fast",
    unit: Unit | None = None,
) -> SimulatedTouch:
    """Press a surface into the gel of a sensor, and return what the camera sees and the gel feels.

    `height_map` (H, W) is in mm, with 0.1 mm between pixels, its highest part nearest to the gel.
    `pose` (B, 4) is the touched place x and y in mm from the map's centre, the turn in rad, and the
    depth in mm. `drag` (B, 3) mm, mm and rad moves the object over the gel under the whole
    pressure. `modulus` kPa and `friction` are the object's. `unit` is a device
    (`sensors.draw_unit`), by default the nominal one without markers. With fidelity "fast" all but
    the pictures can be differentiated with respect to pose and drag. Use it under jit. Raises
    UserError without a camera.
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
            f"{relief.shape} and "
            f"{pose.shape}"
        )
    moves = jnp.broadcast_to(jnp.atleast_2d(jnp.asarray(drag, jnp.float32)), (len(pose), 3))
    device = identity_unit(kind) if unit is None else unit

    def one(pose: jax.Array, drag: jax.Array) -> SimulatedTouch:
        clip = ClipInput(
            relief,
            pose[:2],
            jnp.stack([0.0 * pose[0], 0.0 * pose[0], pose[2]]),
            drag[None],
            pose[3:],
            jnp.zeros(2),
            jnp.float32(modulus),
            jnp.float32(friction),
            device,
            jnp.zeros((1, 3, 3)),
            jnp.uint32(0),
        )
        out = simulate_clip(clip, sensor=kind, fidelity=fidelity, size=size, fields=FIELDS)
        force = jnp.stack([out.labels[name][-1] for name in ("force_x", "force_y", "force")])
        field = out.field[-1]
        return SimulatedTouch(
            out.image[-1],
            out.background,
            field[..., 0],
            field[..., 1:3],
            field[..., 3],
            force,
            out.labels["torque"][-1],
        )

    return jax.vmap(one)(pose, moves)


def ball(diameter: float, pixels: int = 200) -> np.ndarray:
    """Return the height map (pixels, pixels) mm of a ball, 0 at its top."""
    line = (np.arange(pixels) - (pixels - 1) / 2) * SPACING
    away = np.hypot(*np.meshgrid(line, line))
    radius = diameter / 2
    return (np.sqrt(np.maximum(radius**2 - away**2, 0.0)) - radius).astype(np.float32)
