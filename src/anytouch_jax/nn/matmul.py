"""Matrix products of linear layers, with 16-bit products that use a CPU's matrix unit."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name
from jax.typing import DTypeLike


def stored(dtype: DTypeLike) -> jnp.dtype:
    """Return the type of arrays between the products of a model of `dtype`: float32 for 16 bits on a CPU.

    A CPU has 16-bit products (AMX) and nothing else of 16 bits: XLA would widen every sum, norm and copy, and each
    write into a slice would widen the whole array.
    """
    narrow = jnp.dtype(dtype).itemsize == 2 and jax.default_backend() == "cpu"
    return jnp.dtype(jnp.float32 if narrow else dtype)


def product(x: Array, kernel: Array, dtype: DTypeLike) -> Array:
    """Return x (rows, inputs) @ kernel (inputs, outputs), both rounded to `dtype`, as `stored(dtype)`."""
    if stored(dtype) != dtype:
        return checkpoint_name(_narrow(x.astype(stored(dtype)), kernel, jnp.dtype(dtype)), "product")
    return x.astype(dtype) @ kernel.astype(dtype)


# A policy of jax.checkpoint: keep matrix products, with those of this module, and recompute the rest.
products_saveable = jax.checkpoint_policies.save_from_both_policies(
    jax.checkpoint_policies.dots_with_no_batch_dims_saveable, jax.checkpoint_policies.save_only_these_names("product")
)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def _narrow(x: Array, kernel: Array, dtype: DTypeLike) -> Array:
    """Return a product of 16-bit operands summed in float32, and its gradients the same way."""
    # XLA's CPU back end has one fast form: a float32 result, the first operand contracted over its last axis.
    return _wide(x.astype(dtype), kernel.astype(dtype), 0)


def _forward(x: Array, kernel: Array, dtype: DTypeLike) -> tuple[Array, tuple[Array, Array]]:
    return _narrow(x, kernel, dtype), (x, kernel)


def _backward(dtype: DTypeLike, saved: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x, kernel, g = (part.astype(dtype) for part in (*saved, gradient))
    if x.shape[1] <= g.shape[1]:  # transpose the narrower of the two
        return _wide(g, kernel, 1), _wide(_turned(x), g, 0)
    return _wide(g, kernel, 1), _turned(_wide(_turned(g), x, 0))


_narrow.defvjp(_forward, _backward)


def _wide(a: Array, b: Array, axis: int) -> Array:
    """Return a (m, k) times b, contracted over `axis` of b, summed and returned in float32."""
    return lax.dot_general(a, b, (((1,), (axis,)), ((), ())), preferred_element_type=jnp.float32)


def _turned(x: Array) -> Array:
    """Return x^T as a copy. The branch keeps XLA from folding it into the product. NaN stays NaN."""
    if not x.size:
        return x.T
    return lax.cond(x[0, 0] < jnp.inf, lambda x: x.T, lambda x: jnp.full(x.shape[::-1], jnp.nan, x.dtype), x)
