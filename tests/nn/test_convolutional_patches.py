"""Small convolutions inside each patch in place of the projection (ours): what they keep of the projection's laws."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
from tiny_models import compiled, tiny_config, touch_model

from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import build
from anytouch_jax.nn.touch import windows
from anytouch_jax.weights import compatible
from anytouch_jax.weights.convert import to_release
from anytouch_jax.weights.keymaps import param_shapes
from anytouch_jax.weights.load import inflate
from anytouch_jax.weights.safetensors import WeightsError
from anytouch_jax.weights.tree import flatten

RNG = np.random.default_rng(0)
MODEL = touch_model(patch_encoder="convolutional")
NET = compiled(MODEL)
PARAMS = NET.params
CLIP = RNG.standard_normal((2, 3, 28, 28, 3)).astype("f4")
SENSOR = np.array([0, 3], np.int32)


def encode(clip):
    return np.asarray(NET.encode_touch(PARAMS, clip, SENSOR))


@pytest.mark.parametrize("side", [3, 5])
@pytest.mark.parametrize(("height", "width"), [(7, 7), (8, 5), (1, 2)])
def test_a_product_with_windows_is_a_convolution_of_stride_2(side, height, width):
    x = RNG.standard_normal((2, height, width, 3)).astype("f4")
    kernel = RNG.standard_normal((side * side * 3, 4)).astype("f4")

    @jax.jit
    def run(x, kernel):
        around = [(side // 2, side // 2)] * 2
        wanted = jax.lax.conv_general_dilated(
            x, kernel.reshape(side, side, 3, 4), (2, 2), around, dimension_numbers=("NHWC", "HWIO", "NHWC")
        )
        return windows(x, side) @ kernel, wanted

    result, wanted = run(x, kernel)
    assert wanted.shape == (2, -(-height // 2), -(-width // 2), 4)
    np.testing.assert_allclose(result, wanted, atol=1e-5)


def test_a_still_is_a_clip_of_equal_frames():
    np.testing.assert_allclose(encode(CLIP[:, :1]), encode(np.repeat(CLIP[:, :1], 3, axis=1)), atol=2e-5)


def test_the_order_of_frames_is_seen():
    assert np.abs(encode(CLIP) - encode(CLIP[:, ::-1])).max() > 1e-3


def test_a_patch_hangs_on_its_own_pixels_alone():
    """Nothing is read over its border: what is masked stays hidden."""

    @jax.jit
    def tokens(clip):
        return NET.bind(PARAMS).touch.tokens(clip, SENSOR)[:, 6:]

    before = np.asarray(tokens(CLIP))
    clip = CLIP.copy()
    clip[:, :, 7:14, 14:21] += 1.0  # the second row's third patch of four by four
    after = np.asarray(tokens(clip))
    changed = np.abs(after - before).max(axis=(0, 2)) > 0
    assert np.flatnonzero(changed).tolist() == [4 + 2]


def test_every_parameter_of_it_learns():
    grad = jax.jit(jax.grad(lambda params: (NET.net.encode_touch(params, CLIP, SENSOR) ** 2).sum()))(PARAMS)
    for name, value in flatten(grad["touch"]["patch"]).items():
        assert np.abs(value).max() > 1e-4, name


def test_tokens_start_at_the_size_of_projected_ones():
    patches = RNG.standard_normal((2, 16, 3, 147)).astype("f4")
    own, shared = (
        np.std(jax.jit(lambda p, net=net: net.bind(p).touch.patch(patches, SENSOR))(net.params))
        for net in (NET, compiled(touch_model()))
    )
    assert 0.3 < own / shared < 3


@pytest.mark.parametrize("patch", [6, 7, 14])
def test_the_shapes_written_down_are_those_of_the_network(patch):
    model = touch_model(patch_encoder="convolutional", patch=patch, image_size=4 * patch)
    wanted = {name: tuple(leaf.shape) for name, leaf in flatten(build(model).abstract()).items()}
    assert {name: tuple(shape) for name, shape in param_shapes(model).items()} == wanted


def test_both_stages_are_built_with_it():
    for stage in (1, 2):
        model = tiny_config(stage, patch_encoder="convolutional").model
        assert "touch/patch/last/kernel" in flatten(build(model).abstract())


def test_the_authors_files_have_no_place_for_convolutions():
    with pytest.raises(WeightsError, match="one patch projection"):
        to_release(PARAMS, MODEL)


def test_an_image_tower_has_no_projection_to_give():
    with pytest.raises(WeightsError, match=r"leave out --model.patch-encoder"):
        inflate(PARAMS, {"patch": {"kernel": np.zeros((147, 16))}})


def test_weights_of_another_patch_encoder_name_the_option_that_lacks():
    config = tiny_config(1, patch_encoder="convolutional")
    with pytest.raises(UserError, match=r"add --model.patch-encoder shared"):
        compatible.check_form(Path("run"), replace(config.model, patch_encoder="shared"), config)
