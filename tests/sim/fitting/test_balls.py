"""Places of a ball in images of a device whose lights nobody knows."""

import numpy as np
from ball_presses import DIAMETER, POSES, WIDTH, presses

from anytouch_jax.sim.fitting.balls import depth_of, place_balls, slope_of, usual_strength
from anytouch_jax.sim.fitting.fit import colour_changes


def test_places_and_contacts_are_found_without_knowing_the_lights():
    made = presses()
    change, clear = colour_changes(list(made.frames), made.background, None)
    found = place_balls(change, clear, WIDTH, DIAMETER)
    away = np.hypot(*(found.poses - POSES)[:, :2].T)
    assert away.max() < 0.15
    assert np.abs(found.poses[:, 2] / POSES[:, 2] - 1).max() < 0.12
    assert found.explained > 0.9
    # the root mean square over colours and directions of the lights that were drawn
    assert (
        abs(
            found.strength
            / (0.21 * np.sqrt((1.2**2 + 0.3**2 + 0.9**2 + 0.2**2 + 1.1**2 + 0.8**2) / 6))
            - 1
        )
        < 0.2
    )


def test_a_larger_ball_has_stronger_colours_for_the_same_images():
    made = presses()
    change, clear = colour_changes(list(made.frames), made.background, None)
    strength = [place_balls(change, clear, WIDTH, size).strength for size in (6.0, 12.0)]
    assert strength[1] > 1.4 * strength[0]


def test_depth_is_the_integral_of_the_slope_and_inside_it_is_the_ball():
    away = np.linspace(0, 20, 4000)
    slope = slope_of(away, 1.5, 3.0)
    depth = depth_of(away, 1.5, 3.0)
    steps = (slope[1:] + slope[:-1]) / 2 * (away[1] - away[0])
    np.testing.assert_allclose(depth[0] - depth, np.append(0, np.cumsum(steps)), atol=5e-3)
    inside = away < 1.5
    ball = np.sqrt(9 - away[inside] ** 2)
    np.testing.assert_allclose(depth[0] - depth[inside], ball[0] - ball, atol=1e-9)


def test_a_gel_that_darkens_by_depth_has_no_strength():
    assert usual_strength("9dtact") is None and usual_strength("mine") is None
    assert 0.1 < usual_strength("gelsight") < 0.6
