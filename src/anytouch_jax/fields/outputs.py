"""Typical sizes of the outputs of the decoder of fields, which are free of scale.

The outputs themselves are `batch.FieldOutput`, because the core passes them on.
"""

from __future__ import annotations

from anytouch_jax.batch import FieldOutput as FieldOutput

STATES = 3  # hidden states of the encoder that are read
HALF = 2  # pixels of the image for one of the fields, along each axis
# The last layer works with numbers of order one, and these bring them to the size of a usual touch.
LENGTH = 0.02
STRESS = 0.02
FORCE = 0.01
TORQUE = 0.002
# Over LENGTH: what the last layer says of a difference between neighbours. Errors of differences
# add up over the image, so its weights may only move slowly.
DIFFERENCE = 0.1
# What a border pixel in contact weighs in the level of the depth, over one without contact.
TOUCHED_BORDER = 0.02
