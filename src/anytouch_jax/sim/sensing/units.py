"""Sensor units: the differences between two devices of one family, as arrays that vmap over recordings.

`rotation` and `offset` move the *object* before contact (`gel_to_object`). `mirror`, `zoom` and `window` move the
*image*: they choose the visible part of the gel and its side. Only the renderer uses them.
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
Leaf = Any  # numpy, or jax under vmap and jit


class Unit(NamedTuple):
    """Arrays f32 of one unit, or of several units stacked."""

    tint: Leaf  # (3,) factor on the image
    gain: Leaf  # (3,) factor on the colour change
    light_angle: Leaf  # rad by which the lights are rotated
    uneven: Leaf  # (5, 3) relative brightness on u, v, u^2, uv, v^2
    thickness: Leaf  # factor on the gel's thickness
    modulus: Leaf  # factor on the gel's modulus
    marked: Leaf  # 1 with markers, 0 without
    marker_phase: Leaf  # (2,) of a lattice step
    marker_size: Leaf  # factor on the markers' radius
    zoom: Leaf  # share of the field in the image, at most 1
    window: Leaf  # (2,) mm (x, y), middle of that part
    mirror: Leaf  # (2,) +-1 along x and y
    rotation: Leaf  # rad of the object
    offset: Leaf  # (2,) mm of the object
    noise: Leaf  # standard deviation of a pixel (0 to 255), or of a field's displacement in mm


def _unit(**values: object) -> Unit:
    return Unit(**{name: np.asarray(value, np.float32) for name, value in values.items()})


def identity_unit(sensor: Sensor) -> Unit:
    """Return the nominal unit of a sensor: no markers, no noise, the whole field, nothing moved."""
    return _unit(
        tint=np.ones(3), gain=np.ones(3), light_angle=0, uneven=np.zeros((5, 3)), thickness=1, modulus=1,
        marked=0, marker_phase=np.zeros(2), marker_size=1, zoom=1, window=np.zeros(2), mirror=np.ones(2),
        rotation=0, offset=np.zeros(2), noise=0,
    )  # fmt: skip


THINNEST = 0.7  # of the nominal thickness: more than four standard deviations below it, see `draw_unit`


def draw_unit(sensor: Sensor, rng: np.random.Generator) -> Unit:
    """Return a unit of `sensor` drawn from `rng`.

    The number of draws does not depend on the sensor, so several sensors can share a stream.
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
