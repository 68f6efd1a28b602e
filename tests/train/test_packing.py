"""Small leaves as one vector: nothing lost, order kept, values spread where they belong."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.train.optim import global_norm, packing

TREE = {
    "b": np.arange(6, dtype="f4").reshape(2, 3), "a": np.full(4, 7, "f4"),
    "large": np.arange(40, dtype="f4").reshape(5, 8), "scalar": np.float32(3), "whole": np.arange(3, dtype="i4"),
}  # fmt: skip


@pytest.mark.parametrize("small", [0, 5, 10, 1000])
def test_unpacking_gives_the_tree_back(small):
    layout = packing(TREE, small)
    arrays, back = jax.jit(lambda tree: ((arrays := layout.pack(tree)), layout.unpack(arrays)))(TREE)
    assert sum(array.size for array in arrays) == sum(leaf.size for leaf in jax.tree.leaves(TREE))
    assert jax.tree.structure(back) == jax.tree.structure(TREE)
    jax.tree.map(np.testing.assert_array_equal, back, TREE)
    assert all(a.dtype == b.dtype for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(TREE), strict=True))


def test_small_leaves_of_a_type_lie_together_and_large_ones_alone():
    layout = packing(TREE, 10)
    assert layout.groups == ((0, 1, 3), (2,), (4,))
    vector, large, whole = layout.pack(TREE)
    np.testing.assert_array_equal(vector, [7, 7, 7, 7, 0, 1, 2, 3, 4, 5, 3])
    assert large is TREE["large"] and whole is TREE["whole"]


def test_values_spread_over_the_elements_of_their_leaf():
    layout = packing(TREE, 10)
    values = np.asarray([10.0, 20.0, 30.0, 40.0, 50.0])
    for each in (values, jnp.asarray(values)):
        np.testing.assert_array_equal(layout.spread(0, each), [10] * 4 + [20] * 6 + [40])
        assert layout.spread(1, each) == 30 and layout.spread(2, each) == 50


def test_the_norm_is_that_of_all_elements():
    floats = {name: value for name, value in TREE.items() if name != "whole"}
    flat = np.concatenate([np.asarray(leaf).ravel() for leaf in jax.tree.leaves(floats)])
    for small in (0, 1000):
        norm = jax.jit(lambda tree, n=small: global_norm(packing(tree, n).pack(tree)))(floats)
        np.testing.assert_allclose(norm, np.linalg.norm(flat), rtol=1e-6)
