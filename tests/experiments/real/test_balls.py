import numpy as np
import pytest

from experiments.real import balls

MM, BALL = 0.06, 3.0
PRESS = balls.Press("one", np.zeros((120, 160, 3), np.uint8), BALL, 85.3, 62.6, 30.0)


def cap() -> np.ndarray:
    """The depth (h, w) in mm of a ball, 0 outside of its contact."""
    return np.nan_to_num(balls.true_depth(PRESS, MM))


def test_a_perfect_depth_has_no_error_and_a_wrong_one_has_its_own():
    exact = balls.error_of(cap() + 0.2, PRESS, MM)  # where the gel rests is not known
    assert exact.radius == pytest.approx(0, abs=0.01) and exact.centre == pytest.approx(0, abs=0.02)
    assert exact.profile < 0.02 and exact.true_centre == pytest.approx(3 - np.sqrt(9 - 1.8**2), abs=2e-3)
    steep = balls.error_of(1.3 * cap(), PRESS, MM)
    assert steep.centre == pytest.approx(0.3 * exact.true_centre, rel=0.25) and steep.radius < -0.1


@pytest.mark.parametrize("radii", [(20, 48), None])
def test_the_circle_of_a_press_is_found(radii):
    x, y, r = balls.distance(PRESS)
    colours = np.stack([x, y, -x], -1) / PRESS.radius * 40 if radii else np.full((120, 160, 3), 40.0)
    change = colours * (r < PRESS.radius)[..., None] + np.random.default_rng(0).normal(0, 1, (120, 160, 3))
    found = balls.find_circle(np.asarray(change, np.float32), radii)
    assert np.abs(np.array(found) - (PRESS.x, PRESS.y, PRESS.radius)).max() < (2 if radii else 4)
