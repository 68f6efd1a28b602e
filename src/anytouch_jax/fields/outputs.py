"""Outputs of the decoder of fields, under the name that the decoder knows them by."""

from anytouch_jax.encoder.field_outputs import FORCE as FORCE
from anytouch_jax.encoder.field_outputs import HALF as HALF
from anytouch_jax.encoder.field_outputs import LENGTH as LENGTH
from anytouch_jax.encoder.field_outputs import STATES as STATES
from anytouch_jax.encoder.field_outputs import STRESS as STRESS
from anytouch_jax.encoder.field_outputs import TORQUE as TORQUE
from anytouch_jax.encoder.field_outputs import FieldOutput as FieldOutput
