"""The AnyTouch network: touch encoder and decoder, image and text towers, matching head."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array

from anytouch_jax import doors
from anytouch_jax.batch import FieldOutput
from anytouch_jax.config import ModelConfig
from anytouch_jax.nn.clip import ImageTower, Lora, TextEncoder
from anytouch_jax.nn.heads import Head
from anytouch_jax.nn.layers import Dense, Mlp, gelu, rows_of, table
from anytouch_jax.nn.touch import TouchDecoder, TouchEncoder
from anytouch_jax.ops import tokens

Features = TypeVar("Features")  # an array, or a tuple of arrays


def _matcher(model: ModelConfig) -> Mlp | Dense | None:
    """Return the head of Eq. 5: an MLP (paper), one linear layer (release), or None (cosine)."""
    # Logits of a product of unit vectors need more than 8 bits of mantissa.
    if model.dtype == "bfloat16":
        model = replace(model, dtype="float32")
    if model.match_head == "mlp":
        return Mlp(model.embed, model.embed, model, gelu, outputs=1)
    if model.match_head == "linear":
        return Dense(model.embed, 1, model)
    return None


class AnyTouch(nnx.Module):
    """The whole network. A part that the config leaves out does not exist and costs nothing."""

    def __init__(self, model: ModelConfig) -> None:
        self.touch = TouchEncoder(model)
        self.decoder = TouchDecoder(model)
        self.frames = model.frames
        self.embed = model.embed
        if model.fields:
            head: Head = doors.enter(doors.HEADS["fields"])
            self.fields = head.build(model)
            self.field_states = head.states
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

    def encode_touch(
        self, clip: Array, sensor: Array, aggregation: str = "mean", keep_ids: Array | None = None
    ) -> Array:
        """Return touch embeddings (B, E) from the class token, see `Net.encode_touch`."""
        if keep_ids is not None:
            return self.touch.features(clip, sensor, keep_ids)
        return self._over_segments(self.touch.features, clip, sensor, aggregation)

    def encode_poolings(
        self, clip: Array, sensor: Array, aggregation: str = "mean"
    ) -> tuple[Array, Array]:
        """Return in one pass `encode_touch`, and the mean over projected patch tokens.

        The release calls the mean "global".
        """

        def both(clip: Array, sensor: Array) -> tuple[Array, Array]:
            return self._poolings(self.touch.hidden(clip, sensor))

        return self._over_segments(both, clip, sensor, aggregation)

    def encode_sight(self, clip: Array, sensor: Array, aggregation: str = "mean") -> Array:
        """Return what the trunk gives of the last frame of each segment, see `Net.encode_sight`."""

        def last(clip: Array, _: Array) -> Array:
            return self.touch.sight(clip[:, -1])

        return self._over_segments(last, clip, sensor, aggregation)

    def _poolings(self, hidden: Array) -> tuple[Array, Array]:
        """Return both poolings (B, E) of the last hidden states (B, 1 + S + N, D)."""
        mean = jnp.mean(self.touch.projection(hidden[:, self.decoder.special :]), axis=1)
        return self.touch.embedding(hidden[:, 0]), mean

    def _over_segments(
        self,
        features: Callable[[Array, Array], Features],
        clip: Array,
        sensor: Array,
        aggregation: str,
    ) -> Features:
        """Return features of a clip of any length: those of its segments, joined."""
        if clip.shape[1] in (1, self.frames):
            return features(clip, sensor)
        parts = tokens.segments(clip, self.frames)
        b, s = parts.shape[:2]

        def joined(z: Array) -> Array:
            z = z.reshape(b, s, z.shape[-1])
            if aggregation == "mean":
                return z.mean(1)
            if aggregation == "sum":
                return z.sum(1)
            if aggregation == "concat":
                return z.reshape(b, s * z.shape[2])
            raise ValueError(f"segments are joined by mean, sum or concat, not {aggregation!r}")

        flat = parts.reshape(b * s, *parts.shape[2:])
        return jax.tree.map(joined, features(flat, jnp.repeat(sensor, s)))

    def encode_tokens(self, clip: Array, sensor: Array, keep_ids: Array | None = None) -> Array:
        """Return the projected sequence (B, 1 + S + K, E), the decoder's input.

        It is [class, sensor tokens, patches].
        """
        return self.touch.projection(self.touch.hidden(clip, sensor, keep_ids))

    def reconstruct(
        self,
        clip: Array,
        sensor: Array,
        keep_ids: Array,
        restore_ids: Array,
        frames: int,
        decoder_sensor: Array | None = None,
    ) -> Array:
        """Return pixels (B, N, frames, P*P*3) of every position, see `Net.reconstruct`."""
        latent = self.encode_tokens(clip, sensor, keep_ids)
        own = None
        if self.decoder.takes_sensor_tokens:
            rows = sensor if decoder_sensor is None else decoder_sensor
            own = rows_of(self.touch.sensor_tokens[...], rows)
        return self.decoder(latent, restore_ids, frames, own)

    def measure(self, clip: Array, sensor: Array, aspect: Array) -> FieldOutput:
        """Return the fields of the last frame of clips, see `fields.module.FieldDecoder`."""
        return self.fields(self.touch.states(clip, sensor, self.field_states), clip, aspect)

    def encode_and_measure(
        self, clip: Array, sensor: Array, aspect: Array
    ) -> tuple[Array, Array, FieldOutput]:
        """Return in one pass `encode_poolings` and `measure` of clips of one segment."""
        states = self.touch.states(clip, sensor, self.field_states)
        # The last of the concatenated states is the output of the last block.
        embedding, mean = self._poolings(states[..., -self.touch.width :])
        return embedding, mean, self.fields(states, clip, aspect)

    def match(self, z_first: Array, z_second: Array) -> Array:
        """Return matching logits (B,) of two unit-norm touch embeddings (B, E) (Eq. 5).

        They are computed from the element-wise product.
        """
        if self.matcher is None:
            raise ValueError("this network has no matching head (model.match_head is none)")
        product = z_first * z_second
        if isinstance(self.matcher, Mlp):
            # entries of a product of unit vectors are about 1 / E: to order one
            product = product * self.embed
        return self.matcher(product)[:, 0]
