"""Layers that all towers share: products, attention, MLP, pre-norm block, scanned stacks."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name
from jax.typing import DTypeLike

from anytouch_jax.config import ModelConfig, Stack
from anytouch_jax.nn.attention import attention
from anytouch_jax.ops.losses import row_sums

Activation = Callable[[Array], Array]
Turn = Callable[[Array], Array]


def stored(dtype: DTypeLike) -> jnp.dtype:
    """Return the type of arrays between the products of a model of `dtype`.

    It is float32 for 16 bits on a CPU, which has 16-bit products (AMX) and nothing else of 16 bits:
    XLA would widen every sum, norm and copy, and each write into a slice would widen the whole
    array.
    """
    narrow = jnp.dtype(dtype).itemsize == 2 and jax.default_backend() == "cpu"
    return jnp.dtype(jnp.float32 if narrow else dtype)


def product(x: Array, kernel: Array, dtype: DTypeLike) -> Array:
    """Return x (rows, inputs) @ kernel (inputs, outputs) as `stored(dtype)`.

    Both operands are rounded to `dtype`.
    """
    if stored(dtype) != dtype:
        # Named, because jax.checkpoint does not see that a custom_vjp is a product.
        narrow = _narrow(x.astype(stored(dtype)), kernel, jnp.dtype(dtype))
        return checkpoint_name(narrow, "product")
    return x.astype(dtype) @ kernel.astype(dtype)


# A policy of jax.checkpoint: keep matrix products, with those of this module, and recompute the
# rest.
products_saveable = jax.checkpoint_policies.save_from_both_policies(
    jax.checkpoint_policies.dots_with_no_batch_dims_saveable,
    jax.checkpoint_policies.save_only_these_names("product"),
)


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def _narrow(x: Array, kernel: Array, dtype: DTypeLike) -> Array:
    """Return a product of 16-bit operands summed in float32, and its gradients the same way."""
    # XLA's CPU back end has one fast form: a float32 result, the first operand contracted over its
    # last axis.
    return _wide(x.astype(dtype), kernel.astype(dtype), 0)


def _forward(x: Array, kernel: Array, dtype: DTypeLike) -> tuple[Array, tuple[Array, Array]]:
    return _narrow(x, kernel, dtype), (x, kernel)


def _backward(dtype: DTypeLike, saved: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x, kernel = saved
    x = x.astype(dtype)
    kernel = kernel.astype(dtype)
    g = gradient.astype(dtype)
    dx = _wide(g, kernel, 1)
    # dkernel = x^T g needs a transpose, because the fast form contracts the last axis of its first
    # operand. The narrower of the two is transposed: it is less to copy.
    if x.shape[1] <= g.shape[1]:
        return dx, _wide(_transposed(x), g, 0)
    return dx, _transposed(_wide(_transposed(g), x, 0))


_narrow.defvjp(_forward, _backward)


def _wide(a: Array, b: Array, axis: int) -> Array:
    """Return a (m, k) times b, contracted over `axis` of b, summed and returned in float32."""
    return lax.dot_general(a, b, (((1,), (axis,)), ((), ())), preferred_element_type=jnp.float32)


def _transposed(x: Array) -> Array:
    """Return x^T as a copy."""
    if not x.size:
        return x.T

    def not_finite(x: Array) -> Array:
        return jnp.full(x.shape[::-1], jnp.nan, x.dtype)

    # XLA would fold a plain transpose into the product, which then takes its slow form. It cannot
    # fold a branch. The condition holds for every finite x, and NaN stays NaN.
    return lax.cond(x[0, 0] < jnp.inf, lambda x: x.T, not_finite, x)


@jax.custom_vjp
def gelu(x: Array) -> Array:
    """Return exact GELU, x * Phi(x), as CLIP and ViT use it.

    jax.nn.gelu defaults to the tanh form. The derivative is written by hand, because tracing jax's
    erfc form costs 2.5 times as much on a CPU.
    """
    # In float32 at least: 1 + erf in 16 bits has nothing left of the negative tail.
    wide = x.astype(jnp.promote_types(x.dtype, jnp.float32))
    return (wide * _normal_cdf(wide)).astype(x.dtype)


def _normal_cdf(x: Array) -> Array:
    return 0.5 * (1.0 + jax.lax.erf(x * 0.7071067811865476))


def _gelu_forward(x: Array) -> tuple[Array, Array]:
    return gelu(x), x


def _gelu_backward(x: Array, g: Array) -> tuple[Array]:
    wide = x.astype(jnp.promote_types(x.dtype, jnp.float32))
    # Phi(x) + x phi(x), with phi the density of the normal distribution
    slope = _normal_cdf(wide) + wide * 0.3989422804014327 * jnp.exp(-0.5 * wide * wide)
    return ((g * slope).astype(x.dtype),)


gelu.defvjp(_gelu_forward, _gelu_backward)


def quick_gelu(x: Array) -> Array:
    """Return x * sigmoid(1.702 x), the activation of OpenAI's CLIP weights."""
    return x * jax.nn.sigmoid(1.702 * x)


ACTIVATIONS: dict[str, Activation] = {"gelu": gelu, "quick_gelu": quick_gelu}


def table(*shape: int) -> nnx.Param:
    """Return a learned array of tokens or positions.

    `functional.Net.init` draws its first values.
    """
    return nnx.Param(jnp.zeros(shape))


def rows_of(values: Array, ids: Array) -> Array:
    """Return rows of a table (R, ...) by ids of any shape.

    An id outside it gives NaN, which the step reports. JAX alone would take the nearest row, or
    count from the end.
    """
    return values.at[ids].get(mode="fill", fill_value=jnp.nan, wrap_negative_indices=False)


class Dense(nnx.Module):
    """A linear layer (..., inputs) -> (..., outputs).

    Its parameters are float32, and its arithmetic is in the model's dtype.
    """

    def __init__(self, inputs: int, outputs: int, model: ModelConfig, *, bias: bool = True) -> None:
        self.kernel = table(inputs, outputs)
        self.bias = table(outputs) if bias else None
        self.dtype = jnp.dtype(model.dtype)

    def __call__(self, x: Array, outputs: int | None = None) -> Array:
        """Return all outputs, or compute only the first `outputs` of them."""
        # As a matrix: of two contracted axes XLA's CPU back end writes a transposed copy before the
        # gradient's product.
        y = product(x.reshape(-1, x.shape[-1]), self.kernel[...][:, :outputs], self.dtype)
        if self.bias is not None:
            y = y + self.bias[...][None, :outputs].astype(y.dtype)
        return y.reshape(*x.shape[:-1], y.shape[-1])


class LayerNorm(nnx.Module):
    """LayerNorm over the last axis, its statistics in float32 (two passes: no cancellation)."""

    def __init__(self, width: int, eps: float, dtype: DTypeLike) -> None:
        self.scale = table(width)
        self.bias = table(width)
        self.eps = eps
        self.dtype = stored(dtype)

    def __call__(self, x: Array) -> Array:
        wide = x.astype(jnp.promote_types(x.dtype, jnp.float32))
        centred = wide - row_sums(wide) / wide.shape[-1]
        variance = row_sums(centred * centred) / wide.shape[-1]
        # Leading axes by hand: tests run with jax_numpy_rank_promotion="raise".
        scale = jnp.expand_dims(self.scale[...], range(x.ndim - 1))
        bias = jnp.expand_dims(self.bias[...], range(x.ndim - 1))
        return (centred * jax.lax.rsqrt(variance + self.eps) * scale + bias).astype(self.dtype)


class Attention(nnx.Module):
    """Multi-head attention of (B, Q, D) over (B, S, D): `project`, `attend` and `out`."""

    def __init__(self, stack: Stack, model: ModelConfig) -> None:
        self.query = Dense(stack.width, stack.width, model)
        self.key = Dense(stack.width, stack.width, model)
        self.value = Dense(stack.width, stack.width, model)
        self.out = Dense(stack.width, stack.width, model)
        self.heads = stack.heads
        self.implementation = model.attention

    def project(self, asks: Array, x: Array) -> tuple[Array, Array, Array]:
        """Return q (B, Q, H, D / H) and k, v (B, S, H, D / H)."""

        def cut(part: Array) -> Array:
            return part.reshape(*part.shape[:2], self.heads, part.shape[2] // self.heads)

        return cut(self.query(asks)), cut(self.key(x)), cut(self.value(x))

    def attend(self, q: Array, k: Array, v: Array, *, causal: bool, mask: Array | None) -> Array:
        """Return (B, Q, H, D / H). `mask` (B, S) bool marks the keys to read.

        Args:
            q: Queries (B, Q, H, D / H).
            k: Keys (B, S, H, D / H).
            v: Values (B, S, H, D / H).
            causal: Whether a query reads keys up to its own place only.
            mask: bool (B, S), the keys to read; None for all.
        """
        return attention(q, k, v, implementation=self.implementation, causal=causal, mask=mask)


class Mlp(nnx.Module):
    """Two linear layers with an activation between them."""

    def __init__(
        self, width: int, hidden: int, model: ModelConfig, act: Activation, outputs: int = 0
    ) -> None:
        self.up = Dense(width, hidden, model)
        self.down = Dense(hidden, outputs or width, model)
        self.act = act

    def __call__(self, x: Array) -> Array:
        return self.down(self.act(self.up(x)))


# The backward pass keeps matrix products, and recomputes norms, activations and sums. On two CPU
# cores a step takes 15 to 25 % less time and two fifths less memory.
remat = nnx.remat(prevent_cse=False, policy=products_saveable)


class Block(nnx.Module):
    """Pre-norm transformer block: x + attention(norm1 x), then x + mlp(norm2 x)."""

    def __init__(self, stack: Stack, model: ModelConfig, eps: float, act: Activation) -> None:
        self.norm1 = LayerNorm(stack.width, eps, model.dtype)
        self.attention = Attention(stack, model)
        self.norm2 = LayerNorm(stack.width, eps, model.dtype)
        self.mlp = Mlp(stack.width, stack.mlp, model, act)

    def __call__(
        self, x: Array, *, causal: bool = False, mask: Array | None = None, turn: Turn | None = None
    ) -> Array:
        q, k, v = self._before(x)
        if turn is not None:
            q = turn(q)
            k = turn(k)
        return self._after(x, self.attention.attend(q, k, v, causal=causal, mask=mask))

    def first(self, x: Array) -> Array:
        """Return `__call__` for the first token of each row, (B, D).

        Other tokens need only keys and values.
        """
        one = x[:, :1]
        q, k, v = self._before(x, one)
        heads = self.attention.attend(q, k, v, causal=False, mask=None)
        return self._after(one, heads)[:, 0]

    @remat
    def _before(self, x: Array, asks: Array | None = None) -> tuple[Array, Array, Array]:
        normed = self.norm1(x)
        asking = normed if asks is None else self.norm1(asks)
        return self.attention.project(asking, normed)

    @remat
    def _after(self, x: Array, heads: Array) -> Array:
        x = x + self.attention.out(heads.reshape(x.shape))
        return x + self.mlp(self.norm2(x))


def stacked_blocks(
    stack: Stack, model: ModelConfig, eps: float, act: Activation, kind: type[Block] = Block
) -> Block:
    """Return `stack.depth` blocks as one, every parameter with a leading axis of that length.

    Args:
        stack: Width, depth, heads and hidden width.
        model: The rest of the settings, such as the dtype.
        eps: Of the norms.
        act: Of the hidden layer.
        kind: Of block.
    """
    return nnx.vmap(lambda: kind(stack, model, eps, act), axis_size=stack.depth)()


def run_blocks(
    blocks: Block,
    x: Array,
    *,
    remat: bool,
    causal: bool = False,
    mask: Array | None = None,
    turn: Turn | None = None,
) -> Array:
    """Send `x` (B, S, D) through stacked blocks, (B, S, D).

    It is a lax.scan, so that compile time does not grow with depth.

    Args:
        blocks: What `stacked_blocks` returns.
        x: The first block's input.
        remat: Recompute activations in the backward pass.
        causal: Whether a token reads those up to its own place only.
        mask: Tokens to read, bool (B, S). None: all.
        turn: Changes queries and keys (B, S, H, D / H) in each block, by their places.
    """

    def body(x: Array, block: Block) -> Array:
        return block(x, causal=causal, mask=mask, turn=turn)

    if remat:
        body = nnx.remat(body)
    return nnx.scan(body, in_axes=(nnx.Carry, 0), out_axes=nnx.Carry)(x, blocks)


def read_blocks(blocks: Block, x: Array, *, remat: bool) -> Array:
    """Return `run_blocks` for the first token of each row, (B, D).

    The last block skips the other tokens.
    """

    def end(x: Array, block: Block) -> Array:
        return block.first(x)

    if _depth(blocks) > 1:
        x = _but_last(blocks, x, remat)
    if remat:
        end = nnx.remat(end)
    return end(x, jax.tree.map(lambda values: values[-1], blocks))


@partial(jax.custom_vjp, nondiff_argnums=(2,))
def _but_last(blocks: Block, x: Array, remat: bool) -> Array:
    """Send `x` through all blocks but the last one."""
    # Each takes its values out of the stack where it runs: blocks cut off before a scan are copied,
    # which costs more than the last block does for a batch of one. A gradient through it would be
    # added up whole, block by block.

    def body(x: Array, number: Array) -> tuple[Array, None]:
        block = jax.tree.map(
            lambda values: jax.lax.dynamic_index_in_dim(values, number, keepdims=False), blocks
        )
        return block(x), None

    steps = _depth(blocks) - 1
    # the batch of an export is a symbol, not an int
    is_one = isinstance(x.shape[0], int) and x.shape[0] == 1
    unroll = 1
    if is_one and steps < 12:
        # One touch by few blocks: with constant parameters nothing is taken out of the stack, and
        # it takes a tenth less.
        unroll = steps
    last, _ = jax.lax.scan(body, x, jnp.arange(steps), unroll=unroll)
    return last


def _but_last_forward(blocks: Block, x: Array, remat: bool) -> Any:
    def cut(blocks: Block, x: Array) -> Array:
        return run_blocks(blocks_between(blocks, 0, _depth(blocks) - 1), x, remat=remat)

    return jax.vjp(cut, blocks, x)


def _but_last_backward(remat: bool, back: Any, gradient: Array) -> Any:
    return back(gradient)


_but_last.defvjp(_but_last_forward, _but_last_backward)


def _depth(blocks: Block) -> int:
    return len(blocks.norm1.scale[...])


def blocks_between(blocks: Block, first: int, last: int) -> Block:
    """Return the stacked blocks `first` to `last` - 1 as a stack."""
    return jax.tree.map(lambda values: values[first:last], blocks)
