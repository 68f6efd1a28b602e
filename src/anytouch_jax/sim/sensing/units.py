"""Sensor units: the differences between two devices of one family, as arrays that vmap over recordings.

`rotation` and `offset` move the *object* before contact (`gel_to_object`). `mirror`, `zoom` and `window` move the
*image*: they choose the visible part of the gel and its side. Only the renderer uses them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.sim.contact.mechanics import Gel
from anytouch_jax.sim.sensing.sensors import Sensor, bases

Tree = TypeVar("Tree")
Leaf = Any  # numpy, or jax under vmap and jit


class Unit(NamedTuple):
    """Arrays f32 of one unit, or of several units stacked."""

    base: Leaf  # (h, w, 3) untouched gel of the whole field, 0..1
    tint: Leaf  # (3,) factor on the image
    gain: Leaf  # (3,) factor on the colour change
    light_angle: Leaf  # rad by which the lights are rotated
    lights: Leaf  # (4,) shift and stretch along u and v of the place that the lights see
    uneven: Leaf  # (5, 3) relative brightness on u, v, u^2, uv, v^2
    focus: Leaf  # mm, blur of the lens
    specks: Leaf  # (SPECKS, 6): place (u, v), radius mm, share of each colour that dirt or wear absorbs
    grain: Leaf  # (2,) standard deviation (0 to 255) and seed of the fixed pattern of a camera and a gel
    thickness: Leaf  # factor on the gel's thickness
    modulus: Leaf  # factor on the gel's modulus
    marked: Leaf  # 1 with markers, 0 without
    marker_pitch: Leaf  # factor on the markers' pitch
    marker_phase: Leaf  # (2,) of a lattice step
    marker_size: Leaf  # factor on the markers' radius
    zoom: Leaf  # share of the field in the image, at most 1
    window: Leaf  # (2,) mm (x, y), middle of that part
    mirror: Leaf  # (2,) +-1 along x and y
    rotation: Leaf  # rad of the object
    offset: Leaf  # (2,) mm of the object
    noise: Leaf  # standard deviation of a pixel (0 to 255), or of a field's displacement in mm
    quality: Leaf  # of the JPEG files, 0 to 100


def _unit(**values: object) -> Unit:
    return Unit(**{name: np.asarray(value, np.float32) for name, value in values.items()})


def identity_unit(sensor: Sensor) -> Unit:
    """Return the nominal unit of a sensor: no markers, no noise, the whole field, nothing moved."""
    return _unit(
        base=bases(sensor)[0], tint=np.ones(3), gain=np.ones(3), light_angle=0, lights=[0, 0, 1, 1],
        uneven=np.zeros((5, 3)), focus=0, specks=np.zeros((SPECKS, 6)) + np.eye(6)[2], grain=np.zeros(2),
        thickness=1, modulus=1, marked=0, marker_pitch=1, marker_phase=np.zeros(2), marker_size=1, zoom=1,
        window=np.zeros(2), mirror=np.ones(2), rotation=0, offset=np.zeros(2), noise=0, quality=95,
    )  # fmt: skip


THINNEST = 0.7  # of the nominal thickness: more than four standard deviations below it, see `draw_unit`
SPECKS = 6
MOST_BASES = 16  # untouched gels of a sensor; so many weights are drawn for each


def draw_unit(sensor: Sensor, rng: np.random.Generator) -> Unit:
    """Return a unit of `sensor` drawn from `rng`.

    "Measured" is on real pictures scaled to 128 pixels: GelSight Mini with dots (8 gels, 39 recordings) and without (3
    units), DIGIT (3 units), 9DTact (3 units). The number of draws does not depend on the sensor, so several sensors can
    share a stream.
    """
    share = sensor.markers.share if sensor.markers else 0.0
    # Measured: the dots of the 8 gels are 0.131 or 0.183 short sides apart, which is 1.85 mm at a zoom of 1 or 0.72.
    zoom = rng.uniform(0.68, 1.0)
    room = (1 - zoom) / 2 * np.asarray(sensor.field[::-1])
    dirt = rng.uniform(size=SPECKS) < rng.uniform(0, 0.6)  # measured: 0 to 4 specks or scratches a gel
    return _unit(
        base=_draw_base(sensor, rng),
        tint=np.exp(rng.normal(0, 0.09) + rng.normal(0, 0.05, 3)),  # measured: means differ by 9 %, colours by 5 %
        gain=sensor.contrast * np.exp(rng.normal(0, 0.25) + rng.normal(0, 0.15, 3)),
        light_angle=rng.normal(0, np.deg2rad(10)),
        lights=np.concatenate([rng.normal(0, 0.1, 2), rng.uniform(0.8, 1.05, 2)]),
        uneven=rng.normal(0, 0.08, (5, 3)),  # on top of the measured ones in `base`
        focus=rng.uniform(0.02, 0.15),
        specks=np.concatenate([
            rng.uniform(-1, 1, (SPECKS, 2)), np.exp(rng.uniform(math.log(0.06), math.log(0.9), (SPECKS, 1))),
            dirt[:, None] * (rng.normal(0.06, 0.12, (SPECKS, 1)) + rng.normal(0, 0.03, (SPECKS, 3)))], 1),
        # Measured: 0.5 to 2.5 levels of fine structure in an untouched picture.
        grain=[np.exp(rng.uniform(math.log(0.3), math.log(2))), rng.integers(2**24)],
        thickness=np.exp(rng.normal(0, 0.08)),
        modulus=np.exp(rng.normal(0, 0.15)),
        marked=rng.uniform() < share,
        marker_pitch=rng.uniform(0.92, 1.08),
        marker_phase=rng.uniform(0, 1, 2),
        marker_size=rng.uniform(0.8, 1.25),  # measured: radii of 0.30 to 0.44 mm
        zoom=zoom,
        window=rng.uniform(-1, 1, 2) * room,
        mirror=np.where(rng.uniform(size=2) < np.array([0.5, 0.0]), -1, 1),
        rotation=rng.normal(0, np.deg2rad(8)),
        offset=rng.normal(0, 0.4, 2),
        noise=sensor.noise * np.exp(rng.normal(0, 0.5)),  # measured: 10 to 90 % of the recordings have 0.2 to 1.7
        quality=rng.integers(70, 97),
    )  # fmt: skip


def _draw_base(sensor: Sensor, rng: np.random.Generator) -> np.ndarray:
    """Return an untouched gel: mostly one of the real ones, mixed with others, with faint blotches."""
    real = bases(sensor)
    weights = rng.gamma(0.3, size=MOST_BASES)[: len(real)] + 1e-9
    blotches = rng.normal(0, rng.uniform(0, 0.03), (40, 40))[: real.shape[1], : real.shape[2], None]
    return np.clip(np.tensordot(weights / weights.sum(), real, 1) * (1 + blotches), 0, 1)


def draw_drift(frames: int, rng: np.random.Generator) -> np.ndarray:
    """Return the relative change of light (frames, 3, 3) since the background image: at 1, u and v, for each colour.

    Measured on 42 recordings: deviations from the background of 1 to 2 % in each colour and 1 % across the image, and
    of 0.2 % from frame to frame. A tenth of the recordings drift four times as much, as when the exposure settles.
    """
    often = 4.0 if rng.uniform() < 0.1 else 1.0
    since = rng.normal(0, 0.012, (3, 3)) + np.array([1.0, 0.0, 0.0])[:, None] * rng.normal(0, 0.012)
    steps = rng.normal(0, 0.002, (frames, 3, 3)) + rng.normal(0, 0.0015, (3, 3))
    return (often * (since + np.cumsum(steps, 0))).astype(np.float32)


def rotated(x: jax.Array, y: jax.Array, angle: Any) -> tuple[jax.Array, jax.Array]:
    """Return vectors rotated by `angle` rad, from x towards y."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return c * x - s * y, s * x + c * y


def gel_to_object(unit: Unit, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the places mm on the nominally mounted object under the gel's places `x`, `y` mm."""
    return rotated(x - unit.offset[0], y - unit.offset[1], -unit.rotation)


def unit_gel(sensor: Sensor, unit: Unit) -> Gel:
    """Return the gel of a sensor unit."""
    gel = sensor.gel
    return replace(gel, modulus=gel.modulus * unit.modulus, thickness=gel.thickness * unit.thickness)


def stack_trees(trees: Sequence[Tree]) -> Tree:
    """Stack units, or records with units, along a new leading axis for vmap."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)
