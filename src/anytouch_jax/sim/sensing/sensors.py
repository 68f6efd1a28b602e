"""Simulated sensors, one frozen record each, and their units (devices).

Sizes, gels and dots are those of `anytouch_jax.sensors`. This module adds how a sensor looks. A new
sensor is a new record there and a new entry of `SENSORS` here; for your own see `own`.

`photometry.npz` has the colours of the dents of camera sensors (`experiments/results/tried.md`),
and the untouched gels of the two whose appearance is set by eye. Those of real instances are in
`data.background.layout`. GelSight, GelSight Mini, DIGIT and 9DTact look like real instances. The
colours of the Mini are fitted to 17 presses of a ball of 6.31 mm (GelSLAM) by `fitting.fit`. Its
`contrast` makes simulated balls as strong as real ones. GelSlim and DuraGel are a few lights each,
set by eye. Tac3D measures a field and has no image.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from anytouch_jax.data.background.layout import known_backgrounds
from anytouch_jax.errors import UserError
from anytouch_jax.files import read_arrays
from anytouch_jax.sensors import RECORDS, Markers
from anytouch_jax.sim.contact.mechanics import Gel
from anytouch_jax.sim.draws import Leaf, Rng, namespace_of

Array = npt.NDArray[Any]

POISSON = 0.48  # of silicone gels, which hardly change their volume


@dataclass(frozen=True)
class Sensor:
    """One family of tactile sensors. Its numbers may be traced (`endless.as_sensor`)."""

    name: str
    field: tuple[float, float]  # mm (height, width)
    resolution: tuple[int, int]  # pixels (height, width), or points for kind "field"
    gel: Gel
    markers: Markers | None = None
    kind: Literal["image", "field"] = "image"
    skin: float = 0.0  # mm, smallest detail that the coating passes
    contrast: float = 1.0  # of dents in most units over that of the calibrated one
    vignette: float = 0.0  # loss of light from the middle to the corners, of dents too
    halo: float = 1.0  # mm, width of the soft shadow
    # Standard deviation of a pixel (0 to 255), or of a field's displacement in mm. 0.01 mm is a
    # third of a pixel of Tac3D's camera with 640 columns.
    noise: float = 1.0
    real: bool = True  # whether it looks like real units
    # of units, relative to a family's: 1 is also mirrored and cropped, less is one device
    spread: float = 1.0
    arrays: str = ""  # .npz file of its photometry; "" is that of the package
    version: int = 0  # of that file, which may be written again


class Photometry(NamedTuple):
    """The photometric model of a sensor: the change of its image with the tilt of its surface.

    Colours are RGB in 0..1. The colour of diffuse paint under a few fixed lights is a low-order
    polynomial of its normal (spherical harmonics, Basri and Jacobs 2003), whose coefficients drift
    slowly over the image. So a few hundred numbers replace a table over gradient bins (Taxim, Si
    and Yuan 2022). They are smooth, bounded, and exactly zero without contact.
    """

    # (20, 6, 3), a colour for every power of the normal (`POWERS`) and of the position
    normal: Leaf
    # (3, 3, 3), soft shadow and light bleed, on slope and depth (1/mm) of the blurred dent
    halo: Leaf
    # largest sine of the tilt in the fit; steeper surfaces look like this one
    steepest: float | Leaf
    # (3,), the same for the halo: a deep press all over is dark, but not black
    widest: Leaf


DEGREE = 5  # of the polynomial in the normal, without its constant
POWERS = tuple((total - j, j) for total in range(1, DEGREE + 1) for j in range(total + 1))


def _simulated(name: str, **appearance: Any) -> Sensor:
    """Return the simulated form of a sensor: its record, and how it looks."""
    record = RECORDS[name]
    assert record.size_mm is not None and record.pixels is not None
    assert record.modulus_kpa is not None and record.thickness_mm is not None
    return Sensor(
        name,
        record.size_mm,
        record.pixels,
        Gel(modulus=record.modulus_kpa, poisson=POISSON, thickness=record.thickness_mm),
        record.dots,
        kind=record.measures,
        **appearance,
    )


# The place in this table is the number of a sensor's random stream (`own.sensor_number`), and the
# number of its family in a world. So a new sensor comes last.
SENSORS: dict[str, Sensor] = {
    "gelsight": _simulated("gelsight", halo=1.5),
    "gelsight_mini": _simulated("gelsight_mini", contrast=1.1, noise=0.6),
    "gelslim": _simulated("gelslim", vignette=0.35, halo=0.8, noise=1.5, real=False),
    "digit": _simulated("digit", contrast=1.4, skin=0.1, noise=0.8),
    "9dtact": _simulated("9dtact", skin=0.15, halo=0.35, noise=0.6),
    "duragel": _simulated("duragel", vignette=0.2, skin=0.14, noise=1.2, real=False),
    "tac3d": _simulated("tac3d", noise=0.01, real=False),
}


@lru_cache(maxsize=8)
def _stored(sensor: Sensor) -> dict[str, Array]:
    """Return the arrays of a sensor's photometry, from its own file or from the package's."""
    if sensor.arrays:
        return read_arrays(sensor.arrays)
    prefix = f"{sensor.name}."
    file = files("anytouch_jax.sim.sensing") / "photometry.npz"
    with file.open("rb") as stream, np.load(stream) as pack:
        names = [name for name in pack.files if name.startswith(prefix)]
        return {name.removeprefix(prefix): np.asarray(pack[name]) for name in names}


@lru_cache(maxsize=16)
def bases(sensor: Sensor) -> Array:
    """Return untouched images (units, h, w, 3) f32 in 0..1 of the whole field.

    They are black for a field sensor.
    """
    if sensor.kind == "field":
        return np.zeros((1, 30, 30, 3), np.float32)
    stored = _stored(sensor)
    if "bases" in stored:
        bases_of = stored["bases"]
    else:
        # of real units; the core knows these, because it checks cameras by them
        bases_of = np.stack(known_backgrounds(sensor.name))
    if bases_of.dtype == np.uint8:
        return bases_of.astype(np.float32) / 255
    return bases_of


def look(sensor: Sensor) -> Photometry:
    """Return the photometry of a camera sensor. Raises UserError for a field sensor."""
    if sensor.kind != "image":
        raise UserError(f"{sensor.name} has no camera: use optics.measure_field")
    stored = _stored(sensor)
    return Photometry(stored["normal"], stored["halo"], float(stored["steepest"]), stored["widest"])


class Unit(NamedTuple):
    """How a device differs from others of its family.

    The f32 arrays are those of one unit, or of several units stacked. `rotation` and `offset` move
    the *object* before contact (`gel_to_object`). `mirror`, `zoom` and `window` move the *image*:
    they choose the visible part of the gel and its side. Only the renderer uses them.
    """

    base: Leaf  # (h, w, 3) untouched gel of the whole field, 0..1
    tint: Leaf  # (3,) factor on the image
    gain: Leaf  # (3,) factor on the colour change
    light_angle: Leaf  # rad by which the lights are rotated
    lights: Leaf  # (4,) shift and stretch along u and v of the place that the lights see
    uneven: Leaf  # (5, 3) relative brightness on u, v, u^2, uv, v^2
    focus: Leaf  # mm, blur of the lens
    # (SPECKS, 6): place (u, v), radius mm, fraction of each colour that dirt or wear absorbs
    specks: Leaf
    # (2,) standard deviation (0 to 255) and seed of the fixed pattern of a camera and a gel
    grain: Leaf
    thickness: Leaf  # factor on the gel's thickness
    modulus: Leaf  # factor on the gel's modulus
    marked: Leaf  # 1 with markers, 0 without
    marker_pitch: Leaf  # factor on the markers' pitch
    marker_phase: Leaf  # (2,) of a lattice step
    marker_size: Leaf  # factor on the markers' radius
    zoom: Leaf  # fraction of the field in the image, at most 1
    window: Leaf  # (2,) mm (x, y), middle of that part
    mirror: Leaf  # (2,) +-1 along x and y
    rotation: Leaf  # rad of the object
    offset: Leaf  # (2,) mm of the object
    noise: Leaf  # standard deviation of a pixel (0 to 255), or of a field's displacement in mm
    quality: Leaf  # of the JPEG files, 0 to 100


def _unit(**values: Any) -> Unit:
    """Return a unit of these values as float32: jax arrays if one of them is, else numpy's."""
    is_jax = any(isinstance(value, jax.Array) for value in values.values())
    xp = jnp if is_jax else np
    return Unit(**{name: xp.asarray(value, xp.float32) for name, value in values.items()})


def identity_unit(sensor: Sensor) -> Unit:
    """Return the nominal unit of a sensor: no markers, no noise, the whole field, nothing moved."""
    return _unit(
        base=bases(sensor)[0],
        tint=np.ones(3),
        gain=np.ones(3),
        light_angle=0,
        lights=[0, 0, 1, 1],
        uneven=np.zeros((5, 3)),
        focus=0,
        # A radius of 1 and nothing absorbed: a speck of radius 0 would divide by zero.
        specks=np.zeros((SPECKS, 6)) + np.eye(6)[2],
        grain=np.zeros(2),
        thickness=1,
        modulus=1,
        marked=0,
        marker_pitch=1,
        marker_phase=np.zeros(2),
        marker_size=1,
        zoom=1,
        window=np.zeros(2),
        mirror=np.ones(2),
        rotation=0,
        offset=np.zeros(2),
        noise=0,
        quality=95,
    )


# of the nominal thickness: more than four standard deviations below it, see `draw_unit`
THINNEST = 0.7
SPECKS = 6
MOST_BASES = 16  # untouched gels of a sensor; so many weights are drawn for each


def draw_unit(
    sensor: Sensor, rng: Rng, real: Leaf | None = None, of: jax.Array | None = None
) -> Unit:
    """Draw a unit of a sensor.

    "Measured" is on real images scaled to 128 pixels: GelSight Mini with dots (8 gels, 39
    recordings) and without (3 units), DIGIT (3 units), 9DTact (3 units).

    All sensors draw equally often and in the order below, so that they can share a stream of
    random numbers, and a seed keeps its units.

    Args:
        sensor: The family, whose numbers may be traced.
        rng: A numpy generator, or `Draws` inside a compiled program.
        real: Untouched gels (n, h, w, 3) in 0..1 that replace those of `bases`, or those of F
            sensors (F, n, h, w, 3).
        of: The number of the sensor among the F.
    """
    xp = namespace_of(rng)
    spread = sensor.spread
    marked_fraction = sensor.markers.fraction if sensor.markers else 0.0
    # Measured: the dots of the 8 gels are 0.131 or 0.183 short sides apart, which is 1.85 mm at a
    # zoom of 1 or 0.72.
    zoom = 1 + spread * (rng.uniform(0.68, 1.0) - 1)
    room = (1 - zoom) / 2 * xp.asarray(sensor.field[::-1])
    # measured: 0 to 4 specks or scratches a gel
    dirt = rng.uniform(size=SPECKS) < rng.uniform(0, 0.6)
    base = _draw_base(bases(sensor) if real is None else real, rng, of)
    # Measured: means differ by 9 %, colours by 5 %.
    tint = xp.exp(spread * (rng.normal(0, 0.09) + rng.normal(0, 0.05, 3)))
    gain = sensor.contrast * xp.exp(spread * (rng.normal(0, 0.25) + rng.normal(0, 0.15, 3)))
    light_angle = spread * rng.normal(0, np.deg2rad(10))
    light_shift = spread * rng.normal(0, 0.1, 2)
    light_stretch = 1 + spread * (rng.uniform(0.8, 1.05, 2) - 1)
    uneven = spread * rng.normal(0, 0.08, (5, 3))  # on top of the measured ones in `base`
    focus = rng.uniform(0.02, 0.15)
    specks = _draw_specks(dirt, rng)
    # Measured: 0.5 to 2.5 levels of fine structure in an untouched image.
    grain = [xp.exp(rng.uniform(math.log(0.3), math.log(2))), rng.integers(2**24)]
    return _unit(
        base=base,
        tint=tint,
        gain=gain,
        light_angle=light_angle,
        lights=xp.concatenate([light_shift, light_stretch]),
        uneven=uneven,
        focus=focus,
        specks=specks,
        grain=grain,
        thickness=xp.exp(rng.normal(0, 0.08)),
        modulus=xp.exp(rng.normal(0, 0.15)),
        marked=rng.uniform() < marked_fraction,
        marker_pitch=1 + spread * (rng.uniform(0.92, 1.08) - 1),
        marker_phase=rng.uniform(0, 1, 2),
        marker_size=1 + spread * (rng.uniform(0.8, 1.25) - 1),  # measured: radii of 0.30 to 0.44 mm
        zoom=zoom,
        window=rng.uniform(-1, 1, 2) * room,
        mirror=xp.where((rng.uniform(size=2) < np.array([0.5, 0.0])) & (spread >= 1), -1, 1),
        rotation=rng.normal(0, np.deg2rad(8)),
        offset=rng.normal(0, 0.4, 2),
        # Measured: 10 to 90 % of the recordings have 0.2 to 1.7.
        noise=sensor.noise * xp.exp(spread * rng.normal(0, 0.5)),
        quality=rng.integers(70, 97),
    )


def _draw_specks(dirt: Leaf, rng: Rng) -> Leaf:
    """Draw specks (SPECKS, 6) as in `Unit`; those that are not `dirt` (SPECKS,) absorb nothing."""
    xp = namespace_of(rng)
    place = rng.uniform(-1, 1, (SPECKS, 2))
    radius = xp.exp(rng.uniform(math.log(0.06), math.log(0.9), (SPECKS, 1)))
    grey = rng.normal(0.06, 0.12, (SPECKS, 1))
    colour = rng.normal(0, 0.03, (SPECKS, 3))
    specks: Leaf = xp.concatenate([place, radius, dirt[:, None] * (grey + colour)], 1)
    return specks


def _draw_base(real: Leaf, rng: Rng, of: jax.Array | None) -> Leaf:
    """Draw an untouched gel: a mix of the `real` ones (n, h, w, 3) without the black ones, with
    blotches.
    """
    xp = namespace_of(rng)
    count, height, width, _ = real.shape[-4:]
    drawn = rng.gamma(0.3, size=MOST_BASES)[:count] + 1e-9
    weights = (drawn if of is None else drawn[None]) * (real.max((-3, -2, -1)) > 0)
    if of is not None:
        weights = weights * (xp.arange(len(real)) == of)[:, None]
    blotches = rng.normal(0, rng.uniform(0, 0.03), (40, 40))[:height, :width, None]
    mixed = xp.tensordot(weights / xp.maximum(weights.sum(), 1e-9), real, weights.ndim)
    base: Leaf = xp.clip(mixed * (1 + blotches), 0, 1)
    return base


def draw_drift(frames: int, rng: Rng) -> Leaf:
    """Draw the relative change of light (frames, 3, 3) since the background image.

    The middle axis is the part that is equal everywhere, along u and along v; the last one is the
    colour. Measured on 42 recordings: deviations from the background of 1 to 2 % in each colour and
    1 % across the image, and of 0.2 % from frame to frame. A tenth of the recordings drift four
    times as much, as when the exposure settles.
    """
    xp = namespace_of(rng)
    often = xp.where(rng.uniform() < 0.1, 4.0, 1.0)
    since = rng.normal(0, 0.012, (3, 3)) + np.array([[1.0], [0.0], [0.0]]) * rng.normal(0, 0.012)
    steps = rng.normal(0, 0.002, (frames, 3, 3)) + rng.normal(0, 0.0015, (1, 3, 3))
    drift: Leaf = (often * (since[None] + xp.cumsum(steps, 0))).astype(xp.float32)
    return drift


def rotated(x: jax.Array, y: jax.Array, angle: Any) -> tuple[jax.Array, jax.Array]:
    """Return vectors rotated by `angle` rad, from x towards y."""
    c = jnp.cos(angle)
    s = jnp.sin(angle)
    return c * x - s * y, s * x + c * y


def gel_to_object(unit: Unit, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the places mm on the nominally mounted object under the gel's places `x`, `y` mm."""
    return rotated(x - unit.offset[0], y - unit.offset[1], -unit.rotation)


def unit_gel(sensor: Sensor, unit: Unit) -> Gel:
    """Return the gel of a sensor unit."""
    gel = sensor.gel
    return replace(
        gel, modulus=gel.modulus * unit.modulus, thickness=gel.thickness * unit.thickness
    )
