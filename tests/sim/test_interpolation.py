import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.sim.interpolation import sample
from anytouch_jax.sim.recorder import ball, simulate_touch
from anytouch_jax.sim.world.objects import catalogue
from anytouch_jax.sim.world.shapes import height, relief

SAMPLE = jax.jit(sample)


@pytest.mark.parametrize("thing", catalogue(3, 64)[::6], ids=lambda thing: thing.name)
def test_a_raster_of_a_tenth_of_a_millimetre_holds_the_surface(thing):
    """What is read between the pixels is the analytic surface to 4 micrometres (RMS) where a gel
    can touch it.
    """
    shape = thing.shape
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-6, 6, (2, 50, 50)).astype(np.float32)
    if shape.primitive in ("edge", "corner"):
        x = x - 3
        y = y - 3
    z = height(shape, x, y)
    read = np.asarray(SAMPLE(relief(shape, 200, 0.1), 0.1, x, y))
    near = z > -1.0
    assert near.mean() > 0.02
    assert np.sqrt(np.mean((read - z)[near] ** 2)) < 0.004


def test_sample_gives_the_pixels_back():
    raster = np.random.default_rng(0).standard_normal((20, 31)).astype(np.float32)
    x, y = np.meshgrid((np.arange(31) - 15) * 0.13, (np.arange(20) - 9.5) * 0.13)
    np.testing.assert_allclose(
        SAMPLE(raster, 0.13, x.astype(np.float32), y.astype(np.float32)), raster, atol=2e-4
    )
    # Moved by whole pixels: the rest of the raster, and its lowest border outside.
    moved = SAMPLE(
        raster, 0.13, (x + 3 * 0.13).astype(np.float32), (y - 2 * 0.13).astype(np.float32)
    )
    np.testing.assert_allclose(moved[2:, :-3], raster[:-2, 3:], atol=2e-4)
    border = min(raster[0].min(), raster[-1].min(), raster[:, 0].min(), raster[:, -1].min())
    assert np.all(np.asarray(moved)[:2] == border) and np.all(np.asarray(moved)[:, -3:] == border)


def test_sample_is_exact_on_parabolas():
    """A Catmull-Rom spline reproduces polynomials of the second degree; a bilinear one has
    facets.
    """
    x, y = np.meshgrid(*[np.arange(-15, 16) * 0.1] * 2)
    surface = lambda x, y: 0.3 * x * x - 0.2 * x * y + 0.1 * y * y + 0.4 * x - 0.7  # noqa: E731
    at = np.random.default_rng(1).uniform(-1.2, 1.2, (2, 200)).astype(np.float32)
    np.testing.assert_allclose(
        SAMPLE(surface(x, y).astype(np.float32), 0.1, *at),
        surface(*at.astype(np.float64)),
        atol=2e-6,
    )


def test_sample_batches_and_survives_odd_places():
    rasters = np.random.default_rng(3).standard_normal((2, 9, 9)).astype(np.float32)
    x = np.array([[np.nan, 0.0, 99.0], [np.inf, 0.3, -np.inf]], np.float32)
    y = np.array([[0.0, 0.0, 0.0], [0.0, -0.2, 0.0]], np.float32)
    got = np.asarray(jax.jit(jax.vmap(sample, (0, None, 0, 0)))(rasters, 0.5, x, y))
    for raster, row, a, b in zip(rasters, got, x, y, strict=True):
        border = min(raster[0].min(), raster[-1].min(), raster[:, 0].min(), raster[:, -1].min())
        assert row[0] == row[2] == border
        np.testing.assert_allclose(row, SAMPLE(raster, 0.5, a, b), atol=1e-6)
    assert got[0, 1] == rasters[0, 4, 4]


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
    assert column[2] < column[0], (
        "the place 1 mm to the right of the ball's top lies under the middle of the gel"
    )


def test_a_drag_shears_along_it_and_a_turn_twists(press):
    out = press(np.array([[0, 0, 0, 0.6]] * 2, np.float32), jnp.array([[0.5, 0, 0], [0, 0, 0.2]]))
    touched = np.asarray(out.pressure[0]) > 1
    assert np.asarray(out.shear[0])[touched][:, 0].mean() > 0.1 and out.force[0, 0] > 0.1
    assert abs(out.torque[1]) > 5 * abs(out.torque[0])


def test_the_gradient_is_that_of_finite_differences(press):
    def total(pose):
        return jnp.sum(simulate_touch(ball(8.0), pose[None], "digit", size=48).depth) / 1000

    pose = jnp.array([0.3, -0.2, 0.1, 0.5])
    value = jax.jit(total)
    slope = np.asarray(jax.jit(jax.grad(total))(pose))
    assert np.all(np.isfinite(slope)) and slope[3] > 0
    step = 0.02
    measured = (value(pose.at[3].add(step)) - value(pose.at[3].add(-step))) / (2 * step)
    np.testing.assert_allclose(slope[3], measured, rtol=0.1)


def test_mistakes_get_a_sentence():
    with pytest.raises(UserError, match="tac3d has no camera"):
        simulate_touch(ball(6.0), [[0, 0, 0, 0.5]], "tac3d")
    with pytest.raises(UserError, match="a pose"):
        simulate_touch(ball(6.0), [[0, 0, 0]], "digit")
