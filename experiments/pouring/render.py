"""The touch of a held cylinder: loads -> shear, twist and pressure of the gel -> frames of a
GelSight Mini.

A run's contact is solved once: the dent at a few forces, and the skin's motion for unit loads while
everything sticks. A frame then is a weighted sum and an image, so that any frame of a run can be
drawn alone. Mindlin's law adds what the slipping rim gives way. `sim.shear.shear_step` with its
history is what this is tested against.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from anytouch_jax.sim.contact import mechanics, shear
from anytouch_jax.sim.contact.mechanics import Gel, PressResult
from anytouch_jax.sim.sensing import optics
from anytouch_jax.sim.sensing.sensors import SENSORS, gel_to_object, look, unit_gel
from experiments.pouring.physics import Load, Setup

SENSOR = SENSORS["gelsight_mini"]
ROWS = 48
COLUMNS = 64
PITCH = min(SENSOR.field) / ROWS  # mm
DOME = 150.0  # mm, radius of the gel's slightly round face: the contact ends within it
LEVELS = (0.8, 0.95, 1.1)  # of the grip: the forces at which the dent is solved
STICKS = 1e4  # a coefficient of friction at which nothing slips


class Grasp(NamedTuple):
    """How the gel of one run answers: `dents` (L, h, w) mm at normal `forces` (L,) N; `moves` (3,
    h, w, 2) mm of the skin for 1 N along x, 1 N along y (in the gel's own frame) and 1 N mm of
    twist; `radius` mm of the contact for a twist's fraction of the friction; `behind` (3, H, W),
    the untouched image.
    """

    dents: Array
    forces: Array
    moves: Array
    radius: Array
    behind: Array


def surface(setup: Setup) -> Array:
    """Heights (ROWS, COLUMNS) mm of the cylinder over the round gel, 0 where it is met first."""
    x, y = mechanics.positions((ROWS, COLUMNS), PITCH)
    u, v = gel_to_object(setup.unit, x, y)
    u = u - setup.place[0]
    v = v - setup.place[1]
    c = jnp.cos(setup.yaw)
    s = jnp.sin(setup.yaw)
    across = jnp.clip(c * u + s * v, -0.99 * setup.radius, 0.99 * setup.radius)
    z = (
        jnp.sqrt(setup.radius**2 - across**2)
        - setup.radius
        + setup.lean * v
        - (x**2 + y**2) / (2 * DOME)
    )
    return z - jnp.max(z)


def hold(setup: Setup, side: int) -> tuple[Grasp, PressResult]:
    """The gel's answers in one run, for images of `side` pixels, and the contact under the
    grip.
    """
    gel = unit_gel(SENSOR, setup.unit)
    z = surface(setup)
    press = jax.vmap(
        partial(mechanics.press, gel=gel, pitch=PITCH, iterations=40), in_axes=(None, 0)
    )
    depths = jnp.geomspace(0.05, 2.0, 8)
    tried = press(z, depths).force
    wanted = setup.grip * jnp.asarray(LEVELS)
    result = press(z, jnp.exp(jnp.interp(jnp.log(wanted), jnp.log(tried), jnp.log(depths))))
    middle = jax.tree.map(lambda x: x[1], result)
    area = mechanics.area(middle.pressure, PITCH)
    moves = unit_moves(middle, gel)
    shape = optics.image_size(SENSOR, side)
    behind = optics.backdrop(SENSOR, setup.unit, shape)
    return Grasp(result.displacement, result.force, moves, jnp.sqrt(area / jnp.pi), behind), middle


def unit_moves(contact: PressResult, gel: Gel) -> Array:
    """The skin's displacement (3, h, w, 2) mm for 1 N along x, 1 N along y, 1 N mm about the centre
    of pressure.
    """
    centre = mechanics.centroid(contact.pressure, PITCH)
    motions = jnp.diag(jnp.array([0.1, 0.1, 0.02]))

    def moved(motion: Array) -> tuple[Array, Array]:
        done = shear.shear_step(
            None, contact, motion, gel, PITCH, STICKS, centre=centre, iterations=120
        )
        return done.displacement, jnp.append(done.force, done.twist_torque)

    fields, loads = jax.vmap(moved)(motions)
    return jnp.tensordot(jnp.linalg.inv(loads), fields, 1)


def skin(grasp: Grasp, setup: Setup, load: Load) -> tuple[Array, Array]:
    """The gel under a load: dent (h, w) mm and tangential displacement (h, w, 2) mm of the skin.

    The slipping rim lets go further than sticking would by Mindlin's (1949) factor, 3/2 (1 - (1 -
    q)^(2/3)) / q at the fraction q of the friction limit, which full slip ends.
    """
    place = jnp.interp(load.normal, grasp.forces, jnp.arange(len(LEVELS), dtype=jnp.float32))
    weights = jnp.maximum(1 - jnp.abs(place - jnp.arange(len(LEVELS))), 0)
    # of the cylinder's own directions on the gel
    turned = setup.unit.rotation + setup.yaw
    c = jnp.cos(turned)
    s = jnp.sin(turned)
    x, y = load.shear
    acting = jnp.stack([c * x - s * y, s * x + c * y, load.twist])
    drawn = jnp.sqrt(x**2 + y**2 + (load.twist / (2 / 3 * grasp.radius)) ** 2 + 1e-12)
    q = jnp.clip(drawn / (setup.friction * load.normal), 1e-3, 1.0)
    given = 1.5 * (1 - (1 - q) ** (2 / 3)) / q
    held = jnp.minimum(1.0, setup.friction * load.normal / drawn)
    return jnp.tensordot(weights, grasp.dents, 1), jnp.tensordot(
        given * held * acting, grasp.moves, 1
    )


def image(grasp: Grasp, setup: Setup, load: Load, key: Array | None, side: int) -> Array:
    """The frame u8 (side, side, 3) of the whole field, squeezed to a square as the encoder's own
    transform does.
    """
    shape = optics.image_size(SENSOR, side)
    dent, moved = skin(grasp, setup, load)
    image = optics.render(
        dent, moved, PITCH, SENSOR, setup.unit, key, resolution=shape, behind=grasp.behind
    )
    small = jax.image.resize(image.astype(jnp.float32), (side, side, 3), "linear")
    return jnp.round(small).astype(jnp.uint8)


def prepare() -> None:
    """Fit the sensor's colours to real presses once, outside of any compiled program (a few
    seconds).
    """
    look(SENSOR)
