"""Beyond the paper, off by default: frame differences, and force from the class token."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_models import tiny_config

from anytouch_jax import objectives
from anytouch_jax.batch import TouchBatch
from anytouch_jax.config import baselines
from anytouch_jax.nn.functional import build
from anytouch_jax.ops import losses, masking
from anytouch_jax.train.optim import optimizer
from anytouch_jax.train.step import init_state, make_step, micro_batches, used_parameters

RNG = np.random.default_rng(0)
PLAIN = tiny_config(1)
FORCE = baselines.apply("force_heads", PLAIN)
SENSOR = jnp.asarray([0, 3, 1, 9])
NOISE = jnp.asarray(RNG.random((4, 16)), jnp.float32)
CLIP = jnp.asarray(RNG.standard_normal((4, 4, 28, 28, 3)), jnp.float32)
PARAMS = build(FORCE.model).init(jax.random.key(0))


def terms(config, clip, force=None, params=PARAMS):
    net = build(config.model)
    if not config.model.force_head:
        params = {name: part for name, part in params.items() if name != "force"}
    run = jax.jit(partial(objectives.stage1_terms, net=net, config=config))
    loss, metrics = run(params, clip, SENSOR, NOISE, force=force)
    return float(loss), {name: float(value) for name, value in metrics.items()}


# Frame differences ---------------------------------------------------------------------------------------------------


def test_differences_are_errors_of_change_on_hidden_positions():
    pred, target = RNG.standard_normal((2, 2, 3, 3, 5))
    hidden = np.array([[True, False, True], [False, False, False]])
    error = (np.diff(pred, axis=2) - np.diff(target, axis=2)) ** 2
    found = losses.difference_loss(jnp.asarray(pred), jnp.asarray(target), jnp.asarray(hidden))
    np.testing.assert_allclose(found, error[hidden].mean(), rtol=1e-5)
    shifted = jnp.asarray(pred) + 3.0  # an error that every frame has is no error of change
    np.testing.assert_allclose(
        losses.difference_loss(shifted, jnp.asarray(target), jnp.asarray(hidden)), found, rtol=1e-5
    )
    assert float(losses.difference_loss(shifted, jnp.asarray(target), jnp.zeros((2, 3), bool))) == 0.0


def test_differences_are_weighed_on_clips_and_absent_from_stills():
    config = replace(PLAIN, objective=replace(PLAIN.objective, differences=2.5))
    loss, metrics = terms(config, CLIP)
    plain, before = terms(PLAIN, CLIP)
    assert metrics.keys() - before.keys() == {"differences"} and metrics["differences"] > 0
    np.testing.assert_allclose(loss, plain + 2.5 * metrics["differences"], rtol=1e-5)
    assert terms(config, CLIP[:, :1]) == terms(PLAIN, CLIP[:, :1])


# Force ---------------------------------------------------------------------------------------------------------------


def test_force_counts_the_rows_that_know_it():
    pred = jnp.asarray([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]])
    target = jnp.asarray([[0.0, jnp.nan], [jnp.nan, jnp.nan], [2.0, 3.0]])
    loss, metrics = losses.force_loss(pred, target)
    assert metrics["force"] == (1 + 9) / 2 and metrics["force_change"] == 9 and loss == 14
    loss, metrics = losses.force_loss(pred, jnp.full((3, 2), jnp.nan))
    assert loss == 0 and metrics["force"] == 0
    grad = jax.grad(lambda p: losses.force_loss(p, target)[0])(pred)
    np.testing.assert_allclose(grad, [[1, 0], [0, 0], [3, 6]])


def test_force_is_added_with_its_weight_and_read_from_what_is_visible():
    force = jnp.asarray(RNG.standard_normal((4, 2)), jnp.float32)
    _, _, hidden = masking.random_mask(NOISE, 4)

    @jax.jit
    def told(clip):
        def run(clip):
            net = build(FORCE.model)
            loss, metrics = objectives.stage1_terms(PARAMS, clip, SENSOR, NOISE, net=net, config=FORCE, force=force)
            return metrics["force"], (loss, metrics)

        return jax.value_and_grad(run, has_aux=True)(clip)

    (_, (loss, metrics)), grad = told(CLIP)
    pixels = metrics["reconstruction"] + metrics["next_frame"]
    np.testing.assert_allclose(loss, pixels + 0.1 * (metrics["force"] + metrics["force_change"]), rtol=1e-5)
    np.testing.assert_allclose(pixels, terms(PLAIN, CLIP)[0], rtol=1e-6)
    grad = np.asarray(grad)
    cells = grad.reshape(4, 4, 4, 7, 4, 7, 3).transpose(0, 2, 4, 1, 3, 5, 6).reshape(4, 16, 4, -1)
    assert not cells[np.asarray(hidden)].any() and not grad[:, 3].any() and np.abs(grad).max() > 0


def step_of(config):
    net = build(config.model)
    loss = partial(objectives.stage1_loss, net=net, config=config)
    state = init_state(net.init(jax.random.key(1)), config)
    return state, jax.jit(make_step(loss, optimizer(config), total_steps=config.run.steps))


@pytest.mark.slow
def test_the_force_head_recovers_a_linear_signal():
    """Grey level is force: after some steps the head tells it better than its mean, on pictures never trained on."""
    config = replace(
        FORCE,
        objective=replace(FORCE.objective, force=1.0),
        optim=replace(FORCE.optim, learning_rate=5e-3, warmup=5),
        run=replace(FORCE.run, steps=120),
    )
    state, step = step_of(config)

    def batch(number):
        rng = np.random.default_rng(number)
        force = rng.uniform(-1.7, 1.7, 16).astype(np.float32)
        grey = 128 + 60 * force[:, None, None, None, None] + rng.normal(0, 4, (16, 1, 28, 28, 3))
        labels = np.stack([force, np.full(16, np.nan, np.float32)], axis=1)
        return TouchBatch(np.clip(grey, 0, 255).astype(np.uint8), np.full(16, 1, np.int32), labels)

    found = []
    for number in range(120):
        state, metrics = step(state, batch(number), jax.random.key(0))
        found.append(float(metrics["force"]))
    assert np.mean(found[:3]) > 0.5 and np.mean(found[-10:]) < 0.1, found[::10]


def test_a_step_without_labels_leaves_the_head_alone():
    net = build(FORCE.model)
    loss = partial(objectives.stage1_loss, net=net, config=FORCE)
    batch = TouchBatch(RNG.integers(0, 256, (4, 1, 28, 28, 3), np.uint8), np.asarray(SENSOR))
    with_labels = batch._replace(force=np.zeros((4, 2), np.float32))
    for part, moved in ((batch, False), (with_labels, True)):
        used = used_parameters(loss, net.abstract(), part, jax.random.key(0), jnp.float32(0))
        assert used["force"] == {"kernel": moved, "bias": moved} and used["touch"]["post_norm"]["scale"] == moved
        assert used["touch"]["patch"]["kernel"] and used["decoder"]["still_head"]["kernel"]


def test_labels_are_dealt_out_with_their_rows():
    batch = TouchBatch(np.zeros((4, 1, 2, 2, 3), np.uint8), np.arange(4), np.arange(8.0).reshape(4, 2))
    parts = micro_batches(jax.tree.map(jnp.asarray, batch), 2)
    assert parts.sensor.tolist() == [[0, 2], [1, 3]] and parts.force[:, :, 0].tolist() == [[0, 4], [2, 6]]
    assert micro_batches(batch._replace(force=None), 2).force is None
