"""Laws of the integral of a gradient: exact gradients give their surface back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.fields.poisson import border, differences, integrate, inverse_spectrum, transforms

ROWS, COLUMNS = 44, 56
DOWN, ACROSS = np.mgrid[:ROWS, :COLUMNS].astype(np.float32)
AWAY = np.hypot(ACROSS - 31, DOWN - 18)
SURFACES = {
    "sphere": np.sqrt(np.maximum(14.0**2 - AWAY**2, 0)),
    "cone": np.maximum(12 - AWAY, 0),
    "flat punch": 5.0 * (AWAY < 9),
    "stairs": np.floor(ACROSS / 9),
    "punch that leaves the picture": 3.0 * (np.hypot(ACROSS, DOWN - 10) < 15),
}


@pytest.mark.parametrize("name", SURFACES)
def test_exact_gradients_give_their_surface_back(name):
    surface = jnp.asarray(SURFACES[name][None], jnp.float32)
    risen = np.asarray(integrate(differences(surface)))[0]
    wanted = SURFACES[name] - SURFACES[name].mean()
    assert np.ptp(risen) == pytest.approx(np.ptp(wanted), rel=0.02)
    np.testing.assert_allclose(risen, wanted, atol=2e-3)


def test_the_integral_is_that_of_least_squares():
    rng = np.random.default_rng(0)
    rows, columns = 4, 5
    gradient = rng.normal(size=(1, rows, columns, 2)).astype(np.float32)
    equations = []
    values = []
    for row, column in np.ndindex(rows, columns):
        for axis, (r, c) in enumerate(((row, column + 1), (row + 1, column))):
            if r < rows and c < columns:
                equation = np.zeros((rows, columns))
                equation[r, c] = 1
                equation[row, column] = -1
                equations.append(equation.ravel())
                values.append(gradient[0, row, column, axis])
    best = np.linalg.lstsq(np.array(equations), np.array(values), rcond=None)[0]
    risen = np.asarray(integrate(jnp.asarray(gradient)))[0].ravel()
    np.testing.assert_allclose(risen, best - best.mean(), atol=1e-5)


def test_what_is_said_beyond_the_far_edges_is_ignored():
    gradient = np.random.default_rng(1).normal(size=(2, 6, 7, 2)).astype(np.float32)
    other = gradient.copy()
    other[:, :, -1, 0] = 9
    other[:, -1, :, 1] = -9
    np.testing.assert_allclose(integrate(jnp.asarray(gradient)), integrate(jnp.asarray(other)))


def test_the_integral_has_a_gradient():
    gradient = jnp.ones((1, 8, 8, 2))
    slope = jax.grad(lambda g: jnp.sum(integrate(g) ** 2))(gradient)
    assert np.isfinite(slope).all() and np.abs(slope).max() > 0


def test_the_transform_is_orthonormal_and_the_mean_stays_open():
    values, _, squared = transforms(9)
    np.testing.assert_allclose(values @ values.T, np.eye(9), atol=1e-6)
    assert squared[0] == 0 and (np.diff(squared) > 0).all()
    assert inverse_spectrum(9, 9)[0, 0] == 0


def test_the_border_is_one_pixel_wide():
    assert border(5, 6).sum() == 5 * 6 - 3 * 4
