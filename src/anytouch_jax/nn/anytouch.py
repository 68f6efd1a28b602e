"""AnyTouch: touch encoder and decoder, image and text towers, matching head, under the names that others call."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array

from anytouch_jax.config import ModelConfig
from anytouch_jax.nn.clip import ImageTower, TextEncoder
from anytouch_jax.nn.layers import Dense, Mlp, gelu, rows_of, table
from anytouch_jax.nn.touch import TouchDecoder, TouchEncoder
from anytouch_jax.ops import tokens

Found = TypeVar("Found")  # features, or several of them


class Lora(nnx.Module):
    """Low-rank factors of one projection in every block: a (depth, D, r), b (depth, r, D)."""

    def __init__(self, depth: int, width: int, rank: int) -> None:
        self.a, self.b = table(depth, width, rank), table(depth, rank, width)


def _matcher(model: ModelConfig) -> Mlp | Dense | None:
    """The matching head of Eq. 5: an MLP (paper), one linear layer (release), or none (as for cosines). Its logits
    are float32 at least, as those of every contrast."""
    model = replace(model, dtype="float32") if model.dtype == "bfloat16" else model
    if model.match_head == "mlp":
        return Mlp(model.embed, model.embed, model, gelu, outputs=1)
    return Dense(model.embed, 1, model) if model.match_head == "linear" else None


class AnyTouch(nnx.Module):
    """The whole network. Parts that the config leaves out do not exist and cost nothing."""

    def __init__(self, model: ModelConfig) -> None:
        self.touch = TouchEncoder(model)
        self.decoder = TouchDecoder(model)
        self.frames, self.embed = model.frames, model.embed
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
        if model.force_head:
            self.force = Dense(model.embed, 2, model)

    def encode(self, clip: Array, sensor: Array, join: str = "mean") -> Array:
        """Touch embeddings (B, E) of stills (T = 1) or clips, from the class token, not normalised.

        A clip of more than three frames is cut into three-frame segments whose features are averaged
        (join="mean"), summed ("sum") or concatenated ("concat": (B, S*E)) (App. "Discussion on frame number").
        """
        return self._over_segments(self.touch.features, clip, sensor, join)

    def encode_some(self, clip: Array, sensor: Array, keep_ids: Array) -> Array:
        """As `encode`, of stills and clips of three frames, from the patches `keep_ids` (B, K) alone."""
        return self.touch.features(clip, sensor, keep_ids)

    def encode_both(self, clip: Array, sensor: Array, join: str = "mean") -> tuple[Array, Array]:
        """In one pass `encode`, and the mean over the projected patch tokens (the release's "global" pooling)."""
        special = 1 + self.touch.sensor_tokens[...].shape[1]

        def both(clip: Array, sensor: Array) -> tuple[Array, Array]:
            hidden = self.touch.hidden(clip, sensor)
            return self.touch.embedding(hidden[:, 0]), jnp.mean(self.touch.projection(hidden[:, special:]), axis=1)

        return self._over_segments(both, clip, sensor, join)

    def _over_segments(self, features: Callable[[Array, Array], Found], clip: Array, sensor: Array, join: str) -> Found:
        if clip.shape[1] in (1, self.frames):
            return features(clip, sensor)
        parts = tokens.segments(clip, self.frames)
        b, s = parts.shape[:2]
        ways = {"mean": lambda z: z.mean(1), "sum": lambda z: z.sum(1), "concat": lambda z: z.reshape(b, -1)}
        found = features(parts.reshape(b * s, *parts.shape[2:]), jnp.repeat(sensor, s))
        return jax.tree.map(lambda z: ways[join](z.reshape(b, s, -1)), found)

    def encode_tokens(self, clip: Array, sensor: Array, keep_ids: Array | None = None) -> Array:
        """The projected sequence (B, 1 + S + K, E) of [class, sensor tokens, patches]: the decoder's input."""
        return self.touch.projection(self.touch.hidden(clip, sensor, keep_ids))

    def reconstruct(
        self,
        clip: Array,
        sensor: Array,
        keep_ids: Array,
        restore_ids: Array,
        frames: int,
        decoder_sensor: Array | None = None,
        *,
        force: bool = False,
    ) -> tuple[Array, Array | None]:
        """Pixels (B, N, frames, P*P*3) of every position from the visible ones of `clip` (B, T, H, W, 3).

        With `force`, force and its change (B, 2) from the class token of the visible patches; None without.
        """
        hidden, own = self.touch.hidden(clip, sensor, keep_ids), None
        if hasattr(self.decoder, "sensor_projection"):
            own = rows_of(self.touch.sensor_tokens[...], sensor if decoder_sensor is None else decoder_sensor)
        pixels = self.decoder(self.touch.projection(hidden), restore_ids, frames, own)
        return pixels, self.force(self.touch.embedding(hidden[:, 0])) if force else None

    def embed_image(self, image: Array) -> Array:
        """Image embeddings (V, E), not normalised."""
        return self.image(image)

    def embed_text(self, ids: Array, mask: Array | None = None) -> Array:
        """Text embeddings (L, E), not normalised."""
        return self.text(ids, mask)

    def match(self, z_first: Array, z_second: Array) -> Array:
        """Matching logits (B,) of two unit-norm touch embeddings (Eq. 5): a head on their element-wise product."""
        if self.matcher is None:
            raise ValueError("this network has no matching head (model.match_head is none)")
        product = z_first * z_second
        if isinstance(self.matcher, Mlp):
            product = product * self.embed  # entries of a product of unit vectors are about 1 / E: to order one
        return self.matcher(product)[:, 0]

    def scale(self) -> Array:
        """1 / tau, the factor on cosine similarities."""
        return jnp.exp(self.logit_scale[...])
