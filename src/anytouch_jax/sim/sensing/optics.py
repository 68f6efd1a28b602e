"""Renderer of tactile images from the deformation of the skin, and the field that Tac3D measures.

Everything is a product of small matrices along rows and columns, or arithmetic that XLA fuses into
one pass. So a batch under `vmap` costs little more than its pixels. The steps are:

1. Resample and differentiate the displacement at the pixels.
2. Change the colour by the normal and the place: the photometric model (`sensors.Photometry`).
3. Add the soft shadow and the light bleed (halo) of the blurred dent.
4. Add the background image, markers, drift of the light, and noise.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.errors import UserError
from anytouch_jax.sim import interpolation
from anytouch_jax.sim.contact.mechanics import KPA_MM2, Gel
from anytouch_jax.sim.draws import Leaf
from anytouch_jax.sim.sensing.sensors import (
    DEGREE,
    POWERS,
    Markers,
    Photometry,
    Sensor,
    Unit,
    look,
    rotated,
)

Array = jax.Array
Matrices = tuple[Array, Array, Array, Array]  # rows: value, slope; columns: value, slope


class PixelPositions(NamedTuple):
    """Places of an image's columns and rows."""

    x: Array  # (W,) mm from the field's middle
    y: Array  # (H,)
    u: Array  # (W,) in -1..1, as the unit's lights see them
    v: Array  # (H,)


class Rendering(NamedTuple):
    """How a unit is shown. It is equal in all frames of a clip."""

    sensor: Sensor
    unit: Unit
    resolution: tuple[int, int]  # (height, width) in pixels
    photometry: Photometry | None = None  # instead of that of the sensor
    stretched: bool = False  # as in `pixel_positions`

    @property
    def view(self) -> PixelPositions:
        """The places of its columns and rows."""
        return pixel_positions(self.sensor, self.unit, self.resolution, stretched=self.stretched)


class Skin(NamedTuple):
    """A deformed skin on a grid that has the same middle as the field."""

    displacement: Array  # (h, w) mm into the gel; the edge is repeated outside of the grid
    # (h, w, 2) mm (x, y), on that grid or a coarser one: it moves the markers. None moves none.
    tangential: Array | None
    pitch: float | Array  # mm between points of the grid


class _Channel(NamedTuple):
    """What differs between colour channels, each with a leading axis of three outside of the loop.

    The names are in alphabetical order, which is the order of the loop's inputs in the compiled
    program: another one would compile another program.
    """

    behind: Array  # (H, W)
    drift: Array  # (3,)
    gain: Leaf
    halo: Array  # (3, 3)
    ink: Array
    normal: Array  # (20, 6)
    shift: Array  # u32, first of the ten random bits
    tint: Leaf
    uneven: Leaf  # (5,)


def image_size(sensor: Sensor, short: int = 224) -> tuple[int, int]:
    """Return (height, width) of an image of the whole field with square pixels.

    Its short side has `short` pixels. 0 is the sensor's resolution.
    """
    if not short:
        return sensor.resolution
    scale = short / min(sensor.field)
    return round(sensor.field[0] * scale), round(sensor.field[1] * scale)


def pixel_positions(
    sensor: Sensor, unit: Unit, resolution: tuple[int, int], *, stretched: bool = False
) -> PixelPositions:
    """Return the part of the field in an image of (height, width), zoomed and mirrored.

    It is the largest part of the image's shape, unless `stretched`.

    Args:
        sensor: Kind of sensor.
        unit: One device of it.
        resolution: (height, width) in pixels.
        stretched: The whole field fills the image, whose pixels need not be square: what
            `encoder.preprocess` makes.
    """
    height, width = resolution
    tall = sensor.field[0] / height
    wide = sensor.field[1] / width
    if not stretched:
        tall = wide = min(tall, wide)
    x = unit.window[0] + unit.mirror[0] * unit.zoom * wide * (jnp.arange(width) + 0.5 - width / 2)
    y = unit.window[1] + unit.mirror[1] * unit.zoom * tall * (jnp.arange(height) + 0.5 - height / 2)
    du, dv, su, sv = unit.lights
    return PixelPositions(
        x, y, du + su * 2 * x / sensor.field[1], dv + sv * 2 * y / sensor.field[0]
    )


def backdrop(
    sensor: Sensor,
    unit: Unit,
    resolution: tuple[int, int] | None = None,
    *,
    stretched: bool = False,
) -> Array:
    """Return the untouched image of a unit without markers and noise, f32 (3, H, W) in 0..1.

    Pass it to `render` as `behind` if many frames of one unit are rendered outside of one `vmap`.

    Args:
        sensor: Kind of sensor.
        unit: One device of it.
        resolution: (height, width) in pixels, by default the sensor's own.
        stretched: As in `pixel_positions`.
    """
    resolution = resolution or image_size(sensor)
    place = pixel_positions(sensor, unit, resolution, stretched=stretched)
    shape = unit.base.shape
    rows = interpolation.spline((place.v + 1) / 2 * shape[0] - 0.5, shape[0])[0]
    columns = interpolation.spline((place.u + 1) / 2 * shape[1] - 0.5, shape[1])[0]
    image = jnp.einsum("ih,hwc,jw->cij", rows, unit.base, columns)
    # The fixed pattern of the camera and of the gel: noise that is the same in every frame.
    bits = _pixel_bits(jax.random.key(unit.grain[1].astype(jnp.uint32)), resolution)
    grain = unit.grain[0] / 255 * _noise(bits)
    # Dirt and wear: Gaussian spots, which absorb light. They are separable, so all of them are one
    # product.
    u0, v0, radius, *absorbed = jnp.split(unit.specks, 6, 1)
    across = jnp.exp(-0.5 * ((place.x[None] - u0 * sensor.field[1] / 2) / radius) ** 2)
    along = jnp.exp(-0.5 * ((place.y[None] - v0 * sensor.field[0] / 2) / radius) ** 2)
    left = 1 - jnp.einsum("ki,kc,kj->cij", along, jnp.concatenate(absorbed, 1), across)
    light = jax.vmap(partial(_light, place=place, sensor=sensor))(unit.uneven.T, unit.tint)
    return image * left * light + grain[None]


def _light(uneven: Leaf, tint: Leaf, place: PixelPositions, sensor: Sensor) -> Leaf:
    """Return the light (H, W) of one colour, relative to the nominal one.

    It falls on dents as on the untouched gel.
    """
    u = place.u[None, :]
    v = place.v[:, None]
    relative = 1 + u * (uneven[0] + u * uneven[2] + v * uneven[3]) + v * (uneven[1] + v * uneven[4])
    return tint * relative * (1 - sensor.vignette * (u**2 + v**2) / 2)


def render(  # noqa: PLR0913 - the call from before `Rendering` and `Skin`
    displacement: Array | None,
    tangential: Array | None,
    pitch: float | Array,
    sensor: Sensor,
    unit: Unit,
    key: Array | None = None,
    *,
    resolution: tuple[int, int] | None = None,
    photometry: Photometry | None = None,
    behind: Array | None = None,
    drift: Leaf | None = None,
    stretched: bool = False,
) -> Array:
    """Render a skin as `show`, from the parts of its `Skin` and `Rendering`.

    A `displacement` of None is an untouched gel. `resolution` is by default square pixels with a
    short side of 224. Raises UserError for a sensor without a camera.
    """
    camera = Rendering(sensor, unit, resolution or image_size(sensor), photometry, stretched)
    skin = None if displacement is None else Skin(displacement, tangential, pitch)
    return show(skin, camera, key, behind=behind, drift=drift)


def show(
    skin: Skin | None,
    camera: Rendering,
    key: Array | None = None,
    *,
    behind: Array | None = None,
    drift: Leaf | None = None,
) -> Array:
    """Render the image of a skin, u8 (H, W, 3) RGB.

    Args:
        skin: The deformation, or None for an untouched gel.
        camera: How the unit is shown. Its sensor and resolution are static under jit.
        key: Draws the noise of the image. None omits it.
        behind: The `backdrop` of the same unit and resolution, if many frames share it.
        drift: (3, 3) change of the light since the background image (`sensors.draw_drift`).

    Raises:
        UserError: For a sensor without a camera.
    """
    sensor = camera.sensor
    unit = camera.unit
    place = camera.view
    photometry = look(sensor) if camera.photometry is None else camera.photometry
    change = _no_change if skin is None else _shading(skin, sensor, unit, photometry, place)
    ink = None
    if sensor.markers is not None:
        ink = unit.marked * _ink(skin, place, sensor.markers, sensor, unit)
    bits = None if key is None else _pixel_bits(key, camera.resolution)

    def channel(c: _Channel) -> Array:
        light = _light(c.uneven, c.tint, place, sensor)
        image = c.behind + c.gain * change(c) * light
        if ink is not None:
            image = image + ink * (c.ink * light - image)
        if drift is not None:
            image = image * (
                1 + c.drift[0] + c.drift[1] * place.u[None, :] + c.drift[2] * place.v[:, None]
            )
        # Each colour takes ten other bits of the pixel's random word.
        noise = 0.0 if bits is None else unit.noise * _noise(bits >> c.shift)
        return jnp.round(jnp.clip(255 * image + noise, 0, 255)).astype(jnp.uint8)

    if behind is None:
        behind = backdrop(sensor, unit, camera.resolution, stretched=camera.stretched)
    # A loop over the channels, not a broadcast: shared terms are computed once, and XLA's CPU
    # backend cannot fuse the arithmetic into the transpose, whose inner loop over three channels is
    # not vectorised (six times slower).
    channels = _channels(photometry, sensor, unit, behind, drift)
    planes = jax.lax.map(channel, channels).astype(jnp.uint32)
    # Three bytes in one word: a transposition of bytes would take longer than a channel.
    packed = planes[0] | planes[1] << 8 | planes[2] << 16
    return jax.lax.bitcast_convert_type(packed, jnp.uint8)[..., :3]


def _no_change(channel: _Channel) -> float:
    """Return the change of a channel without a dent."""
    return 0.0


def _shading(
    skin: Skin, sensor: Sensor, unit: Unit, photometry: Photometry, place: PixelPositions
) -> Callable[[_Channel], Array | float]:
    """Return the change (H, W) of one channel by the dent, as a function of the channel."""
    displacement = skin.displacement
    pitch = skin.pitch
    matrices = _resample(displacement.shape, pitch, place)
    # The coating and the lens pass no finer detail. A blur of nothing would divide by zero.
    surface = _blurred(displacement, jnp.maximum(jnp.hypot(sensor.skin, unit.focus) / pitch, 0.05))
    slopes = rotated(*_slopes(surface, matrices, pitch), unit.light_angle)
    nx, ny = tilt(*slopes, photometry.steepest)
    if not is_traced(photometry.halo) and not np.any(np.asarray(photometry.halo)):
        return lambda c: colour_change(c.normal, nx, ny, place.u, place.v)
    # The halo is the part of the light that does not depend on the normal alone. Its source is a
    # dent blurred by the way that light takes in the gel.
    soft = _blurred(displacement, sensor.halo / pitch)
    depth = matrices[0] @ soft @ matrices[2].T
    lit = (*rotated(*_slopes(soft, matrices, pitch), unit.light_angle), depth)
    glow = tuple(jnp.clip(f, -most, most) for f, most in zip(lit, photometry.widest, strict=True))

    def change(c: _Channel) -> Array:
        by_normal = colour_change(c.normal, nx, ny, place.u, place.v)
        return by_normal + halo_change(c.halo, glow, place.u, place.v)

    return change


def tilt(slope_x: Array, slope_y: Array, steepest: float | Leaf) -> tuple[Array, Array]:
    """Return slopes (mm/mm) over the length of their normal, cut to the length `steepest`.

    They are the sines of the tilt: n = (s_x, s_y) / sqrt(1 + s_x^2 + s_y^2).
    """
    square = slope_x**2 + slope_y**2
    scale = jnp.minimum(
        jax.lax.rsqrt(1.0 + square), steepest * jax.lax.rsqrt(jnp.maximum(square, 1e-12))
    )
    return slope_x * scale, slope_y * scale


def colour_change(normal: Array, nx: Array, ny: Array, u: Array, v: Array) -> Array:
    """Return the change of one colour channel by a tilted surface.

    It is the sum over powers i + j <= 5 of c_ij(u, v) nx^i ny^j, without a constant, by Horner's
    scheme in nx over Horner's scheme in ny. Every coefficient c_ij is a quadric of the place.

    Args:
        normal: (20, 6), that channel of `Photometry.normal`.
        nx: (H, W) of `tilt`.
        ny: (H, W) of `tilt`.
        u: (W,) places in -1..1.
        v: (H,) places in -1..1.

    Returns:
        (H, W), 0..1.
    """
    index = {power: k for k, power in enumerate(POWERS)}
    u = u[None, :]
    v = v[:, None]

    def coefficient(i: int, j: int) -> Array:
        c0, cu, cv, cuu, cuv, cvv = normal[index[i, j]]
        return (c0 + v * (cv + v * cvv)) + u * ((cu + v * cuv) + u * cuu)

    total = coefficient(DEGREE, 0)
    for i in range(DEGREE - 1, -1, -1):
        inner = coefficient(i, DEGREE - i)
        for j in range(DEGREE - i - 1, -1, -1):
            # A flat surface changes nothing, so there is no constant.
            inner = inner * ny + (coefficient(i, j) if (i, j) != (0, 0) else 0.0)
        total = total * nx + inner
    return total


def halo_change(halo: Array, features: tuple[Array, ...], u: Array, v: Array) -> Array:
    """Return the change (H, W) of one channel by the blurred dent.

    Args:
        halo: (3, 3), one channel of `Photometry.halo`: a constant and a drift along u and v for
            each feature.
        features: Slope along x, slope along y and depth of the blurred dent, each (H, W).
        u: (W,) places along x, -1 to 1 over the image.
        v: (H,) places along y.
    """
    terms = [
        feature * (halo[k, 0] + u[None, :] * halo[k, 1] + v[:, None] * halo[k, 2])
        for k, feature in enumerate(features)
    ]
    return terms[0] + terms[1] + terms[2]


def _channels(
    photometry: Photometry, sensor: Sensor, unit: Unit, behind: Array, drift: Leaf | None
) -> _Channel:
    """Return the inputs that differ between colour channels, each with a leading axis of three."""
    ink = sensor.markers.ink if sensor.markers else (0.0, 0.0, 0.0)
    normal = jnp.moveaxis(jnp.asarray(photometry.normal), -1, 0)
    inked = jnp.asarray(ink)
    halo = jnp.moveaxis(jnp.asarray(photometry.halo), -1, 0)
    uneven = unit.uneven.T
    drifts = jnp.zeros((3, 3)) if drift is None else jnp.asarray(drift.T)
    shift = jnp.array([0, 10, 20], jnp.uint32)
    return _Channel(
        behind=behind,
        drift=drifts,
        gain=unit.gain,
        halo=halo,
        ink=inked,
        normal=normal,
        shift=shift,
        tint=unit.tint,
        uneven=uneven,
    )


def background(sensor: Sensor, unit: Unit, key: Array | None = None, **options: Any) -> Array:
    """Render the background image of a unit, u8 (H, W, 3) RGB, with its markers and noise.

    `options` of `render`.
    """
    return render(None, None, 1.0, sensor, unit, key, **options)


def onto_image(
    maps: Array,
    *,
    pitch: Any,
    sensor: Sensor,
    unit: Unit,
    resolution: tuple[int, int],
    vectors: bool = False,
    stretched: bool = False,
    grid: tuple[int, int] | None = None,
) -> Array:
    """Resample maps of the solve grid at the pixels of a unit's image.

    Args:
        maps: (..., h, w, C), on the solve grid or a coarser one.
        pitch: mm between points of the solve grid.
        sensor: The family of the unit.
        unit: The unit.
        resolution: (height, width) of the image.
        vectors: The two channels are x and y of a vector, which is mirrored with the image.
        stretched: As in `pixel_positions`.
        grid: Size (rows, columns) of the solve grid if that of the maps is coarser.

    Returns:
        (..., height, width, C).
    """
    place = pixel_positions(sensor, unit, resolution, stretched=stretched)
    ay, ax = _enlarging(maps.shape[-3:-1], grid, pitch, place)
    mapped = jnp.einsum("ih,...hwc,jw->...ijc", ay, maps, ax)
    if vectors:
        return mapped * unit.mirror.reshape((1,) * (mapped.ndim - 1) + (2,))
    return mapped


def _resample(shape: tuple[int, ...], pitch: Any, place: PixelPositions) -> Matrices:
    """Return value and derivative matrices from the solve grid to the image's rows and columns."""
    rows = interpolation.spline(place.y / pitch + (shape[0] - 1) / 2, shape[0])
    return *rows, *interpolation.spline(place.x / pitch + (shape[1] - 1) / 2, shape[1])


def _enlarging(
    shape: tuple[int, ...], grid: Any, pitch: Any, place: PixelPositions
) -> tuple[Array, Array]:
    """Return the value matrices (rows, columns) from a map of `shape` to the image.

    The map is on a `grid` of (rows, columns) with `pitch` mm, or on a coarser one.
    """
    grid = grid or shape
    ay, _, ax, _ = _resample(grid, pitch, place)
    if shape[:2] == grid[:2]:
        return ay, ax
    # One product of small matrices, and not a large map between them.
    wide = [
        jax.image.resize(jnp.eye(n), (most, n), "cubic")
        for n, most in zip(shape[:2], grid[:2], strict=True)
    ]
    return ay @ wide[0], ax @ wide[1]


def _slopes(field: Array, matrices: Matrices, pitch: Any) -> tuple[Array, Array]:
    """Return slopes (H, W) along x and y at the pixels."""
    ay, dy, ax, dx = matrices
    return ay @ field @ dx.T / pitch, dy @ field @ ax.T / pitch


def _blurred(field: Array, sigma: Any) -> Array:
    """Return a field (h, w) blurred by a Gaussian of `sigma` points."""
    rows, columns = (interpolation.blur(n, sigma) for n in field.shape)
    return rows @ field @ columns.T


def _ink(
    skin: Skin | None, place: PixelPositions, ink: Markers, sensor: Sensor, unit: Unit
) -> Array:
    """Return the fraction of ink (H, W): the lattice at the undeformed places of the skin.

    The skin at a pixel came from where it was before it moved, so the motion is subtracted.
    """
    size = (len(place.y), len(place.x))
    x = jnp.broadcast_to(place.x[None, :], size)
    y = jnp.broadcast_to(place.y[:, None], size)
    if skin is not None and skin.tangential is not None:
        moved = skin.tangential
        ay, ax = _enlarging(moved.shape, skin.displacement.shape, skin.pitch, place)
        x = x - ay @ moved[..., 0] @ ax.T
        y = y - ay @ moved[..., 1] @ ax.T
    soft = 1.5 * jnp.abs(place.x[1] - place.x[0]) + 2 * unit.focus
    half = jnp.hypot(*sensor.field) / 2
    x = x / unit.marker_pitch
    y = y / unit.marker_pitch
    return ink_coverage(ink, x, y, unit.marker_phase, unit.marker_size, soft, half)


def ink_coverage(
    markers: Markers, x: Array, y: Array, phase: Leaf, size: Leaf, soft: Array, half: Any
) -> Array:
    """Return the fraction of ink, 0..1, at places of the skin.

    Spots lie on a lattice and differ a little in size, as printed spots do.

    Args:
        markers: The lattice. Its numbers may be traced.
        x: (H, W) mm, *undeformed* coordinates.
        y: (H, W) mm.
        phase: (2,) of the lattice, in its steps.
        size: Factor on the radius.
        soft: mm of a spot's rim.
        half: mm, half the field's diagonal, for the lens.

    Returns:
        (H, W).
    """
    # Without distortion the program has no lens. A traced number is not known to be 0.
    bends = is_traced(markers.bend) or markers.bend
    grow = 1.0 - markers.bend * (1.0 - (x**2 + y**2) / half**2) if bends else 1.0
    column = x * grow / markers.pitch - phase[0]
    row = y * grow / markers.pitch - phase[1]
    i = jnp.floor(column + 0.5)
    j = jnp.floor(row + 0.5)
    dx = (column - i) * (markers.pitch / markers.aspect)
    dy = (row - j) * markers.pitch
    # Sizes of neighbours without a visible order (plastic number), cheaper than a sine.
    scatter = 0.754877 * i + 0.569840 * j
    radius = markers.radius * size * (0.88 + 0.24 * (scatter - jnp.floor(scatter)))
    distance = jnp.sqrt(dx**2 + dy**2 + 1e-12)
    return jnp.clip((radius - distance) / soft + 0.5, 0.0, 1.0)


def is_traced(value: Any) -> bool:
    """Return whether a value is known only while a compiled program runs."""
    return isinstance(value, jax.core.Tracer)


def _pixel_bits(key: Array, shape: tuple[int, int]) -> Array:
    """Return a random word u32 (H, W) for each pixel: its number, mixed with the key.

    It is cheaper than `jax.random.bits`, and an image's noise needs no cryptography.
    """
    step = jnp.uint32(0x9E3779B9)  # 2^32 over the golden ratio: odd, and far from small numbers
    first, second = _mixed(jax.random.key_data(key) + step)
    number = jnp.arange(shape[0] * shape[1], dtype=jnp.uint32).reshape(shape)
    return _mixed(_mixed(number * step + first) ^ second)


def _mixed(word: Array) -> Array:
    """Return words u32 in which every bit depends on all bits of `word`.

    The constants are those of C. Wellons (Hash Prospector, 2018).
    """
    word = (word ^ word >> 16) * jnp.uint32(0x21F0AAAD)
    word = (word ^ word >> 15) * jnp.uint32(0x735A2D97)
    return word ^ word >> 15


def _noise(bits: Array) -> Array:
    """Return noise of zero mean and unit variance from the lowest ten bits of each word.

    Ten coin tosses have mean 5 and variance 2.5, and are near enough to normal for a pixel.
    """
    heads = jax.lax.population_count(bits & jnp.uint32(1023))
    return (heads.astype(jnp.float32) - 5) / np.sqrt(2.5)


def measure_field(  # noqa: PLR0913 - four maps, which are arguments under vmap
    displacement: Array,
    tangential: Array,
    pressure: Array,
    traction: Array,
    pitch: Any,
    points: int = 20,
    *,
    noise: Any = 0.0,
    gel: Gel | None = None,
    key: Array | None = None,
) -> Array:
    """Return the measurement of a field sensor.

    A point reports the mean displacement and the total force of its cell, so without noise the
    forces sum to the load. The sensor computes forces from displacements, so their noise is the
    force that moves a cube of `gel` under a cell by the noise of a displacement.

    Args:
        displacement: (h, w) mm on the solve grid.
        tangential: (h, w, 2) mm.
        pressure: (h, w) kPa.
        traction: (h, w, 2) kPa.
        pitch: mm between points of the solve grid.
        points: Points along a side.
        noise: Standard deviation of a displacement, mm.
        gel: The gel, for the noise of forces.
        key: Draws the noise. None omits it.

    Returns:
        f32 (points, points, 6): displacement x, y, z mm, force x, y, z N.

    Raises:
        UserError: For maps of different sizes.
    """
    shape = displacement.shape
    if not shape == pressure.shape == tangential.shape[:2] == traction.shape[:2]:
        raise UserError(
            f"displacement {shape}, pressure {pressure.shape} and the tangential maps must have "
            "one size"
        )
    maps = jnp.concatenate([tangential, displacement[..., None], traction, pressure[..., None]], -1)
    rows, columns = (jnp.asarray(interpolation.average(n, points)) for n in shape)
    means = jnp.einsum("ih,hwc,jw->ijc", rows, maps, columns)
    cell = shape[0] * shape[1] / points**2 * pitch**2  # mm^2
    exact = means * _each(1.0, cell * KPA_MM2)
    if key is not None and gel is not None:
        spread = _each(noise, noise * gel.modulus * jnp.sqrt(cell) * KPA_MM2)
        exact = exact + spread * jax.random.normal(key, exact.shape)
    return exact.astype(jnp.float32)


def _each(displacement: Any, force: Any) -> Array:
    """Return one value for the displacements and one for the forces of a field, (1, 1, 6)."""
    return jnp.repeat(jnp.stack([jnp.asarray(displacement), jnp.asarray(force)]), 3)[None, None]
