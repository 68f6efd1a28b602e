import jax
import numpy as np
import pytest

from anytouch_jax.sim.interpolation import sample
from anytouch_jax.sim.world.objects import catalogue
from anytouch_jax.sim.world.shapes import height, relief

SAMPLE = jax.jit(sample)


def axes(count, pitch):
    axis = (np.arange(count) - (count - 1) / 2) * pitch
    return np.meshgrid(axis, axis)


@pytest.mark.parametrize("thing", catalogue(3, 64)[::6], ids=lambda thing: thing.name)
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
