"""Networks that turn one sensor's touch into another's: a ViT decoder and a critic as in ViTGAN
(Lee et al., 2021), a regression of fields, and the U-Net (Ronneberger et al., 2015) and MLP they
are compared with (App. "Cross-sensor generation").
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array

from anytouch_jax.config import ModelConfig, Stack
from anytouch_jax.nn.layers import (
    Dense,
    LayerNorm,
    Mlp,
    gelu,
    run_blocks,
    stacked_blocks,
    stored,
    table,
)
from anytouch_jax.ops import tokens

DECODER = Stack(128, 2, 4, 512)
# hidden states of an encoder that are read: the embedded patches, and as many blocks as DPT reads
STATES = 5


@dataclass(frozen=True)
class Translation:
    """What decides the shapes: the encoder's `model`, the ViT `decoder`, `hidden` channels of the
    MLPs, and the shape of the `field` to regress; () for an image of the encoder's size. `states`:
    hidden states of the encoder that are read (`TouchEncoder.states`). `few`: channels of a patch
    that a field's MLP reads; `channels`: of the U-Net, from its finest level to its coarsest.
    """

    model: ModelConfig
    decoder: Stack = DECODER
    hidden: int = 256
    field: tuple[int, ...] = ()
    states: int = 1
    few: int = 16
    channels: tuple[int, ...] = (16, 32, 48, 64)

    @property
    def special(self) -> int:
        """Tokens before the patches: the class token and the sensor's."""
        return 1 + self.model.sensor_tokens

    @property
    def read(self) -> int:
        """Channels of a token that is read."""
        return self.states * self.model.touch.width


class Painter(nnx.Module):
    """ViT decoder: every token of the encoder (B, 1 + S + N, D) -> an image (B, H, W, 3), a patch
    from each position.

    A linear head paints a patch; ViTGAN's implicit one costs a network a pixel.
    """

    def __init__(self, options: Translation) -> None:
        model = options.model
        width = options.decoder.width
        self.embed = Dense(options.read, width, model)
        self.position = table(options.special + model.patches, width)
        self.blocks = stacked_blocks(options.decoder, model, model.norm_eps, gelu)
        self.norm = LayerNorm(width, model.norm_eps, model.dtype)
        self.head = Dense(width, model.patch**2 * 3, model)
        self.special = options.special
        self.patch = model.patch
        self.side = model.image_size
        self.remat = model.remat

    def __call__(self, x: Array) -> Array:
        x = self.embed(x)
        x = run_blocks(self.blocks, x + self.position[...].astype(x.dtype)[None], remat=self.remat)
        patches = self.head(self.norm(x[:, self.special :]))
        return tokens.unpatchify(patches[:, :, None], self.patch, self.side)[:, 0]


class FieldHead(nnx.Module):
    """MLP (B, inputs) -> a field (B, *field)."""

    def __init__(self, options: Translation, inputs: int) -> None:
        self.mlp = Mlp(
            inputs, options.hidden, options.model, gelu, outputs=math.prod(options.field)
        )
        self.field = options.field

    def __call__(self, x: Array) -> Array:
        return self.mlp(x).reshape(len(x), *self.field)


class FeatureField(FieldHead):
    """A field from an encoder's patch tokens: a few channels of each of (B, 1 + S + N, D), then the
    MLP over all.
    """

    def __init__(self, options: Translation) -> None:
        super().__init__(options, options.model.patches * options.few)
        self.embed = Dense(options.read, options.few, options.model)
        self.special = options.special

    def __call__(self, x: Array) -> Array:
        return super().__call__(self.embed(x[:, self.special :]).reshape(len(x), -1))


class PixelField(FieldHead):
    """A field from the pixels of a thumbnail, (B, t * t * 3)."""

    def __init__(self, options: Translation) -> None:
        super().__init__(options, thumbnail_side(options.model.image_size) ** 2 * 3)


class Critic(nnx.Module):
    """Logit (B,) that a touch is real, from an encoder's class token and the mean of its patch
    tokens, (B, 2 D).
    """

    def __init__(self, options: Translation) -> None:
        width = 2 * options.model.touch.width
        self.norm = LayerNorm(width, options.model.norm_eps, options.model.dtype)
        self.mlp = Mlp(width, options.hidden, options.model, gelu, outputs=1)

    def __call__(self, x: Array) -> Array:
        return self.mlp(self.norm(x))[:, 0].astype(jnp.float32)


class Conv(nnx.Module):
    """A 3 x 3 convolution with zero padding, its kernel stored as a matrix (9 * inputs,
    outputs).
    """

    def __init__(self, inputs: int, outputs: int, model: ModelConfig) -> None:
        self.kernel = table(9 * inputs, outputs)
        self.bias = table(outputs)
        self.dtype = stored(model.dtype)

    def __call__(self, x: Array) -> Array:
        kernel = self.kernel[...].reshape(3, 3, x.shape[-1], -1).astype(self.dtype)
        y = jax.lax.conv_general_dilated(
            x.astype(self.dtype), kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        return y + self.bias[...].astype(self.dtype)[None, None, None]


class UNet(nnx.Module):
    """A small U-Net (B, H, W, 3) -> (B, H, W, 3): halved while the side is even and there are
    channels, and back.
    """

    def __init__(self, options: Translation) -> None:
        model, side = options.model, options.model.image_size
        levels = 0
        while levels < len(options.channels) - 1 and side % 2 ** (levels + 1) == 0:
            levels += 1
        wide = options.channels[: levels + 1]
        down = {
            f"down{i}": Conv(a, b, model)
            for i, (a, b) in enumerate(zip((3, *wide), wide, strict=False))
        }
        up = {f"up{i}": Conv(wide[i + 1] + wide[i], wide[i], model) for i in range(levels)}
        self.convs = nnx.Dict(down | up | {"middle": Conv(wide[-1], wide[-1], model)})
        self.head = Dense(wide[0], 3, model)
        self.levels = levels

    def __call__(self, x: Array) -> Array:
        skipped = []
        for i in range(self.levels):
            x = gelu(self.convs[f"down{i}"](x))
            skipped.append(x)
            x = halved(x)
        x = gelu(self.convs[f"down{self.levels}"](x))
        x = gelu(self.convs["middle"](x))
        for i in reversed(range(self.levels)):
            x = jnp.concatenate([doubled(x), skipped[i]], axis=-1)
            x = gelu(self.convs[f"up{i}"](x))
        return self.head(x)


def halved(x: Array, times: int = 2) -> Array:
    """(B, H, W, C) -> (B, H / times, W / times, C), means of squares."""
    b, h, w, c = x.shape
    return x.reshape(b, h // times, times, w // times, times, c).mean((2, 4))


def doubled(x: Array) -> Array:
    """(B, H, W, C) -> (B, 2 H, 2 W, C), every pixel repeated."""
    return jnp.repeat(jnp.repeat(x, 2, axis=1), 2, axis=2)


def thumbnail_side(side: int) -> int:
    """Side of the largest thumbnail of at most 28 pixels whose pixels are whole squares of the
    image's.
    """
    return max(t for t in range(1, 29) if side % t == 0)
