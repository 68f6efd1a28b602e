"""Fits of colour changes, and sensors that are a few lights."""

from __future__ import annotations

from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.sim.sensing import optics, sensors
from anytouch_jax.sim.sensing.sensors import SENSORS
from experiments.benchmarks import photometry
from experiments.benchmarks.photometry import Light, Lights


@pytest.mark.parametrize("name", photometry.LIGHTS)
def test_the_polynomial_follows_the_lights(name):
    rng = np.random.default_rng(0)
    angle, size = rng.uniform(0, 2 * np.pi, 400), np.sqrt(rng.uniform(0, 0.9**2, 400))
    place = rng.uniform(-1, 1, (2, 400))
    nx, ny = size * np.cos(angle), size * np.sin(angle)
    look = photometry.LIGHTS[name]
    exact = photometry.shade(look, nx, ny, *place) - photometry.shade(look, 0 * nx, 0 * ny, *place)
    model = sensors.look(SENSORS[name])
    fitted = photometry.design(nx, ny, *place) @ model.normal.reshape(-1, 3)
    assert np.abs(fitted - exact).mean() < 0.25 * np.abs(exact).mean()
    assert min(np.corrcoef(fitted[:, c], exact[:, c])[0, 1] for c in range(3)) > 0.97


def test_a_flank_that_faces_a_light_takes_its_colour():
    # A lamp at the right; a slope of -1 along x is the right flank of a bump (height falls to the right).
    lamp = Lights((0.1, 0.1, 0.1), (Light((1.0, 0.0), (1.0, 0.0, 0.0)),))
    zero = np.zeros(1)
    right, flat, left = (photometry.shade(lamp, np.array([n]), zero, zero, zero)[0] for n in (-0.5, 0.0, 0.5))
    assert right[0] > flat[0] > left[0]
    assert right[1] == flat[1] == left[1] == 0


def test_design_and_horner_are_the_same_polynomial():
    rng = np.random.default_rng(1)
    normal = rng.normal(size=(20, 6, 3)).astype(np.float32)
    nx, ny = rng.uniform(-0.6, 0.6, (2, 5, 7)).astype(np.float32)
    u, v = np.linspace(-1, 1, 7, dtype=np.float32), np.linspace(-1, 1, 5, dtype=np.float32)
    uu, vv = np.meshgrid(u, v)
    rows = photometry.design(*(a.ravel().astype(np.float64) for a in (nx, ny, uu, vv)))
    for c in range(3):
        ours = optics.colour_change(jnp.asarray(normal[..., c]), *map(jnp.asarray, (nx, ny, u, v)))
        np.testing.assert_allclose(np.asarray(ours).ravel(), rows @ normal[..., c].ravel(), rtol=1e-4, atol=1e-4)


def test_ridge_finds_the_coefficients_it_was_made_from():
    rng = np.random.default_rng(2)
    rows = photometry.design(*rng.uniform(-0.9, 0.9, (4, 4000)))
    truth = rng.normal(size=(120, 3))
    np.testing.assert_allclose(photometry.ridge(rows, rows @ truth, 1e-12), truth, atol=1e-4)
    halved = photometry.ridge(rows, rows @ truth, 1.0)
    assert np.linalg.norm(halved) < np.linalg.norm(truth)


def test_the_side_of_a_dent_that_turns_away_from_a_light_is_in_its_shadow():
    lamp = Lights((0.1, 0.1, 0.1), (Light((1.0, 0.0), (1.0, 0.0, 0.0)),), shadow=0.5)
    halo = photometry.lit(lamp).halo
    assert not photometry.fit_shading(partial(photometry.shade, lamp)).halo.any()
    rising, zero, middle = jnp.ones((1, 1)), jnp.zeros((1, 1)), jnp.zeros(1)
    red = optics.halo_change(jnp.asarray(halo[..., 0]), (rising, zero, zero), middle, middle)
    np.testing.assert_allclose(red, [[-0.5]])  # it rises to the right, so it faces left: half of the lamp is lost
    for other in ((zero, rising, zero), (zero, zero, rising)):
        assert optics.halo_change(jnp.asarray(halo[..., 0]), other, middle, middle) == 0
    assert not halo[..., 1:].any()
