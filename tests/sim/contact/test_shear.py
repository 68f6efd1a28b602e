import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.sim.contact.mechanics import Gel, PressResult, press, sideways
from anytouch_jax.sim.contact.shear import at_rest, shear_step

N = 48
MU = 0.5
POISSON = 0.4
MODULUS = 150.0
GEL = Gel(MODULUS, POISSON)
SHEAR = MODULUS / (2 * (1 + POISSON))
STIFFNESS = SHEAR / (2 - POISSON)  # G* of a rigid object, Johnson 7.43
RADIUS = 8.0
DEPTH = 0.5
A = np.sqrt(RADIUS * DEPTH)
PITCH = 2.6 * A / N
POSITION = (np.arange(N) - (N - 1) / 2) * PITCH
X, Y = np.meshgrid(POSITION, POSITION)
R = np.hypot(X, Y)


def hertz(depth=DEPTH):
    """The contact of a ball, from its own formula."""
    a = np.sqrt(RADIUS * depth)
    plane = GEL.plane
    pressure = 2 * plane * a / (np.pi * RADIUS) * np.sqrt(np.maximum(1 - (R / a) ** 2, 0))
    pressure = jnp.asarray(pressure, jnp.float32)
    nothing = jnp.zeros_like(pressure)
    return PressResult(pressure, nothing, jnp.sum(pressure) * PITCH**2 * 1e-3, True, 0, 0.0)


CONTACT = hertz()
LOAD = float(CONTACT.force)
FULL = 3 * MU * LOAD * 1e3 / (16 * STIFFNESS * A)  # mm: where the last of it slips


@jax.jit
def exact(state, contact, motion, friction=MU):
    return shear_step(state, contact, motion, GEL, PITCH, friction, tolerance=3e-4)


@jax.jit
def fast(state, contact, motion, friction=MU):
    return shear_step(state, contact, motion, GEL, PITCH, friction, fidelity="fast")


def walk(step, motions, contacts=None, friction=MU):
    state = at_rest((N, N))
    states = []
    for number, motion in enumerate(motions):
        contact = CONTACT if contacts is None else contacts[number]
        state = step(state, contact, jnp.asarray(motion, jnp.float32), friction)
        states.append(jax.tree.map(np.asarray, state))
    return states


def within_coulomb(state, contact, friction=MU):
    strength = np.linalg.norm(state.traction, axis=-1)
    assert (strength <= friction * np.asarray(contact.pressure) * (1 + 1e-5) + 1e-6).all()
    assert np.linalg.norm(state.force) <= friction * float(contact.force) * (1 + 1e-5) + 1e-9


def mindlin(fraction):
    """Force over the limit at displacement over that of full slip (Cattaneo 1938, Mindlin 1949;
    Johnson 7.42).
    """
    return 1 - (1 - np.minimum(fraction, 1)) ** 1.5


def test_mindlin_force_and_stick_circle():
    states = walk(exact, [(FULL / 4, 0, 0)] * 5)
    for number, state in enumerate(states, 1):
        fraction = min(number / 4, 1)
        assert state.converged
        assert state.force[0] == pytest.approx(MU * LOAD * mindlin(fraction), rel=0.01)
        assert abs(state.force[1]) < 1e-5 * MU * LOAD and abs(state.twist_torque) < 1e-5 * LOAD
        stick = np.sqrt(
            ((np.asarray(CONTACT.pressure) > 0) & ~state.slipping).sum() * PITCH**2 / np.pi
        )
        assert stick == pytest.approx(A * np.sqrt(1 - fraction), abs=0.05 * A)
        within_coulomb(state, CONTACT)
    assert states[-1].slip_fraction == 1


def test_unloading_leaves_mindlin_and_deresiewicz():
    """Back by the same way: Q = Q(d) - 2 Q(back / 2), not the path of the loading (Johnson
    7.54).
    """
    states = walk(exact, [(0.6 * FULL, 0, 0), (-0.4 * FULL, 0, 0), (-0.2 * FULL, 0, 0)])
    first, second, third = (state.force[0] / (MU * LOAD) for state in states)
    assert first == pytest.approx(mindlin(0.6), rel=0.01)
    assert second == pytest.approx(mindlin(0.6) - 2 * mindlin(0.2), abs=0.01)
    assert third == pytest.approx(mindlin(0.6) - 2 * mindlin(0.3), abs=0.01)
    assert third < -0.05  # where it started, yet sheared the other way


def test_a_sticking_circle_has_mindlins_stiffness():
    """No slip: Q = 8 a G* d, T = 16 / 3 G a^3 theta; this sees every tangential coefficient, x by y
    too.
    """
    inside = np.hypot(X, Y) <= 0.85 * A
    a = np.sqrt(inside.sum() * PITCH**2 / np.pi)
    punch = PressResult(jnp.asarray(inside, jnp.float32), jnp.zeros((N, N)), 1.0, True, 0, 0.0)
    pushed, turned = (
        exact(at_rest((N, N)), punch, jnp.array(motion), 1e6)
        for motion in ((0.1, 0.0, 0.0), (0.0, 0.0, 0.1))
    )
    assert float(pushed.force[0]) == pytest.approx(8 * a * STIFFNESS * 0.1 * 1e-3, rel=0.02)
    assert float(turned.twist_torque) == pytest.approx(16 / 3 * SHEAR * a**3 * 0.1 * 1e-3, rel=0.03)
    np.testing.assert_allclose(np.asarray(pushed.displacement)[inside][:, 0], 0.1, rtol=2e-3)
    np.testing.assert_allclose(np.asarray(pushed.displacement)[inside][:, 1], 0, atol=2e-4)
    assert not np.asarray(pushed.slipping).any()


def test_a_slowly_turning_contact_slips_from_its_rim():
    states = walk(exact, [(0, 0, 0.02), (0, 0, 0.5), (0, 0, 1.0), (0, 0, 1.0)])
    assert 0 < states[0].slip_fraction < 0.4
    rim = (R > 0.97 * A) & (np.asarray(CONTACT.pressure) > 0)
    assert states[0].slipping[rim].all() and not states[0].slipping[R < 0.5 * A].any()
    # Lubkin 1951
    assert states[-1].twist_torque == pytest.approx(3 * np.pi / 16 * MU * LOAD * A, rel=0.01)
    assert np.abs(states[-1].force).max() < 1e-5 * LOAD
    turning = X * states[1].traction[..., 1] - Y * states[1].traction[..., 0]
    assert (turning >= -1e-4).all()


@pytest.mark.parametrize("step", [exact, fast])
def test_turns_with_the_motion(step):
    """A quarter turn, x to y, of the motion turns the tractions; pushing back reverses them."""
    first, second, back = (
        walk(step, [motion])[0] for motion in ((0.1, 0, 0), (0, 0.1, 0), (-0.1, 0, 0))
    )
    np.testing.assert_allclose(second.traction[..., 1], np.rot90(first.traction[..., 0]), atol=0.02)
    np.testing.assert_allclose(
        second.traction[..., 0], -np.rot90(first.traction[..., 1]), atol=0.02
    )
    np.testing.assert_allclose(back.traction, -first.traction, atol=1e-4)


@pytest.mark.parametrize("step", [exact, fast])
def test_never_beyond_the_friction_limit(step):
    rng = np.random.default_rng(0)
    motions = rng.normal(size=(8, 3)) * [0.2, 0.2, 0.1]
    contacts = [hertz(depth) for depth in rng.uniform(0.1, 0.5, 8)]
    for state, contact in zip(walk(step, motions, contacts), contacts, strict=True):
        within_coulomb(state, contact)
        assert 0 <= state.slip_fraction <= 1
        assert all(np.isfinite(field).all() for field in state)


@pytest.mark.parametrize("step", [exact, fast])
def test_no_motion_changes_nothing_and_lifting_off_lets_go(step):
    pushed, held = walk(step, [(0.1, 0, 0.02), (0, 0, 0)])
    np.testing.assert_allclose(held.traction, pushed.traction, atol=1e-3)
    empty = CONTACT._replace(pressure=jnp.zeros((N, N)), force=jnp.zeros(()))
    free = walk(step, [(0.1, 0, 0.02), (0.1, 0, 0)], [CONTACT, empty])[-1]
    assert not free.traction.any() and not free.displacement.any() and not free.slipping.any()
    assert free.slip_fraction == 0 and free.twist_torque == 0 and free.converged


@pytest.mark.parametrize("size", [1e-6, 5.0])
def test_tiny_and_huge_motions(size):
    for step in (exact, fast):
        state = walk(step, [(size, 0, 0)])[0]
        assert all(np.isfinite(field).all() for field in state)
        linear = 8 * A * STIFFNESS * size * 1e-3
        assert state.force[0] == pytest.approx(
            min(linear, MU * LOAD), rel=0.1 if step is fast else 0.02
        )


def test_fast_is_near_exact_on_a_path():
    path = [(0.08, 0, 0)] * 3 + [(-0.05, 0.03, 0.02)] * 4 + [(0, 0, -0.05)] * 3
    for right, quick in zip(walk(exact, path), walk(fast, path), strict=True):
        assert np.linalg.norm(quick.force - right.force) < 0.06 * MU * LOAD
        assert abs(quick.twist_torque - right.twist_torque) < 0.06 * MU * LOAD * A
        assert abs(quick.slip_fraction - right.slip_fraction) < 0.2
        error = np.sqrt(np.mean((quick.displacement - right.displacement) ** 2))
        assert error < 0.05 * np.abs(right.displacement).max()


def test_scan_and_batch_equal_steps():
    motions = jnp.array([[0.1, 0, 0.02], [0.1, 0.05, 0], [-0.1, 0, 0]], jnp.float32)
    both = [CONTACT, hertz(0.3)]

    def path(contact, motions):
        return jax.lax.scan(
            lambda state, motion: (fast(state, contact, motion),) * 2, at_rest((N, N)), motions
        )[1]

    contacts = jax.tree.map(lambda *fields: jnp.stack([jnp.asarray(one) for one in fields]), *both)
    batch = jax.jit(jax.vmap(path))(contacts, jnp.stack([motions, -motions]))
    for row, (contact, sign) in enumerate(zip(both, (1, -1), strict=True)):
        for number, state in enumerate(walk(fast, sign * motions, [contact] * 3)):
            np.testing.assert_allclose(batch.traction[row, number], state.traction, atol=2e-3)
            np.testing.assert_allclose(
                batch.displacement[row, number], state.displacement, atol=2e-5
            )


def test_mistakes_are_named():
    with pytest.raises(UserError, match="friction"):
        shear_step(None, CONTACT, (0, 0, 0), GEL, PITCH, -0.1)
    with pytest.raises(UserError, match="fidelity"):
        shear_step(None, CONTACT, (0, 0, 0), GEL, PITCH, MU, fidelity="best")
    with pytest.raises(UserError, match="pitch"):
        shear_step(None, CONTACT, (0, 0, 0), GEL, 0.0, MU)
    with pytest.raises(UserError, match="vmap"):
        shear_step(None, CONTACT._replace(pressure=jnp.zeros((2, N, N))), (0, 0, 0), GEL, PITCH, MU)


@pytest.mark.parametrize("fidelity", ["exact", "fast"])
def test_friction_holds_back_what_pressing_squeezes_out(fidelity):
    layer = Gel(MODULUS, 0.48, 2.0)
    contact = press(jnp.asarray(-(R**2) / (2 * RADIUS), jnp.float32), DEPTH, layer, PITCH)
    squeezed = sideways(contact.pressure, layer, PITCH)
    step = jax.jit(
        lambda friction: shear_step(
            None,
            contact,
            (0, 0, 0),
            layer,
            PITCH,
            friction,
            fidelity=fidelity,
            squeezed=squeezed,
            tolerance=3e-4,
        )
    )
    inside = np.asarray(contact.pressure) > 0.05 * float(contact.pressure.max())
    free, partly, held = (step(friction) for friction in (0.0, 0.2, 20.0))
    moved = [
        np.linalg.norm(state.displacement + squeezed, axis=-1)[inside]
        for state in (free, partly, held)
    ]
    np.testing.assert_allclose(moved[0], np.linalg.norm(squeezed, axis=-1)[inside], atol=1e-6)
    # it moves with the object: not at all
    assert moved[2].max() < (0.02 if fidelity == "exact" else 0.3) * moved[0].max()
    assert moved[2].mean() < moved[1].mean() < moved[0].mean()
    assert held.slip_fraction < 0.05 < partly.slip_fraction < 1
    within_coulomb(jax.tree.map(np.asarray, partly), contact, 0.2)
    inward = (partly.traction * jnp.asarray(np.stack([X, Y], -1))).sum(-1)
    # the object pulls toward the middle
    assert np.asarray(inward)[inside].max() < 1e-3
    assert np.abs(partly.force).max() < 1e-3 * float(contact.force)


@pytest.fixture(scope="module")
def dragged():
    """The force along x and the torque of three frames (dx, dy, turn, depth), as a function with
    its gradient.
    """
    gel = Gel(MODULUS, 0.48, 4.0)

    def total(frames, surface, friction):
        def frame(before, now):
            contact = press(surface, now[3], gel, 0.3, fidelity="fast", modulus_object=1e6)
            squeezed = sideways(contact.pressure, gel, 0.3, fidelity="fast", coarse=True)
            state = shear_step(
                start._replace(traction=before[0]),
                contact,
                now[:3],
                gel,
                0.3,
                friction,
                fidelity="fast",
                modulus_object=1e6,
                squeezed=squeezed - before[1],
                coarse=True,
            )
            return (state.traction, squeezed), (state.force[0], state.twist_torque)

        start = at_rest((N, N))
        forces = jax.lax.scan(frame, (start.traction, jnp.zeros((N // 2, N // 2, 2))), frames)[1]
        return jnp.sum(forces[0]) + jnp.sum(forces[1]) / 10

    return jax.jit(jax.value_and_grad(total, argnums=(0, 1, 2)))


AWAY = np.hypot(*np.meshgrid(*[(np.arange(N) - (N - 1) / 2) * 0.3] * 2))
BALL = np.sqrt(np.maximum(25 - AWAY**2, 0)) - 5
SLIDE = [[0.05, 0.02, 0.01, 0.5], [0.1, 0, 0, 0.5], [0.2, 0.1, 0.05, 0.6]]


@pytest.mark.parametrize("surface", [BALL, np.where(AWAY < 0.3, 0, -2.0)], ids=["ball", "spike"])
@pytest.mark.parametrize("friction", [0.6, 0.05, 0.0])
def test_gradients_through_frames_are_finite(dragged, surface, friction):
    """The last steps of a descent are so small that their squares are no numbers."""
    slips = [[0, 0, 0, 0.5], [1, 0, 0, 0.5], [1, 0, 0, 0.5]]
    lands = [[0, 0, 0, -1], [0, 0, 0, 0.2], [0.1, 0, 0, 0.5]]
    lifts = [[0, 0, 0, 0.5], [0.1, 0, 0, -1], [0.1, 0, 0, 0.3]]
    drawn = np.random.default_rng(0).normal(0, 0.1, (4, 3, 4)) * [1, 1, 1, 3] + [0, 0, 0, 0.3]
    for frames in (SLIDE, slips, lands, lifts, np.zeros((3, 4)), *drawn):
        value, slopes = dragged(*(jnp.asarray(x, jnp.float32) for x in (frames, surface, friction)))
        assert np.isfinite(value) and all(np.isfinite(slope).all() for slope in slopes), frames


def test_the_gradient_through_frames_is_that_of_finite_differences(dragged):
    frames = jnp.asarray(SLIDE, jnp.float32)
    surface = jnp.asarray(BALL, jnp.float32)
    slope = dragged(frames, surface, jnp.float32(0.6))[1][0]
    for at in ((0, 0), (1, 0), (2, 0), (2, 2), (2, 3)):
        ends = [
            dragged(frames.at[at].add(step), surface, jnp.float32(0.6))[0] for step in (0.01, -0.01)
        ]
        np.testing.assert_allclose(slope[at], (ends[0] - ends[1]) / 0.02, rtol=0.1, atol=0.02)
