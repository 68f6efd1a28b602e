"""The convolutional trunk: its convolution against XLA's, its export, and what it leaves alone."""

from collections.abc import Callable
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from anytouch_jax.batch import FieldOutput
from anytouch_jax.config import preset
from anytouch_jax.encoder import features
from anytouch_jax.encoder.encoder import random_encoder
from anytouch_jax.nn import sight
from anytouch_jax.nn.functional import build

PLAIN = preset("tiny", stage=1)
PLAIN = replace(PLAIN, model=replace(PLAIN.model, image_size=56))
SEEING = replace(PLAIN, model=replace(PLAIN.model, sight=24))
CLIPS = np.random.default_rng(0).integers(0, 256, (2, 3, 56, 56, 3), np.uint8)
ROWS = np.zeros(2, np.int32)

touch_features = jax.jit(features.touch_features, static_argnames=("net", "pooling", "aggregation"))
features_and_fields = jax.jit(features.features_and_fields, static_argnames=("net", "pooling"))


@pytest.fixture(scope="module")
def params() -> dict[str, jax.Array]:
    return build(SEEING.model).init(jax.random.key(0))


def grouped(x: jax.Array, kernel: jax.Array, stride: int) -> jax.Array:
    """Return XLA's own depthwise convolution."""
    channels = x.shape[-1]
    form = ("NHWC", "HWIO", "NHWC")
    return lax.conv_general_dilated(
        x,
        kernel[:, :, None],
        (stride, stride),
        "SAME",
        dimension_numbers=form,
        feature_group_count=channels,
    )


@pytest.mark.parametrize(("side", "stride", "size"), [(3, 2, 7), (3, 2, 8), (5, 2, 14), (5, 1, 7)])
def test_depthwise_equals_a_grouped_convolution(side: int, stride: int, size: int) -> None:
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.standard_normal((2, size, size + 1, 6)), jnp.float32)
    kernel = jnp.asarray(rng.standard_normal((side, side, 6)), jnp.float32)

    def gradients(convolve: Callable[..., jax.Array]) -> tuple[jax.Array, jax.Array]:
        def total(x: jax.Array, kernel: jax.Array) -> jax.Array:
            return jnp.sum(jnp.sin(convolve(x, kernel, stride)))

        return jax.grad(total, (0, 1))(x, kernel)

    wanted = grouped(x, kernel, stride)
    np.testing.assert_allclose(sight.depthwise(x, kernel, stride), wanted, rtol=1e-4, atol=1e-4)
    for ours, theirs in zip(gradients(sight.depthwise), gradients(grouped), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("pooling", "parts"), [("class", 1), ("mean", 1), ("both", 2)])
def test_the_trunk_joins_the_features_and_changes_none(
    params: dict[str, jax.Array], pooling: str, parts: int
) -> None:
    without = {name: part for name, part in params["touch"].items() if name != "sight"}
    plain = touch_features(
        {"touch": without}, CLIPS, ROWS, net=build(PLAIN.model), pooling=pooling, aggregation="mean"
    )
    joined = touch_features(
        params, CLIPS, ROWS, net=build(SEEING.model), pooling=pooling, aggregation="mean"
    )
    width = parts * SEEING.model.embed
    assert joined.shape == (2, width + 24)
    # XLA may fuse the arithmetic in another order where the trunk is beside it.
    np.testing.assert_allclose(joined[:, :width], plain, rtol=1e-4, atol=1e-5)
    # The last frame alone is seen.
    still = touch_features(
        params, CLIPS[:, -1:], ROWS, net=build(SEEING.model), pooling=pooling, aggregation="mean"
    )
    np.testing.assert_allclose(joined[:, width:], still[:, width:], rtol=1e-4, atol=1e-5)
    assert np.ptp(joined[:, width:], axis=0).min() > 0


def test_segments_are_joined_as_those_of_the_transformer(params: dict[str, jax.Array]) -> None:
    net = build(SEEING.model)
    long = np.concatenate([CLIPS, CLIPS[:, ::-1]], axis=1)
    wide = touch_features(params, long, ROWS, net=net, pooling="class", aggregation="concat")
    mean = touch_features(params, long, ROWS, net=net, pooling="class", aggregation="mean")
    segments = (wide.shape[1]) // (SEEING.model.embed + 24)
    own = wide[:, segments * SEEING.model.embed :].reshape(2, segments, 24)
    np.testing.assert_allclose(own.mean(1), mean[:, SEEING.model.embed :], rtol=1e-4, atol=1e-5)


def test_fields_and_features_of_one_pass_are_those_of_two() -> None:
    model = replace(SEEING.model, fields=16)
    net = build(model)
    params = net.init(jax.random.key(1))
    aspect = np.zeros(2, np.float32)
    together, out = features_and_fields(params, CLIPS, ROWS, aspect, net=net, pooling="both")
    assert isinstance(out, FieldOutput)
    alone = touch_features(params, CLIPS, ROWS, net=net, pooling="both", aggregation="mean")
    np.testing.assert_allclose(together, alone, rtol=1e-4, atol=1e-5)


def test_texts_and_matching_read_the_embedding_alone() -> None:
    encoder = random_encoder(SEEING)
    touches = encoder.encode_touch(CLIPS, np.zeros(2, np.int32))
    text = np.random.default_rng(1).standard_normal((3, SEEING.model.embed)).astype(np.float32)
    louder = touches.copy()
    louder[:, SEEING.model.embed :] *= 100
    np.testing.assert_array_equal(
        encoder.similarity(touches, text), encoder.similarity(louder, text)
    )


def test_the_graph_of_onnx_sees_the_same(params: dict[str, jax.Array]) -> None:
    pytest.importorskip("onnxruntime")
    from anytouch_jax.export import engines
    from anytouch_jax.export.graph import touch_graph

    live = touch_features(
        params, CLIPS, ROWS, net=build(SEEING.model), pooling="class", aggregation="mean"
    )
    run = engines.session(touch_graph({"touch": params["touch"]}, SEEING.model, 3))
    seen = run(CLIPS, ROWS)
    np.testing.assert_allclose(seen, live, atol=1e-4 * float(jnp.abs(live).max()))
