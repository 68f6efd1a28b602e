import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from adam_moments import moments
from tiny_models import compiled, tiny_config
from train_toy import toy_config, toy_params

from anytouch_jax.errors import ConfigError
from anytouch_jax.train.optim import (
    depth_rate,
    learning_rate,
    match_rules,
    optimizer,
    packing,
    schedule,
)
from anytouch_jax.weights.keymaps import param_shapes
from anytouch_jax.weights.tree import flatten

PEAK = 2e-4
FLOOR = 1e-6


def test_the_first_rule_wins_and_a_name_without_one_is_an_error():
    rules = ((r"bias$", 0.0), (r"^a/", 0.5), (r"", 0.1))
    assert list(match_rules(rules, ["a/bias", "a/kernel", "b/a/kernel"]).values()) == [
        0.0,
        0.5,
        0.1,
    ]
    with pytest.raises(ConfigError, match=r"no rule matches the parameter b/kernel"):
        match_rules(rules[:2], ["b/kernel"])


@pytest.mark.parametrize("decay", ["linear", "cosine"])
@pytest.mark.parametrize(("warmup", "total"), [(1.0, 20.0), (37, 1000), (0, 10), (5, 5)])
def test_schedule_values(decay, warmup, total):
    def by_hand(t):
        if t < warmup:
            return PEAK * t / warmup
        fraction = (
            min(1.0, (t - warmup) / (total - warmup))
            if total > warmup
            else 0.0
            if t == warmup
            else 1.0
        )
        height = 1 - fraction if decay == "linear" else 0.5 * (1 + math.cos(math.pi * fraction))
        return FLOOR + (PEAK - FLOOR) * height

    times = [
        0.0,
        warmup / 3,
        warmup,
        (warmup + total) / 2,
        0.9 * total + 0.1 * warmup,
        total,
        total + 3,
    ]
    got = [
        float(learning_rate(t, peak=PEAK, floor=FLOOR, warmup=warmup, total=total, decay=decay))
        for t in times
    ]
    np.testing.assert_allclose(got, [by_hand(t) for t in times], rtol=2e-5, atol=1e-11)
    assert warmup == 0 or got[0] == 0.0
    assert total == warmup or got[-2] == pytest.approx(FLOOR)


def adamw_by_hand(
    params, grads_of_steps, uses_of_steps, rates, *, b1=0.9, b2=0.99, eps=1e-8, decay
):
    """AdamW as PyTorch documents it, in float64; a gradient of None leaves its parameter alone."""
    values = {name: np.asarray(v, np.float64) for name, v in params.items()}
    m = {name: np.zeros_like(v) for name, v in values.items()}
    v2 = {name: np.zeros_like(v) for name, v in values.items()}
    count = dict.fromkeys(values, 0)
    for grads, uses, lr in zip(grads_of_steps, uses_of_steps, rates, strict=True):
        for name in values:
            if not uses[name]:
                continue
            count[name] += 1
            values[name] = values[name] * (1 - lr * decay[name])
            m[name] = b1 * m[name] + (1 - b1) * grads[name]
            v2[name] = b2 * v2[name] + (1 - b2) * grads[name] ** 2
            m_hat = m[name] / (1 - b1 ** count[name])
            v_hat = v2[name] / (1 - b2 ** count[name])
            values[name] = values[name] - lr * m_hat / (np.sqrt(v_hat) + eps)
    return values, count, m, v2


@functools.partial(jax.jit, static_argnums=(0, 4))
def update(config, grads, state, params, used=None, **more):
    """`used`: its leaves, as a key of the cache."""
    used = None if used is None else jax.tree.unflatten(jax.tree.structure(params), used)
    updates, state = optimizer(config).update(grads, state, params, used=used, **more)
    return jax.tree.map(jnp.add, params, updates), state


def first_state(config, params):
    return jax.jit(optimizer(config).init)(params)


def test_adamw_with_skipped_parameters_equals_plain_numpy():
    config = toy_config(steps=9)
    params = toy_params()
    rng = np.random.default_rng(3)
    draw = lambda p: (rng.normal(size=p.shape) * 10.0 ** rng.integers(-9, 2)).astype(np.float32)  # noqa: E731
    grads = [jax.tree.map(draw, params) for _ in range(9)]
    heads = [
        {"still_head": {"kernel": n % 3 == 0}, "clip_head": {"kernel": n % 3 != 0}}
        for n in range(9)
    ]
    trunk = {"kernel": True, "bias": True}
    uses = [
        {"trunk": trunk, "decoder": {"position": True} | one, "idle": {"kernel": False}}
        for one in heads
    ]
    got = params
    state = first_state(config, params)
    for step, grad in enumerate(grads):
        got, state = jax.device_get(
            update(config, grad, state, got, tuple(jax.tree.leaves(uses[step])), step=step)
        )
    rates = [float(schedule(config)(step)) for step in range(9)]
    expected, count, m, v2 = adamw_by_hand(
        flatten(params),
        [flatten(g) for g in grads],
        [flatten(u) for u in uses],
        rates,
        decay=match_rules(config.weight_decay, flatten(params)),
    )
    assert count["decoder/still_head/kernel"] == 3 and count["idle/kernel"] == 0
    held = flatten(moments(state, params))
    for name, value in flatten(got).items():
        np.testing.assert_allclose(value, expected[name], rtol=0, atol=2e-6, err_msg=name)
        assert held[f"{name}/updates"] == count[name], name
        np.testing.assert_allclose(
            held[f"{name}/mu"], m[name], rtol=1e-5, atol=1e-7 * np.abs(m[name]).max()
        )
        np.testing.assert_allclose(
            held[f"{name}/nu"], v2[name], rtol=1e-5, atol=1e-7 * np.abs(v2[name]).max()
        )
    np.testing.assert_array_equal(got["idle"]["kernel"], params["idle"]["kernel"])


def test_clipping_counts_the_used_parameters_only():
    config = toy_config(optim={"grad_clip": 1.0, "beta1": 0.0, "weight_decay": 0.0})
    params = {"a": np.zeros(2, "f4"), "b": np.zeros(2, "f4")}
    large, small = (
        {"a": np.asarray(a, "f4"), "b": np.full(2, b, "f4")}
        for a, b in (([3, 4], 1e6), ([0.3, 0.4], 0))
    )
    _, state = update(config, large, first_state(config, params), params, (True, False), step=1)
    held = moments(state, params)
    np.testing.assert_allclose(held["a"].mu, [0.6, 0.8], rtol=1e-6)
    np.testing.assert_array_equal(held["b"].mu, 0.0)
    _, state = update(config, small, first_state(config, params), params, step=1)
    np.testing.assert_array_equal(moments(state, params)["a"].mu, small["a"])


def test_the_rate_is_given_or_follows_the_step_never_a_counter():
    config = toy_config(steps=10)
    params = {"w": np.ones(2, "f4")}
    start = first_state(config, params)
    _, state = update(config, params, start, params, step=7)
    assert state.learning_rate == schedule(config)(7)
    new, state = update(config, params, start, params, learning_rate=0.25)
    assert state.learning_rate == 0.25
    np.testing.assert_allclose(new["w"], 1 - 0.25 * (1 + 0.1), rtol=1e-5)
    with pytest.raises(TypeError, match="step or learning_rate"):
        update(config, params, start, params)


def decayed(decay, **optim):
    config = tiny_config(2)
    model = dataclasses.replace(
        config.model, touch=dataclasses.replace(config.model.touch, depth=3)
    )
    optim = dataclasses.replace(config.optim, layer_decay=decay, **optim)
    return dataclasses.replace(config, model=model, optim=optim)


def test_each_block_learns_so_much_slower_than_the_next():
    config = decayed(0.5)
    rates = {
        name: depth_rate(name, shape, config) for name, shape in param_shapes(config.model).items()
    }
    blocks = [name for name in rates if name.startswith("touch/blocks/")]
    assert len(blocks) == 16
    for name in blocks:
        assert rates[name].shape == (3, *[1] * (len(param_shapes(config.model)[name]) - 1))
        np.testing.assert_allclose(rates[name].ravel(), [0.25, 0.5, 1.0])
    before = {name: rate for name, rate in rates.items() if name not in blocks and rate != 1}
    names = (
        "class_token",
        "position",
        "sensor_tokens",
        "patch/kernel",
        "pre_norm/scale",
        "pre_norm/bias",
    )
    assert before == dict.fromkeys((f"touch/{name}" for name in names), 0.125)


def test_a_layer_decay_scales_the_step_and_none_is_no_change():
    def updates(config):
        params = compiled(config.model).params
        grads = jax.tree.map(
            lambda x: np.sin(np.arange(x.size, dtype="f4")).reshape(x.shape) + 2, params
        )
        one = optimizer(config)
        step = jax.jit(lambda g, p: one.update(g, one.init(p), p, learning_rate=1e-3)[0])
        return jax.device_get(flatten(step(grads, params)))

    plain, slow, still = (updates(decayed(decay)) for decay in (1.0, 0.1, 0.0))
    for name, change in plain.items():
        rate = np.asarray(depth_rate(name, change.shape, decayed(0.1)))
        np.testing.assert_allclose(slow[name], change * rate, rtol=1e-5, err_msg=name)
    assert not np.any(still["touch/patch/kernel"]) and not np.any(
        still["touch/blocks/mlp/up/kernel"][:2]
    )
    np.testing.assert_array_equal(
        still["touch/blocks/mlp/up/kernel"][2], plain["touch/blocks/mlp/up/kernel"][2]
    )
    np.testing.assert_array_equal(
        still["touch/projection/kernel"], plain["touch/projection/kernel"]
    )
    np.testing.assert_array_equal(still["image/patch/kernel"], plain["image/patch/kernel"])


TREE = {
    "b": np.arange(6, dtype="f4").reshape(2, 3),
    "a": np.full(4, 7, "f4"),
    "large": np.arange(40, dtype="f4").reshape(5, 8),
    "scalar": np.float32(3),
    "whole": np.arange(3, dtype="i4"),
}


@pytest.mark.parametrize("small", [0, 5, 10, 1000])
def test_unpacking_gives_the_tree_back(small):
    layout = packing(TREE, small)
    arrays, back = jax.jit(lambda tree: ((arrays := layout.pack(tree)), layout.unpack(arrays)))(
        TREE
    )
    assert sum(array.size for array in arrays) == sum(leaf.size for leaf in jax.tree.leaves(TREE))
    assert jax.tree.structure(back) == jax.tree.structure(TREE)
    jax.tree.map(np.testing.assert_array_equal, back, TREE)
    assert all(
        a.dtype == b.dtype
        for a, b in zip(jax.tree.leaves(back), jax.tree.leaves(TREE), strict=True)
    )
