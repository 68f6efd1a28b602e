"""Sensor tokens: the random draw between a sensor's own and the universal ones (Sec. 3.5, Eq. 7)."""

from __future__ import annotations

import jax.numpy as jnp
from jax import Array


def universal_probability(progress: Array, start: float, end: float) -> Array:
    """Return p_u, which grows linearly from `start` to `end` with `progress` in [0, 1] (appendix: 0 to 0.75)."""
    return start + (end - start) * progress


def draw_tokens(sensor: Array, uniform: Array, probability: Array, universal_row: int) -> Array:
    """Replace a sensor's row by the universal one where `uniform` < p_u: i ~ Bernoulli(p_u) (Eq. 7).

    `sensor` i32 (B,), `uniform` (B,) in [0, 1). Returns rows i32 (B,) of the sensor-token table.
    """
    return jnp.where(uniform < probability, universal_row, sensor)
