"""Centred alignment: a direction that all samples share says nothing, and all samples equal is no way out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.config import preset
from anytouch_jax.ops.losses import alignment_loss, centered, normalise

B, E, WEIGHTS = 6, 5, (0.5, 0.25, 0.1)
HAS_IMAGE, HAS_TEXT = jnp.asarray([1, 1, 0, 1, 1, 0], bool), jnp.asarray([0, 1, 1, 1, 0, 1], bool)


def draw():
    rng = np.random.default_rng(0)
    return tuple(jnp.asarray(rng.standard_normal((B, E)), jnp.float32) for _ in range(3))


def loss(z, center=True):
    return alignment_loss(*z, HAS_IMAGE, HAS_TEXT, jnp.float32(5.0), WEIGHTS, center=center)[0]


def test_rows_have_unit_length_and_mean_zero_before_it():
    (x, _, _) = draw()
    z = centered(x, HAS_IMAGE)
    there = np.asarray(HAS_IMAGE)
    np.testing.assert_allclose(np.linalg.norm(z[there], axis=1), 1.0, rtol=1e-6)
    own = np.asarray(x)[there] - np.asarray(x)[there].mean(0)
    np.testing.assert_allclose(z[there], own / np.linalg.norm(own, axis=1, keepdims=True), rtol=1e-5)
    np.testing.assert_array_equal(z[~there], 0.0)


@pytest.mark.parametrize("which", range(3))
def test_what_all_samples_share_does_not_count(which):
    z = draw()
    moved = [x + (10.0 * jnp.arange(E)[None] if i == which else 0.0) for i, x in enumerate(z)]
    np.testing.assert_allclose(loss(moved), loss(z), rtol=1e-4)
    assert abs(float(loss(moved, center=False)) - float(loss(z, center=False))) > 0.1


@pytest.mark.parametrize("garbage", [1e30, np.nan, np.inf])
def test_absent_rows_are_not_in_the_mean_nor_in_the_gradient(garbage):
    touch, image, text = draw()
    spoiled = jnp.where(HAS_IMAGE[:, None], image, garbage)
    value, grad = jax.value_and_grad(lambda x: loss((touch, x, text)))(spoiled)
    np.testing.assert_allclose(value, loss((touch, image, text)), rtol=1e-6)
    assert np.isfinite(grad).all() and not np.any(grad[2]) and not np.any(grad[5])


def test_the_gradient_does_not_vanish_near_the_collapsed_point():
    """Almost equal embeddings: without centring nothing pulls them apart, with it the pull grows as they near."""
    touch, image, text = draw()
    ones = jnp.ones((1, E))
    near = [ones + 1e-3 * x for x in (touch, image, text)]
    pull = {c: jax.grad(lambda x, c=c: loss((normalise(x), *near[1:]), c))(near[0]) for c in (False, True)}
    assert float(jnp.abs(pull[True]).max()) > 100 * float(jnp.abs(pull[False]).max())


def test_equal_embeddings_and_a_single_pair_have_a_finite_gradient():
    same = tuple(jnp.ones((B, E)) for _ in range(3))
    assert np.isfinite(jax.grad(lambda x: loss((x, *same[1:])))(same[0])).all()
    one = alignment_loss(same[0][:1], same[1][:1], None, None, None, jnp.float32(5.0), WEIGHTS, center=True)[0]
    assert float(one) == 0.0


def test_towers_from_scratch_are_centred_and_the_papers_are_not():
    assert preset("tiny", stage=2, towers="scratch").objective.center_embeddings
    assert not preset("tiny", stage=2, towers="pretrained").objective.center_embeddings
    assert not preset("tiny", stage=2, towers="scratch", recipe="release").objective.center_embeddings
    assert not preset("tiny").objective.center_embeddings
