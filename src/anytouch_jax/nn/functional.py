"""The one file that turns Flax modules into pure functions: build(config) -> Net(init, apply, abstract)."""

from __future__ import annotations

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

from anytouch_jax.config import Model
from anytouch_jax.nn.anytouch import AnyTouch
from anytouch_jax.nn.lora import merge_lora
from anytouch_jax.ops import tokens

Params = dict[str, Any]


@dataclass(frozen=True)
class Net:
    """A network as functions of its parameters, a plain nested dict of arrays."""

    model: Model

    def init(self, key: Array) -> Params:
        """Fresh float32 parameters, drawn on the host from a PRNG key: the same on every device and version."""
        seed = np.asarray(jax.random.key_data(key)).tolist()
        draw = partial(_first_value, model=self.model, seed=seed)
        return jax.tree_util.tree_map_with_path(draw, self.abstract())

    def abstract(self) -> Params:
        """The tree of jax.ShapeDtypeStruct that `init` would return; allocates nothing."""
        return nnx.to_pure_dict(_skeleton(self.model)[1])

    def apply(self, params: Params, method: str, *args: Any, **kwargs: Any) -> Any:
        """Call a method of `AnyTouch` (encode, reconstruct, embed_image, embed_text, match, scale, ...).

        A "lora" entry is merged into the image tower on the way in.
        """
        params = merge_lora(jax.tree.map(jnp.asarray, params), self.model.lora_alpha)
        graph, state = _skeleton(replace(self.model, lora_rank=0))
        state = jax.tree.map(lambda leaf: leaf, state)  # a copy: the skeleton is shared between traces
        nnx.replace_by_pure_dict(state, params)
        return getattr(nnx.merge(graph, state), method)(*args, **kwargs)


def build(model: Model) -> Net:
    """The network of a model configuration."""
    return Net(model)


@dataclass(frozen=True)
class Part:
    """A module beside `AnyTouch` as functions of its parameters; `kind(options)` makes it (see `translation`).

    `options` is a frozen dataclass with a `model`.
    """

    kind: Callable[[Any], Any]
    options: Any

    def init(self, key: Array) -> Params:
        """Fresh float32 parameters, by the rules of `Net.init`."""
        seed = np.asarray(jax.random.key_data(key)).tolist()
        draw = partial(_first_value, model=self.options.model, seed=seed)
        return jax.tree_util.tree_map_with_path(draw, nnx.to_pure_dict(_part(self)[1]))

    def apply(self, params: Params, *args: Any) -> Any:
        """Call the module."""
        graph, state = _part(self)
        state = jax.tree.map(lambda leaf: leaf, state)  # a copy, as in `Net.apply`
        nnx.replace_by_pure_dict(state, jax.tree.map(jnp.asarray, params))
        return nnx.merge(graph, state)(*args)


@lru_cache(maxsize=16)
def _part(part: Part) -> tuple[Any, Any]:
    return nnx.split(nnx.eval_shape(lambda: part.kind(part.options)))


@lru_cache(maxsize=8)
def _skeleton(model: Model) -> tuple[Any, Any]:
    """Graph and abstract state of a network."""
    return nnx.split(nnx.eval_shape(lambda: AnyTouch(model)))


def _first_value(path: Any, leaf: jax.ShapeDtypeStruct, *, model: Model, seed: list[int]) -> Array:
    """The initial value of the parameter at `path`: every rule of initialisation in one place."""
    name, shape = "/".join(entry.key for entry in path), leaf.shape
    last = name.rsplit("/", 1)[-1]
    rng = np.random.default_rng([*seed, zlib.crc32(name.encode())])
    if name == "logit_scale":
        value = -np.log(model.temperature)
    elif name == "decoder/position":
        value = tokens.sincos_table(shape[1], model.image_size // model.patch)
    elif last == "scale":
        value = np.ones(shape)
    elif last in ("bias", "b"):  # b: LoRA starts as no change
        value = np.zeros(shape)
    elif last == "kernel":  # Xavier uniform, as MAE; the touch kernel's inputs span its frames
        inputs = shape[-2] * (shape[-3] if name == "touch/patch/kernel" else 1)
        value = rng.uniform(-1, 1, shape) * np.sqrt(6 / (inputs + shape[-1]))
    else:  # tokens and positions; LoRA's a
        value = rng.standard_normal(shape) * (shape[-2] ** -0.5 if last == "a" else 0.02)
    return jnp.asarray(value, leaf.dtype)
