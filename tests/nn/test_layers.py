import math
import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from tiny_models import STACK, compiled, full_model, touch_model

from anytouch_jax.fields.module import convolved
from anytouch_jax.nn.functional import build
from anytouch_jax.nn.layers import gelu, read_blocks, run_blocks, stacked_blocks, stored

CLIP = np.random.default_rng(2).standard_normal((2, 1, 28, 28, 3)).astype("f4")
ROWS = np.asarray([0, 1], np.int32)
X = np.linspace(-6, 6, 241, dtype="f4")


def exact_gelu(x):
    """Value and derivative in float64."""
    x = np.asarray(x, np.float64)
    phi = (1 + np.vectorize(math.erf)(x / math.sqrt(2))) / 2
    return x * phi, phi + x * np.exp(-x * x / 2) / math.sqrt(2 * math.pi)


@pytest.mark.parametrize(("dtype", "step"), [(np.float32, 0.0), (jnp.bfloat16, 2**-8)])
def test_gelu_is_the_exact_form_in_value_and_derivative(dtype, step):
    """The tanh form differs by more than 1e-4.

    Sixteen bits are rounded once, and keep the negative tail.
    """
    x = X.astype(dtype)
    for function, wanted in zip((gelu, jax.vmap(jax.grad(gelu))), exact_gelu(x), strict=True):
        result = jax.jit(function)(x)
        assert result.dtype == dtype
        np.testing.assert_allclose(np.asarray(result, np.float64), wanted, rtol=step, atol=1e-6)


def reference_block(x, p, heads, eps):
    """A pre-norm block in plain numpy."""

    def norm(x, p):
        return (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + eps) * p[
            "scale"
        ] + p["bias"]

    def dense(x, p):
        return x @ p["kernel"] + p["bias"]

    y = norm(x, p["norm1"])
    b, s, d = y.shape
    q, k, v = (
        dense(y, p["attention"][n]).reshape(b, s, heads, -1) for n in ("query", "key", "value")
    )
    logits = np.einsum("bqhd,bkhd->bhqk", q, k) / np.sqrt(d // heads)
    weights = np.exp(logits - logits.max(-1, keepdims=True))
    weights /= weights.sum(-1, keepdims=True)
    x = x + dense(np.einsum("bhqk,bkhd->bqhd", weights, v).reshape(b, s, d), p["attention"]["out"])
    return x + dense(exact_gelu(dense(norm(x, p["norm2"]), p["mlp"]["up"]))[0], p["mlp"]["down"])


def test_the_stack_equals_a_loop_over_plain_blocks():
    net = compiled(touch_model())
    start, last = jax.jit(
        lambda p: ((t := net.bind(p).touch).tokens(CLIP, ROWS), t.hidden(CLIP, ROWS))
    )(net.params)
    x = np.asarray(start, np.float64)
    blocks = jax.device_get(net.params["touch"]["blocks"])
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + net.net.model.norm_eps)
    for layer in range(STACK.depth):
        x = reference_block(
            x, jax.tree.map(lambda p, i=layer: p[i].astype(np.float64), blocks), 2, 1e-5
        )
    np.testing.assert_allclose(last, x, atol=2e-5)


@pytest.mark.parametrize("remat", [False, True])
@pytest.mark.parametrize("depth", [1, 3])
def test_what_is_read_alone_is_what_the_whole_stack_gives_there(depth, remat):
    """Values and gradients."""
    model = touch_model()
    stack = replace(STACK, depth=depth)
    blocks = stacked_blocks(stack, model, 1e-5, gelu)
    for number, (_, p) in enumerate(nnx.to_flat_state(nnx.state(blocks))):
        p[...] = jax.device_put(
            0.3 * np.random.default_rng(number).standard_normal(p.shape).astype("f4")
        )
    x = np.random.default_rng(99).standard_normal((3, 7, STACK.width)).astype("f4")

    def whole(blocks, x):
        return run_blocks(blocks, x, remat=remat)[:, 0]

    def lock(blocks, x):
        return read_blocks(blocks, x, remat=remat)

    def outputs_and_grads(function):
        total = lambda b, x: (jnp.sum((y := function(b, x)) ** 2), y)  # noqa: E731
        return jax.device_get(jax.jit(jax.grad(total, (0, 1), has_aux=True))(blocks, x))

    (first, y), (second, z) = map(outputs_and_grads, (whole, lock))
    np.testing.assert_allclose(z, y, atol=2e-5)
    scale = max(np.abs(leaf).max() for leaf in jax.tree.leaves(first))
    assert scale > 1
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-6 * scale), second, first)


def test_the_last_block_works_for_the_token_that_is_read():
    """Of one block: keys and values of all tokens, all else of one.

    The stack before it is not copied.
    """
    model = full_model(image_size=56)  # 64 patches
    args = np.zeros((2, 1, 56, 56, 3), "f4"), ROWS

    def program(depth, read):
        net = build(replace(model, touch=replace(STACK, depth=depth)))
        return jax.jit(lambda p: read(net.bind(p))).lower(net.abstract()), net.abstract()

    methods = (
        (lambda module: module.encode_touch(*args)),
        (lambda module: module.touch.hidden(*args)),
    )

    read, whole = (program(1, method)[0].cost_analysis()["flops"] for method in methods)
    tokens = 70
    dense = 2 * 2 * tokens * STACK.width * STACK.width  # of two rows
    assert whole - read > 0.9 * (2 * dense + 2 * dense * STACK.mlp / STACK.width) * (1 - 1 / tokens)
    (read, params), (whole, _) = (program(9, method) for method in methods)
    temporary = [one.compile().memory_analysis().temp_size_in_bytes for one in (read, whole)]
    blocks = sum(leaf.size * 4 for leaf in jax.tree.leaves(params["touch"]["blocks"]))
    assert temporary[0] - temporary[1] < 0.5 * blocks


def test_bfloat16_changes_cost_not_meaning():
    net = compiled(touch_model())
    plain = np.asarray(net.encode_touch(net.params, CLIP, ROWS))
    half = compiled(touch_model(dtype="bfloat16")).encode_touch(net.params, CLIP, ROWS)
    assert half.dtype == stored("bfloat16")
    assert 1e-5 < np.abs(np.asarray(half, np.float32) - plain).max() / np.abs(plain).max() < 0.05


@pytest.mark.parametrize(
    "method",
    [
        "encode_touch",
        "encode_image",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("reconstruct", "encode_text")),
    ],
)
def test_rematerialised_stacks_give_the_same_gradient_from_work_done_again(method):
    ids = np.arange(16, dtype=np.int32)
    args = {
        "encode_touch": (CLIP, ROWS),
        "reconstruct": (CLIP, ROWS, ids[None, :4].repeat(2, 0), ids[None].repeat(2, 0), 1),
        "encode_image": (CLIP[:, 0],),
        "encode_text": (ids.reshape(2, 8), np.ones((2, 8), bool)),
    }[method]
    params = compiled(full_model()).params
    result = []
    for remat in (False, True):
        net = build(full_model(remat=remat))
        first = lambda params, net=net: jnp.mean(getattr(net, method)(params, *args) ** 2)  # noqa: E731
        traced = jax.jit(jax.grad(first)).trace(params)
        again = re.findall(r"\b(?:remat2?|checkpoint)\[", str(traced.jaxpr))
        result.append((jax.device_get(traced.lower().compile()(params)), len(again)))
    (plain, few), (remat, many) = result
    # of each stack, of encoder and decoder
    assert many - few >= 2 * (2 if method == "reconstruct" else 1)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), remat, plain)
    assert max(np.abs(leaf).max() for leaf in jax.tree.leaves(plain)) > 0.01


RNG = np.random.default_rng(0)


@pytest.mark.parametrize(("side", "stride"), [(3, 1), (3, 2), (5, 2)])
@pytest.mark.parametrize(("height", "width"), [(7, 7), (8, 5), (1, 2)])
def test_a_product_with_windows_is_a_convolution(side, stride, height, width, monkeypatch):
    x = RNG.standard_normal((2, height, width, 3)).astype("f4")
    kernel = RNG.standard_normal((side * side * 3, 4)).astype("f4")

    def run():
        return jax.jit(lambda x, kernel: convolved(x, kernel, side, stride, "float32"))(x, kernel)

    wanted = run()
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    result = run()
    assert wanted.shape == (2, -(-height // stride), -(-width // stride), 4)
    np.testing.assert_allclose(result, wanted, atol=1e-5)
