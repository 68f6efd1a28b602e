"""LoRA (Hu et al., 2022) as a pure function over the parameter tree: W + alpha / r * A B."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

Params = dict[str, Any]


def merge_lora(params: Params, alpha: float) -> Params:
    """Return `params` with the low-rank updates of "lora" added to the image tower's q, k, v and output kernels.

    a (depth, D, r) and b (depth, r, D); without a "lora" entry the tree is returned unchanged. Being linear, the
    update may be added to the kernel instead of being applied to the activations: same output, same gradient.
    """
    if "lora" not in params:
        return params
    attention = dict(params["image"]["blocks"]["attention"])
    for name, factors in params["lora"].items():
        update = jnp.einsum("ldr,lre->lde", factors["a"], factors["b"]) * (alpha / factors["a"].shape[-1])
        attention[name] = attention[name] | {"kernel": attention[name]["kernel"] + update}
    image = params["image"] | {"blocks": params["image"]["blocks"] | {"attention": attention}}
    return {name: value for name, value in params.items() if name != "lora"} | {"image": image}
