"""Sight: its depthwise convolution against XLA's, its export, and that it leaves the features of AnyTouch alone."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from anytouch_jax.config import preset
from anytouch_jax.encoder import engines
from anytouch_jax.encoder.base import touch_features
from anytouch_jax.nn import sight
from anytouch_jax.nn.functional import build


@pytest.mark.parametrize(("side", "stride", "size"), [(3, 1, 7), (3, 2, 8), (5, 2, 14), (5, 1, 7)])
def test_depthwise_equals_a_grouped_convolution(side: int, stride: int, size: int) -> None:
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.standard_normal((2, size, size, 6)), jnp.float32)
    kernel = jnp.asarray(rng.standard_normal((side, side, 6)), jnp.float32)

    def grouped(x: jax.Array, kernel: jax.Array) -> jax.Array:
        around, form = [(side // 2, side // 2)] * 2, ("NHWC", "HWIO", "NHWC")
        return lax.conv_general_dilated(
            x, kernel[:, :, None], (stride, stride), around, dimension_numbers=form, feature_group_count=6
        )

    np.testing.assert_allclose(sight.depthwise(x, kernel, stride), grouped(x, kernel), rtol=1e-4, atol=1e-4)

    def gradients(function: object) -> object:
        return jax.grad(lambda x, kernel: jnp.sum(jnp.sin(function(x, kernel))), (0, 1))(x, kernel)  # type: ignore[operator]

    ours = gradients(lambda x, kernel: sight.depthwise(x, kernel, stride))
    for mine, theirs in zip(ours, gradients(grouped), strict=True):  # type: ignore[call-overload]
        np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-4)


def test_sight_joins_the_features_and_changes_none() -> None:
    plain = replace(preset("tiny", stage=1).model, image_size=112)
    model = replace(plain, sight=24)
    params = build(model).init(jax.random.key(0))
    clips = np.random.default_rng(0).integers(0, 256, (2, 3, 112, 112, 3), np.uint8)
    rows = np.zeros(2, np.int32)
    without = {"touch": {name: part for name, part in params["touch"].items() if name != "sight"}}
    for pooling, width in (("class", model.embed), ("mean", model.embed), ("both", 2 * model.embed)):
        features = [
            touch_features(given, clips, rows, net=build(form), pooling=pooling, join="mean")  # type: ignore[arg-type]
            for given, form in ((params, model), (without, plain))
        ]
        assert features[0].shape == (2, width + 24)
        np.testing.assert_array_equal(features[0][:, :width], features[1])
        seen = build(model).see(params, (jnp.asarray(clips) / 255 - 0.5), rows)
        assert seen.shape == (2, 24)


def test_the_graph_of_onnx_sees_the_same() -> None:
    pytest.importorskip("onnxruntime")
    model = replace(preset("tiny", stage=1).model, image_size=112, sight=24)
    params = build(model).init(jax.random.key(0))
    clips = np.random.default_rng(0).integers(0, 256, (2, 1, 112, 112, 3), np.uint8)
    rows = np.zeros(2, np.int32)
    live = touch_features(params, clips, rows, net=build(model), pooling="class", join="mean")
    run = engines.session(engines.touch_graph({"touch": params["touch"]}, model, 1))
    np.testing.assert_allclose(run(clips, rows), live, atol=1e-5 * float(jnp.abs(live).max()))
