"""Random masking: each sample by its own noise, and the way back."""

import jax
import numpy as np
import pytest

from anytouch_jax.ops import tokens
from anytouch_jax.ops.tokens import count_visible

random_mask = jax.jit(tokens.random_mask, static_argnums=1)


def test_masks_are_drawn_per_row():
    # A per-batch permutation looks right and is wrong: rows of one batch must hide different patches.
    hidden = np.asarray(random_mask(np.random.default_rng(0).random((64, 16)), 4)[2])
    assert len(np.unique(hidden, axis=0)) > 50
    # and every position is hidden about as often as any other
    share = hidden.mean(axis=0)
    assert abs(share.mean() - 0.75) < 1e-6
    assert share.min() > 0.5 and share.max() < 0.95


def test_a_row_depends_on_its_own_noise_only():
    noise = np.random.default_rng(0).random((3, 9))
    other = noise.copy()
    other[0] = other[0, ::-1]
    before, after = (np.asarray(random_mask(x, 3)[0]) for x in (noise, other))
    np.testing.assert_array_equal(before[1:], after[1:])
    assert not np.array_equal(before[0], after[0])


@pytest.mark.parametrize("count", [0, 1, 5, 9])
def test_kept_are_the_smallest_noise_in_order_and_restore_is_the_inverse(count):
    noise = np.random.default_rng(1).random((2, 9))
    keep_ids, restore_ids, hidden = jax.device_get(random_mask(noise, count))
    np.testing.assert_array_equal(keep_ids, np.argsort(noise, axis=1)[:, :count])
    assert hidden.sum() == 2 * (9 - count)
    x = np.random.default_rng(2).standard_normal((2, 9, 4)).astype("f4")
    visible = jax.jit(tokens.keep)(x, keep_ids)
    assert visible.shape == (2, count, 4)
    back = jax.jit(tokens.restore)(visible, np.full(4, -7.0, "f4"), restore_ids)
    np.testing.assert_array_equal(back, np.where(hidden[..., None], np.float32(-7.0), x))


def test_number_of_kept_patches():
    cases = [(256, 0.25), (64, 0.25), (16, 0.0), (16, 1.0), (1, 0.25)]
    assert [count_visible(*case) for case in cases] == [64, 16, 0, 16, 0]
