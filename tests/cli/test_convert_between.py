"""`anytouch convert --between`: weights on the way from what a stage started from to what it came to."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from tiny_models import touch_model

from anytouch_jax.config import to_json
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import build
from anytouch_jax.weights import load, safetensors
from anytouch_jax.weights.tree import flatten, interpolate


def write(path, model, params, **told):
    arrays = {name: np.asarray(array) for name, array in flatten(params).items()}
    safetensors.write_safetensors(path, arrays, {safetensors.MODEL_KEY: to_json(model)} | told)
    return path


@pytest.fixture
def two(tmp_path):
    """(first, second): files of two encoders of one network, and the parameters of both."""
    model = touch_model()
    params = [{"touch": build(model).init(jax.random.key(seed))["touch"]} for seed in (0, 1)]
    return [write(tmp_path / f"{name}.safetensors", model, one) for name, one in zip("ab", params, strict=True)], params


def test_every_weight_lies_the_asked_share_from_the_first_to_the_second(two, tmp_path, anytouch):
    (first, second), params = two
    target = tmp_path / "between.safetensors"
    for share in (0, 0.25, 1):
        assert not anytouch("convert", second, target, "--names", "own", "--between", first, "--share", share).status
        found = load.read_weights(target)
        start, end = (flatten(one) for one in params)
        assert found.keys() == end.keys()
        for name, weights in found.items():
            expected = np.asarray(start[name]) * (1 - share) + np.asarray(end[name]) * share
            np.testing.assert_allclose(weights, expected, rtol=1e-6, atol=1e-7)
    clip = np.random.default_rng(0).integers(0, 256, (2, 3, 28, 28, 3), np.uint8)
    np.testing.assert_array_equal(load_encoder(target).encode_touch(clip), load_encoder(second).encode_touch(clip))
    assert safetensors.read_file_metadata(target)["source"] == f"1 of the way from {first} to {second}"


def test_what_the_first_has_not_stays_as_in_the_second():
    first, second = {"touch": {"a": np.zeros(2)}, "decoder": np.ones(3)}, {"touch": {"a": np.ones(2)}, "text": 5.0}
    found = interpolate(first, second, 0.5)
    assert found.keys() == {"touch", "text"} and found["text"] == 5.0
    np.testing.assert_array_equal(found["touch"]["a"], [0.5, 0.5])
    with pytest.raises(UserError, match="a has shape \\(3,\\) in one and \\(2,\\)"):
        interpolate({"a": np.zeros(3)}, {"a": np.zeros(2)}, 0.5)


def test_a_run_and_its_stage_1(tiny_run, tmp_path, anytouch):
    target = tmp_path / "w.safetensors"
    said = anytouch("convert", tiny_run, target, "--between", tiny_run, "--share", 0.5)  # by the authors' names, too
    assert (said.status, said.out) == (0, f"{target}: written\n")
    clip = np.random.default_rng(0).integers(0, 256, (1, 3, 28, 28, 3), np.uint8)
    np.testing.assert_array_equal(load_encoder(target).encode_touch(clip), load_encoder(tiny_run).encode_touch(clip))


def test_mistakes(two, tmp_path, mistake):
    (first, second), (_, params) = two
    target = tmp_path / "w.safetensors"
    words = ("convert", second, target, "--names", "own")
    assert "0 to 1, not 1.5" in mistake(*words, "--between", first, "--share", 1.5)
    assert "--share does nothing without --between" in mistake(*words, "--share", 0.25)
    other = write(tmp_path / "other.safetensors", replace(touch_model(), norm_eps=1e-3), params)
    assert "of different networks (norm_eps)" in mistake(*words, "--between", other)
    seen = write(tmp_path / "seen.safetensors", touch_model(), params, **{safetensors.BACKGROUND_KEY: "subtract"})
    assert "of different networks (background)" in mistake(*words, "--between", seen)
    assert "nowhere" in mistake(*words, "--between", tmp_path / "nowhere.safetensors")
    assert "is a file that is read" in mistake("convert", second, first, "--names", "own", "--between", first)
    assert not target.exists()
