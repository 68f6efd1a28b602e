"""Multi-head attention in three equal forms: by XLA, by cuDNN, or mapped over groups of heads."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import jax
import jax.numpy as jnp
from jax import Array

from anytouch_jax.config import ModelConfig

# Bytes of logits that fit in a core's cache: six heads of a still at 262 tokens.
CACHE = 1_700_000


def attention(
    q: Array,
    k: Array,
    v: Array,
    *,
    implementation: str,
    causal: bool = False,
    mask: Array | None = None,
) -> Array:
    """Return softmax(q k^T / sqrt(D)) v, (B, Q, H, D).

    Args:
        q: Queries (B, Q, H, D).
        k: Keys (B, S, H, D).
        v: Values (B, S, H, D).
        implementation: "xla", "cudnn", "mapped" or "auto", which is mapped on a single CPU device,
            else XLA. What a form cannot do, XLA does.
        causal: Whether a query reads the keys up to its own place only.
        mask: Keys to read, bool (B, S). None: all.
    """
    free = mask is None and not causal and q.shape == k.shape
    if implementation == "auto":
        # Over several devices the map would run the groups of one device after those of another.
        one_cpu = jax.default_backend() == "cpu" and jax.device_count() == 1
        implementation = "mapped" if one_cpu else "xla"
    # Text, which is causal and masked, is too short to gain, and so is a call with few queries.
    if implementation == "mapped" and free and q.size:
        return mapped(q, k, v)
    keys = None if mask is None else mask[:, None, None, :]
    known: Literal["cudnn", "xla"] = "xla"
    # cuDNN has no other precision, and refuses an odd number of queries.
    is_narrow = q.dtype in (jnp.bfloat16, jnp.float16)
    if implementation == "cudnn" and mask is None and q.shape[1] % 2 == 0 and is_narrow:
        known = "cudnn"
    return jax.nn.dot_product_attention(q, k, v, mask=keys, is_causal=causal, implementation=known)


def usable(model: ModelConfig) -> ModelConfig:
    """Return `model` with a form of attention that this machine has, for weights of cuDNN."""
    if model.attention == "cudnn" and jax.default_backend() != "gpu":
        return replace(model, attention="auto")
    return model


@jax.custom_vjp
def mapped(q: Array, k: Array, v: Array) -> Array:
    """Return attention (B, S, H, D), computed for a few heads at a time.

    All B * H tables of S x S logits at once are written to memory and read back a dozen times. A
    few at a time never leave the cache (Rabe and Staats, 2021; Dao et al., 2022), which is 2 to 4
    times as fast on two CPU cores. The backward pass recomputes the softmax from its log-sum.
    """
    return _forward(q, k, v)[0]


def _forward(q: Array, k: Array, v: Array) -> tuple[Array, tuple[Array, ...]]:
    parts = tuple(_groups(x) for x in (q, k, v))
    out, log_sum = jax.lax.map(_attend, parts)
    out = _heads(out, q.shape)
    return out, (*parts, out, log_sum)


def _backward(saved: tuple[Array, ...], gradient: Array) -> tuple[Array, Array, Array]:
    *parts, out, log_sum = saved
    # The softmax's backward pass needs, for each query, the sum over keys of weight times the
    # gradient of the weight. That is gradient times output, (B, S, H, 1): no table of logits.
    own = jnp.sum(gradient.astype(log_sum.dtype) * out, axis=-1, keepdims=True)
    grads = jax.lax.map(_differentiate, (*parts, log_sum, _groups(own), _groups(gradient)))
    dq, dk, dv = grads
    shape = gradient.shape
    return _heads(dq, shape), _heads(dk, shape), _heads(dv, shape)


mapped.defvjp(_forward, _backward)


def _groups(x: Array) -> Array:
    """Reshape (B, S, H, D) to (groups, G, S, D), G heads whose logits fit in `CACHE`."""
    b, s, h, d = x.shape
    most = max(1, CACHE // (4 * s * s))
    # the largest divisor: lax.map takes groups of one size
    size = next(n for n in range(min(most, b * h), 0, -1) if b * h % n == 0)
    return jnp.swapaxes(x, 1, 2).reshape(b * h // size, size, s, d)


def _heads(x: Array, shape: tuple[int, ...]) -> Array:
    """Invert `_groups`."""
    b, s, h, d = shape
    return jnp.swapaxes(x.reshape(b, h, s, d), 1, 2)


def _product(subscripts: str, a: Array, b: Array) -> Array:
    """Return a product of small matrices, summed in float32 or wider."""
    wide = jnp.promote_types(a.dtype, jnp.float32)
    return jnp.einsum(subscripts, a, b, preferred_element_type=wide)


def _attend(part: tuple[Array, ...]) -> tuple[Array, Array]:
    """Return output (G, S, D) and log-sum of the logits (G, S) of one group."""
    q, k, v = part
    logits = _product("gqd,gkd->gqk", q * q.shape[-1] ** -0.5, k)
    largest = jnp.max(logits, axis=-1, keepdims=True)
    weights = jnp.exp(logits - largest)
    total = jnp.sum(weights, axis=-1, keepdims=True)
    # Divided after the product: D numbers a query instead of S.
    out = _product("gqk,gkd->gqd", weights.astype(v.dtype), v) / total
    return out.astype(v.dtype), (largest + jnp.log(total))[..., 0]


def _differentiate(part: tuple[Array, ...]) -> tuple[Array, Array, Array]:
    """Return gradients (G, S, D) of query, key and value of a group.

    `own` (G, S, 1) is gradient times output.
    """
    q, k, v, log_sum, own, gradient = part
    scale = q.shape[-1] ** -0.5
    weights = jnp.exp(_product("gqd,gkd->gqk", q * scale, k) - log_sum[..., None])
    dv = _product("gqk,gqd->gkd", weights.astype(v.dtype), gradient)
    # d softmax: weight * (gradient of the weight - its mean under the weights)
    dweights = _product("gqd,gkd->gqk", gradient, v)
    dlogits = (weights * (dweights - own)).astype(q.dtype)
    dq = _product("gqk,gkd->gqd", dlogits, k) * scale
    dk = _product("gqk,gqd->gkd", dlogits, q * scale)
    return dq.astype(q.dtype), dk.astype(k.dtype), dv.astype(v.dtype)
