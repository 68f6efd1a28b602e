"""Motion of dots: known shifts come back with true deviations, also under a press."""

import cv2
import numpy as np
import pytest

from anytouch_jax.data.background.dots import DotFlow

SHAPE = (240, 320)
PITCH = 32
RADIUS = 5


def gel_with_dots(motion=lambda x, y: (0 * x, 0 * y), *, ink=30, dots=True, noise=0.0, press=0.0):
    """A gel u8 (240, 320, 3) whose dots have moved by `motion` pixels, under a press."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(np.float32)
    image = np.stack([110 + 0.2 * x, 130 - 0.1 * y, 140 - 0.1 * x], -1)
    away = np.hypot(x - 170, y - 120) / 40
    image += (
        press
        * np.exp(-(away**2))[..., None]
        * np.stack([(x - 170) / 40, (y - 120) / 40, (170 - x) / 40], -1)
    )
    for across in range(PITCH // 2, SHAPE[1], PITCH) if dots else ():
        for down in range(PITCH // 2, SHAPE[0], PITCH):
            dx, dy = motion(np.float32(across), np.float32(down))
            fraction = np.clip(RADIUS + 0.5 - np.hypot(x - across - dx, y - down - dy), 0, 1)[
                ..., None
            ]
            image = image + fraction * (ink - image)
    rng = np.random.default_rng(0)
    return np.clip(
        cv2.GaussianBlur(image, (0, 0), 0.7) + rng.normal(0, noise, image.shape), 0, 255
    ).astype(np.uint8)


def drag(x, y):
    """A drag to the right and up, which fades away from the middle."""
    fades = np.exp(-((x - 160) ** 2 + (y - 120) ** 2) / 120**2)
    return 9 * fades, -5 * fades


@pytest.mark.parametrize("ink", [30, 240])
@pytest.mark.parametrize("press", [0.0, 60.0])
def test_a_drag_of_dots_comes_back(ink, press):
    flow = DotFlow(gel_with_dots(ink=ink))
    shift, deviation = flow(gel_with_dots(drag, ink=ink, noise=1.0, press=press), 56, 56)
    y, x = (np.mgrid[:56, :56] + 0.5) * np.array([SHAPE[0], SHAPE[1]])[:, None, None] / 56
    off = np.abs(shift * SHAPE[1] - np.stack(drag(x, y), -1))
    middle = np.s_[8:-8, 8:-8]
    assert np.median(off[middle]) < 0.35 and off[middle].max() < 1.5, (
        np.median(off[middle]),
        off[middle].max(),
    )
    assert np.mean(off.mean(-1)[middle] < 3 * SHAPE[1] * deviation[middle]) > 0.9


def test_dots_that_stay_have_no_shear_under_a_press():
    shift, deviation = DotFlow(gel_with_dots())(gel_with_dots(noise=1.0, press=60.0), 40, 60)
    assert shift.shape == (40, 60, 2) and deviation.shape == (40, 60)
    assert SHAPE[1] * np.abs(shift).max() < 0.3 and SHAPE[1] * deviation.max() < 0.3


def test_a_gel_without_dots_has_no_flow():
    assert not DotFlow(gel_with_dots(dots=False)) and DotFlow(gel_with_dots())


def test_frames_of_another_size_show_the_same_shift():
    flow = DotFlow(gel_with_dots())
    moved = gel_with_dots(drag)
    wanted = flow(moved, 56, 56)[0]
    larger = cv2.resize(moved, (640, 480), interpolation=cv2.INTER_CUBIC)
    np.testing.assert_allclose(flow(larger, 56, 56)[0], wanted, atol=0.5 / 320)
