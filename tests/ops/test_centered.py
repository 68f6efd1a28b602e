"""Centred alignment: a direction that all samples share says nothing, and all samples equal is no way out."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.config import preset
from anytouch_jax.ops.losses import alignment_loss, centered, normalise

B, E, WEIGHTS = 6, 5, (0.5, 0.25, 0.1)
HAS_IMAGE, HAS_TEXT = np.array([[1, 1, 0, 1, 1, 0], [0, 1, 1, 1, 0, 1]], bool)


def draw():
    return tuple(np.random.default_rng(0).standard_normal((3, B, E)).astype("f4"))


@partial(jax.jit, static_argnums=1)
@partial(jax.value_and_grad, has_aux=False)
def loss_and_grads(z, center):
    return alignment_loss(*z, HAS_IMAGE, HAS_TEXT, jnp.float32(5.0), WEIGHTS, center=center)[0]


def loss(z, center=True):
    return float(loss_and_grads(tuple(z), center)[0])


def test_rows_have_unit_length_and_mean_zero_before_it():
    (x, _, _) = draw()
    z = np.asarray(jax.jit(centered)(x, HAS_IMAGE))
    there = HAS_IMAGE
    np.testing.assert_allclose(np.linalg.norm(z[there], axis=1), 1.0, rtol=1e-6)
    own = x[there] - x[there].mean(0)
    np.testing.assert_allclose(z[there], own / np.linalg.norm(own, axis=1, keepdims=True), rtol=1e-5)
    np.testing.assert_array_equal(z[~there], 0.0)


@pytest.mark.parametrize("which", range(3))
def test_what_all_samples_share_does_not_count(which):
    z = draw()
    moved = [x + (10.0 * np.arange(E, dtype="f4") if i == which else 0.0) for i, x in enumerate(z)]
    np.testing.assert_allclose(loss(moved), loss(z), rtol=1e-4)
    assert abs(loss(moved, center=False) - loss(z, center=False)) > 0.1


@pytest.mark.parametrize("garbage", [1e30, np.nan, np.inf])
def test_absent_rows_are_not_in_the_mean_nor_in_the_gradient(garbage):
    touch, image, text = draw()
    value, (_, grad, _) = loss_and_grads((touch, np.where(HAS_IMAGE[:, None], image, np.float32(garbage)), text), True)
    np.testing.assert_allclose(value, loss((touch, image, text)), rtol=1e-6)
    assert np.isfinite(grad).all() and not np.any(grad[~HAS_IMAGE])


def test_the_gradient_does_not_vanish_near_the_collapsed_point():
    """Almost equal embeddings: without centring nothing pulls them apart, with it the pull grows as they near."""
    near = tuple(np.float32(1.0) + np.float32(1e-3) * x for x in draw())

    def pull(center):
        value = lambda x: loss_and_grads.__wrapped__((normalise(x), *near[1:]), center)[0]  # noqa: E731
        return float(np.abs(jax.jit(jax.grad(value))(near[0])).max())

    assert pull(True) > 100 * pull(False)


def test_equal_embeddings_and_a_single_pair_have_a_finite_gradient():
    assert all(np.isfinite(grad).all() for grad in loss_and_grads((np.ones((B, E), "f4"),) * 3, True)[1])
    one = np.ones((1, E), "f4")
    single = jax.jit(lambda z: alignment_loss(z, z, None, None, None, jnp.float32(5.0), WEIGHTS, center=True)[0])
    assert float(single(one)) == 0.0


def test_towers_from_scratch_are_centred_and_the_papers_are_not():
    recipes = [("scratch", "paper"), ("pretrained", "paper"), ("scratch", "release")]
    configs = [preset("tiny", stage=2, towers=towers, recipe=recipe) for towers, recipe in recipes]
    assert [config.objective.center_embeddings for config in [*configs, preset("tiny")]] == [True, False, False, False]
