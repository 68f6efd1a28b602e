"""The head of fields as `doors.HEADS` names it."""

from anytouch_jax.fields.module import FieldDecoder
from anytouch_jax.fields.outputs import STATES
from anytouch_jax.nn.heads import Head

HEAD = Head(build=FieldDecoder, states=STATES)
