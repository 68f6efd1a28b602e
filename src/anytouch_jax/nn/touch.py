"""Touch encoder with sensor tokens (Sec. 3.1, 3.5), and pixel decoder (Sec. 3.2)."""

from __future__ import annotations

from functools import reduce

import jax.numpy as jnp
from flax import nnx
from jax import Array

from anytouch_jax.config import ModelConfig
from anytouch_jax.nn.layers import (
    ACTIVATIONS,
    Dense,
    LayerNorm,
    blocks_between,
    gelu,
    product,
    read_blocks,
    rows_of,
    run_blocks,
    stacked_blocks,
    stored,
    table,
)
from anytouch_jax.nn.sight import Sight
from anytouch_jax.ops import tokens


class TouchPatch(nnx.Module):
    """Patch projection of stills and clips: one kernel a frame, (frames, P*P*3, D), no bias.

    It is shared by all sensors, or each row of the sensor table has its own: then the kernel is
    (rows, frames, P*P*3, D).
    """

    def __init__(self, model: ModelConfig) -> None:
        shape = [model.frames, model.patch**2 * 3, model.touch.width]
        self.own = model.patch_encoder == "sensor"
        if self.own:
            shape.insert(0, len(model.sensors))
        self.kernel = table(*shape)
        self.dtype = jnp.dtype(model.dtype)

    def __call__(self, patches: Array, sensor: Array) -> Array:
        """Project (B, K, T, P*P*3) to (B, K, D).

        A still is a clip of equal frames (Sec. 3.1): kernels are summed.
        """
        kernel = self.kernel[...]
        if patches.shape[2] == 1:
            # The product is linear, so equal frames need one projection by the sum of the kernels
            # instead of three.
            kernel = reduce(jnp.add, jnp.moveaxis(kernel, -3, 0))[..., None, :, :]
        if not self.own:
            matrix = kernel.reshape(-1, kernel.shape[-1])
            x = product(patches.reshape(-1, len(matrix)), matrix, self.dtype)
            return x.reshape(*patches.shape[:2], kernel.shape[-1])
        # One kernel a sample (T3): the batch has several sensors.
        each = rows_of(kernel, sensor)
        own = stored(self.dtype)
        return jnp.einsum("bktc,btcd->bkd", patches.astype(own), each.astype(own))


class TouchEncoder(nnx.Module):
    """ViT over [class, sensor tokens, visible patches]; the architecture of CLIP's image tower."""

    def __init__(self, model: ModelConfig) -> None:
        width = model.touch.width
        self.patch = TouchPatch(model)
        self.class_token = table(width)
        self.position = table(model.patches + 1, width)
        self.sensor_tokens = table(len(model.sensors), model.sensor_tokens, width)
        self.pre_norm = LayerNorm(width, model.norm_eps, model.dtype) if model.pre_norm else None
        self.blocks = stacked_blocks(
            model.touch, model, model.norm_eps, ACTIVATIONS[model.activation]
        )
        self.post_norm = LayerNorm(width, model.norm_eps, model.dtype)
        self.projection = Dense(width, model.embed, model, bias=False)
        if model.sight:
            self.sight = Sight(model)
        self.patch_size = model.patch
        self.depth = model.touch.depth
        self.width = width
        self.remat = model.remat

    def tokens(self, clip: Array, sensor: Array, keep_ids: Array | None = None) -> Array:
        """Return the input sequence (B, 1 + S + K, D), before the first norm.

        With `keep_ids` (B, K) the others are hidden, and never projected.
        """
        batch = clip.shape[0]
        patches = tokens.patchify(clip, self.patch_size)
        table = self.position[...]
        position = jnp.broadcast_to(table[None, 1:], (batch, *table[1:].shape))
        if keep_ids is not None:
            patches = tokens.keep(patches, keep_ids)
            position = tokens.keep(position, keep_ids)
        x = self.patch(patches, sensor)
        first = (self.class_token[...] + table[0])[None, None]
        start = jnp.broadcast_to(first, (batch, 1, x.shape[-1]))
        # Sensor tokens have no position: they belong to the whole image (Sec. 3.5).
        own = rows_of(self.sensor_tokens[...], sensor)
        parts = [start.astype(x.dtype), own.astype(x.dtype), x + position.astype(x.dtype)]
        return jnp.concatenate(parts, axis=1)

    def _first(self, clip: Array, sensor: Array, keep_ids: Array | None = None) -> Array:
        x = self.tokens(clip, sensor, keep_ids)
        if self.pre_norm is None:
            return x
        return self.pre_norm(x)

    def hidden(self, clip: Array, sensor: Array, keep_ids: Array | None = None) -> Array:
        """Return the last hidden states (B, 1 + S + K, D), without the final norm (golden Q5)."""
        x = self._first(clip, sensor, keep_ids)
        return run_blocks(self.blocks, x, remat=self.remat)

    def states(self, clip: Array, sensor: Array, count: int) -> Array:
        """Return `count` hidden states, evenly spaced over the depth of the encoder.

        The first is the first block's input, the last the last block's output. They are
        concatenated: (B, 1 + S + N, count * D). A count of 1 gives the last state (DPT, Ranftl et
        al. 2021).
        """
        x = self._first(clip, sensor)
        states = []
        before = 0
        for number in range(count):
            block = self.depth
            if count > 1:
                block = round(number * self.depth / (count - 1))
            if block > before:
                between = blocks_between(self.blocks, before, block)
                x = run_blocks(between, x, remat=self.remat)
            states.append(x)
            before = block
        return jnp.concatenate(states, axis=-1)

    def features(self, clip: Array, sensor: Array, keep_ids: Array | None = None) -> Array:
        """Return the touch embedding (B, E), not normalised, of all patches or of `keep_ids`."""
        x = self._first(clip, sensor, keep_ids)
        return self.embedding(read_blocks(self.blocks, x, remat=self.remat))

    def embedding(self, token: Array) -> Array:
        """Return the touch embedding (B, E) of the class token's last hidden state (B, D)."""
        return self.projection(self.post_norm(token))


class TouchDecoder(nnx.Module):
    """Light ViT that predicts every position from the visible ones (He et al., 2022).

    It has a head for stills and one for clips, whose last frame is the next one.
    """

    def __init__(self, model: ModelConfig) -> None:
        width = model.decoder.width
        pixels = model.patch**2 * 3
        self.embed = Dense(model.embed, width, model)
        self.mask_token = table(width)
        self.position = table(model.patches + 1, width)
        self.blocks = stacked_blocks(model.decoder, model, model.decoder_norm_eps, gelu)
        self.norm = LayerNorm(width, model.decoder_norm_eps, model.dtype)
        self.still_head = Dense(width, pixels, model)
        self.clip_head = Dense(width, pixels * (model.frames + 1), model)
        self.takes_sensor_tokens = model.decoder_sensor_tokens
        if model.decoder_sensor_tokens:
            self.sensor_projection = Dense(model.touch.width, width, model, bias=False)
        self.special = 1 + model.sensor_tokens
        self.remat = model.remat

    def __call__(
        self, latent: Array, restore_ids: Array, frames: int, sensor_tokens: Array | None = None
    ) -> Array:
        """Return pixels (B, N, frames, P*P*3) of every position.

        Args:
            latent: The projected sequence (B, 1 + S + K, E) of [class, sensor tokens, patches].
            restore_ids: The place (B, N) of each position in [visible, hidden].
            frames: 1 for a still, 3 for a clip, 4 with the next frame.
            sensor_tokens: Tokens (B, S, D) before encoding, which replace the encoded ones as in
                the release. None keeps those.
        """
        x = self.embed(latent)
        position = self.position[...].astype(x.dtype)
        start = x[:, :1] + position[None, :1]
        own = x[:, 1 : self.special]
        if sensor_tokens is not None:
            own = self.sensor_projection(sensor_tokens)
        # Every position is there again, the hidden ones as one learned token. So the position
        # is all that tells two of them apart.
        grid = tokens.restore(x[:, self.special :], self.mask_token[...], restore_ids)
        grid = grid + position[None, 1:]
        x = jnp.concatenate([start, own, grid], axis=1)
        x = self.norm(run_blocks(self.blocks, x, remat=self.remat))[:, self.special :]
        return self.pixels(x, frames)

    def pixels(self, x: Array, frames: int) -> Array:
        """Return (B, N, frames, P*P*3) of (B, N, Dd).

        Only the frames that the loss reads are computed.
        """
        if frames == 1:
            return self.still_head(x)[:, :, None]
        # The outputs of the clip head are in the order of the frames, so the first columns of its
        # kernel are enough where there is no next frame.
        size = self.still_head.kernel.shape[1]
        pixels = self.clip_head(x, outputs=frames * size)
        return pixels.reshape(*x.shape[:2], frames, size)
