"""Ink spots in the skin: dots or dashes on a lattice, carried along by the skin's tangential displacement."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from anytouch_jax.sim.sensing.sensors import Markers


def coverage(
    markers: Markers, x: jax.Array, y: jax.Array, phase: jax.Array, size: jax.Array, soft: jax.Array, half: float
) -> jax.Array:
    """Share of ink (H, W), 0..1, at places with *undeformed* coordinates `x`, `y` (H, W) mm.

    `phase` (2,) of a lattice step, `size` factor on the radius, `soft` mm width of a spot's rim, `half` mm half the
    field's diagonal (for the lens's bend). Spots differ a little in size, as printed ones do.
    """
    grow = 1.0 - markers.bend * (1.0 - (x**2 + y**2) / half**2) if markers.bend else 1.0
    column, row = x * grow / markers.pitch - phase[0], y * grow / markers.pitch - phase[1]
    i, j = jnp.floor(column + 0.5), jnp.floor(row + 0.5)
    dx, dy = (column - i) * (markers.pitch / markers.aspect), (row - j) * markers.pitch
    scatter = 0.754877 * i + 0.569840 * j  # of no visible order (plastic number), and cheaper than a sine
    radius = markers.radius * size * (0.88 + 0.24 * (scatter - jnp.floor(scatter)))
    distance = jnp.sqrt(dx**2 + dy**2 + 1e-12)
    return jnp.clip((radius - distance) / soft + 0.5, 0.0, 1.0)
