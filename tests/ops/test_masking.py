"""Random masking: each sample by its own noise, and the way back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.ops.tokens import count_visible, keep, random_mask, restore


def test_masks_are_drawn_per_row():
    # A per-batch permutation looks right and is wrong: rows of one batch must hide different patches.
    noise = jax.random.uniform(jax.random.key(0), (64, 16))
    _, _, hidden = random_mask(noise, 4)
    assert len(np.unique(np.asarray(hidden), axis=0)) > 50
    # and every position is hidden about as often as any other
    share = np.asarray(hidden).mean(axis=0)
    assert abs(share.mean() - 0.75) < 1e-6
    assert share.min() > 0.5 and share.max() < 0.95


def test_a_row_depends_on_its_own_noise_only():
    noise = np.random.default_rng(0).random((3, 9))
    other = noise.copy()
    other[0] = other[0, ::-1]
    before, after = random_mask(jnp.asarray(noise), 3)[0], random_mask(jnp.asarray(other), 3)[0]
    np.testing.assert_array_equal(before[1:], after[1:])
    assert not np.array_equal(before[0], after[0])


@pytest.mark.parametrize("count", [0, 1, 5, 9])
def test_kept_are_the_smallest_noise_in_order_and_restore_is_the_inverse(count):
    noise = np.random.default_rng(1).random((2, 9))
    keep_ids, restore_ids, hidden = random_mask(jnp.asarray(noise), count)
    np.testing.assert_array_equal(keep_ids, np.argsort(noise, axis=1)[:, :count])
    assert hidden.sum() == 2 * (9 - count)
    x = jnp.asarray(np.random.default_rng(2).standard_normal((2, 9, 4)))
    visible = keep(x, keep_ids)
    assert visible.shape == (2, count, 4)
    back = restore(visible, jnp.full(4, -7.0), restore_ids)
    np.testing.assert_array_equal(back, jnp.where(hidden[..., None], -7.0, x))


def test_number_of_kept_patches():
    assert count_visible(256, 0.25) == 64
    assert count_visible(64, 0.25) == 16
    assert count_visible(16, 0.0) == 0
    assert count_visible(16, 1.0) == 16
    assert count_visible(1, 0.25) == 0
