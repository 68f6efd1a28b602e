"""Pouring: the flow (mass, repose, chance) and the load on the gel, and the touch that comes of it."""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.errors import UserError
from experiments.pouring import physics
from experiments.pouring.physics import POUR, RETRACT, WAIT, Task

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
shaken = jax.jit(partial(physics.load, task=TASK, shocks=True))


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


@pytest.mark.parametrize("seed", range(4))
def test_a_cylinder_full_to_the_brim_flows_just_over_the_angle_of_repose(seed):
    """Nothing else holds the beads back: they break loose 0.4 to 2 degrees over it."""
    setup = setup_of(seed, tilt=0.0)
    brim = TASK.beads / float(setup.bulk) / (math.pi * float(setup.radius) ** 2)
    setup = setup._replace(height=np.float32(1.0005 * brim))  # slices are summed in float32
    states = play(setup, actions_of((POUR, 300)), seed)
    first = int(np.asarray(states.flowing).argmax())
    over = math.degrees(float(states.tilt[first] - setup.repose))
    assert 0.4 <= over <= 2 + TASK.step + 0.1
    assert (np.asarray(states.mass)[:first] == TASK.beads).all()


def test_a_waiting_cylinder_stops_flowing_and_a_tilted_one_goes_on():
    setup = setup_of(2)
    states = play(setup, actions_of((POUR, 130)), 0)
    out = TASK.beads - np.asarray(states.mass)
    assert out[130] > 5
    assert float(states.rate[-1]) == 0 and out[-1] - out[200] == 0
    assert float(play(setup, actions_of((POUR, 180)), 0).mass[-1]) < float(states.mass[-1]) - 5


def test_steeper_holds_less_and_the_rim_is_exact():
    setup = setup_of(0)
    slopes = jnp.deg2rad(jnp.array([-20.0, 0.0, 10.0, 30.0, 50.0, 70.0, 85.0]))
    held = np.asarray(jax.vmap(lambda s: physics.capacity(s, setup))(slopes))
    radius, height, bulk = (float(x) for x in (setup.radius, setup.height, setup.bulk))
    assert held[0] == held[1] == pytest.approx(bulk * math.pi * radius**2 * height, rel=1e-4)
    assert (np.diff(held[1:]) < 0).all()
    rim = math.tan(math.radians(10))  # a plane through the lip that does not cut the bottom
    assert held[2] == pytest.approx(bulk * math.pi * radius**2 * (height - radius * rim), rel=1e-4)
    steep = math.tan(math.radians(70))  # a hoof (ungula) over the bottom
    edge = radius - height / steep
    hoof = steep * (
        2 / 3 * (radius**2 - edge**2) ** 1.5
        - edge * (radius**2 * math.acos(edge / radius) - edge * math.sqrt(radius**2 - edge**2))
    )
    assert held[5] == pytest.approx(bulk * hoof, rel=0.02)


def test_the_slot_law_by_hand():
    setup = setup_of(0, radius=25.0, height=60.0, bead=2.0, bulk=1.5e-3)
    slope, depth = math.radians(40), 2.0  # mm over the slope of repose; 50 tan 40 = 42 mm: the bottom is covered
    excess = depth * 1.5e-3 * math.pi * 25**2 / math.cos(slope)
    sagitta = depth / math.sin(slope)
    chord = 2 * math.sqrt(sagitta * (50 - sagitta))
    expected = 1.03 * 1.5e-3 * math.sqrt(9810) * (chord - 2.8) * depth**1.5
    assert float(physics.slot_rate(jnp.asarray(excess), jnp.asarray(slope), setup)) == pytest.approx(expected, rel=1e-4)
    assert float(physics.slot_rate(jnp.asarray(-3.0), jnp.asarray(slope), setup)) == 0


def test_the_layer_lies_on_what_is_left():
    """Where half of the bottom is bare the same mass is a layer twice as deep."""
    setup = setup_of(0, radius=25.0, height=25 * math.tan(math.radians(60)), bead=2.0, bulk=1.5e-3)
    slope, depth = math.radians(60), 2.0  # the surface through the lip meets the bottom in its middle
    excess = depth * 1.5e-3 * math.pi * 25**2 / 2 / math.cos(slope)
    sagitta = depth / math.sin(slope)
    chord = 2 * math.sqrt(sagitta * (50 - sagitta))
    expected = 1.03 * 1.5e-3 * math.sqrt(9810) * (chord - 2.8) * depth**1.5
    # slices are 1/49 of half a turn wide: the middle one is in or out
    assert float(physics.slot_rate(jnp.asarray(excess), jnp.asarray(slope), setup)) == pytest.approx(expected, rel=0.1)


def test_chance_differs_and_a_seed_repeats_it():
    setup, actions = setup_of(3), actions_of((POUR, 150))
    a, b, c = (np.asarray(play(setup, actions, seed).mass) for seed in (0, 0, 1))
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).max() > 0.05


def test_runs_differ_and_do_not_depend_on_each_other():
    setups = [setup_of(seed) for seed in range(20)]
    for name in ("bead", "repose", "grip", "tilt", "empty", "friction", "yaw"):
        assert np.std([float(getattr(s, name)) for s in setups]) > 0
    assert np.std([float(s.unit.modulus) for s in setups]) > 0.05
    ends = [float(play(s, actions_of((POUR, 120)), 0).mass[-1]) for s in setups[:8]]
    assert np.std(ends) > 8  # g: a count of steps does not tell the mass
    assert all(float(physics.capacity(s.tilt - s.repose, s)) > TASK.beads for s in setups)  # at rest at first


def test_it_ends_when_it_is_back_and_stays_as_it_was():
    setup = setup_of(0)
    states = play(setup, actions_of((POUR, 30), (RETRACT, 30)), 0)
    done = np.asarray(states.done)
    assert int(done.argmax()) == 30 + round(TASK.back / TASK.step) - 1
    assert len(np.unique(np.asarray(states.tilt)[done])) == 1 and int(states.steps[-1]) == 42
    short = Task(limit=7)
    assert int(play(setup, actions_of((POUR, 10), length=10), 0, short).steps[-1]) == 7


def test_it_does_not_end_while_beads_flow():
    setup, task = setup_of(1), Task(back=0.25)
    states = play(setup, actions_of((POUR, 150), (RETRACT, 30)), 0, task)
    ends = int(np.asarray(states.done).argmax())
    assert bool(states.flowing[150]) and ends > 150 and not bool(states.flowing[ends])
    settled = play(setup, actions_of((POUR, 150), (RETRACT, ends - 149)), 0, Task(back=50.0))
    assert float(states.mass[-1]) == float(settled.mass[-1])  # every bead is counted


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"target": 100.0}, "below the 100 g"),
        ({"step": 0.0}, "step"),
        ({"beads": math.nan}, "beads"),
        ({"limit": 0}, "limit"),
        ({"most": -5.0}, "most"),
        ({"most": 200.0}, "at most 180"),
    ],
)
def test_a_task_that_cannot_be_done_is_refused(changes, words):
    with pytest.raises(UserError, match=words):
        Task(**changes)


# The load.


@pytest.mark.parametrize("mass", [100.0, 40.0, 0.0])
def test_an_upright_cylinder_weighs_m_g(mass):
    setup = setup_of(0, share=1.0)  # all of it on the gel
    result = still(at(setup, mass=mass), setup)
    weight = (mass + float(setup.empty)) * 1e-3 * GRAVITY
    np.testing.assert_allclose(np.asarray(result.shear), [0, weight], rtol=1e-5, atol=1e-6)
    assert float(result.twist) == pytest.approx(0, abs=1e-4)
    assert float(result.normal) == pytest.approx(float(setup.grip), rel=0.1)


def test_a_standing_cylinder_loads_nothing_but_the_grip():
    setup = setup_of(0)
    result = still(at(setup, tilt=0.7)._replace(steps=jnp.asarray(physics.STAND - 1)), setup)
    assert np.asarray(result.shear).tolist() == [0, 0] and float(result.twist) == 0
    assert 0.9 * float(setup.grip) < float(result.normal) <= float(setup.grip)


def test_the_weight_is_there_at_every_tilt():
    """Both fingers and the grip's axis together bear m g, whatever the share and the tilt."""
    for tilt in (0.0, 0.4, 0.9, 1.4):
        setup = setup_of(1, share=1.0, mount=0.0)
        result = still(at(setup, tilt=tilt, slope=0.3), setup)  # the gel faces the axis of the tilt: no couple
        weight = (100 + float(setup.empty)) * 1e-3 * GRAVITY
        assert float(jnp.hypot(*result.shear)) == pytest.approx(weight, rel=1e-5)
        assert float(jnp.arctan2(*result.shear)) == pytest.approx(tilt, abs=1e-5)


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


def test_the_gel_toward_the_lip_is_pressed_and_less_mass_loads_less():
    setup = setup_of(2, relax=0.0)
    full, less = (still(at(setup, tilt=1.0, mass=m, slope=0.5), setup) for m in (100.0, 40.0))
    assert float(full.normal) > float(less.normal) > float(setup.grip)
    assert float(jnp.hypot(*full.shear)) > 1.3 * float(jnp.hypot(*less.shear))


def test_the_heap_lies_where_a_fine_sum_says():
    setup = setup_of(0)
    radius, height, bulk = (float(x) for x in (setup.radius, setup.height, setup.bulk))
    flat = physics.heap(jnp.asarray(100.0), jnp.asarray(0.0), setup)
    fill = 100 / bulk / (math.pi * radius**2)
    np.testing.assert_allclose([float(x) for x in flat], [0, fill / 2], atol=1e-3)
    place, up = (float(x) for x in physics.heap(jnp.asarray(40.0), jnp.asarray(0.9), setup))
    axis = np.linspace(-radius, radius, 801)
    x, y = np.meshgrid(axis, axis)
    inside, steep = x**2 + y**2 < radius**2, math.tan(0.9)
    column = lambda level: np.clip(level + x * steep, 0, height) * inside  # noqa: E731
    cell, low, high = (axis[1] - axis[0]) ** 2, -80.0, 80.0
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if column(middle).sum() * cell * bulk < 40 else (low, middle)
    z = column(low)
    assert place == pytest.approx((z * x).sum() / z.sum(), abs=0.1)
    assert up == pytest.approx((z * z).sum() / 2 / z.sum(), abs=0.1)
    assert place > 5  # toward the lip


@pytest.mark.parametrize("seed", [0, 5])
def test_the_load_is_continuous(seed):
    setup = setup_of(seed)
    states = play(setup, actions_of((POUR, 150), (WAIT, 20), (RETRACT, 30)), seed)
    result = jax.vmap(lambda s: still(s, setup))(states)
    weight = (TASK.beads + float(setup.empty)) * 1e-3 * GRAVITY
    states = jax.tree.map(lambda x: x[physics.STAND :], states)  # once it is lifted
    result = jax.tree.map(lambda x: x[physics.STAND :], result)
    out = np.abs(np.diff(np.asarray(states.mass))) / 1000 * GRAVITY
    for part, scale in ((result.shear, 1.0), (result.twist[:, None], 30.0), (result.normal[:, None], 1.0)):
        jump = np.abs(np.diff(np.asarray(part), axis=0)).max(1)
        assert (jump <= scale * (0.02 * weight + 2 * out) + 0.01).all()  # a quarter of a degree, and what flowed


def test_blows_are_small_and_come_only_with_movement():
    setup = setup_of(0, bead=5.0, jolt=0.01)
    calm = at(setup, tilt=1.0)
    for name in ("shear", "twist", "normal"):
        np.testing.assert_allclose(getattr(shaken(calm, setup), name), getattr(still(calm, setup), name), rtol=1e-6)
    flowing = calm._replace(rate=jnp.asarray(5.0))
    keys = jax.random.split(jax.random.key(1), 500)
    draws = jax.vmap(lambda key: shaken(flowing._replace(key=key), setup).shear)(keys)
    away = np.asarray(draws - still(flowing, setup).shear[None])
    assert 1e-3 < away.std() < 0.05 and abs(away.mean()) < 5 * away.std() / math.sqrt(1000)


def test_blows_have_the_spread_of_so_many_beads():
    """`rate` g/s of beads that have fallen by the radius: Poisson's number in an exposure, each a blow of m v / t."""
    setup = setup_of(0, bead=5.0, jolt=0.0)
    flowing = at(setup, tilt=1.0)._replace(rate=jnp.asarray(5.0))
    keys = jax.random.split(jax.random.key(1), 4000)
    away = jax.vmap(lambda key: shaken(flowing._replace(key=key), setup).normal)(keys) - still(flowing, setup).normal
    gram = 2.5e-3 * math.pi / 6 * 5.0**3
    blow = gram * 1e-3 * math.sqrt(2 * 9.81 * float(setup.radius) * 1e-3) * 60  # N over 1/60 s
    assert float(jnp.std(away)) == pytest.approx(math.sqrt(5.0 / 60 / gram) * blow, rel=0.05)


def test_the_grip_relaxes_in_seconds():
    setup = setup_of(0, relax=0.1, relax_time=2.0, grip=8.0)
    upright = at(setup)._replace(steps=jnp.asarray(10))  # at 5 Hz two seconds
    assert float(still(upright, setup).normal) == pytest.approx(8.0 * (1 - 0.1 * (1 - math.exp(-1))), rel=1e-4)
