"""CLIP's image and text towers (Radford et al., 2021) for stage 2, and LoRA of the image tower."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from flax import nnx
from jax import Array

from anytouch_jax.config import ModelConfig, Stack, TextTower
from anytouch_jax.nn.layers import (
    ACTIVATIONS,
    Dense,
    LayerNorm,
    rows_of,
    run_blocks,
    stacked_blocks,
    stored,
    table,
)
from anytouch_jax.ops import tokens

Params = dict[str, Any]


class ImageTower(nnx.Module):
    """ViT over [class, patches] of an RGB image, with the embedding from the class token."""

    def __init__(self, model: ModelConfig, stack: Stack) -> None:
        self.patch = Dense(model.patch**2 * 3, stack.width, model, bias=False)
        self.class_token = table(stack.width)
        self.position = table(model.patches + 1, stack.width)
        self.pre_norm = LayerNorm(stack.width, model.norm_eps, model.dtype)
        self.blocks = stacked_blocks(stack, model, model.norm_eps, ACTIVATIONS[model.activation])
        self.post_norm = LayerNorm(stack.width, model.norm_eps, model.dtype)
        self.projection = Dense(stack.width, model.embed, model, bias=False)
        self.patch_size = model.patch
        self.remat = model.remat

    def hidden(self, image: Array) -> Array:
        """Return the last hidden states (V, 1 + N, D) of normalised images (V, H, W, 3)."""
        x = self.patch(tokens.patchify(image[:, None], self.patch_size)[:, :, 0])
        class_token = self.class_token[...].astype(x.dtype)[None, None]
        start = jnp.broadcast_to(class_token, (len(x), 1, x.shape[-1]))
        x = jnp.concatenate([start, x], axis=1) + self.position[...].astype(x.dtype)[None]
        return run_blocks(self.blocks, self.pre_norm(x), remat=self.remat)

    def pooled(self, image: Array) -> Array:
        """Return the normed class token (V, D), before the projection."""
        return self.post_norm(self.hidden(image)[:, 0])

    def __call__(self, image: Array) -> Array:
        """Return the image embedding (V, E), not normalised."""
        return self.projection(self.pooled(image))


class TextEncoder(nnx.Module):
    """Causal transformer over token ids, with the embedding from the end token.

    CLIP pads with the end token too, which is the largest id: the first one is pooled.
    """

    def __init__(self, model: ModelConfig, tower: TextTower) -> None:
        width = tower.stack.width
        self.token = table(tower.vocab, width)
        self.position = table(tower.length, width)
        self.blocks = stacked_blocks(
            tower.stack, model, model.norm_eps, ACTIVATIONS[model.activation]
        )
        self.final_norm = LayerNorm(width, model.norm_eps, model.dtype)
        self.projection = Dense(width, model.embed, model, bias=False)
        self.end_token = tower.end_token
        self.dtype = stored(model.dtype)
        self.remat = model.remat

    def hidden(self, ids: Array, mask: Array | None = None) -> Array:
        """Return normed hidden states (L, S, W) of token ids (L, S).

        `mask` bool (L, S) is True on readable tokens.
        """
        position = self.position[...][None, : ids.shape[1]]
        x = (rows_of(self.token[...], ids) + position).astype(self.dtype)
        x = run_blocks(self.blocks, x, remat=self.remat, causal=True, mask=mask)
        return self.final_norm(x)

    def pooled(self, ids: Array, mask: Array | None = None) -> Array:
        """Return the hidden state (L, W) of the end token, at its first place.

        It is the largest id, or `end_token`.
        """
        # argmax gives the first of equal ones
        if self.end_token is None:
            at = jnp.argmax(ids, axis=1)
        else:
            at = jnp.argmax(ids == self.end_token, axis=1)
        return jnp.take_along_axis(self.hidden(ids, mask), at[:, None, None], axis=1)[:, 0]

    def __call__(self, ids: Array, mask: Array | None = None) -> Array:
        """Return the text embedding (L, E), not normalised."""
        return self.projection(self.pooled(ids, mask))


class Lora(nnx.Module):
    """Low-rank factors of one projection in every block: a (depth, D, r), b (depth, r, D)."""

    def __init__(self, depth: int, width: int, rank: int) -> None:
        self.a = table(depth, width, rank)
        self.b = table(depth, rank, width)


def merge_lora(params: Params, alpha: float) -> Params:
    """Return `params` with LoRA merged into the image tower's attention (Hu et al., 2022).

    Its q, k, v and output kernels W become W + alpha / r * A B. Without a "lora" entry the tree is
    unchanged.
    """
    if "lora" not in params:
        return params
    # The update is linear, so adding it to the kernel gives the output and the gradient of applying
    # it to the activations, and costs a product of D x r x D instead of two over all tokens.
    blocks = params["image"]["blocks"]
    attention = dict(blocks["attention"])
    for name, factors in params["lora"].items():
        rank = factors["a"].shape[-1]
        update = jnp.einsum("ldr,lre->lde", factors["a"], factors["b"]) * (alpha / rank)
        attention[name] = attention[name] | {"kernel": attention[name]["kernel"] + update}
    image = params["image"] | {"blocks": blocks | {"attention": attention}}
    others = {name: value for name, value in params.items() if name != "lora"}
    return others | {"image": image}
