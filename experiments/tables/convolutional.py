"""A small convolutional network for touches: what can be learned of them without a transformer."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx

WIDTHS = (24, 48, 96, 160)
FEATURES = 2 * WIDTHS[-1]


class Convolutional(nnx.Module):
    """Strided and plain convolutions with group norms; (B, H, W, 3) to the mean and the maximum over places of
    what they find, (B, FEATURES)."""

    def __init__(self, seed: int) -> None:
        rngs, plan = nnx.Rngs(seed), [(3, WIDTHS[0], 5, 2)]
        for before, width in pairwise(WIDTHS):
            plan += [(before, width, 3, 2), (width, width, 3, 1)]
        self.layers = nnx.List(
            [nnx.Conv(a, b, (side, side), strides=step, use_bias=False, rngs=rngs) for a, b, side, step in plan]
        )
        self.norms = nnx.List([nnx.GroupNorm(width, num_groups=8, rngs=rngs) for _, width, _, _ in plan])

    def __call__(self, x: Any) -> Any:
        for layer, norm in zip(self.layers, self.norms, strict=True):
            x = jax.nn.relu(norm(layer(x)))
        return jnp.concatenate([x.mean((1, 2)), x.max((1, 2))], -1)
