import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import Literal

from anytouch_jax.errors import UserError
from anytouch_jax.sim.interpolation import sample, sample_sharp
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
    # Three touches as above, and so the same program; the last one stays still.
    drags = jnp.array([[0.5, 0, 0], [0, 0, 0.2], [0, 0, 0]])
    out = press(np.array([[0, 0, 0, 0.6]] * 3, np.float32), drags)
    touched = np.asarray(out.pressure[0]) > 1
    assert np.asarray(out.shear[0])[touched][:, 0].mean() > 0.1 and out.force[0, 0] > 0.1
    assert abs(out.torque[1]) > 5 * abs(out.torque[0])


def total(pose, height_map):
    return jnp.sum(simulate_touch(height_map, pose[None], "digit", size=48).depth) / 1000


# One program for both.
TOTAL_AND_SLOPE = jax.jit(jax.value_and_grad(total))


def test_the_gradient_is_that_of_finite_differences():
    pose = jnp.array([0.3, -0.2, 0.1, 0.5])
    slope = np.asarray(TOTAL_AND_SLOPE(pose, ball(8.0))[1])
    assert np.all(np.isfinite(slope)) and slope[3] > 0
    step = 0.02
    deeper, lighter = (TOTAL_AND_SLOPE(pose.at[3].add(by), ball(8.0))[0] for by in (step, -step))
    np.testing.assert_allclose(slope[3], (deeper - lighter) / (2 * step), rtol=0.1)


def punched(height, hole=False):
    """A disc of 6 mm that stands out of a plate of 14 mm by `height` mm, or a hole of its size."""
    y, x = (np.mgrid[:141, :141] - 70) * 0.1
    disc = np.hypot(x, y) < 3
    return np.where(disc != hole, height, 0.0).astype(np.float32)


@pytest.fixture(scope="module")
def press_map():
    press = jax.jit(lambda height_map, poses: simulate_touch(height_map, poses, "digit", size=64))
    usual = np.array([[0.0, 0, 0.3, 0.3], [0.6, -0.3, 0.0, 0.15]], np.float32)
    return lambda height_map, poses=usual: jax.device_get(
        press(np.asarray(height_map, np.float32), np.asarray(poses, np.float32))
    )


@pytest.mark.parametrize("height", [0.7, 2.0, 20.0, np.inf])
@pytest.mark.parametrize("hole", [False, True])
def test_what_the_gel_never_reaches_does_not_matter(press_map, height, hole):
    """A cliff is as good as another one, and as a hole: the face of a punch is pressed whole."""
    usual = press_map(punched(1.0, hole))
    other = punched(height, hole)
    if np.isinf(height):
        other = np.where(other > 0, 0.0, np.nan)
    touch = press_map(other)
    np.testing.assert_allclose(touch.force[:, 2], usual.force[:, 2], rtol=0.01)
    np.testing.assert_allclose(touch.depth, usual.depth, atol=0.005)
    rows, columns = touch.depth.shape[1:]
    middle = touch.depth[:, rows // 2, columns // 2]
    depths = np.array([0.3, 0.15])
    if hole:
        assert np.all(middle < 0.02), "the gel bulges into a hole"
    else:
        np.testing.assert_allclose(middle, depths, rtol=0.1)
    # The highest place of the dent is where the object is, and not a ridge at the cliff.
    np.testing.assert_allclose(touch.depth.max((1, 2)), depths, rtol=0.15)


def test_beyond_a_map_there_is_nothing(press_map):
    usual = press_map(punched(1.0))
    close = punched(1.0)[40:101, 40:101]  # the punch ends where the map does
    for height_map in (close, np.pad(close, 40, constant_values=np.nan)):
        touch = press_map(height_map)
        np.testing.assert_allclose(touch.force, usual.force, atol=0.01 * usual.force.max())
        np.testing.assert_allclose(touch.depth, usual.depth, atol=0.005)


def test_a_place_outside_of_the_map_or_in_a_hole_touches_nothing(press_map):
    edge = np.where(np.arange(141) < 2, 0.0, np.nan)[None].repeat(141, 0)
    for poses in (
        [[60.0, 0, 0, 0.3], [0, -1e9, 0, 0.3]],
        [[np.nan, 0, 0, 0.3], [6.0, 0, 0, 0.3]],  # the last one is over a hole wider than the gel
    ):
        touch = press_map(edge, poses)
        for name in ("depth", "shear", "pressure", "force", "torque"):
            np.testing.assert_array_equal(getattr(touch, name), 0.0, err_msg=name)
        np.testing.assert_array_equal(touch.image, touch.background)
    assert press_map(edge, [[-7.0, 0, 0, 0.3]] * 2).force[0, 2] > 0
    _, slope = TOTAL_AND_SLOPE(jnp.array([60.0, 0, 0, 0.3]), ball(8.0))
    np.testing.assert_array_equal(slope, 0.0)


def test_sharp_look_ups_never_leave_what_is_around_and_keep_smooth_surfaces():
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-0.8, 0.8, (2, 4000)).astype(np.float32)
    # terraces of any height, in any direction
    terraces = rng.integers(0, 3, (17, 17)).repeat(2, 0).repeat(2, 1).astype(np.float32)
    read = np.asarray(jax.jit(sample_sharp)(terraces, 0.1, x, y))
    row, column = (np.floor(a / 0.1 + 16.5).astype(int) for a in (y, x))
    around = np.stack([terraces[row + i, column + j] for i in (0, 1) for j in (0, 1)])
    room = 0.1 / 8 + 1e-6  # of a gentle bend: an eighth of a pixel, and not of a cliff
    assert np.all(read >= around.min(0) - room) and np.all(read <= around.max(0) + room)
    assert np.abs(read - np.clip(read, around.min(0), around.max(0))).mean() < 1e-4
    assert np.mean(around.min(0) == around.max(0)) > 0.2
    u, v = np.meshgrid(*[np.arange(-16, 17) * 0.1] * 2)
    surface = lambda x, y: 0.3 * x * x - 0.2 * x * y + 0.1 * y * y + 0.4 * x - 0.7  # noqa: E731
    smooth = surface(u, v).astype(np.float32)
    exact = surface(x.astype(np.float64), y)
    np.testing.assert_allclose(jax.jit(sample_sharp)(smooth, 0.1, x, y), exact, atol=2e-6)


def test_mistakes_get_a_sentence():
    for wrong in (np.full((9, 9), np.nan), np.where(np.eye(9) > 0, np.inf, 0.0)):
        with pytest.raises(UserError, match="at least one height"):
            simulate_touch(wrong, [[0, 0, 0, 0.5]], "digit")
    with pytest.raises(UserError, match="tac3d has no camera"):
        simulate_touch(ball(6.0), [[0, 0, 0, 0.5]], "tac3d")
    with pytest.raises(UserError, match="a pose"):
        simulate_touch(ball(6.0), [[0, 0, 0]], "digit")


@pytest.mark.parametrize("fidelity", ["fast", "exact"])
def test_xla_is_given_no_large_products_of_constants(fidelity):
    """Such products are computed while XLA compiles, slowly and with alarms on the terminal.

    The matrices that enlarge a coarse grid are small. Those of the gel and of the image took 14
    million multiplications.
    """

    def press(height_map, pose):
        return simulate_touch(height_map, pose, "gelsight_mini", fidelity=fidelity)

    program = jax.make_jaxpr(press)(ball(6.0), jnp.zeros((1, 4)))
    assert sum(constant_products(program.jaxpr)) < 500_000


def constant_products(jaxpr, known=frozenset()):
    """Multiplications of the products in a program whose inputs are all constants."""
    constants = {*jaxpr.constvars, *known}
    found = []
    for equation in jaxpr.eqns:
        is_known = [isinstance(one, Literal) or one in constants for one in equation.invars]
        is_loop = equation.primitive.name in ("scan", "while")
        for inner in inner_programs(equation.params):
            passed = [] if is_loop else zip(inner.invars, is_known, strict=True)
            found += constant_products(inner, {one for one, sure in passed if sure})
        if all(is_known) and equation.primitive.name != "optimization_barrier":
            constants.update(equation.outvars)
            if equation.primitive.name == "dot_general":
                (summed, _), _ = equation.params["dimension_numbers"]
                length = math.prod(equation.invars[0].aval.shape[axis] for axis in summed)
                found.append(length * equation.outvars[0].aval.size)
    return found


def inner_programs(params):
    for value in params.values():
        for one in value if isinstance(value, tuple) else (value,):
            program = getattr(one, "jaxpr", one)
            if hasattr(program, "eqns"):
                yield program
