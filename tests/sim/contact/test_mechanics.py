import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.sim.contact import elastic, mechanics
from anytouch_jax.sim.contact.elastic import Plan
from anytouch_jax.sim.contact.mechanics import Gel, press

N = 64
PLANE = 150.0 / (1 - 0.48**2)
INF = float("inf")


def grid(pitch=1.0):
    axis = (np.arange(N) - (N - 1) / 2) * pitch
    return np.meshgrid(axis, axis)


@jax.jit
def exact(surface, depth, pitch, modulus_object=INF):
    return press(surface, depth, Gel(), pitch, modulus_object=modulus_object, tolerance=2e-5)


@jax.jit
def fast(surface, depth, pitch):
    return press(surface, depth, Gel(), pitch, fidelity="fast")


def solved(surface, depth, pitch, modulus_object=INF):
    outcome = exact(jnp.asarray(surface, jnp.float32), depth, pitch, modulus_object)
    assert outcome.converged
    return jax.tree.map(np.asarray, outcome)


def ball(pitch, radius=8.0, at=(0.0, 0.0)):
    x, y = grid(pitch)
    return -((x - at[0] * pitch) ** 2 + (y - at[1] * pitch) ** 2) / (2 * radius)


def rough(pitch, seed=0, spread=0.03):
    x, y = grid(pitch)
    rng = np.random.default_rng(seed)
    waves = rng.uniform(1.2, 2.6, 80)
    turns = rng.uniform(0, 2 * np.pi, 80)
    phases = rng.uniform(0, 2 * np.pi, 80)
    field = sum(
        np.cos(k * (x * np.cos(a) + y * np.sin(a)) / pitch + b)
        for k, a, b in zip(waves, turns, phases, strict=True)
    )
    return (field - field.max()) / np.sqrt(40) * spread


@pytest.mark.parametrize("depth", [0.01, 0.03, 0.1, 0.3, 1.0])
def test_hertz_sphere(depth):
    """Force, radius and peak pressure within 1 % over two decades of depth; the grid is chosen for
    each.
    """
    radius = 8.0
    a = np.sqrt(radius * depth)
    pitch = 3.2 * a / N
    outcome = solved(ball(pitch, radius), depth, pitch)
    assert outcome.force == pytest.approx(
        4 / 3 * PLANE * np.sqrt(radius) * depth**1.5 * 1e-3, rel=0.01
    )
    assert np.sqrt(mechanics.area(outcome.pressure, pitch) / np.pi) == pytest.approx(a, rel=0.01)
    assert outcome.pressure.max() == pytest.approx(
        2 * PLANE * np.sqrt(depth / radius) / np.pi, rel=0.01
    )
    assert outcome.displacement.max() == pytest.approx(depth, rel=2e-3)
    x, y = grid(pitch)
    far = np.hypot(x, y) > 1.2 * a
    r = np.hypot(x, y)[far] / a
    # Johnson 3.42a
    outside = depth / np.pi * ((2 - r**2) * np.arcsin(1 / r) + np.sqrt(r**2 - 1))
    np.testing.assert_allclose(outcome.displacement[far], outside, rtol=0.01)


def test_flat_punch():
    """F = 2 a E* d; the pressure at the centre is E* d / (pi a)."""
    radius = 2.4
    pitch = 0.1
    depth = 0.2
    x, y = grid(pitch)
    inside = np.hypot(x, y) <= radius
    outcome = solved(np.where(inside, 0.0, -INF), depth, pitch)
    a = np.sqrt(inside.sum() * pitch**2 / np.pi)
    assert outcome.force == pytest.approx(2 * a * PLANE * depth * 1e-3, rel=0.02)
    assert outcome.pressure[N // 2, N // 2] == pytest.approx(PLANE * depth / (np.pi * a), rel=0.02)
    assert not outcome.pressure[~inside].any()
    np.testing.assert_allclose(outcome.displacement[inside], depth, rtol=1e-4)


@pytest.mark.parametrize("shape", ["ball", "rough"])
def test_force_is_the_slope_of_the_energy(shape):
    """The sum of the pressure against the load that does the work: dU / dd, U = half of pressure
    times motion.
    """
    pitch = 0.1
    surface = ball(pitch) if shape == "ball" else rough(pitch)
    depths = (0.28, 0.3, 0.32)
    energies = []
    for depth in depths:
        outcome = solved(surface, depth, pitch)
        energies.append(
            0.5
            * np.sum(outcome.pressure * outcome.displacement, dtype=np.float64)
            * pitch**2
            * 1e-3
        )
    work = (energies[2] - energies[0]) / (depths[2] - depths[0])
    assert work == pytest.approx(solved(surface, 0.3, pitch).force, rel=2e-3)


@pytest.mark.parametrize("solve", [exact, fast])
def test_zero_depth_is_exactly_nothing(solve):
    for surface in (ball(0.1), rough(0.1), np.zeros((N, N)), np.full((N, N), -INF)):
        outcome = solve(jnp.asarray(surface, jnp.float32), 0.0, 0.1)
        assert not np.asarray(outcome.pressure).any() and not np.asarray(outcome.displacement).any()
        assert outcome.force == 0 and outcome.converged


@pytest.mark.parametrize("solve", [exact, fast])
def test_moves_and_turns_with_the_object(solve):
    pitch = 0.1
    surface = np.maximum(ball(pitch, 2.0, at=(-6, 3)), ball(pitch, 1.0, at=(4, -8)) - 0.05)
    # the fast path has grids of 16 and 32 behind it: it moves with whole coarse pixels
    first = solve(jnp.asarray(surface, jnp.float32), 0.2, pitch)
    turned = solve(jnp.asarray(np.rot90(surface), jnp.float32), 0.2, pitch)
    other = np.maximum(ball(pitch, 2.0, at=(2, -1)), ball(pitch, 1.0, at=(12, -12)) - 0.05)
    moved = solve(jnp.asarray(other, jnp.float32), 0.2, pitch)
    np.testing.assert_allclose(turned.displacement, np.rot90(first.displacement), atol=1e-5)
    inner = np.asarray(moved.displacement)[: N - 4, 8:]
    np.testing.assert_allclose(
        inner, np.asarray(first.displacement)[4:, : N - 8], atol=2e-4 if solve is fast else 1e-5
    )
    assert moved.force == pytest.approx(float(first.force), rel=1e-3)


def test_batch_equals_single():
    surfaces = jnp.asarray(np.stack([ball(0.1), rough(0.1), np.full((N, N), -INF)]), jnp.float32)
    depths = jnp.array([0.2, 0.1, 0.3])
    for solve in (exact, fast):
        batch = jax.vmap(solve, (0, 0, None))(surfaces, depths, 0.1)
        for row in range(3):
            single = solve(surfaces[row], depths[row], 0.1)
            assert int(batch.iterations[row]) == int(single.iterations)
            np.testing.assert_allclose(batch.displacement[row], single.displacement, atol=2e-5)
            np.testing.assert_allclose(batch.force[row], single.force, rtol=1e-4)


def cone(pitch):
    x, y = grid(pitch)
    return -np.hypot(x, y) * 1.5


def tip(pitch):
    surface = np.full((N, N), -INF)
    surface[20, 31] = 0.0
    return surface


def square(pitch):
    x, y = grid(pitch)
    return np.where((abs(x) < 2) & (abs(y) < 1.5), 0.0, -3.0)


@pytest.mark.parametrize("shape", [cone, tip, square, rough, ball, lambda pitch: np.zeros((N, N))])
@pytest.mark.parametrize("depth", [1e-7, 0.02, 1.0, 50.0])
def test_hard_cases_converge_and_stay_finite(shape, depth):
    surface = jnp.asarray(shape(0.1), jnp.float32)
    outcome = exact(surface, depth, 0.1)
    assert outcome.converged and outcome.residual <= 2e-5
    for result in (outcome, fast(surface, depth, 0.1)):
        assert all(np.isfinite(np.asarray(field)).all() for field in result)
        assert (np.asarray(result.pressure) >= 0).all()
        # apex between pixels
        highest = max(float(jnp.max(jnp.where(jnp.isfinite(surface), surface, -1))) + depth, 0)
        assert np.asarray(result.displacement).max() <= highest * 1.35 + 1e-12
        assert (float(result.force) > 0) == (highest > 0)


def test_double_precision_in_double_precision_out():
    with jax.enable_x64(True):
        outcome = press(jnp.asarray(ball(0.1)), 0.2, Gel(), 0.1, tolerance=1e-10)
        assert outcome.pressure.dtype == outcome.force.dtype == jnp.float64
        assert outcome.converged and outcome.residual <= 1e-10
    single = exact(jnp.asarray(ball(0.1), jnp.float32), 0.2, 0.1)
    assert single.pressure.dtype == single.displacement.dtype == single.force.dtype == jnp.float32
    np.testing.assert_allclose(single.displacement, np.asarray(outcome.displacement), atol=2e-5)


def test_on_a_bonded_layer_an_elastic_object_moves_as_a_half_space_and_the_gel_as_a_layer():
    pitch = 0.25
    soft = PLANE / 3
    gel = Gel(thickness=2.0)
    surface = jnp.asarray(ball(pitch), jnp.float32)
    outcome = press(surface, 0.6, gel, pitch, modulus_object=soft, tolerance=1e-5)
    plan = Plan(N, N)

    def moves(thickness, modulus):
        spectrum = elastic.normal_spectrum(plan, pitch, gel.poisson, thickness, 1.0, jnp.float32)
        return np.asarray(
            plan.inverse(plan.even(plan.forward(outcome.pressure * (pitch / modulus)), spectrum))
        )

    layer = moves(2.0, PLANE)
    object_ = moves(INF, soft)
    np.testing.assert_allclose(outcome.displacement, layer, atol=2e-4)
    touching = np.asarray(outcome.pressure) > 0
    np.testing.assert_allclose(
        (layer + object_)[touching], (np.asarray(surface) + 0.6)[touching], atol=1e-3
    )
    # no dent like 1 / r far away
    assert abs(outcome.displacement[N // 2, 2]) < 0.02 * np.max(outcome.displacement)
    quick = press(surface, 0.6, gel, pitch, fidelity="fast", modulus_object=soft).displacement
    assert np.sqrt(np.mean((quick - layer) ** 2)) < 0.02 * layer.max()


@pytest.mark.parametrize(
    ("surface", "rms", "force"),
    [(ball(0.1), 2e-3, 0.01), (rough(0.1), 0.03, 0.05), (square(0.1), 0.01, 0.02)],
)
def test_fast_is_near_exact(surface, rms, force):
    right = solved(surface, 0.3, 0.1)
    quick = fast(jnp.asarray(surface, jnp.float32), 0.3, 0.1)
    error = np.asarray(quick.displacement) - right.displacement
    assert np.sqrt(np.mean(error**2)) < rms * right.displacement.max()
    assert float(quick.force) == pytest.approx(right.force, rel=force)
    # the gel is never inside the object
    assert (np.asarray(quick.displacement) >= surface + 0.3 - 1e-6).all()
    area = (right.pressure > 0).sum()
    # unsharpened: every pixel
    assert abs((np.asarray(quick.pressure) > 0).sum() - area) < 0.6 * area + 1
    assert np.linalg.norm(quick.pressure - right.pressure) < 0.35 * np.linalg.norm(right.pressure)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"depth": -0.1}, "depth"),
        ({"pitch": float("inf")}, "pitch"),
        ({"surface": np.full((8, 8), np.nan)}, "NaN"),
        ({"surface": np.zeros((2, 8, 8))}, "vmap"),
        ({"fidelity": "exactly"}, "fidelity"),
        ({"modulus_object": 0.0}, "modulus_object must be above 0"),
        ({"gel": Gel(modulus=float("nan"))}, "modulus must be above 0"),
        ({"gel": Gel(thickness=0.0)}, "thickness must be above 0"),
        ({"gel": Gel(poisson=1.0)}, "Poisson ratio is 0 to 0.5"),
        ({"gel": Gel(thickness=0.09)}, "too thin for this grid: 0.1 mm is the least"),
        (
            {"gel": Gel(thickness=0.25), "fidelity": "fast"},
            "too thin for this grid: 0.3 mm is the least",
        ),
    ],
)
def test_mistakes_are_named(change, word):
    with pytest.raises(UserError, match=word):
        press(**{"surface": np.zeros((64, 64)), "depth": 0.05, "gel": Gel(), "pitch": 0.1} | change)
