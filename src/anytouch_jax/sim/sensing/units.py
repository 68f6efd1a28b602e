"""One unit of a sensor: what differs between two devices of the same family, as arrays that vmap over recordings.

`rotation` and `offset` move the *object*: `from_gel` turns places on the gel into places of the object's frame, before
contact. `mirror`, `zoom` and `window` move the *picture*: they choose
which part of the gel the camera shows and from which side, and only the renderer knows them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.sim.contact.mechanics import Gel
from anytouch_jax.sim.sensing.sensors import Sensor

Tree = TypeVar("Tree")
Leaf = Any  # numpy as drawn, jax under vmap and jit


class Unit(NamedTuple):
    """Arrays f32 of one unit (or, stacked, of several); the identity unit leaves a sensor as its record says.

    `tint` (3,) factor on the image; `gain` (3,) factor on the colour change; `light_angle` rad by which the lights
    are turned; `uneven` (5, 3) relative brightness on u, v, u^2, uv, v^2; `thickness`, `modulus` factors of the gel;
    `marked` 1 with markers, 0 without; `marker_phase` (2,) of a lattice step; `marker_size` factor; `zoom` (<= 1)
    share of the field that is shown, `window` (2,) its middle, mm (x, y); `mirror` (2,) +-1 along x and y;
    `rotation` rad and `offset` (2,) mm of the object; `noise` standard deviation of a pixel, 0..255, or of a
    field's displacement, mm.
    """

    tint: Leaf
    gain: Leaf
    light_angle: Leaf
    uneven: Leaf
    thickness: Leaf
    modulus: Leaf
    marked: Leaf
    marker_phase: Leaf
    marker_size: Leaf
    zoom: Leaf
    window: Leaf
    mirror: Leaf
    rotation: Leaf
    offset: Leaf
    noise: Leaf


def _unit(**values: object) -> Unit:
    return Unit(**{name: np.asarray(value, np.float32) for name, value in values.items()})


def identity_unit(sensor: Sensor) -> Unit:
    """The unit that the sensor's record describes: no markers, no noise, the whole field, nothing moved."""
    return _unit(
        tint=np.ones(3), gain=np.ones(3), light_angle=0, uneven=np.zeros((5, 3)), thickness=1, modulus=1,
        marked=0, marker_phase=np.zeros(2), marker_size=1, zoom=1, window=np.zeros(2), mirror=np.ones(2),
        rotation=0, offset=np.zeros(2), noise=0,
    )  # fmt: skip


THINNEST = 0.7  # of the nominal gel: more than four standard deviations below, see `draw_unit`


def draw_unit(sensor: Sensor, rng: np.random.Generator) -> Unit:
    """A unit of `sensor` drawn from `rng`; the same generator state gives the same unit.

    The number of draws does not depend on the sensor, so one stream can serve several.
    """
    share = sensor.markers.share if sensor.markers else 0.0
    zoom = rng.uniform(0.8, 1.0)
    room = (1 - zoom) / 2 * np.asarray(sensor.field[::-1])
    return _unit(
        tint=np.exp(rng.normal(0, 0.06) + rng.normal(0, 0.05, 3)),
        gain=np.exp(rng.normal(0, 0.12) + rng.normal(0, 0.12, 3)),
        light_angle=rng.normal(0, np.deg2rad(7)),
        uneven=rng.normal(0, 0.06, (5, 3)),
        thickness=np.exp(rng.normal(0, 0.08)),
        modulus=np.exp(rng.normal(0, 0.15)),
        marked=rng.uniform() < share,
        marker_phase=rng.uniform(0, 1, 2),
        marker_size=rng.uniform(0.8, 1.2),
        zoom=zoom,
        window=rng.uniform(-1, 1, 2) * room,
        mirror=np.where(rng.uniform(size=2) < np.array([0.5, 0.0]), -1, 1),
        rotation=rng.normal(0, np.deg2rad(8)),
        offset=rng.normal(0, 0.4, 2),
        noise=sensor.noise * np.exp(rng.normal(0, 0.3)),
    )


def turned(x: jax.Array, y: jax.Array, angle: Any) -> tuple[jax.Array, jax.Array]:
    """Vectors turned by `angle` rad, from x towards y."""
    c, s = jnp.cos(angle), jnp.sin(angle)
    return c * x - s * y, s * x + c * y


def from_gel(unit: Unit, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Where on the nominally mounted object the gel's places `x`, `y` (mm) lie: moved and turned back."""
    return turned(x - unit.offset[0], y - unit.offset[1], -unit.rotation)


def gel_of(sensor: Sensor, unit: Unit) -> Gel:
    """The gel of a sensor's unit."""
    gel = sensor.gel
    return replace(gel, modulus=gel.modulus * unit.modulus, thickness=gel.thickness * unit.thickness)


def stack(several: Sequence[Tree]) -> Tree:
    """Several units, or records that hold one, as one, with a leading axis for vmap."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *several)
