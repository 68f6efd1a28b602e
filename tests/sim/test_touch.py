import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.sim.touch import ball, simulate_touch


@pytest.fixture(scope="module")
def press():
    return jax.jit(lambda pose, drag: simulate_touch(ball(8.0), pose, "digit", drag=drag, size=48))


def test_a_ball_dents_the_gel_where_it_is_pressed(press):
    poses = np.array([[0, 0, 0, 0.6], [0, 0, 0, 0.2], [1.0, 0, 0, 0.6]], np.float32)
    out = press(poses, jnp.zeros((3, 3)))
    assert out.image.shape == (3, 64, 48, 3) and out.image.dtype == np.uint8
    deepest = np.asarray(out.depth).max((1, 2))
    assert abs(deepest[0] - 0.6) < 0.05 and abs(deepest[1] - 0.2) < 0.05
    force = np.asarray(out.force)
    assert force[0, 2] > 2 * force[1, 2] > 0 and np.abs(force[:, :2]).max() < 0.05 * force[0, 2]
    column = np.asarray(out.depth).sum(1).argmax(1)
    assert column[2] < column[0], "the place 1 mm to the right of the ball's top lies under the middle of the gel"


def test_a_drag_shears_along_it_and_a_turn_twists(press):
    out = press(np.array([[0, 0, 0, 0.6]] * 2, np.float32), jnp.array([[0.5, 0, 0], [0, 0, 0.2]]))
    touched = np.asarray(out.pressure[0]) > 1
    assert np.asarray(out.shear[0])[touched][:, 0].mean() > 0.1 and out.force[0, 0] > 0.1
    assert abs(out.torque[1]) > 5 * abs(out.torque[0])


def test_the_gradient_is_that_of_finite_differences(press):
    def total(pose):
        return jnp.sum(simulate_touch(ball(8.0), pose[None], "digit", size=48).depth) / 1000

    pose = jnp.array([0.3, -0.2, 0.1, 0.5])
    value, slope = jax.jit(total), np.asarray(jax.jit(jax.grad(total))(pose))
    assert np.all(np.isfinite(slope)) and slope[3] > 0
    step = 0.02
    measured = (value(pose.at[3].add(step)) - value(pose.at[3].add(-step))) / (2 * step)
    np.testing.assert_allclose(slope[3], measured, rtol=0.1)


def test_mistakes_get_a_sentence():
    with pytest.raises(UserError, match="no simulated camera sensor 'tac3d'"):
        simulate_touch(ball(6.0), [[0, 0, 0, 0.5]], "tac3d")
    with pytest.raises(UserError, match="a pose"):
        simulate_touch(ball(6.0), [[0, 0, 0]], "digit")
