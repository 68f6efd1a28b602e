"""The one file that turns Flax modules into pure functions: build(config) -> Net(init, apply, abstract)."""

from __future__ import annotations

import operator
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

from anytouch_jax.config import ModelConfig
from anytouch_jax.nn.anytouch import AnyTouch
from anytouch_jax.nn.lora import merge_lora
from anytouch_jax.ops import tokens

Params = dict[str, Any]


@dataclass(frozen=True)
class Net:
    """A network as functions of its parameters, a plain nested dict of arrays."""

    model: ModelConfig

    def init(self, key: Array) -> Params:
        """Fresh float32 parameters, drawn on the host from a PRNG key: the same on every device and version."""
        return _drawn(self.abstract(), self.model, key)

    def abstract(self) -> Params:
        """The tree of jax.ShapeDtypeStruct that `init` would return; allocates nothing."""
        return nnx.to_pure_dict(_skeleton(AnyTouch, self.model)[1])

    def apply(self, params: Params, method: str, *args: Any, **kwargs: Any) -> Any:
        """Call a method of `AnyTouch` (encode, embed_image, match, ...) or, by a dotted name, of a part (text.hidden).

        A "lora" entry is merged into the image tower on the way in.
        """
        params = merge_lora(jax.tree.map(jnp.asarray, params), self.model.lora_alpha)
        module = _with(params, *_skeleton(AnyTouch, replace(self.model, lora_rank=0)))
        return operator.attrgetter(method)(module)(*args, **kwargs)


def build(model: ModelConfig) -> Net:
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
        return _drawn(nnx.to_pure_dict(_skeleton(self.kind, self.options)[1]), self.options.model, key)

    def apply(self, params: Params, *args: Any) -> Any:
        """Call the module."""
        return _with(jax.tree.map(jnp.asarray, params), *_skeleton(self.kind, self.options))(*args)


@lru_cache(maxsize=24)
def _skeleton(kind: Callable[[Any], Any], options: Any) -> tuple[Any, Any]:
    """Graph and abstract state of a module."""
    return nnx.split(nnx.eval_shape(lambda: kind(options)))


def _with(params: Params, graph: Any, state: Any) -> Any:
    """The module of a skeleton with these parameters."""
    state = jax.tree.map(lambda leaf: leaf, state)  # a copy: the skeleton is shared between traces
    nnx.replace_by_pure_dict(state, params)
    return nnx.merge(graph, state)


def _drawn(abstract: Params, model: ModelConfig, key: Array) -> Params:
    seed = np.asarray(jax.random.key_data(key)).tolist()
    return jax.tree_util.tree_map_with_path(partial(_first_value, model=model, seed=seed), abstract)


def _first_value(path: Any, leaf: jax.ShapeDtypeStruct, *, model: ModelConfig, seed: list[int]) -> Array:
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
