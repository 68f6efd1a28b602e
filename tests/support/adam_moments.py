"""What Adam remembers of each parameter, out of the packed state of the optimiser."""

from typing import Any, NamedTuple

import jax

from anytouch_jax.train.optim import OptState, packing


class Moments(NamedTuple):
    """The state of Adam for one parameter: the count `updates` i32 (), and `mu` and `nu` of its
    shape.
    """

    updates: jax.Array
    mu: jax.Array
    nu: jax.Array


def moments(state: OptState, params: Any) -> Any:
    """The `Moments` of every parameter, in a tree like `params`."""
    layout = packing(params)
    counts = layout.treedef.unflatten(list(state.counts))
    return jax.tree.map(Moments, counts, layout.unpack(state.mu), layout.unpack(state.nu))
