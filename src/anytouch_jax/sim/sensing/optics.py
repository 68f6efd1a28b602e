"""Renderer of tactile images from the deformation of the skin, and the field that Tac3D measures.

Everything is a product of small matrices along rows and columns, or arithmetic that XLA fuses into
one pass. So a batch under `vmap` costs little more than its pixels. The steps are: resample and
differentiate the displacement at the pixels, colour change by normal and place, soft shadow and
light bleed from the blurred dent, background, markers, noise.
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


class PictureView(NamedTuple):
    """Places of the image's columns and rows: `x` (W,), `y` (H,) mm from the field's middle, and
    `u`, `v` in -1..1.

    `u` and `v` are the places that the unit's lights see.
    """

    x: Array
    y: Array
    u: Array
    v: Array


def picture_size(sensor: Sensor, short: int = 224) -> tuple[int, int]:
    """Return (height, width) of an image of the whole field with square pixels.

    Its short side has `short` pixels. 0 is the sensor's resolution.
    """
    if not short:
        return sensor.resolution
    scale = short / min(sensor.field)
    return round(sensor.field[0] * scale), round(sensor.field[1] * scale)


def picture_view(
    sensor: Sensor, unit: Unit, resolution: tuple[int, int], *, stretched: bool = False
) -> PictureView:
    """Return the part of the field in an image of (height, width): the largest of its shape, zoomed
    and mirrored.

    If `stretched`, the whole field fills the image, whose pixels need not be square: what
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
    return PictureView(x, y, du + su * 2 * x / sensor.field[1], dv + sv * 2 * y / sensor.field[0])


def backdrop(
    sensor: Sensor,
    unit: Unit,
    resolution: tuple[int, int] | None = None,
    *,
    stretched: bool = False,
) -> Array:
    """Return the untouched image of a unit without markers and noise, f32 (3, H, W) in 0..1.

    Pass it to `render` as `behind` if many frames of one unit are rendered outside of one `vmap`.
    """
    resolution = resolution or picture_size(sensor)
    place = picture_view(sensor, unit, resolution, stretched=stretched)
    shape = unit.base.shape
    rows = interpolation.spline((place.v + 1) / 2 * shape[0] - 0.5, shape[0])[0]
    columns = interpolation.spline((place.u + 1) / 2 * shape[1] - 0.5, shape[1])[0]
    image = jnp.einsum("ih,hwc,jw->cij", rows, unit.base, columns)
    bits = _pixel_bits(jax.random.key(unit.grain[1].astype(jnp.uint32)), resolution)
    grain = unit.grain[0] / 255 * _noise(bits)
    # dirt and wear
    u0, v0, radius, *absorbed = jnp.split(unit.specks, 6, 1)
    across = jnp.exp(-0.5 * ((place.x[None] - u0 * sensor.field[1] / 2) / radius) ** 2)
    along = jnp.exp(-0.5 * ((place.y[None] - v0 * sensor.field[0] / 2) / radius) ** 2)
    left = 1 - jnp.einsum("ki,kc,kj->cij", along, jnp.concatenate(absorbed, 1), across)
    light = jax.vmap(partial(_light, place=place, sensor=sensor))(unit.uneven.T, unit.tint)
    return image * left * light + grain[None]


def _light(uneven: Array, tint: Array, place: PictureView, sensor: Sensor) -> Array:
    """Return the light (H, W) of one colour, relative to the nominal one.

    It falls on dents as on the untouched gel.
    """
    u = place.u[None, :]
    v = place.v[:, None]
    relative = 1 + u * (uneven[0] + u * uneven[2] + v * uneven[3]) + v * (uneven[1] + v * uneven[4])
    return tint * relative * (1 - sensor.vignette * (u**2 + v**2) / 2)


def render(
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
    drift: Array | None = None,
    stretched: bool = False,
) -> Array:
    """Render the image u8 (H, W, 3) RGB of a skin pushed in by `displacement` (h, w) mm on a grid
    of `pitch` mm.

    The grid and the field have the same middle, and the grid's edge is repeated outside of it.
    `tangential` (h, w, 2) mm (x, y), on that grid or a coarser one, moves the markers. None is an
    untouched gel. `key` draws the noise, and None omits it. `resolution` is (height, width), by
    default square pixels with a short side of 224. `photometry` replaces that of the sensor.
    `sensor` and `resolution` are static under jit. `behind` is the `backdrop` of the same unit and
    resolution. `drift` (3, 3) changes the light (`sensors.draw_drift`). `stretched` is as in
    `picture_view`. Raises UserError for a sensor without a camera.
    """
    resolution = resolution or picture_size(sensor)
    place = picture_view(sensor, unit, resolution, stretched=stretched)
    photometry = look(sensor) if photometry is None else photometry
    change = (
        (lambda c: 0.0)
        if displacement is None
        else _shading(displacement, pitch, sensor, unit, photometry, place)
    )
    ink = None
    if sensor.markers is not None:
        grid = None if displacement is None else displacement.shape
        ink = unit.marked * _ink(tangential, grid, pitch, place, sensor.markers, sensor, unit)
    bits = None if key is None else _pixel_bits(key, resolution)

    def channel(c: dict[str, Array]) -> Array:
        light = _light(c["uneven"], c["tint"], place, sensor)
        image = c["behind"] + c["gain"] * change(c) * light
        if ink is not None:
            image = image + ink * (c["ink"] * light - image)
        if drift is not None:
            image = image * (
                1
                + c["drift"][0]
                + c["drift"][1] * place.u[None, :]
                + c["drift"][2] * place.v[:, None]
            )
        noise = 0.0 if bits is None else unit.noise * _noise(bits >> c["shift"])
        return jnp.round(jnp.clip(255 * image + noise, 0, 255)).astype(jnp.uint8)

    if behind is None:
        behind = backdrop(sensor, unit, resolution, stretched=stretched)
    # A loop over the channels, not a broadcast: shared terms are computed once, and XLA's CPU
    # backend cannot fuse the arithmetic into the transpose, whose inner loop over three channels is
    # not vectorised (six times slower).
    planes = jax.lax.map(channel, _channels(photometry, sensor, unit, behind, drift)).astype(
        jnp.uint32
    )
    # a transposition of bytes would take longer than a channel
    packed = planes[0] | planes[1] << 8 | planes[2] << 16
    return jax.lax.bitcast_convert_type(packed, jnp.uint8)[..., :3]


def _shading(
    displacement: Array,
    pitch: Any,
    sensor: Sensor,
    unit: Unit,
    photometry: Photometry,
    place: PictureView,
) -> Callable[[dict[str, Array]], Array]:
    """Return the change (H, W) of one channel by the dent, as a function of the channel's
    numbers.
    """
    matrices = _resample(displacement.shape, pitch, place)
    skin = _blurred(displacement, jnp.maximum(jnp.hypot(sensor.skin, unit.focus) / pitch, 0.05))
    nx, ny = tilt(*rotated(*_slopes(skin, matrices, pitch), unit.light_angle), photometry.steepest)
    if not is_traced(photometry.halo) and not np.any(np.asarray(photometry.halo)):
        return lambda c: colour_change(c["normal"], nx, ny, place.u, place.v)
    soft = _blurred(displacement, sensor.halo / pitch)
    depth = matrices[0] @ soft @ matrices[2].T
    lit = (*rotated(*_slopes(soft, matrices, pitch), unit.light_angle), depth)
    glow = tuple(jnp.clip(f, -most, most) for f, most in zip(lit, photometry.widest, strict=True))
    return lambda c: (
        colour_change(c["normal"], nx, ny, place.u, place.v)
        + halo_change(c["halo"], glow, place.u, place.v)
    )


def tilt(slope_x: Array, slope_y: Array, steepest: float | Array) -> tuple[Array, Array]:
    """Return slopes (mm/mm) over the length of their normal, which are sines of the tilt, cut to
    length `steepest`.
    """
    square = slope_x**2 + slope_y**2
    scale = jnp.minimum(
        jax.lax.rsqrt(1.0 + square), steepest * jax.lax.rsqrt(jnp.maximum(square, 1e-12))
    )
    return slope_x * scale, slope_y * scale


def colour_change(normal: Array, nx: Array, ny: Array, u: Array, v: Array) -> Array:
    """Return the change (H, W) of one colour channel, 0..1, of a surface with `tilt` (nx, ny) (H,
    W).

    `normal` (20, 6) is that channel of `Photometry.normal`, and `u` (W,) and `v` (H,) are places in
    -1..1. It is Horner's scheme in nx over Horner's scheme in ny. Every coefficient is a quadric of
    the place.
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
            inner = inner * ny + (coefficient(i, j) if (i, j) != (0, 0) else 0.0)
        total = total * nx + inner
    return total


def halo_change(halo: Array, features: tuple[Array, ...], u: Array, v: Array) -> Array:
    """Return the change (H, W) of one channel from slope x, slope y and depth (each (H, W)) of the
    blurred dent.

    `halo` (3, 3) is that channel of `Photometry.halo`.
    """
    terms = [
        feature * (halo[k, 0] + u[None, :] * halo[k, 1] + v[:, None] * halo[k, 2])
        for k, feature in enumerate(features)
    ]
    return terms[0] + terms[1] + terms[2]


def _channels(
    photometry: Photometry, sensor: Sensor, unit: Unit, behind: Array, drift: Array | None
) -> dict[str, Array]:
    """Return the inputs that differ between colour channels, each with a leading axis of three."""
    ink = sensor.markers.ink if sensor.markers else (0.0, 0.0, 0.0)
    return {
        "normal": jnp.moveaxis(jnp.asarray(photometry.normal), -1, 0),
        "behind": behind,
        "ink": jnp.asarray(ink),
        "halo": jnp.moveaxis(jnp.asarray(photometry.halo), -1, 0),
        "gain": unit.gain,
        "tint": unit.tint,
        "uneven": unit.uneven.T,
        "drift": jnp.zeros((3, 3)) if drift is None else drift.T,
        "shift": jnp.array([0, 10, 20], jnp.uint32),
    }


def background(sensor: Sensor, unit: Unit, key: Array | None = None, **options: Any) -> Array:
    """Render the background image of a unit, u8 (H, W, 3) RGB, with its markers and noise.

    `options` of `render`.
    """
    return render(None, None, 1.0, sensor, unit, key, **options)


def onto_picture(
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
    """Resample maps (..., h, w, C) of the solve grid at the pixels of a unit's image of (height,
    width).

    With `vectors`, the two channels are x and y of a vector, which is mirrored with the image.
    `grid` is the size of the solve grid if that of the maps is coarser.
    """
    place = picture_view(sensor, unit, resolution, stretched=stretched)
    ay, ax = _enlarging(maps.shape[-3:-1], grid, pitch, place)
    mapped = jnp.einsum("ih,...hwc,jw->...ijc", ay, maps, ax)
    if vectors:
        return mapped * unit.mirror.reshape((1,) * (mapped.ndim - 1) + (2,))
    return mapped


def _resample(shape: tuple[int, ...], pitch: Any, place: PictureView) -> Matrices:
    """Return value and derivative matrices from the solve grid to the image's rows and columns."""
    rows = interpolation.spline(place.y / pitch + (shape[0] - 1) / 2, shape[0])
    return *rows, *interpolation.spline(place.x / pitch + (shape[1] - 1) / 2, shape[1])


def _enlarging(
    shape: tuple[int, ...], grid: Any, pitch: Any, place: PictureView
) -> tuple[Array, Array]:
    """Return the value matrices from a map of `shape`, on a grid of (rows, columns) with `pitch` or
    a coarser one.
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
    rows, columns = (interpolation.blur(n, sigma) for n in field.shape)
    return rows @ field @ columns.T


def _ink(
    tangential: Array | None,
    grid: Any,
    pitch: Any,
    place: PictureView,
    ink: Markers,
    sensor: Sensor,
    unit: Unit,
) -> Array:
    """Return the share of ink (H, W): the lattice at the undeformed places of the skin at the
    pixels.
    """
    x, y = (
        jnp.broadcast_to(a, (len(place.y), len(place.x)))
        for a in (place.x[None, :], place.y[:, None])
    )
    if tangential is not None:
        ay, ax = _enlarging(tangential.shape, grid, pitch, place)
        x = x - ay @ tangential[..., 0] @ ax.T
        y = y - ay @ tangential[..., 1] @ ax.T
    soft = 1.5 * jnp.abs(place.x[1] - place.x[0]) + 2 * unit.focus
    half = jnp.hypot(*sensor.field) / 2
    x = x / unit.marker_pitch
    y = y / unit.marker_pitch
    return ink_coverage(ink, x, y, unit.marker_phase, unit.marker_size, soft, half)


def ink_coverage(
    markers: Markers, x: Array, y: Array, phase: Array, size: Array, soft: Array, half: Any
) -> Array:
    """Return the share of ink (H, W), 0..1, at places with *undeformed* coordinates `x`, `y` (H, W)
    mm.

    Spots lie on a lattice and differ a little in size, as printed spots do. `phase` (2,) is in
    lattice steps, `size` a factor on the radius, `soft` mm the width of a spot's rim, `half` mm
    half the field's diagonal (for the lens).
    """
    bends = is_traced(markers.bend) or markers.bend
    grow = 1.0 - markers.bend * (1.0 - (x**2 + y**2) / half**2) if bends else 1.0
    column = x * grow / markers.pitch - phase[0]
    row = y * grow / markers.pitch - phase[1]
    i = jnp.floor(column + 0.5)
    j = jnp.floor(row + 0.5)
    dx = (column - i) * (markers.pitch / markers.aspect)
    dy = (row - j) * markers.pitch
    # no visible order (plastic number), and cheaper than a sine
    scatter = 0.754877 * i + 0.569840 * j
    radius = markers.radius * size * (0.88 + 0.24 * (scatter - jnp.floor(scatter)))
    distance = jnp.sqrt(dx**2 + dy**2 + 1e-12)
    return jnp.clip((radius - distance) / soft + 0.5, 0.0, 1.0)


def is_traced(value: Any) -> bool:
    """Return whether a value is known only while a compiled program runs."""
    return isinstance(value, jax.core.Tracer)


def _pixel_bits(key: Array, shape: tuple[int, int]) -> Array:
    """Return a random word u32 (H, W) for each pixel: its number, mixed with the key.

    It is cheaper than `jax.random.bits`, and a picture's noise needs no cryptography.
    """
    step = jnp.uint32(0x9E3779B9)
    first, second = _mixed(jax.random.key_data(key) + step)
    return _mixed(
        _mixed(jnp.arange(shape[0] * shape[1], dtype=jnp.uint32).reshape(shape) * step + first)
        ^ second
    )


def _mixed(word: Array) -> Array:
    """Return words in which every bit depends on all bits of `word` u32 (C. Wellons, Hash
    Prospector, 2018).
    """
    word = (word ^ word >> 16) * jnp.uint32(0x21F0AAAD)
    word = (word ^ word >> 15) * jnp.uint32(0x735A2D97)
    return word ^ word >> 15


def _noise(bits: Array) -> Array:
    """Return noise of zero mean and unit variance from the lowest ten bits of each word: ten coin
    tosses.
    """
    return (jax.lax.population_count(bits & jnp.uint32(1023)).astype(jnp.float32) - 5) / np.sqrt(
        2.5
    )


def measure_field(
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
    """Return the measurement of a field sensor, f32 (points, points, 6): displacement x, y, z mm,
    force x, y, z N.

    Inputs on the solve grid are `displacement` (h, w) mm, `tangential` (h, w, 2) mm, `pressure` (h,
    w) kPa, `traction` (h, w, 2) kPa and `pitch` mm. A point reports the mean displacement and the
    total force of its cell, so without noise the forces sum to the load. `key` draws noise of
    `noise` mm in a displacement. The sensor computes forces from displacements, so their noise is
    the force that moves a cube of `gel` under a cell by it. Raises UserError for maps of different
    sizes.
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
