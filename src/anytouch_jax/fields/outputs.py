"""Outputs of the decoder of fields, free of scale, and their typical sizes."""

from __future__ import annotations

from typing import NamedTuple

from jax import Array

STATES = 3  # hidden states of the encoder that are read
HALF = 2  # pixels of the picture for one of the fields, along each axis
# Typical sizes of the outputs, so that the last layer works with numbers of order one.
LENGTH = 0.02
STRESS = 0.02
FORCE = 0.01
TORQUE = 0.002


class FieldOutput(NamedTuple):
    """Fields (B, h, w) at half the picture's resolution.

    `*_log` are logarithms of Laplace deviations.

    `depth`, `shear` (..., 2) along x and y of the picture, `pressure` over the gel's modulus.
    `contact` are logits. `force` (B, 3): tangential x and y and normal, over modulus times width
    squared. `torque` (B,) over modulus times width cubed. `slip` (B,) logits of the share of the
    contact that slides.
    """

    depth: Array
    shear: Array
    contact: Array
    pressure: Array
    depth_log: Array
    shear_log: Array
    force: Array
    torque: Array
    slip: Array
    force_log: Array  # (B, 2): tangential, and of the logarithm of the normal force
    torque_log: Array
    slip_log: Array
