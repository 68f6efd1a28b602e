import dataclasses
import math

import cv2
import numpy as np
import pytest

from anytouch_jax.sim.sensing.photo import EXTENT, photograph
from anytouch_jax.sim.world.objects import catalogue, draw_object

BALL = draw_object("sphere", "smooth", "plastic", 5)
BALL = dataclasses.replace(BALL, shape=dataclasses.replace(BALL.shape, size=8.0))


def middle(mask):
    rows, columns = np.nonzero(mask)
    return np.array([columns.mean(), rows.mean()]) / mask.shape[0] - 0.5


@pytest.mark.parametrize("thing", catalogue(2, 27)[::3], ids=lambda thing: thing.name)
def test_a_photograph_is_a_image_that_is_neither_black_nor_burnt(thing):
    # touches lie within 3 mm of the middle
    for place in ((-2.0, 2.0), (2.1, -2.1)):
        image = photograph(thing, place, np.random.default_rng(3), 64)
        assert image.shape == (64, 64, 3) and image.dtype == np.uint8
        assert 15 < image.mean() < 235 and image.std() > 4
        assert (image.min(-1) > 252).mean() < 0.15 and (image.max(-1) < 4).mean() < 0.15


@pytest.mark.parametrize("seed", range(3))
def test_the_place_is_in_the_middle_and_the_scale_is_right(seed):
    things = (
        dataclasses.replace(BALL, colour=colour) for colour in ((0.8, 0.1, 0.1), (0.1, 0.1, 0.8))
    )
    red, blue = (
        photograph(thing, (0.0, 0.0), np.random.default_rng(seed), 96).astype(int)
        for thing in things
    )
    # the object is what changes with its paint alone
    mask = np.abs(red - blue).max(-1) > 25
    # The top of the ball is in the middle; from aside, its body leans away by at most its radius
    # times the tilt.
    assert np.hypot(*middle(mask)) < 8 * math.sin(math.radians(38)) / EXTENT[0]
    assert mask[44:52, 44:52].all()
    fraction = mask.mean()
    assert 0.8 * math.pi * 64 / EXTENT[1] ** 2 < fraction < 1.25 * math.pi * 64 / EXTENT[0] ** 2


def fineness(image):
    grey = image.astype(np.float32).mean(-1)
    return (grey - cv2.GaussianBlur(grey, (0, 0), 3))[40:-40, 40:-40].std()


@pytest.mark.parametrize("texture", ["ridges", "weave", "sand"])
def test_textures_can_be_seen(texture):
    plain, structured = (
        dataclasses.replace(thing, shape=dataclasses.replace(thing.shape, size=60.0))
        for thing in (draw_object("flat", t, "plastic", 4) for t in ("smooth", texture))
    )
    for seed in range(3):
        received = [
            fineness(photograph(t, (0.0, 0.0), np.random.default_rng(seed), 160))
            for t in (plain, structured)
        ]
        assert received[1] > 1.6 * received[0]
