"""The held cylinder's touch: loads and the skin's motion against the full contact model, and frames of it."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.sim.contact import mechanics, shear
from anytouch_jax.sim.sensing.sensors import unit_gel
from experiments.pouring import physics, render
from experiments.pouring.physics import Load, Task

pytestmark = pytest.mark.slow

SIDE = 56


def drawn(seed: int, **changes) -> physics.Setup:
    setup = physics.draw_setup(Task(), np.random.default_rng(seed))
    setup = setup._replace(unit=setup.unit._replace(rotation=np.float32(0)))
    return setup._replace(**{name: np.asarray(value, np.float32) for name, value in changes.items()})


@pytest.fixture(scope="module")
def setup() -> physics.Setup:
    return drawn(0, grip=7.0, friction=0.7, yaw=0.0)


@pytest.fixture(scope="module")
def held(setup):
    render.prepare()
    return jax.jit(partial(render.hold, side=SIDE))(setup)


skin = jax.jit(render.skin)
picture = jax.jit(partial(render.picture, side=SIDE))


def load(x: float = 0.0, y: float = 0.0, twist: float = 0.0, normal: float = 7.0) -> Load:
    return Load(jnp.array([x, y]), jnp.asarray(twist), jnp.asarray(normal))


def test_the_grip_presses_with_its_force(held, setup):
    grasp, contact = held
    np.testing.assert_allclose(np.asarray(grasp.forces), 7.0 * np.array(render.LEVELS), rtol=0.03)
    assert (np.diff(np.asarray(grasp.forces)) > 0).all()
    x, y = mechanics.positions((render.ROWS, render.COLUMNS), render.PITCH)
    pressure = np.asarray(contact.pressure)
    across, along = (np.sqrt((pressure * np.asarray(a) ** 2).sum() / pressure.sum()) for a in (x, y))
    assert along > 1.3 * across  # a strip down the cylinder's axis


def test_a_unit_load_moves_the_skin_as_the_full_model_does(held, setup):
    """Sticking, by the weighted sum; and with a slipping rim, whose extra motion is Mindlin's."""
    grasp, contact = held
    gel, pitch = unit_gel(render.SENSOR, setup.unit), render.PITCH
    centre = mechanics.centroid(contact.pressure, pitch)
    step = jax.jit(partial(shear.shear_step, None, contact, gel=gel, pitch=pitch, centre=centre, iterations=300))
    for friction, motion in ((1e4, (0.0, 0.2, 0.0)), (0.7, (0.05, 0.25, 0.02)), (0.25, (0.0, 0.3, 0.0))):
        full = step(motion=jnp.asarray(motion), friction=friction)
        acting = Load(full.force, full.twist_torque, contact.force)
        _, moved = skin(grasp, setup._replace(friction=np.float32(friction)), acting)
        under = np.asarray(contact.pressure) > 0.2 * float(contact.pressure.max())
        off = np.linalg.norm(np.asarray(moved - full.displacement)[under], axis=-1).mean()
        size = np.linalg.norm(np.asarray(full.displacement)[under], axis=-1).mean()
        assert off < (0.02 if friction > 1e3 else 0.12) * size, (friction, off / size)


def test_shear_grows_with_the_load_and_full_slip_ends_it(held, setup):
    grasp, _ = held
    size = [float(jnp.abs(skin(grasp, setup, load(y=y))[1]).max()) for y in (0.2, 0.4, 0.8, 4.9, 50.0)]
    assert size[1] / size[0] == pytest.approx(2, rel=0.05) and size[2] / size[1] == pytest.approx(2, rel=0.1)
    assert size[4] == pytest.approx(size[3], rel=0.05) and np.isfinite(size).all()


def test_a_harder_press_dents_more_and_between_levels_it_is_continuous(held, setup):
    grasp, _ = held
    dents = [float(skin(grasp, setup, load(normal=n))[0].max()) for n in (6.0, 6.64, 6.66, 7.0, 7.5)]
    assert (np.diff(dents) > 0).all() and dents[2] - dents[1] < 0.1 * (dents[4] - dents[0])


def test_the_load_turns_with_the_mounting(held, setup):
    grasp, _ = held
    turned = setup._replace(unit=setup.unit._replace(rotation=np.float32(np.pi / 2)))
    np.testing.assert_allclose(
        skin(grasp, turned, load(x=0.5))[1], skin(grasp, setup, load(y=0.5))[1], atol=1e-6
    )  # the grasp itself is the same one


def test_markers_show_the_load_and_a_bare_gel_does_not(held, setup):
    grasp, _ = held
    frames = {}
    for marked in (0, 1):
        unit = setup.unit._replace(marked=np.float32(marked), noise=np.float32(0))
        frames[marked] = [
            np.asarray(picture(grasp, setup._replace(unit=unit), load(y=y), None)).astype(int) for y in (0.0, 0.4, 0.8)
        ]
    change = {marked: [np.abs(f - some[0]).mean() for f in some] for marked, some in frames.items()}
    assert change[1][2] > 1.3 * change[1][1] > 0.5
    assert change[0][2] < 0.05 * change[1][2]
    assert frames[1][0].shape == (SIDE, SIDE, 3) and 30 < frames[1][0].mean() < 220


def test_noise_is_the_keys(held, setup):
    grasp, _ = held
    one, two, again = (np.asarray(picture(grasp, setup, load(y=0.5), jax.random.key(k))).astype(int) for k in (0, 1, 0))
    np.testing.assert_array_equal(one, again)
    assert 0.05 < np.abs(one - two).mean() < 4


def test_a_twist_slips_where_friction_on_the_disc_ends_it(held, setup):
    """Full slip of a disc under even pressure: a torque of 2/3 mu P a."""
    grasp, _ = held
    limit = 2 / 3 * 0.7 * 7.0 * float(jnp.interp(7.0, grasp.forces, jnp.full(len(grasp.forces), grasp.radius)))
    size = [float(jnp.abs(skin(grasp, setup, load(twist=share * limit))[1]).max()) for share in (0.9, 1.0, 1.5)]
    assert size[0] < 0.95 * size[1] and size[2] == pytest.approx(size[1], rel=1e-3)
