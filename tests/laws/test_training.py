"""Laws of both training steps on the real network: what cannot be seen, what is dropped, what costs nothing."""

import sys
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
from tiny_models import tiny_config

from anytouch_jax import objectives
from anytouch_jax.batch import AlignBatch, MatchBatch, Stage2Batch, TouchBatch
from anytouch_jax.nn.functional import build
from anytouch_jax.train.mesh import batch_sharding, make_mesh, put_batch, replicated
from anytouch_jax.train.optim import optimizer
from anytouch_jax.train.step import init_state, make_step

B, KEY = 8, jax.random.key(3)


def clips(frames, seed=0, batch=B):
    return np.random.default_rng(seed).integers(0, 256, (batch, frames, 28, 28, 3), np.uint8)


def touch_batch(frames):
    return TouchBatch(clips(frames), (np.arange(B) % 5).astype(np.int32))


def align_batch(frames=3, images=(0, 2, 3, 7), texts=(2, 3, 5), slots=4):
    rng = np.random.default_rng(7)
    image_row, text_row = np.full(slots, B, np.int32), np.full(slots, B, np.int32)
    image_row[: len(images)], text_row[: len(texts)] = images, texts
    image = rng.integers(0, 256, (slots, 28, 28, 3), np.uint8)
    text = np.sort(rng.integers(0, 49, (slots, 8)), axis=1).astype(np.int32)
    text[:, -1] = 49
    sensor = (np.arange(B) % 5).astype(np.int32)
    return AlignBatch(clips(frames), sensor, image, image_row, text, np.ones((slots, 8), bool), text_row)


def match_batch(frames=3):
    sensors = [(np.arange(B) % 5).astype(np.int32) for _ in range(3)]
    return MatchBatch(*(x for i in range(3) for x in (clips(frames, 10 + i), sensors[i])))


def floats(batch):
    """The batch as `stage2_terms` takes it: pixels normalised, sensor rows as they are."""
    align, match = batch
    if align is not None:
        align = align._replace(
            clip=objectives.normalise_touch(jnp.asarray(align.clip)),
            image=objectives.normalise_image(jnp.asarray(align.image)),
        )
    if match is not None:
        parts = {
            n: objectives.normalise_touch(jnp.asarray(getattr(match, n))) for n in ("clip", "positive", "negative")
        }
        match = match._replace(**parts)
    return Stage2Batch(align, match)


@cache
def parts(stage, recipe="paper"):
    config = tiny_config(stage, recipe)
    net = build(config.model)
    return config, net, net.init(jax.random.key(0))


@cache
def terms2(recipe="paper"):
    config, net, _ = parts(2, recipe)
    return jax.jit(jax.value_and_grad(partial(objectives.stage2_terms, net=net, config=config), has_aux=True))


def same(a, b, atol=1e-6):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-5, atol=atol), a, b)


def test_the_future_frame_has_exactly_no_influence_on_the_prediction():
    config, net, params = parts(1)
    noise, sensor = jax.random.uniform(KEY, (B, 16)), jnp.zeros(B, jnp.int32)
    clip = objectives.normalise_touch(jnp.asarray(clips(4)))

    @jax.jit
    @jax.grad
    def gradient(clip):
        pred, _ = objectives.reconstruct(params, clip, sensor, noise, net=net, config=config)
        return jnp.sum(pred**2)

    grad = np.asarray(gradient(clip))
    assert not grad[:, 3].any()
    assert grad[:, :3].any()


def test_the_target_of_the_next_frame_counts_everywhere_and_of_the_others_where_hidden():
    config, net, params = parts(1)
    noise, sensor = jax.random.uniform(KEY, (B, 16)), jnp.zeros(B, jnp.int32)
    batch = objectives.normalise_touch(jnp.asarray(clips(4)))
    terms = jax.jit(partial(objectives.stage1_terms, net=net, config=config))
    loss, metrics = terms(params, batch, sensor, noise)
    np.testing.assert_allclose(loss, metrics["reconstruction"] + metrics["next_frame"], rtol=1e-6)
    moved, after = terms(params, batch.at[:, 3].add(1.0), sensor, noise)
    np.testing.assert_allclose(after["reconstruction"], metrics["reconstruction"], rtol=1e-6)
    assert moved > loss
    static = replace(config, objective=replace(config.objective, next_frame=False))
    short, only = objectives.stage1_terms(params, batch, sensor, noise, net=net, config=static)
    assert set(only) == {"reconstruction"}
    np.testing.assert_allclose(short, metrics["reconstruction"], rtol=1e-5)


def test_packed_slots_equal_the_dense_batch_in_any_order():
    _, net, params = parts(2)
    batch = floats(Stage2Batch(align_batch(), None))
    (loss, _), grads = terms2()(params, batch, None)
    order = np.array([2, 0, 3, 1])
    names = ("image", "image_row", "text", "text_mask", "text_row")
    shuffled = batch.align._replace(**{name: getattr(batch.align, name)[order] for name in names})
    (again, _), other = terms2()(params, Stage2Batch(shuffled, None), None)
    np.testing.assert_allclose(loss, again, rtol=1e-5)
    same(grads, other, 2e-6)
    z = objectives.align_embeddings(params, batch.align, net=net)
    assert np.flatnonzero(z.has_image).tolist() == [0, 2, 3, 7]
    assert np.flatnonzero(z.has_text).tolist() == [2, 3, 5]
    alone = net.apply(params, "embed_image", batch.align.image[1:2])
    np.testing.assert_allclose(z.image[2], alone[0] / np.linalg.norm(alone[0]), atol=1e-5)


def test_garbage_in_an_unused_slot_changes_nothing():
    _, _, params = parts(2)
    clean = floats(Stage2Batch(align_batch(images=(0, 2, 3)), None))
    dirty = clean.align._replace(
        image=clean.align.image.at[3].set(jnp.nan), text=np.where(np.arange(4)[:, None] == 3, 10**6, clean.align.text)
    )
    (a, _), grads = terms2()(params, clean, None)
    (b, _), other = terms2()(params, Stage2Batch(dirty, None), None)
    np.testing.assert_array_equal(a, b)
    jax.tree.map(np.testing.assert_array_equal, grads, other)


@pytest.mark.parametrize(("recipe", "pair", "reconstructs"), [("paper", 0.5, False), ("release", 1.0, True)])
def test_stage_2_is_the_weighted_sum_of_its_terms(recipe, pair, reconstructs):
    _, _, params = parts(2, recipe)
    batch = floats(Stage2Batch(align_batch(4 if reconstructs else 3), match_batch()))
    (loss, m), _ = terms2(recipe)(params, batch, jax.random.uniform(KEY, (B, 16)))
    expected = 0.5 * (m["touch_to_vision"] + m["vision_to_touch"]) + pair * (m["touch_to_text"] + m["text_to_touch"])
    expected += 0.1 * (m["vision_to_text"] + m["text_to_vision"]) + 0.1 * m["match"]
    if reconstructs:
        expected += m["reconstruction"] + m["next_frame"]
    np.testing.assert_allclose(loss, expected, rtol=1e-5)
    assert ("reconstruction" in m) == reconstructs
    assert (int(m["touch_vision_pairs"]), int(m["touch_text_pairs"]), int(m["vision_text_pairs"])) == (4, 3, 2)


def flops(batch):
    config, net, params = parts(2)
    loss = partial(objectives.stage2_loss, net=net, config=config)
    program = jax.jit(lambda p, b: jax.grad(lambda q: loss(q, b, KEY, 0.5)[0])(p)).lower(params, batch)
    return program.compile().cost_analysis().get("flops", 0.0)


def test_a_modality_that_is_absent_costs_nothing():
    empty = align_batch(images=(), texts=(), slots=0)
    touch_only = flops(Stage2Batch(empty, None))
    with_images = flops(
        Stage2Batch(
            align_batch(slots=4)._replace(text=empty.text, text_mask=empty.text_mask, text_row=empty.text_row), None
        )
    )
    both = flops(Stage2Batch(align_batch(slots=4), None))
    assert touch_only < with_images < both
    # and no tower is traced: its parameters may be missing
    config, net, params = parts(2)
    alone = {name: params[name] for name in ("touch", "decoder", "logit_scale")}
    loss, _ = objectives.stage2_loss(alone, Stage2Batch(empty, None), KEY, jnp.asarray(0.0), net=net, config=config)
    assert loss == 0


def loss_of(stage, recipe="paper"):
    config, net, params = parts(stage, recipe)
    loss = objectives.stage1_loss if stage == 1 else objectives.stage2_loss
    return config, params, partial(loss, net=net, config=config)


def test_jit_equals_no_jit_and_the_key_decides_everything():
    _, params, loss = loss_of(1)
    batch = touch_batch(4)
    plain = loss(params, batch, KEY, jnp.asarray(0.5))[0]
    np.testing.assert_allclose(jax.jit(loss)(params, batch, KEY, jnp.asarray(0.5))[0], plain, rtol=1e-5)
    assert loss(params, batch, jax.random.key(4), jnp.asarray(0.5))[0] != plain
    assert loss(params, batch, KEY, jnp.asarray(1.0))[0] != plain  # other sensor tokens are drawn


@pytest.mark.parametrize("stage", [1, 2])
def test_loss_falls_on_a_fixed_batch_and_devices_agree(stage):
    config, params, loss = loss_of(stage)
    config = replace(
        config, run=replace(config.run, steps=40), optim=replace(config.optim, warmup=2, learning_rate=3e-3)
    )
    batch = touch_batch(4) if stage == 1 else Stage2Batch(align_batch(), match_batch())
    step, results = make_step(loss, optimizer(config), total_steps=40), {}
    for devices in (1, 2, 4):
        mesh = make_mesh(data=devices, fsdp=1, devices=jax.devices()[:devices])
        state = jax.device_put(init_state(params, config), replicated(mesh))
        placed, key = put_batch(batch, batch_sharding(mesh)), jax.device_put(KEY, replicated(mesh))
        run, losses = jax.jit(step), []
        for _ in range(30 if devices == 1 else 3):
            state, metrics = run(state, placed, key)
            losses.append(float(metrics["loss"]))
        results[devices] = losses
    assert results[1][-1] < 0.7 * results[1][0]
    for devices in (2, 4):
        np.testing.assert_allclose(results[devices], results[1][:3], rtol=1e-5)


def test_a_sensor_outside_the_table_skips_the_step():
    config, params, loss = loss_of(1)
    step = jax.jit(make_step(loss, optimizer(config), total_steps=10))
    state = init_state(params, config)._replace(step=jnp.asarray(3))
    after, metrics = step(state, touch_batch(1)._replace(sensor=np.full(B, 10, np.int32)), KEY)
    assert metrics["skipped"] == 1 and after.step == 4
    jax.tree.map(np.testing.assert_array_equal, after.trainable, state.trainable)


def test_bfloat16_follows_float32():
    config, _, params = parts(2)
    batch = floats(Stage2Batch(align_batch(), match_batch()))
    half = tiny_config(2, dtype="bfloat16")
    wide, narrow = (
        objectives.stage2_terms(params, batch, None, net=build(c.model), config=c)[0] for c in (config, half)
    )
    assert narrow.dtype == jnp.float32 and abs(float(wide - narrow)) < 0.05 * float(wide)
