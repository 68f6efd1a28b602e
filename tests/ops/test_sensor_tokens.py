"""The draw of universal sensor tokens."""

import jax
import numpy as np

from anytouch_jax.ops.tokens import draw_tokens, universal_probability


def test_probability_grows_linearly():
    assert [universal_probability(t, 0.0, 0.75) for t in (0.0, 0.5, 1.0)] == [0.0, 0.375, 0.75]


def test_draw_replaces_the_right_share_and_nothing_at_zero():
    sensor, uniform = np.arange(20000) % 5, np.random.default_rng(0).random(20000)
    draw = jax.jit(lambda probability: draw_tokens(sensor, uniform, probability, 9))
    np.testing.assert_array_equal(draw(0.0), sensor)
    assert (np.asarray(draw(1.0)) == 9).all()
    drawn = np.asarray(draw(0.75))
    assert abs((drawn == 9).mean() - 0.75) < 0.01
    np.testing.assert_array_equal(drawn[drawn != 9], sensor[drawn != 9])
