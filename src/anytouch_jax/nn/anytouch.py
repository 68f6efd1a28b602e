"""The AnyTouch network: touch encoder and decoder, image and text towers, matching head."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array

from anytouch_jax.config import ModelConfig
from anytouch_jax.nn.clip import ImageTower, Lora, TextEncoder
from anytouch_jax.nn.fields import STATES, FieldDecoder, FieldOutput
from anytouch_jax.nn.layers import Dense, Mlp, gelu, rows_of, table
from anytouch_jax.nn.touch import TouchDecoder, TouchEncoder
from anytouch_jax.ops import tokens

Features = TypeVar("Features")  # an array, or a tuple of arrays


def _matcher(model: ModelConfig) -> Mlp | Dense | None:
    """Return the head of Eq. 5, float32 at least: an MLP (paper), one linear layer (release), or None (cosine)."""
    model = replace(model, dtype="float32") if model.dtype == "bfloat16" else model
    if model.match_head == "mlp":
        return Mlp(model.embed, model.embed, model, gelu, outputs=1)
    return Dense(model.embed, 1, model) if model.match_head == "linear" else None


class AnyTouch(nnx.Module):
    """The whole network. A part that the config leaves out does not exist and costs nothing."""

    def __init__(self, model: ModelConfig) -> None:
        self.touch = TouchEncoder(model)
        self.decoder = TouchDecoder(model)
        self.frames, self.embed = model.frames, model.embed
        if model.fields:
            self.fields = FieldDecoder(model)
        if model.image is not None:
            self.image = ImageTower(model, model.image)
            if model.lora_rank:
                size = (model.image.depth, model.image.width, model.lora_rank)
                self.lora = nnx.Dict({n: Lora(*size) for n in ("query", "key", "value", "out")})
        if model.text is not None:
            self.text = TextEncoder(model, model.text)
        if model.image is not None or model.text is not None or model.match_head == "cosine":
            self.logit_scale = table()
        self.matcher = _matcher(model)

    def encode_touch(self, clip: Array, sensor: Array, join: str = "mean", keep_ids: Array | None = None) -> Array:
        """Return touch embeddings (B, E) from the class token, see `Net.encode_touch`."""
        if keep_ids is not None:
            return self.touch.features(clip, sensor, keep_ids)
        return self._over_segments(self.touch.features, clip, sensor, join)

    def encode_poolings(self, clip: Array, sensor: Array, join: str = "mean") -> tuple[Array, Array]:
        """Return in one pass `encode_touch`, and the mean over projected patch tokens (the release's "global")."""

        def both(clip: Array, sensor: Array) -> tuple[Array, Array]:
            hidden, special = self.touch.hidden(clip, sensor), self.decoder.special
            return self.touch.embedding(hidden[:, 0]), jnp.mean(self.touch.projection(hidden[:, special:]), axis=1)

        return self._over_segments(both, clip, sensor, join)

    def see(self, clip: Array, sensor: Array, join: str = "mean") -> Array:
        """Return what sight gives of the last frame, or of that of each segment, see `Net.see`."""
        return self._over_segments(lambda clip, _: self.touch.sight(clip[:, -1]), clip, sensor, join)

    def _over_segments(
        self, features: Callable[[Array, Array], Features], clip: Array, sensor: Array, join: str
    ) -> Features:
        if clip.shape[1] in (1, self.frames):
            return features(clip, sensor)
        parts = tokens.segments(clip, self.frames)
        b, s = parts.shape[:2]
        joins = {
            "mean": lambda z: z.mean(1), "sum": lambda z: z.sum(1), "concat": lambda z: z.reshape(b, s * z.shape[2]),
        }  # fmt: skip
        values = features(parts.reshape(b * s, *parts.shape[2:]), jnp.repeat(sensor, s))
        return jax.tree.map(lambda z: joins[join](z.reshape(b, s, z.shape[-1])), values)

    def encode_tokens(self, clip: Array, sensor: Array, keep_ids: Array | None = None) -> Array:
        """Return the projected sequence (B, 1 + S + K, E) of [class, sensor tokens, patches]: the decoder's input."""
        return self.touch.projection(self.touch.hidden(clip, sensor, keep_ids))

    def reconstruct(
        self, clip: Array, sensor: Array, keep_ids: Array, restore_ids: Array, frames: int,
        decoder_sensor: Array | None = None,
    ) -> Array:  # fmt: skip
        """Return pixels (B, N, frames, P*P*3) of every position from the visible ones of `clip` (B, T, H, W, 3)."""
        latent, own = self.encode_tokens(clip, sensor, keep_ids), None
        if hasattr(self.decoder, "sensor_projection"):
            own = rows_of(self.touch.sensor_tokens[...], sensor if decoder_sensor is None else decoder_sensor)
        return self.decoder(latent, restore_ids, frames, own)

    def measure(self, clip: Array, sensor: Array, aspect: Array) -> FieldOutput:
        """Return the fields of the last frame of clips, see `FieldDecoder`."""
        return self.fields(self.touch.states(clip, sensor, STATES), clip, aspect)

    def encode_and_measure(self, clip: Array, sensor: Array, aspect: Array) -> tuple[Array, Array, FieldOutput]:
        """Return in one pass `encode_poolings` and `measure` of clips of one segment."""
        states = self.touch.states(clip, sensor, STATES)
        hidden = states[..., -self.touch.width :]
        mean = jnp.mean(self.touch.projection(hidden[:, self.decoder.special :]), axis=1)
        return self.touch.embedding(hidden[:, 0]), mean, self.fields(states, clip, aspect)

    def match(self, z_first: Array, z_second: Array) -> Array:
        """Return matching logits (B,) of two unit-norm touch embeddings (Eq. 5), from their element-wise product."""
        if self.matcher is None:
            raise ValueError("this network has no matching head (model.match_head is none)")
        product = z_first * z_second
        if isinstance(self.matcher, Mlp):
            product = product * self.embed  # entries of a product of unit vectors are about 1 / E: to order one
        return self.matcher(product)[:, 0]
