"""In a rendered image the dots move with the skin: right for shear along +x, down for +y."""

from functools import partial

import cv2
import jax
import numpy as np
import pytest

from anytouch_jax.sim.sensing import optics, sensors
from anytouch_jax.sim.sensing.sensors import SENSORS

MINI = SENSORS["gelsight_mini"]
SIZE = (96, 128)
GRID = (24, 32)
PITCH = MINI.field[0] / GRID[0]
PIXEL = MINI.field[0] / SIZE[0]  # mm
MARKED = sensors.identity_unit(MINI)._replace(marked=np.float32(1))
FLAT = np.zeros(GRID, np.float32)


@pytest.fixture(scope="module")
def draw():
    return jax.jit(partial(optics.render, pitch=PITCH, sensor=MINI, resolution=SIZE))


def ink(draw, shear, unit):
    """Return how much darker f64 (h, w) the image is by its dots."""
    tangential = np.broadcast_to(np.float32(shear), (*GRID, 2))
    images = [
        draw(FLAT, tangential, unit=one) for one in (unit, unit._replace(marked=np.float32(0)))
    ]
    dotted, plain = (np.asarray(image, np.float64).sum(-1) for image in images)
    return plain - dotted


@pytest.mark.parametrize("mirror", [(1, 1), (-1, 1), (1, -1)])
@pytest.mark.parametrize("shear", [(0.4, 0.0), (0.0, 0.4), (-0.3, 0.5)])
def test_dots_move_the_way_of_the_shear(draw, shear, mirror):
    """They move by its length too. A mirrored image shows the mirrored motion."""
    unit = MARKED._replace(mirror=np.array(mirror, np.float32))
    rest, moved = ink(draw, (0, 0), unit), ink(draw, shear, unit)
    assert rest.max() > 30
    window = cv2.createHanningWindow(SIZE[::-1], cv2.CV_64F)
    (across, down), _ = cv2.phaseCorrelate(rest, moved, window)
    shown = np.array([across, down]) * PIXEL
    np.testing.assert_allclose(shown, np.array(shear) * mirror, atol=0.05)
