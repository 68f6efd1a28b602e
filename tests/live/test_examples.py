"""The built-in recording."""

import numpy as np
import pytest

from anytouch_jax.data.background.contact import THRESHOLDS
from anytouch_jax.data.background.estimate import UntouchedBackground
from anytouch_jax.live.examples import SENSOR, ExampleCamera


@pytest.mark.parametrize("turn", [0, 1])
def test_two_things_press_in_turn_and_nothing_between(turn):
    """Contact and its end are found, and no frame repeats the one before."""
    camera = ExampleCamera()
    begin = 5.5 * turn
    gel = UntouchedBackground(camera.frame(0.0))
    scores = [gel.score(camera.frame(begin + at)) for at in (0.2, 1.0, 2.0, 3.5, 5.0, 5.49)]
    is_pressed = [score > THRESHOLDS[SENSOR] for score in scores]
    assert is_pressed == [False, False, True, True, True, False]
    assert not np.array_equal(camera.frame(2.0), camera.frame(2.04))


def test_it_is_read_like_a_camera():
    camera = ExampleCamera()
    assert camera.grab()
    whole, pixels = camera.retrieve()
    assert whole and pixels.dtype == np.uint8
    # BGR, as OpenCV gives it
    np.testing.assert_array_equal(pixels[..., ::-1], camera.frame(1 / 25))
