import functools
import math

import jax
import numpy as np
import pytest
from tiny_models import compiled, full_model, touch_model

from anytouch_jax.config import Stack, preset
from anytouch_jax.nn.functional import build

MODEL = touch_model()
NET = compiled(MODEL)
PARAMS = NET.params
encode = NET.encode_touch
RNG = np.random.default_rng(0)
SENSOR = np.asarray([0, 3], np.int32)


def clips(frames, batch=2):
    return RNG.standard_normal((batch, frames, 28, 28, 3)).astype("f4")


def masks(keep=4, batch=2):
    order = RNG.random((batch, 16)).argsort(axis=1)
    restore = order.argsort(axis=1)
    return order[:, :keep], restore, restore >= keep


def test_a_still_is_a_clip_of_equal_frames():
    still = clips(1)
    equal = encode(PARAMS, np.repeat(still, 3, axis=1), SENSOR)
    np.testing.assert_allclose(encode(PARAMS, still, SENSOR), equal, atol=2e-5)


def test_states_are_hidden_states_evenly_spaced_from_the_embedded_tokens():
    """The first is what the first block gets, the last is `hidden`; each hangs on the blocks before
    it alone.
    """
    model = touch_model(touch=Stack(8, 5, 2, 16))
    net = build(model)
    clip = clips(1)
    params = net.init(jax.random.key(0))

    @functools.partial(jax.jit, static_argnums=1)
    def states(params, count):
        return net.bind(params).touch.states(clip, SENSOR, count)

    result = states(params, 3)
    assert result.shape == (2, 1 + 5 + 16, 3 * 8)
    # Depths 0, 2 (2.5 is rounded to even) and 5 of the same stack: the blocks behind add nothing
    # when they are zero.
    for depth, part in ((0, result[..., :8]), (2, result[..., 8:16]), (5, result[..., 16:])):
        blocks = jax.tree.map(
            lambda x, n=depth: np.where(np.arange(5).reshape(-1, *[1] * (x.ndim - 1)) < n, x, 0),
            jax.device_get(params["touch"]["blocks"]),
        )
        cut = params | {"touch": params["touch"] | {"blocks": blocks}}
        np.testing.assert_allclose(part, states(cut, 1), atol=1e-6)
    hidden = jax.jit(lambda params: net.bind(params).touch.hidden(clip, SENSOR))(params)
    np.testing.assert_allclose(result[..., 16:], hidden, atol=1e-6)
    every = states(params, 6)
    assert every.shape[-1] == 6 * 8
    np.testing.assert_allclose(every[..., :8], result[..., :8], atol=1e-6)


def test_sensor_tokens_matter_and_come_from_their_row():
    clip = np.repeat(clips(1, 1), 2, axis=0)
    rows = np.asarray([1, 2], np.int32)
    z = np.asarray(encode(PARAMS, clip, rows))
    assert np.abs(z[0] - z[1]).max() > 1e-3
    grad = jax.jit(jax.grad(lambda p: NET.net.encode_touch(p, clip, rows).sum()))(PARAMS)
    rows = np.abs(np.asarray(grad["touch"]["sensor_tokens"])).max(axis=(1, 2))
    assert (rows > 0).tolist() == [i in (1, 2) for i in range(10)]


def test_a_sensor_outside_the_table_is_not_clamped_to_another():
    """Nor is one of the decoder."""
    net = compiled(touch_model(decoder_sensor_tokens=True))
    (keep_ids, restore_ids, _) = masks()
    for outside in (10, -1, -10):
        own = np.asarray([9, outside], np.int32)
        z = np.asarray(encode(PARAMS, clips(1), own))
        assert np.isfinite(z[0]).all() and np.isnan(z[1]).all()
        pred = np.asarray(
            net.reconstruct(net.params, clips(1), SENSOR, keep_ids, restore_ids, 1, own)
        )
        assert np.isfinite(pred[0]).all() and np.isnan(pred[1]).all()


@pytest.mark.parametrize("frames", [1, 3])
def test_both_poolings_are_of_one_pass(frames):
    clip = clips(frames)
    token, patches = NET.encode_poolings(PARAMS, clip, SENSOR)
    np.testing.assert_allclose(token, encode(PARAMS, clip, SENSOR), atol=1e-5)
    # class token, five sensor tokens, sixteen patches
    every = NET.encode_tokens(PARAMS, clip, SENSOR)
    np.testing.assert_allclose(patches, np.asarray(every)[:, 6:].mean(axis=1), atol=1e-5)
    assert every.shape[1] == 22
    cost = {
        name: jax.jit(lambda p, c, read=read: read(NET.bind(p), c))
        .lower(PARAMS, clip)
        .cost_analysis()["flops"]
        for name, read in (
            ("hidden", lambda module, clip: module.touch.hidden(clip, SENSOR)),
            ("poolings", lambda module, clip: module.encode_poolings(clip, SENSOR)),
        )
    }
    assert cost["poolings"] < 1.05 * cost["hidden"]


@pytest.mark.parametrize("head", ["mlp", "linear"])
def test_matching_logits_have_all_their_digits(head):
    nets = [
        compiled(touch_model(match_head=head, dtype=dtype)) for dtype in ("float32", "bfloat16")
    ]
    z = RNG.standard_normal((2, 5, 12)).astype("f4")
    first, second = (net.match(nets[0].params, *z) for net in nets)
    assert second.dtype == np.float32
    np.testing.assert_array_equal(first, second)
    if head == "mlp":  # of the product scaled by its width
        up, down = (
            jax.tree.map(np.asarray, nets[0].params["matcher"][name]) for name in ("up", "down")
        )
        x = (z[0] * z[1] * 12) @ up["kernel"] + up["bias"]
        hidden = x * (1 + np.vectorize(math.erf)(x / math.sqrt(2))) / 2
        np.testing.assert_allclose(
            first, (hidden @ down["kernel"] + down["bias"])[:, 0], rtol=1e-5, atol=1e-6
        )


@pytest.mark.parametrize(("aggregation", "width"), [("mean", 12), ("sum", 12), ("concat", 36)])
def test_long_clips_are_segments_of_three(aggregation, width):
    clip = clips(8)
    z = encode(PARAMS, clip, SENSOR, aggregation)
    parts = [np.asarray(encode(PARAMS, clip[:, s : s + 3], SENSOR)) for s in (0, 3, 5)]
    expected = {
        "mean": np.mean(parts, axis=0),
        "sum": np.sum(parts, axis=0),
        "concat": np.concatenate(parts, axis=1),
    }
    assert z.shape == (2, width)
    np.testing.assert_allclose(z, expected[aggregation], atol=3e-5)


def flops(function, *args):
    return jax.jit(function).lower(*args).cost_analysis()["flops"]


def test_work_follows_what_is_visible():
    clip = clips(3, 8)
    sensor = np.zeros(8, np.int32)
    keep_ids = masks(4, 8)[0]
    encoder = lambda c, k: NET.bind(PARAMS).touch.hidden(c, sensor, k)  # noqa: E731
    masked = flops(encoder, clip, keep_ids)
    full = flops(lambda c: encoder(c, None), clip)
    assert masked < full * (1 + 5 + 4) / (1 + 5 + 16) * 1.15


def test_a_still_projects_one_frame():
    patch = lambda c: NET.bind(PARAMS).touch.tokens(c, np.zeros(8, np.int32))  # noqa: E731
    still = flops(patch, clips(1, 8))
    clip = flops(patch, clips(3, 8))
    one_frame = 2 * 8 * 16 * 147 * 16
    assert still < one_frame * 1.2
    assert clip > 2.5 * one_frame


def test_abstract_has_the_shapes_of_init_and_allocates_nothing():
    net = build(full_model(lora_rank=2))
    real = net.init(jax.random.key(0))
    abstract = net.abstract()
    assert jax.tree.map(lambda x: (x.shape, x.dtype), real) == jax.tree.map(
        lambda x: (x.shape, x.dtype), abstract
    )
    large = build(preset("large", stage=2, recipe="release", towers="pretrained").model).abstract()
    assert sum(np.prod(leaf.shape) for leaf in jax.tree.leaves(large)) > 7.5e8


def test_parameters_have_the_floats_of_the_context_whatever_was_built_before():
    net = build(touch_model(embed=5))
    for wide, expected in ((True, "float64"), (False, "float32"), (True, "float64")):
        with jax.enable_x64(wide):
            params = net.init(jax.random.key(0))
        assert {str(leaf.dtype) for leaf in jax.tree.leaves(params)} == {expected}


def test_first_values():
    net = build(full_model(lora_rank=2))
    a, b, c = (net.init(jax.random.key(seed)) for seed in (0, 0, 1))
    jax.tree.map(np.testing.assert_array_equal, a, b)
    assert not np.array_equal(a["touch"]["patch"]["kernel"], c["touch"]["patch"]["kernel"])
    assert abs(np.std(a["touch"]["sensor_tokens"]) - 0.02) < 0.002
    # blocks of a stack and equal layers of different names start apart
    kernel = np.asarray(a["touch"]["blocks"]["attention"]["query"]["kernel"])
    assert not np.array_equal(kernel[0], kernel[1])
    assert not np.array_equal(kernel, a["touch"]["blocks"]["attention"]["key"]["kernel"])


def test_parts_left_out_do_not_exist():
    assert set(build(touch_model()).abstract()) == {"touch", "decoder"}
    with pytest.raises(AttributeError):
        compiled(touch_model()).encode_image(
            compiled(touch_model()).params, np.zeros((1, 28, 28, 3))
        )
