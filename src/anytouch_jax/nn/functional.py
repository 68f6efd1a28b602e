"""Networks as pure functions of their parameters: `build(config) -> Net`.

Flax modules stay behind this file.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jax import Array
from jax.typing import DTypeLike

from anytouch_jax.batch import FieldOutput
from anytouch_jax.config import ModelConfig
from anytouch_jax.nn.anytouch import AnyTouch
from anytouch_jax.nn.clip import merge_lora
from anytouch_jax.ops import losses, tokens
from anytouch_jax.renamed import keywords
from anytouch_jax.shown import shown_short

Params = dict[str, Any]


@shown_short
@dataclass(frozen=True)
class Net:
    """The network of a model configuration, as functions of a plain nested dict of arrays.

    A method of a part that the model lacks raises AttributeError. Call methods inside `jax.jit`:
    outside of it each operation is compiled for itself.
    """

    model: ModelConfig

    def init(self, key: Array) -> Params:
        """Return fresh float32 parameters, drawn from a PRNG key.

        They are drawn on the host, so they are equal on every device and version of jax.
        """
        return _drawn(self.abstract(), self.model, key)

    def abstract(self) -> Params:
        """Return the tree of jax.ShapeDtypeStruct of `init`, without allocating."""
        return nnx.to_pure_dict(_skeleton(AnyTouch, self.model)[1])

    def bind(self, params: Params) -> AnyTouch:
        """Return the module with these parameters, for parts without a method here.

        `net.bind(params).touch` is the touch encoder. A "lora" entry is merged into the image
        tower.
        """
        params = merge_lora(jax.tree.map(jnp.asarray, params), self.model.lora_alpha)
        return _with(params, *_skeleton(AnyTouch, replace(self.model, lora_rank=0)))

    @keywords(join="aggregation")
    def encode_touch(
        self,
        params: Params,
        clip: Array,
        sensor: Array,
        aggregation: str = "mean",
        keep_ids: Array | None = None,
    ) -> Array:
        """Return touch embeddings (B, E) from the class token, not unit-norm.

        Args:
            params: Parameters of the network.
            clip: Normalised pixels, float (B, T, H, W, 3).
            sensor: Rows of the token table, i32 (B,).
            aggregation: A clip longer than `frames` is cut into segments (appendix, "Discussion on
                frame number"). Their features are averaged ("mean"), summed ("sum") or concatenated
                ("concat", which gives (B, segments * E)).
            keep_ids: Patches to encode (B, K), of stills and of clips of `frames` frames. None
                encodes all.
        """
        return self.bind(params).encode_touch(clip, sensor, aggregation, keep_ids)

    @keywords(join="aggregation")
    def encode_poolings(
        self, params: Params, clip: Array, sensor: Array, aggregation: str = "mean"
    ) -> tuple[Array, Array]:
        """Return both poolings (B, E) in one pass: class token, and mean over patch tokens.

        Args:
            params: Of the network.
            clip: Normalised frames (B, T, H, W, 3).
            sensor: Rows i32 (B,) of the sensor table.
            aggregation: How the segments of a longer clip are joined.
        """
        return self.bind(params).encode_poolings(clip, sensor, aggregation)

    def encode_sight(
        self, params: Params, clip: Array, sensor: Array, aggregation: str = "mean"
    ) -> Array:
        """Return values (B, model.sight) of the last frame of normalised clips, see `nn.sight`.

        Those of a clip (B, T, H, W, 3) of several segments are aggregated as in `encode_touch`.

        Args:
            params: Of the network.
            clip: Normalised frames (B, T, H, W, 3).
            sensor: Rows i32 (B,) of the sensor table.
            aggregation: How the segments of a longer clip are joined.
        """
        return self.bind(params).encode_sight(clip, sensor, aggregation)

    def encode_tokens(
        self, params: Params, clip: Array, sensor: Array, keep_ids: Array | None = None
    ) -> Array:
        """Return the projected sequence (B, 1 + S + K, E), the decoder's input.

        It is [class, sensor tokens, patches].

        Args:
            params: Of the network.
            clip: Normalised frames (B, T, H, W, 3).
            sensor: Rows i32 (B,) of the sensor table.
            keep_ids: i32 (B, K) of the visible patches, None for all.
        """
        return self.bind(params).encode_tokens(clip, sensor, keep_ids)

    def reconstruct(
        self,
        params: Params,
        clip: Array,
        sensor: Array,
        keep_ids: Array,
        restore_ids: Array,
        frames: int,
        decoder_sensor: Array | None = None,
    ) -> Array:
        """Return pixels (B, N, frames, P*P*3) of every position from the visible patches.

        Args:
            params: Parameters of the network.
            clip: Normalised pixels, float (B, T, H, W, 3), without the next frame.
            sensor: Rows of the token table, i32 (B,).
            keep_ids: The visible patches (B, K).
            restore_ids: The place (B, N) of each position in [visible, hidden].
            frames: Frames to predict: 1 of a still, 3 of a clip, 4 with the next frame.
            decoder_sensor: Rows i32 (B,) of the tokens that the decoder of the release gets.
        """
        return self.bind(params).reconstruct(
            clip, sensor, keep_ids, restore_ids, frames, decoder_sensor
        )

    def measure(self, params: Params, clip: Array, sensor: Array, aspect: Array) -> FieldOutput:
        """Return depth, shear, contact and force of normalised clips (B, T, H, W, 3).

        The result is free of scale.

        Args:
            params: Of the network.
            clip: Normalised frames (B, T, H, W, 3).
            sensor: Rows i32 (B,) of the sensor table.
            aspect: (B,), the logarithm of the height over the width that the image shows.
        """
        return self.bind(params).measure(clip, sensor, aspect)

    def encode_and_measure(
        self, params: Params, clip: Array, sensor: Array, aspect: Array
    ) -> tuple[Array, Array, FieldOutput]:
        """Return both poolings (B, E) and the fields of clips of one segment, in one pass.

        Args:
            params: Of the network.
            clip: Normalised frames (B, T, H, W, 3), of one segment.
            sensor: Rows i32 (B,) of the sensor table.
            aspect: (B,), the logarithm of the height over the width that the image shows.
        """
        return self.bind(params).encode_and_measure(clip, sensor, aspect)

    def encode_image(self, params: Params, image: Array) -> Array:
        """Return image embeddings (V, E) of normalised RGB images (V, H, W, 3); not unit-norm."""
        return self.bind(params).image(image)

    def encode_text(self, params: Params, ids: Array, mask: Array | None = None) -> Array:
        """Return text embeddings (L, E) of token ids (L, S); not unit-norm."""
        return self.bind(params).text(ids, mask)

    def match(self, params: Params, z_first: Array, z_second: Array) -> Array:
        """Return matching logits f32 (B,) of two unit-norm touch embeddings (B, E) (Eq. 5)."""
        return self.bind(params).match(z_first, z_second)

    def scale(self, params: Params) -> Array:
        """Return 1 / tau f32 (), the learned factor on cosine similarities (Eq. 3): 100 at most."""
        log = self.bind(params).logit_scale[...]
        # Clipped by a straight-through term: the gradient stays that of exp, so a scale beyond 100
        # can fall again. CLIP clips the parameter after each step instead.
        clipped = jnp.minimum(log, math.log(losses.MOST_SCALE))
        return jnp.exp(log + jax.lax.stop_gradient(clipped - log))


def build(model: ModelConfig) -> Net:
    """Return the network of a model configuration."""
    return Net(model)


@dataclass(frozen=True)
class Part:
    """Any other module as functions of its parameters.

    `kind(options)` makes it; `options.model` is a ModelConfig.
    """

    kind: Callable[[Any], Any]
    options: Any

    def init(self, key: Array) -> Params:
        """Return fresh float32 parameters, by the rules of `Net.init`."""
        return _drawn(self.abstract(), self.options.model, key)

    def abstract(self) -> Params:
        """Return the tree of jax.ShapeDtypeStruct of `init`, without allocating."""
        return nnx.to_pure_dict(_skeleton(self.kind, self.options)[1])

    def apply(self, params: Params, *args: Any) -> Any:
        """Call the module."""
        graph, state = _skeleton(self.kind, self.options)
        return _with(jax.tree.map(jnp.asarray, params), graph, state)(*args)


def _skeleton(kind: Callable[[Any], Any], options: Any) -> tuple[Any, Any]:
    """Return graph and abstract state of a module.

    Parameters have the widest float of the context: float64 while jax_enable_x64 is set.
    """
    return _cached_skeleton(kind, options, jax.dtypes.canonicalize_dtype(float))


# Cached, because every call of `bind` needs it.
@lru_cache(maxsize=24)
def _cached_skeleton(kind: Callable[[Any], Any], options: Any, _: DTypeLike) -> tuple[Any, Any]:
    return nnx.split(nnx.eval_shape(lambda: kind(options)))


def _with(params: Params, graph: Any, state: Any) -> Any:
    """Return the module of a skeleton with these parameters."""
    # a copy: the skeleton is shared between traces
    state = jax.tree.map(lambda leaf: leaf, state)
    nnx.replace_by_pure_dict(state, params)
    return nnx.merge(graph, state)


def _drawn(abstract: Params, model: ModelConfig, key: Array) -> Params:
    seed = np.asarray(jax.random.key_data(key)).tolist()
    return jax.tree_util.tree_map_with_path(partial(_first_value, model=model, seed=seed), abstract)


def _first_value(
    path: Any, leaf: jax.ShapeDtypeStruct, *, model: ModelConfig, seed: list[int]
) -> Array:
    """Return the initial value of the parameter at `path`: every rule of initialisation is here."""
    name = "/".join(entry.key for entry in path)
    shape = leaf.shape
    last = name.rsplit("/", 1)[-1]
    # A stream for each name: a new parameter changes no other, and the order does not matter.
    rng = np.random.default_rng([*seed, zlib.crc32(name.encode())])
    if name == "logit_scale":
        value = -np.log(model.temperature)
    elif name == "decoder/position":
        value = jax.jit(tokens.sincos_table, static_argnums=(0, 1))(
            shape[1], model.image_size // model.patch
        )
    elif last == "scale":
        value = np.ones(shape)
    elif last in ("bias", "b"):  # b: LoRA starts as no change
        value = np.zeros(shape)
    elif last == "kernel":
        # Xavier uniform, as MAE. The inputs of the touch kernel span its frames.
        inputs = shape[-2]
        if name == "touch/patch/kernel":
            inputs = inputs * shape[-3]
        value = rng.uniform(-1, 1, shape) * np.sqrt(6 / (inputs + shape[-1]))
    elif last == "a":
        # LoRA's other factor: of the size that an input of the layer keeps.
        value = rng.standard_normal(shape) * shape[-2] ** -0.5
    else:
        # Tokens and positions, as CLIP and MAE.
        value = rng.standard_normal(shape) * 0.02
    # jnp.asarray would compile a program for each shape
    return jax.device_put(np.asarray(value, leaf.dtype))
