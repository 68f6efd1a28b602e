import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg

from anytouch_jax.sim.contact import elastic
from anytouch_jax.sim.contact.elastic import Plan
from anytouch_jax.sim.contact.mechanics import Gel, sideways

POISSON = 0.4


def dense(coefficients, shape, odd=False):
    """The matrix of a convolution with coefficients at offsets >= 0."""
    rows, columns = np.indices(shape).reshape(2, -1)
    down = rows[:, None] - rows[None]
    across = columns[:, None] - columns[None]
    matrix = coefficients[abs(down), abs(across)]
    if odd:
        return matrix * np.sign(down) * np.sign(across)
    return matrix


@pytest.mark.parametrize("shape", [(12, 10), (9, 14), (1, 6), (21, 21), (7, 147)])
def test_convolution_is_the_sum(shape):
    plan = Plan(*shape)
    field = np.random.default_rng(0).normal(size=shape)
    normal = elastic.normal_coefficients(*shape)
    mixed = elastic.tangential_coefficients(*shape, POISSON)[1]
    with jax.enable_x64(True):
        transform = plan.forward(jnp.asarray(field))
        even = np.asarray(plan.inverse(plan.even(transform, jnp.asarray(plan.spectrum(normal)))))
        odd = np.asarray(plan.inverse(plan.odd(transform, jnp.asarray(plan.spectrum(mixed, -1)))))
    assert plan.matmul == (max(shape) <= elastic.MATMUL_LIMIT)
    np.testing.assert_allclose(even.ravel(), dense(normal, shape) @ field.ravel(), atol=1e-12)
    np.testing.assert_allclose(
        odd.ravel(), dense(mixed, shape, odd=True) @ field.ravel(), atol=1e-12
    )


def moved_by_a_wave(thickness, poisson):
    """(along, into the layer) that a load cos(x) moves the surface of a bonded layer of E* = 1:
    plane strain's ODEs in depth for (u, w, shear, normal stress), with shear and normal stress 0
    and -1 above, and no motion below.
    """
    modulus = 1 - poisson**2
    lame = modulus * poisson / (1 + poisson) / (1 - 2 * poisson)
    shear = modulus / 2 / (1 + poisson)
    whole = lame + 2 * shear
    rates = np.array(
        [
            [0, -1, 1 / shear, 0],
            [lame / whole, 0, 0, 1 / whole],
            [whole - lame**2 / whole, 0, 0, -lame / whole],
            [0, 0, 1, 0],
        ]
    )
    through = scipy.linalg.expm(thickness * rates)
    return np.linalg.solve(through[:2, :2], through[:2, 3])


@pytest.mark.parametrize("poisson", [0.3, 0.45, 0.48])
@pytest.mark.parametrize("wave", [0.05, 0.7, 2.0, 6.0])
def test_the_symbols_of_a_layer_solve_its_equations(wave, poisson):
    # a wave number of 1: its thickness is the wave
    along, into = moved_by_a_wave(wave, poisson)
    at = np.array([wave])
    assert 2 * elastic.layer_symbols(at, poisson)[0][0] == pytest.approx(into, rel=1e-6)
    assert 2 * elastic.sideways_symbol(at, poisson)[0] == pytest.approx(along, rel=1e-6)


def surface_under(load, spectra, plan):
    return np.asarray(plan.inverse(plan.even(plan.forward(jnp.asarray(load)), spectra)))


def test_a_wide_load_confines_a_thin_layer():
    """Under a load much wider than the layer: u = p h (1 + nu)(1 - 2 nu) / (E (1 - nu)) and shear u
    = q h / G.
    """
    plan = Plan(60, 60)
    thickness = 4.0
    with jax.enable_x64(True):
        load = np.zeros((60, 60))
        load[6:54, 6:54] = 1.0
        normal = elastic.normal_spectrum(plan, 1.0, POISSON, thickness, 1.0, jnp.float64)
        pressed = surface_under(load, normal, plan)
        xx = elastic.tangential_spectra(plan, 1.0, POISSON, thickness, 1.0, jnp.float64)[0]
        sheared = surface_under(load, xx, plan)
    modulus = 1 - POISSON**2  # E* = 1
    confined = thickness * (1 + POISSON) * (1 - 2 * POISSON) / (modulus * (1 - POISSON))
    assert pressed[30, 30] == pytest.approx(confined, rel=0.03)
    assert sheared[30, 30] == pytest.approx(thickness * 2 * (1 + POISSON) / modulus, rel=0.03)
    # a half-space would sink far away too
    assert abs(pressed[0, 0]) < 0.02 * confined


def test_a_thick_layer_is_a_half_space_and_fraction_zero_too():
    plan = Plan(16, 16)
    for build in (elastic.normal_spectrum, elastic.tangential_spectra):
        deep = build(plan, 1.0, POISSON, float("inf"), 1.0, jnp.float32)
        np.testing.assert_allclose(
            build(plan, 1.0, POISSON, 3000.0, 1.0, jnp.float32), deep, rtol=0.02, atol=2e-4
        )
        np.testing.assert_allclose(
            build(plan, 1.0, POISSON, 2.0, 0.0, jnp.float32), deep, atol=1e-6
        )


def test_the_tangential_kernels_of_a_layer_are_those_of_its_symbols():
    """A smooth traction along x moves a layer by the sum over waves of what each wave is moved
    by.
    """
    n = 64
    pitch = 0.2
    poisson = 0.48
    thickness = 2.0
    x, y = np.meshgrid(*[(np.arange(n) - (n - 1) / 2) * pitch] * 2)
    load = np.exp(-(x**2 + y**2) / (2 * 0.5**2))
    wave = 2 * np.pi * np.fft.fftfreq(8 * n, pitch)
    wave_x, wave_y = np.meshgrid(wave, wave)
    wave = np.hypot(wave_x, wave_y)
    wave[0, 0] = 1e-9
    _, along, across = (
        2 / wave * one for one in elastic.layer_symbols(np.minimum(wave * thickness, 300), poisson)
    )
    across /= 1 - poisson
    cosine = np.cos(np.arctan2(wave_y, wave_x))
    sine = np.sin(np.arctan2(wave_y, wave_x))
    plan = Plan(n, n)
    with jax.enable_x64(True):
        xx, xy, _ = elastic.tangential_spectra(plan, pitch, poisson, thickness, 1.0, jnp.float64)
        forward = plan.forward(jnp.asarray(load))
        result = [
            np.asarray(plan.inverse(one)) * pitch
            for one in (plan.even(forward, xx), plan.odd(forward, xy))
        ]
    symbols = along * cosine**2 + across * sine**2, (along - across) * cosine * sine
    for one, symbol, tolerance in zip(result, symbols, (0.01, 0.02), strict=True):
        moved = np.fft.ifft2(np.fft.fft2(load, wave.shape) * symbol).real[:n, :n]
        np.testing.assert_allclose(one, moved, atol=tolerance * np.abs(moved).max())


@pytest.mark.parametrize("poisson", [0.3, 0.48])
def test_the_sideways_kernel_is_that_of_its_symbol(poisson):
    """The gradient of its potential is the sum over waves of what each wave of a smooth load moves
    sideways.
    """
    n = 64
    pitch = 0.2
    thickness = 2.0
    x, y = np.meshgrid(*[(np.arange(n) - (n - 1) / 2) * pitch] * 2)
    load = np.exp(-((x - 0.7) ** 2 + y**2) / (2 * 0.9**2))
    waves = 2 * np.pi * np.fft.fftfreq(8 * n, pitch)
    wave_x, wave_y = np.meshgrid(waves, waves)
    wave = np.hypot(wave_x, wave_y)
    wave[0, 0] = 1e-9
    symbol = (
        1j
        * wave_x
        * 2
        / wave**2
        * elastic.sideways_symbol(np.minimum(wave * thickness, 300), poisson)
    )
    moved = np.fft.ifft2(np.fft.fft2(load, wave.shape) * symbol).real[:n, :n]
    gel = Gel(modulus=1 - poisson**2, poisson=poisson, thickness=thickness)
    with jax.enable_x64(True):
        result = np.asarray(sideways(jnp.asarray(load), gel, pitch))[..., 0]
    inside = np.s_[1:-1, 1:-1]  # one-sided differences at the rim
    np.testing.assert_allclose(result[inside], moved[inside], atol=0.02 * np.abs(moved).max())
    turned = np.asarray(sideways(jnp.asarray(load.T, jnp.float32), gel, pitch))[..., 1].T
    # and float32 is enough
    np.testing.assert_allclose(turned, result, atol=1e-3 * np.abs(moved).max())
