"""Outputs of the head of fields, free of scale, and their typical sizes.

They belong to the core, because the head makes them, the encoder passes them on, and exports have
them too. In `encoder.measured` they have become millimetres and newtons.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Generic, NamedTuple, TypeVar

if TYPE_CHECKING:
    import jax
    import numpy as np

A = TypeVar("A", bound="np.ndarray | jax.Array")

STATES = 3  # hidden states of the encoder that are read
HALF = 2  # pixels of the picture for one of the fields, along each axis
# The last layer works with numbers of order one, and these bring them to the size of a usual touch.
LENGTH = 0.02
STRESS = 0.02
FORCE = 0.01
TORQUE = 0.002


class FieldOutput(NamedTuple, Generic[A]):
    """Fields (B, h, w) at half the picture's resolution, each with its deviation.

    Attributes:
        depth: over the width of the picture.
        shear: (..., 2) along x and y of the picture, over its width.
        contact: logits.
        pressure: over the gel's modulus.
        depth_log: logarithms of Laplace deviations of the depth, over LENGTH.
        shear_log: those of the shear, over LENGTH.
        force: (B, 3), tangential x and y and normal, over modulus times width squared.
        torque: (B,), over modulus times width cubed.
        slip: (B,), logits of the fraction of the contact that slides.
        force_log: (B, 2), of the tangential force over FORCE, and of the logarithm of the normal
            force.
        torque_log: (B,), over TORQUE.
        slip_log: (B,).
    """

    depth: A
    shear: A
    contact: A
    pressure: A
    depth_log: A
    shear_log: A
    force: A
    torque: A
    slip: A
    force_log: A
    torque_log: A
    slip_log: A
