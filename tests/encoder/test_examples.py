import numpy as np

import anytouch_jax as at
from anytouch_jax.config import SENSORS


def test_each_press_is_felt_by_each_sensor_and_differs_from_the_untouched_gel():
    touches = at.example_touches()
    presses, sensors = ({getattr(touch, name) for touch in touches} for name in ("press", "sensor"))
    assert len(touches) == len(presses) * len(sensors) == 6 and sensors <= set(SENSORS)
    for touch in touches:
        assert touch.frame.shape == touch.background.shape and touch.frame.dtype == np.uint8
        difference = np.abs(touch.frame.astype(int) - touch.background)
        assert np.percentile(difference, 98) > 15  # the press is visible
