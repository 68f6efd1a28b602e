"""Layout of a sensor's picture: is it turned, mirrored, or are its colours exchanged?"""

from anytouch_jax.live.health import UnitFrames as UnitFrames
from anytouch_jax.live.health import check_layout as check_layout
from anytouch_jax.live.health import known_gels as known_gels
