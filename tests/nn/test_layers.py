"""Layers against plain formulas, and the scanned stack against the loop."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx
from tiny_models import STACK, full_model, touch_model

from anytouch_jax.nn.functional import build
from anytouch_jax.nn.layers import gelu, quick_gelu, read_blocks, run_blocks, stacked_blocks, stored

X = jnp.linspace(-6, 6, 241)


def test_gelu_is_the_exact_form_in_value_and_derivative():
    np.testing.assert_allclose(gelu(X), jax.nn.gelu(X, approximate=False), atol=1e-6)
    ours, theirs = (jax.vmap(jax.grad(f))(X) for f in (gelu, lambda x: jax.nn.gelu(x, approximate=False)))
    np.testing.assert_allclose(ours, theirs, atol=1e-6)
    assert np.abs(np.asarray(gelu(X) - jax.nn.gelu(X, approximate=True))).max() > 1e-4  # and not the tanh form


def test_gelu_keeps_its_negative_tail_in_sixteen_bits():
    x = jnp.linspace(-5, 5, 2001).astype(jnp.bfloat16)
    exact = np.asarray(jax.nn.gelu(x.astype(jnp.float32), approximate=False))
    slope = np.asarray(jax.vmap(jax.grad(lambda v: jax.nn.gelu(v, approximate=False)))(x.astype(jnp.float32)))
    ours, ours_slope = (np.asarray(f(x), np.float32) for f in (jax.jit(gelu), jax.jit(jax.vmap(jax.grad(gelu)))))
    assert gelu(x).dtype == jnp.bfloat16
    np.testing.assert_allclose(ours, exact, rtol=2**-8, atol=1e-6)  # rounded once
    np.testing.assert_allclose(ours_slope, slope, rtol=2**-8, atol=1e-6)


def test_quick_gelu():
    np.testing.assert_allclose(quick_gelu(X), X / (1 + np.exp(-1.702 * np.asarray(X))), rtol=1e-5, atol=1e-7)


def reference_block(x, p, heads, eps):
    """A pre-norm block in plain numpy."""

    def norm(x, p):
        return (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + eps) * p["scale"] + p["bias"]

    def dense(x, p):
        return x @ p["kernel"] + p["bias"]

    y = norm(x, p["norm1"])
    b, s, d = y.shape
    q, k, v = (dense(y, p["attention"][n]).reshape(b, s, heads, -1) for n in ("query", "key", "value"))
    logits = np.einsum("bqhd,bkhd->bhqk", q, k) / np.sqrt(d // heads)
    weights = np.exp(logits - logits.max(-1, keepdims=True))
    weights /= weights.sum(-1, keepdims=True)
    x = x + dense(np.einsum("bhqk,bkhd->bqhd", weights, v).reshape(b, s, d), p["attention"]["out"])
    hidden = np.asarray(jax.nn.gelu(jnp.asarray(dense(norm(x, p["norm2"]), p["mlp"]["up"])), approximate=False))
    return x + dense(hidden, p["mlp"]["down"])


def test_the_stack_equals_a_loop_over_plain_blocks():
    model = touch_model()
    net = build(model)
    params = net.init(jax.random.key(1))
    clip, sensor = jax.random.normal(jax.random.key(2), (2, 1, 28, 28, 3)), jnp.asarray([0, 1])
    x = np.asarray(net.bind(params).touch.tokens(clip, sensor), np.float64)
    x = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + model.norm_eps)
    for layer in range(STACK.depth):
        x = reference_block(
            x, jax.tree.map(lambda p, i=layer: np.asarray(p[i], np.float64), params["touch"]["blocks"]), 2, 1e-5
        )
    np.testing.assert_allclose(net.bind(params).touch.hidden(clip, sensor), x, atol=2e-5)


@pytest.mark.parametrize("remat", [False, True])
@pytest.mark.parametrize("depth", [1, 3])
def test_what_is_read_alone_is_what_the_whole_stack_gives_there(depth, remat):
    """Values and gradients."""
    model, stack = touch_model(), replace(STACK, depth=depth)
    blocks = stacked_blocks(stack, model, 1e-5, gelu)
    for number, (_, p) in enumerate(nnx.to_flat_state(nnx.state(blocks))):
        p[...] = 0.3 * jax.random.normal(jax.random.key(number), p.shape)
    x = jax.random.normal(jax.random.key(99), (3, 7, STACK.width))

    def whole(blocks, x):
        return run_blocks(blocks, x, remat=remat)[:, 0]

    def lock(blocks, x):
        return read_blocks(blocks, x, remat=remat)

    np.testing.assert_allclose(lock(blocks, x), whole(blocks, x), atol=2e-5)
    first, second = (
        jax.jit(jax.grad(lambda b, x, f=f: jnp.sum(f(b, x) ** 2), (0, 1)))(blocks, x) for f in (whole, lock)
    )
    scale = max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(first))
    assert scale > 1
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=2e-6 * scale), second, first)


def test_the_last_block_works_for_the_token_that_is_read():
    """Of one block: keys and values of all tokens, all else of one. The stack before it is not copied."""
    model = full_model(image_size=56)  # 64 patches
    args = jnp.zeros((2, 1, 56, 56, 3)), jnp.asarray([0, 1])

    def program(depth, read):
        net = build(replace(model, touch=replace(STACK, depth=depth)))
        return jax.jit(lambda p: read(net.bind(p))).lower(net.abstract()), net.abstract()

    methods = (lambda module: module.encode_touch(*args)), (lambda module: module.touch.hidden(*args))

    read, whole = (program(1, method)[0].cost_analysis()["flops"] for method in methods)
    tokens = 70
    dense = 2 * 2 * tokens * STACK.width * STACK.width  # of two rows
    assert whole - read > 0.9 * (2 * dense + 2 * dense * STACK.mlp / STACK.width) * (1 - 1 / tokens)
    (read, params), (whole, _) = (program(9, method) for method in methods)
    temporary = [one.compile().memory_analysis().temp_size_in_bytes for one in (read, whole)]
    blocks = sum(leaf.size * 4 for leaf in jax.tree.leaves(params["touch"]["blocks"]))
    assert temporary[0] - temporary[1] < 0.5 * blocks


def test_rematerialisation_and_bfloat16_change_cost_not_meaning():
    clip, sensor = jax.random.normal(jax.random.key(2), (2, 3, 28, 28, 3)), jnp.asarray([0, 1])
    net = build(touch_model())
    params = net.init(jax.random.key(1))
    plain = net.encode_touch(params, clip, sensor)
    remat = build(touch_model(remat=True)).encode_touch(params, clip, sensor)
    np.testing.assert_allclose(plain, remat, atol=1e-6)
    half = build(touch_model(dtype="bfloat16")).encode_touch(params, clip, sensor)
    assert half.dtype == stored("bfloat16")
    error = np.abs(np.asarray(half, np.float32) - np.asarray(plain)).max() / np.abs(np.asarray(plain)).max()
    assert 1e-5 < error < 0.05


@pytest.mark.parametrize(
    "method",
    [
        "encode_touch",
        "encode_image",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("reconstruct", "encode_text")),
    ],
)
def test_rematerialised_stacks_give_the_same_gradient_from_work_done_again(method):
    clip, sensor, ids = jax.random.normal(jax.random.key(2), (2, 1, 28, 28, 3)), jnp.asarray([0, 1]), jnp.arange(16)
    args = {
        "encode_touch": (clip, sensor),
        "reconstruct": (clip, sensor, ids[None, :4].repeat(2, 0), ids[None].repeat(2, 0), 1),
        "encode_image": (clip[:, 0],),
        "encode_text": (ids.reshape(2, 8), jnp.ones((2, 8), bool)),
    }[method]
    params, result = build(full_model()).init(jax.random.key(1)), []
    for remat in (False, True):
        net = build(full_model(remat=remat))
        first = lambda params, net=net: getattr(net, method)(params, *args)  # noqa: E731
        slope = jax.grad(lambda params, first=first: jnp.mean(first(params) ** 2))
        again = re.findall(r"\b(?:remat2?|checkpoint)\[", str(jax.make_jaxpr(slope)(params)))
        result.append((jax.jit(slope)(params), len(again)))
    (plain, few), (remat, many) = result
    assert many - few >= 2 * (2 if method == "reconstruct" else 1)  # of each stack, of encoder and decoder
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5), remat, plain)
    assert max(float(jnp.abs(leaf).max()) for leaf in jax.tree.leaves(plain)) > 0.01
