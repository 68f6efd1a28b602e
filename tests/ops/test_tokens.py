import jax
import numpy as np
import pytest

from anytouch_jax.ops import tokens
from anytouch_jax.ops.tokens import count_visible

patchify, segments, sincos_table = (
    jax.jit(f, static_argnums=n)
    for f, n in ((tokens.patchify, 1), (tokens.segments, 1), (tokens.sincos_table, (0, 1)))
)
unpatchify = jax.jit(tokens.unpatchify, static_argnums=(1, 2))


def test_patchify_orders_row_col_colour():
    ramp = np.arange(1 * 1 * 4 * 4 * 3).reshape(1, 1, 4, 4, 3)
    patches = np.asarray(patchify(ramp, 2))
    assert patches.shape == (1, 4, 1, 12)
    # The second patch is the top right one: pixels (0, 2), (0, 3), (1, 2), (1, 3), three colours
    # each.
    assert patches[0, 1, 0].tolist() == [6, 7, 8, 9, 10, 11, 18, 19, 20, 21, 22, 23]


@pytest.mark.parametrize("shape", [(2, 1, 6, 6, 3), (1, 4, 4, 8, 3), (3, 3, 2, 2, 1)])
def test_unpatchify_is_the_exact_inverse(shape):
    clip = np.random.default_rng(0).standard_normal(shape).astype(np.float32)
    patches = patchify(clip, 2)
    assert patches.shape == (shape[0], shape[2] * shape[3] // 4, shape[1], 4 * shape[4])
    np.testing.assert_array_equal(unpatchify(patches, 2, shape[2]), clip)


def test_sincos_table_class_row_is_zero_and_positions_differ():
    table = np.asarray(sincos_table(32, 4))
    assert table.shape == (17, 32)
    assert not table[0].any()
    assert len(np.unique(table.round(5), axis=0)) == 17
    # Position (row 0, col 0): all sines 0, all cosines 1. First half of the channels: the column.
    np.testing.assert_allclose(table[1], np.tile(np.repeat([0.0, 1.0], 8), 2))
    # one column on: the row half stays
    np.testing.assert_array_equal(table[1 + 1, 16:], table[1, 16:])
    # one row on: the column half stays
    np.testing.assert_array_equal(table[1 + 4, :16], table[1, :16])


@pytest.mark.parametrize(
    ("total", "starts"), [(3, [0]), (6, [0, 3]), (7, [0, 3, 4]), (10, [0, 3, 6, 7])]
)
def test_segments_cover_every_frame_and_end_with_the_last(total, starts):
    cut = np.asarray(segments(np.arange(total).reshape(1, total, 1), 3))
    assert cut.shape == (1, len(starts), 3, 1)
    assert cut[0, :, 0, 0].tolist() == starts
    assert set(cut.ravel().tolist()) == set(range(total))


random_mask = jax.jit(tokens.random_mask, static_argnums=1)


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
