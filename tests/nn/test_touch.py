"""The touch encoder and decoder: what they see, what they cannot see, what they cost."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_models import touch_model

from anytouch_jax.config import Stack
from anytouch_jax.nn.functional import build
from anytouch_jax.ops.tokens import random_mask

MODEL = touch_model()
NET = build(MODEL)
PARAMS = NET.init(jax.random.key(0))
RNG = np.random.default_rng(0)
SENSOR = jnp.asarray([0, 3])


def clips(frames, batch=2):
    return jnp.asarray(RNG.standard_normal((batch, frames, 28, 28, 3)), jnp.float32)


def masks(keep=4, batch=2):
    return random_mask(jnp.asarray(RNG.random((batch, 16))), keep)


@jax.jit
def encode(params, clip, sensor):
    return NET.encode_touch(params, clip, sensor)


def test_shapes():
    keep_ids, restore_ids, _ = masks()
    assert encode(PARAMS, clips(1), SENSOR).shape == (2, 12)
    assert NET.encode_tokens(PARAMS, clips(3), SENSOR, keep_ids).shape == (2, 1 + 5 + 4, 12)
    pred = NET.reconstruct(PARAMS, clips(3), SENSOR, keep_ids, restore_ids, 4)
    assert pred.shape == (2, 16, 4, 147)


def test_a_still_is_a_clip_of_equal_frames():
    still = clips(1)
    np.testing.assert_allclose(
        encode(PARAMS, still, SENSOR), encode(PARAMS, jnp.repeat(still, 3, axis=1), SENSOR), atol=2e-5
    )


def test_states_are_hidden_states_evenly_spaced_from_the_embedded_tokens():
    """The first is what the first block gets, the last is `hidden`; each hangs on the blocks before it alone."""
    model = touch_model(touch=Stack(8, 5, 2, 16))
    net, clip = build(model), clips(1)
    params = net.init(jax.random.key(0))
    result = np.asarray(net.bind(params).touch.states(clip, SENSOR, 3))
    assert result.shape == (2, 1 + 5 + 16, 3 * 8)
    for depth, part in ((0, result[..., :8]), (2, result[..., 8:16]), (5, result[..., 16:])):  # 2.5 is rounded to even
        early = replace(model, touch=replace(model.touch, depth=max(depth, 1)))
        cut = jax.tree.map(lambda x: x, params)
        cut["touch"]["blocks"] = jax.tree.map(lambda x, depth=depth: x[: max(depth, 1)], params["touch"]["blocks"])
        if depth == 0:  # a block that adds nothing
            cut["touch"]["blocks"] = jax.tree.map(jnp.zeros_like, cut["touch"]["blocks"])
        np.testing.assert_allclose(part, build(early).bind(cut).touch.hidden(clip, SENSOR), atol=1e-6)
    last = net.bind(params).touch.states(clip, SENSOR, 1)
    np.testing.assert_allclose(last, net.bind(params).touch.hidden(clip, SENSOR), atol=1e-6)
    every = net.bind(params).touch.states(clip, SENSOR, 6)
    assert every.shape[-1] == 6 * 8
    np.testing.assert_allclose(every[..., :8], result[..., :8], atol=1e-6)


def test_hidden_patches_have_exactly_no_influence():
    keep_ids, restore_ids, hidden = masks()
    clip = clips(3)

    def total(clip):
        return jnp.sum(NET.reconstruct(PARAMS, clip, SENSOR, keep_ids, restore_ids, 4) ** 2)

    grad = np.asarray(jax.jit(jax.grad(total))(clip))
    cells = grad.reshape(2, 3, 4, 7, 4, 7, 3).transpose(0, 2, 4, 1, 3, 5, 6).reshape(2, 16, -1)
    hidden = np.asarray(hidden)
    assert not cells[hidden].any()
    assert (np.abs(cells[~hidden]).max(axis=-1) > 0).all()


def test_sensor_tokens_matter_and_come_from_their_row():
    clip = jnp.repeat(clips(1, 1), 2, axis=0)
    z = np.asarray(encode(PARAMS, clip, jnp.asarray([1, 2])))
    assert np.abs(z[0] - z[1]).max() > 1e-3
    grad = jax.grad(lambda p: encode(p, clip, jnp.asarray([1, 2])).sum())(PARAMS)
    rows = np.abs(np.asarray(grad["touch"]["sensor_tokens"])).max(axis=(1, 2))
    assert (rows > 0).tolist() == [i in (1, 2) for i in range(10)]


def test_a_sensor_outside_the_table_is_not_clamped_to_another():
    for outside in (10, -1, -10):
        z = np.asarray(encode(PARAMS, clips(1), jnp.asarray([9, outside])))
        assert np.isfinite(z[0]).all() and np.isnan(z[1]).all()


@pytest.mark.parametrize("outside", [10, -1])
def test_nor_is_one_in_the_decoder(outside):
    net = build(touch_model(decoder_sensor_tokens=True))
    keep_ids, restore_ids, _ = masks()
    own = jnp.asarray([9, outside])
    pred = net.reconstruct(net.init(jax.random.key(0)), clips(1), SENSOR, keep_ids, restore_ids, 1, own)
    assert np.isfinite(pred[0]).all() and np.isnan(pred[1]).all()


@pytest.mark.parametrize("frames", [1, 3])
def test_both_poolings_are_of_one_pass(frames):
    clip = clips(frames)
    token, patches = NET.encode_poolings(PARAMS, clip, SENSOR)
    np.testing.assert_allclose(token, encode(PARAMS, clip, SENSOR), atol=1e-5)
    every = NET.encode_tokens(PARAMS, clip, SENSOR)  # class token, five sensor tokens, sixteen patches
    np.testing.assert_allclose(patches, every[:, 6:].mean(axis=1), atol=1e-5)
    assert every.shape[1] == 22
    cost = {
        name: jax.jit(lambda p, c, read=read: read(NET.bind(p), c)).lower(PARAMS, clip).cost_analysis()["flops"]
        for name, read in (
            ("hidden", lambda module, clip: module.touch.hidden(clip, SENSOR)),
            ("poolings", lambda module, clip: module.encode_poolings(clip, SENSOR)),
        )
    }
    assert cost["poolings"] < 1.05 * cost["hidden"]


@pytest.mark.parametrize("head", ["mlp", "linear"])
def test_matching_logits_have_all_their_digits(head):
    nets = [build(touch_model(match_head=head, dtype=dtype)) for dtype in ("float32", "bfloat16")]
    params = nets[0].init(jax.random.key(0))
    z = jax.random.normal(jax.random.key(1), (2, 5, 12))
    first, second = (net.match(params, *z) for net in nets)
    assert second.dtype == jnp.float32
    np.testing.assert_array_equal(first, second)


def test_the_mlp_matches_the_product_scaled_by_its_width():
    net = build(touch_model(match_head="mlp"))
    params = net.init(jax.random.key(0))
    first, second = np.asarray(jax.random.normal(jax.random.key(1), (2, 5, 12)))
    up, down = (jax.tree.map(np.asarray, params["matcher"][name]) for name in ("up", "down"))
    hidden = np.asarray(jax.nn.gelu((first * second * 12) @ up["kernel"] + up["bias"], approximate=False))
    wanted = (hidden @ down["kernel"] + down["bias"])[:, 0]
    np.testing.assert_allclose(net.match(params, first, second), wanted, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("join", "width"), [("mean", 12), ("sum", 12), ("concat", 36)])
def test_long_clips_are_segments_of_three(join, width):
    clip = clips(8)
    z = NET.encode_touch(PARAMS, clip, SENSOR, join)
    parts = [np.asarray(encode(PARAMS, clip[:, s : s + 3], SENSOR)) for s in (0, 3, 5)]
    expected = {"mean": np.mean(parts, axis=0), "sum": np.sum(parts, axis=0), "concat": np.concatenate(parts, axis=1)}
    assert z.shape == (2, width)
    np.testing.assert_allclose(z, expected[join], atol=3e-5)


def test_only_the_frames_asked_for_are_painted():
    keep_ids, restore_ids, _ = masks()
    four, three = (NET.reconstruct(PARAMS, clips_3, SENSOR, keep_ids, restore_ids, t) for t in (4, 3))
    np.testing.assert_allclose(four[:, :, :3], three, rtol=1e-5, atol=1e-6)


clips_3 = clips(3)


def flops(function, *args):
    return jax.jit(function).lower(*args).compile().cost_analysis()["flops"]


def test_work_follows_what_is_visible():
    clip, sensor = clips(3, 8), jnp.zeros(8, jnp.int32)
    keep_ids = masks(4, 8)[0]
    encoder = lambda c, k: NET.bind(PARAMS).touch.hidden(c, sensor, k)  # noqa: E731
    masked, full = flops(encoder, clip, keep_ids), flops(lambda c: encoder(c, None), clip)
    assert masked < full * (1 + 5 + 4) / (1 + 5 + 16) * 1.15


def test_a_still_projects_one_frame():
    patch = lambda c: NET.bind(PARAMS).touch.tokens(c, jnp.zeros(8, jnp.int32))  # noqa: E731
    still, clip = flops(patch, clips(1, 8)), flops(patch, clips(3, 8))
    one_frame = 2 * 8 * 16 * 147 * 16
    assert still < one_frame * 1.2
    assert clip > 2.5 * one_frame


def test_one_patch_images_and_keeping_everything():
    model = touch_model(image_size=7)
    net = build(model)
    params = net.init(jax.random.key(0))
    clip = jnp.ones((1, 1, 7, 7, 3))
    for keep in (0, 1):
        keep_ids, restore_ids, _ = random_mask(jnp.zeros((1, 1)), keep)
        pred = net.reconstruct(params, clip, jnp.asarray([0]), keep_ids, restore_ids, 1)
        assert pred.shape == (1, 1, 1, 147) and np.isfinite(np.asarray(pred)).all()
