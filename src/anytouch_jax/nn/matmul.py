"""The product of a linear layer, and how 16-bit products reach a CPU's matrix unit."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name
from jax.typing import DTypeLike


def stored(dtype: DTypeLike) -> jnp.dtype:
    """The type of what lies between the products of a model of `dtype`: float32 for 16 bits on a CPU.

    A CPU has 16-bit products (AMX) and nothing else of 16 bits: XLA would widen every sum, norm and copy, and each
    write into a slice would widen the whole array.
    """
    narrow = jnp.dtype(dtype).itemsize == 2 and jax.default_backend() == "cpu"
    return jnp.dtype(jnp.float32 if narrow else dtype)


def product(x: Array, kernel: Array, dtype: DTypeLike) -> Array:
    """x (rows, inputs) @ kernel (inputs, outputs), both rounded to `dtype`, as `stored(dtype)`."""
    if stored(dtype) != dtype:
        return checkpoint_name(_narrow(x.astype(stored(dtype)), kernel, jnp.dtype(dtype)), "product")
    return x.astype(dtype) @ kernel.astype(dtype)


# A policy of jax.checkpoint: keep the products of matrices, ours among them, and do the rest anew.
products_saveable = jax.checkpoint_policies.save_from_both_policies(
    jax.checkpoint_policies.dots_with_no_batch_dims_saveable, jax.checkpoint_policies.save_only_these_names("product")
)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def _narrow(x: Array, kernel: Array, dtype: DTypeLike) -> Array:
    """A product of 16-bit operands summed in float32, and its gradients the same way.

    XLA's CPU back end has one fast form of it: a float32 result, the first operand contracted over its last axis. All
    others it widens, and is then slower than in float32.
    """
    return _wide(x.astype(dtype), kernel.astype(dtype), 0)


def _forward(x: Array, kernel: Array, dtype: DTypeLike) -> tuple[Array, tuple[Array, Array]]:
    return _narrow(x, kernel, dtype), (x, kernel)


def _backward(dtype: DTypeLike, saved: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x, kernel, g = (part.astype(dtype) for part in (*saved, gradient))
    if x.shape[1] <= g.shape[1]:  # x^T g with the narrower of the two turned
        return _wide(g, kernel, 1), _wide(_turned(x), g, 0)
    return _wide(g, kernel, 1), _turned(_wide(_turned(g), x, 0))


_narrow.defvjp(_forward, _backward)


def _wide(a: Array, b: Array, axis: int) -> Array:
    """a (m, k) times b, contracted over `axis` of b, summed and returned in float32."""
    return lax.dot_general(a, b, (((1,), (axis,)), ((), ())), preferred_element_type=jnp.float32)


def _turned(x: Array) -> Array:
    """x^T, written out: the branch keeps XLA from folding it into the product. What is not finite stays so."""
    if not x.size:
        return x.T
    return lax.cond(x[0, 0] < jnp.inf, lambda x: x.T, lambda x: jnp.full(x.shape[::-1], jnp.nan, x.dtype), x)
