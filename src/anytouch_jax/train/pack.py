"""Packing of small arrays into one vector, so that the optimiser has a few large kernels.

A ViT has about twenty parameters a stack, and most are vectors. Updated one by one, they take longer to compile than
the whole backward pass. `optax.adamw` on the packed vectors would need one state for each kind of batch, since a batch
trains some parameters only.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array
Tree = Any
SMALL = 2**16  # elements; a larger array gets its own kernel and is sharded


class Packing(NamedTuple):
    """Which leaves of a tree are packed together: `groups` of leaf numbers, `shapes` and `treedef` of the tree.

    A group of several leaves is one vector in their order. A group of one is the leaf itself.
    """

    groups: tuple[tuple[int, ...], ...]
    shapes: tuple[tuple[int, ...], ...]
    treedef: Any

    def pack(self, tree: Tree) -> tuple[Array, ...]:
        """Return one array a group."""
        leaves = self.treedef.flatten_up_to(tree)
        return tuple(
            leaves[group[0]] if len(group) == 1 else jnp.concatenate([leaves[i].reshape(-1) for i in group])
            for group in self.groups
        )

    def unpack(self, arrays: Sequence[Array]) -> Tree:
        """Return the tree that was packed."""
        leaves: list[Any] = [None] * len(self.shapes)
        for group, array in zip(self.groups, arrays, strict=True):
            start = 0
            for i in group:
                size = int(np.prod(self.shapes[i]))
                leaves[i] = array if len(group) == 1 else array[start : start + size].reshape(self.shapes[i])
                start += size
        return self.treedef.unflatten(leaves)

    def spread(self, group: int, values: Any) -> Any:
        """Repeat `values` (leaves,) over the elements of a group: (n,), or () for a group of one leaf."""
        leaves = self.groups[group]
        if len(leaves) == 1:
            return values[leaves[0]]
        # The index is known while tracing: jnp.repeat would leave XLA to fold a cumulative sum for seconds.
        return values[np.repeat(np.asarray(leaves, np.int32), [int(np.prod(self.shapes[i])) for i in leaves])]


def packing(tree: Tree, small: int = SMALL) -> Packing:
    """Return how to pack a tree of arrays or shapes: leaves below `small` elements together, by data type."""
    leaves, treedef = jax.tree.flatten(tree)
    together: dict[Any, list[int]] = {}
    for i, leaf in enumerate(leaves):
        together.setdefault(leaf.dtype if leaf.size < small else i, []).append(i)
    groups = tuple(tuple(group) for group in together.values())
    return Packing(groups, tuple(leaf.shape for leaf in leaves), treedef)


def global_norm(arrays: Sequence[Array]) -> Array:
    """Return the Euclidean norm of all elements, f32 ()."""
    return jnp.sqrt(sum(jnp.sum(jnp.square(x.astype(jnp.float32))) for x in arrays))
