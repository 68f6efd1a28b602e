"""Traceable functions of the AnyTouch encoder: features and fields, and what they check.

Parameters are arguments, so all of it can be compiled, differentiated and exported.
"""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np

from anytouch_jax.batch import FieldOutput
from anytouch_jax.config import Config, ModelConfig
from anytouch_jax.encoder import arrays
from anytouch_jax.encoder.arrays import Aggregation, Params, Pooling
from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.nn.attention import usable
from anytouch_jax.nn.functional import Net, build
from anytouch_jax.objectives import normalise_touch


def network(model: ModelConfig) -> Net:
    """Return the network of a model, with the implementations that this machine can run."""
    return build(usable(model))


def precision(config: Config) -> AbstractContextManager[Any]:
    """Return a context with 64 bits for a float64 model, else 32.

    Raises UserError if this process cannot use jax.
    """
    refuse_forked()
    return jax.enable_x64(config.model.dtype == "float64")


def as_clips(frames: Any) -> np.ndarray:
    """Return frames (H, W, 3), (B, H, W, 3) or (B, T, H, W, 3) as clips.

    Raises UserError for frames of two sizes.
    """
    frames = arrays.as_array(frames, "frames")
    if frames.ndim == 3:
        return frames[None, None]
    if frames.ndim == 4:
        return frames[:, None]
    return frames


def check_choices(pooling: Pooling, aggregation: Aggregation) -> None:
    """Raise UserError for another pooling or join than there are."""
    for name, value, kind in (
        ("pooling", pooling, Pooling),
        ("aggregation", aggregation, Aggregation),
    ):
        if value not in get_args(kind):
            raise UserError(f"{name} is one of {', '.join(get_args(kind))}, not {value!r}")


def touch_features(
    params: Params,
    clips: jax.Array,
    sensor: jax.Array,
    *,
    net: Net,
    pooling: Pooling,
    aggregation: Aggregation,
) -> jax.Array:
    """Return features f32 (B, E): a traceable `encode_touch`.

    Args:
        params: those of the touch encoder.
        clips: u8 (B, T, H, W, 3).
        sensor: rows (B,) of the sensor table.
        net: the network of these parameters.
        pooling: see `Encoder.encode_touch`.
        aggregation: see `Encoder.encode_touch`.
    """
    check_choices(pooling, aggregation)
    clips = normalise_touch(clips)
    if pooling == "class":
        values = [net.encode_touch(params, clips, sensor, aggregation)]
    else:
        # XLA drops the class token where it is not used, so "mean" costs no more than it needs.
        both = net.encode_poolings(params, clips, sensor, aggregation)
        values = [*(both if pooling == "both" else both[1:])]
    if net.model.sight:
        values.append(net.encode_sight(params, clips, sensor, aggregation))
    return jnp.concatenate(values, axis=-1).astype(jnp.float32)


def features_and_fields(
    params: Params,
    clips: jax.Array,
    sensor: jax.Array,
    aspect: jax.Array,
    *,
    net: Net,
    pooling: Pooling,
) -> tuple[jax.Array, FieldOutput]:
    """Return features f32 (B, E) and fields of touches: a traceable `encode_and_measure`.

    Args:
        params: those of touch encoder and fields.
        clips: u8 (B, T, H, W, 3).
        sensor: rows (B,) of the sensor table.
        aspect: (B,), logarithms of the images' height over width.
        net: the network of these parameters.
        pooling: that of the features.
    """
    check_choices(pooling, "mean")
    clips = normalise_touch(clips)
    token, mean, out = net.encode_and_measure(params, clips, sensor, aspect)
    values = {"class": [token], "mean": [mean], "both": [token, mean]}[pooling]
    if net.model.sight:
        values.append(net.encode_sight(params, clips, sensor))
    wide = jax.tree.map(lambda value: value.astype(jnp.float32), out)
    return jnp.concatenate(values, axis=-1).astype(jnp.float32), wide


def bare_model(model: ModelConfig) -> ModelConfig:
    """Return a model without towers and heads."""
    return replace(usable(model), image=None, text=None, match_head="none", lora_rank=0, fields=0)


def touch_only(config: Config) -> Config:
    """Return the configuration of the touch encoder alone."""
    return replace(
        config, model=bare_model(config.model), data=replace(config.data, on_bad_sample="error")
    )
