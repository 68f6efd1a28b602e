"""Interpolation: matrices against polynomials, and cubic lookup against analytic surfaces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.sim import interpolation
from anytouch_jax.sim.interpolation import sample
from anytouch_jax.sim.world.objects import catalogue
from anytouch_jax.sim.world.shapes import Shape, height, relief

SAMPLE = jax.jit(sample)


def axes(count, pitch):
    axis = (np.arange(count) - (count - 1) / 2) * pitch
    return np.meshgrid(axis, axis)


def test_the_spline_keeps_lines_differentiates_parabolas_and_repeats_the_edge():
    at = jnp.array([3.0, 4.25, 7.5, 11.9])
    value, slope = interpolation.spline(at, 16)
    samples = jnp.arange(16.0)
    np.testing.assert_allclose(value.sum(1), 1, rtol=1e-6)
    np.testing.assert_allclose(value @ samples, at, rtol=1e-6)
    np.testing.assert_allclose(slope @ samples**2, 2 * at, rtol=1e-5)
    np.testing.assert_allclose(slope @ jnp.ones(16), 0, atol=1e-6)
    outside = interpolation.spline(jnp.array([-9.0, 40.0]), 16)[0] @ samples
    np.testing.assert_allclose(outside, [1 / 6, 15 - 1 / 6], rtol=1e-5)


def test_blur_and_average_keep_the_mean():
    np.testing.assert_allclose(interpolation.blur(12, 2.0).sum(1), 1, rtol=1e-6)
    peak = interpolation.blur(41, 3.0)[20]
    spread = np.sqrt((np.asarray(peak) * (np.arange(41) - 20) ** 2).sum())
    assert abs(spread - 3) < 0.01
    matrix = interpolation.average(10, 4)
    np.testing.assert_allclose(matrix.sum(1), 1, rtol=1e-6)
    np.testing.assert_allclose(matrix.sum(0), 0.4, rtol=1e-5)
    np.testing.assert_allclose(matrix @ np.arange(10), [0.8, 3.2, 5.8, 8.2], rtol=1e-5)


@pytest.mark.parametrize("thing", catalogue(3, 64)[::3], ids=lambda thing: thing.name)
def test_a_raster_of_a_tenth_of_a_millimetre_holds_the_surface(thing):
    """What is read between the pixels is the analytic surface to 4 micrometres (RMS) where a gel can touch it."""
    shape, rng = thing.shape, np.random.default_rng(1)
    x, y = rng.uniform(-6, 6, (2, 50, 50)).astype(np.float32)
    if shape.primitive in ("edge", "corner"):
        x, y = x - 3, y - 3
    z = height(shape, x, y)
    read = np.asarray(SAMPLE(relief(shape, 200, 0.1), 0.1, x, y))
    near = z > -1.0
    assert near.mean() > 0.02
    assert np.sqrt(np.mean((read - z)[near] ** 2)) < 0.004


def test_sample_gives_the_pixels_back():
    raster = np.random.default_rng(0).standard_normal((20, 31)).astype(np.float32)
    x, y = np.meshgrid((np.arange(31) - 15) * 0.13, (np.arange(20) - 9.5) * 0.13)
    np.testing.assert_allclose(SAMPLE(raster, 0.13, x.astype(np.float32), y.astype(np.float32)), raster, atol=2e-4)
    # Moved by whole pixels: the rest of the raster, and its lowest border outside.
    moved = SAMPLE(raster, 0.13, (x + 3 * 0.13).astype(np.float32), (y - 2 * 0.13).astype(np.float32))
    np.testing.assert_allclose(moved[2:, :-3], raster[:-2, 3:], atol=2e-4)
    border = min(raster[0].min(), raster[-1].min(), raster[:, 0].min(), raster[:, -1].min())
    assert np.all(np.asarray(moved)[:2] == border) and np.all(np.asarray(moved)[:, -3:] == border)


def test_sample_is_exact_on_parabolas():
    """A Catmull-Rom spline reproduces polynomials of the second degree; a bilinear one has facets."""
    x, y = axes(31, 0.1)
    surface = lambda x, y: 0.3 * x * x - 0.2 * x * y + 0.1 * y * y + 0.4 * x - 0.7  # noqa: E731
    at = np.random.default_rng(1).uniform(-1.2, 1.2, (2, 200)).astype(np.float32)
    np.testing.assert_allclose(
        SAMPLE(surface(x, y).astype(np.float32), 0.1, *at), surface(*at.astype(np.float64)), atol=2e-6
    )


def test_slopes_do_not_jump_at_the_pixels():
    raster = jnp.asarray(np.random.default_rng(2).standard_normal((12, 12)), jnp.float32)
    slope = jax.jit(jax.vmap(jax.grad(lambda x, y: sample(raster, 1.0, x, y)), (0, None)))
    before, after = slope(jnp.array([0.4999, 1.4999, -2.5001]), 0.2), slope(jnp.array([0.5001, 1.5001, -2.4999]), 0.2)
    np.testing.assert_allclose(before, after, atol=5e-3)
    assert np.abs(before).min() > 0.02


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


def test_a_raster_of_one_pixel():
    z = relief(Shape("sphere", size=3.0), 1, 0.1)
    assert z.shape == (1, 1) and z[0, 0] == 0
    got = SAMPLE(
        np.full((1, 1), -0.3, np.float32), 0.1, np.array([0.0, 0.04, 5.0], np.float32), np.zeros(3, np.float32)
    )
    np.testing.assert_allclose(got, -0.3, rtol=1e-6)
