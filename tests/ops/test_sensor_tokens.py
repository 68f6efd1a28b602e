"""The draw of universal sensor tokens."""

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.ops.tokens import draw_tokens, universal_probability


def test_probability_grows_linearly():
    assert [float(universal_probability(jnp.asarray(t), 0.0, 0.75)) for t in (0.0, 0.5, 1.0)] == [0.0, 0.375, 0.75]


def test_draw_replaces_the_right_share_and_nothing_at_zero():
    sensor = jnp.arange(20000) % 5
    uniform = jax.random.uniform(jax.random.key(0), sensor.shape)
    np.testing.assert_array_equal(draw_tokens(sensor, uniform, jnp.asarray(0.0), 9), sensor)
    assert (draw_tokens(sensor, uniform, jnp.asarray(1.0), 9) == 9).all()
    drawn = draw_tokens(sensor, uniform, jnp.asarray(0.75), 9)
    assert abs(float((drawn == 9).mean()) - 0.75) < 0.01
    kept = np.asarray(drawn) != 9
    np.testing.assert_array_equal(np.asarray(drawn)[kept], np.asarray(sensor)[kept])
