import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.pouring import physics
from experiments.pouring.physics import POUR, WAIT, Task

TASK = Task()
GRAVITY = 9.81


def setup_of(seed: int = 0, **changes) -> physics.Setup:
    drawn = physics.draw_setup(TASK, np.random.default_rng(seed))
    return drawn._replace(**{name: np.asarray(value, np.float32) for name, value in changes.items()})


@partial(jax.jit, static_argnames=("task",))
def play(setup: physics.Setup, actions: jax.Array, seed: int, task: Task = TASK) -> physics.State:
    """The states after each action."""

    def step(state: physics.State, action: jax.Array) -> tuple[physics.State, physics.State]:
        state = physics.advance(state, action, setup, task)
        return state, state

    return jax.lax.scan(step, physics.begin(setup, task, jax.random.key(seed)), actions)[1]


def actions_of(*parts: tuple[int, int], length: int = 300) -> jax.Array:
    """(action, times) one after the other, then waiting."""
    result = np.concatenate([np.full(times, action) for action, times in parts])
    return jnp.asarray(np.concatenate([result, np.full(length - len(result), WAIT)]), jnp.int32)


still = jax.jit(partial(physics.load, task=TASK, shocks=False))


def at(setup: physics.Setup, tilt: float = 0.0, mass: float = 100.0, slope: float = 0.0) -> physics.State:
    state = physics.begin(setup, TASK, jax.random.key(0))
    changes = {"tilt": tilt, "mass": mass, "slope": slope}
    state = state._replace(steps=jnp.asarray(physics.STAND))
    return state._replace(**{name: jnp.asarray(value, jnp.float32) for name, value in changes.items()})


# The flow.


def test_beads_only_leave_and_come_in_whole():
    setup = setup_of(1)
    states = play(setup, actions_of((POUR, 300)), 0)
    mass = np.asarray(states.mass, np.float64)
    out = -np.diff(np.concatenate([[TASK.beads], mass]))
    assert (out >= 0).all() and (mass >= 0).all()
    assert mass[-1] < 10  # it was tilted far
    np.testing.assert_allclose(np.asarray(states.rate), out * TASK.rate, atol=1e-3)
    np.testing.assert_allclose(np.sum(np.asarray(states.rate)) / TASK.rate + mass[-1], TASK.beads, atol=0.01)
    one = physics.GLASS * math.pi / 6 * float(setup.bead) ** 3
    beads = out / one
    whole = np.abs(beads - beads.round()) < 0.02
    assert whole.mean() > 0.9  # the last step of an avalanche may end it within a bead


@pytest.mark.parametrize("seed", range(4))
def test_nothing_flows_below_the_angle_of_repose(seed):
    setup = setup_of(seed, tilt=0.0)
    steps = int(np.rad2deg(setup.repose) / TASK.step)
    states = play(setup, actions_of((POUR, steps)), seed)
    assert float(states.tilt[-1]) == pytest.approx(math.radians(steps * TASK.step), abs=1e-4)
    assert (np.asarray(states.mass) == TASK.beads).all() and not np.asarray(states.flowing).any()


# The load.


@pytest.mark.parametrize("seed", range(3))
def test_two_fingers_balance_gravity_and_its_moment(seed):
    """Forces and moments by vectors: a finger stands at +R n, with the gel, and one at -R n; both bear f k and f e."""
    setup = setup_of(seed, share=0.5, relax=0.0)
    tilt, slope, mass = 0.8, 0.4, 70.0
    result = still(at(setup, tilt=tilt, mass=mass, slope=slope), setup)
    d, k = np.array([1.0, 0, 0]), np.array([0, 0, 1.0])
    t, m = np.cross(k, d), float(setup.mount)
    n, radius, total = math.cos(m) * t + math.sin(m) * d, float(setup.radius), mass + float(setup.empty)
    e = np.cross(n, k)
    across, up = (float(x) for x in physics.heap(jnp.asarray(mass), jnp.asarray(slope), setup))
    middle = mass * across * d + (mass * up + float(setup.empty) * float(setup.height) / 2) * k
    arm = middle / total - float(setup.grip_height) * k
    gravity = total * 1e-3 * GRAVITY * (math.sin(tilt) * d - math.cos(tilt) * k)
    moment = np.cross(arm, gravity)
    on_gel = float(result.shear[0]) * e - float(result.shear[1]) * k + (float(result.normal) - float(setup.grip)) * n
    on_other = gravity - on_gel
    np.testing.assert_allclose(on_gel @ n, gravity @ n / 2, atol=1e-4)
    held = np.cross(radius * n, on_gel) + np.cross(-radius * n, on_other) + 2 * float(result.twist) * n
    np.testing.assert_allclose(held @ n, moment @ n, rtol=1e-4)
    np.testing.assert_allclose(held @ e, moment @ e, rtol=1e-3)
    assert abs(moment @ n) > 0.5 and abs(moment @ e) > 0.5  # N mm
