"""Patches and frames left out: features of all patches, of none that changed, and what each frame is given."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from anytouch_jax.encoder.encoder import load_encoder, random_encoder
from anytouch_jax.encoder.stream import LEARNED
from experiments.benchmarks import scene
from experiments.benchmarks.scene import UNTOUCHED, Embedder, Frames, Variant, patches_by_change, pruned_features


@pytest.fixture(scope="module")
def encoder(tiny_run):
    return random_encoder(load_encoder(tiny_run).config.with_settings({"model.patch": 7, "model.image_size": 28}))


@pytest.fixture(scope="module")
def frames(encoder):
    """Ten untouched gels, then ten pictures whose changes differ from patch to patch."""
    rng = np.random.default_rng(0)
    still = np.full((10, 28, 28, 3), UNTOUCHED, np.uint8)
    levels = np.kron(rng.permuted(np.tile(np.arange(16), (10, 1)), axis=1).reshape(10, 4, 4), np.ones((7, 7)))
    pressed = (still + levels[..., None]).astype(np.uint8)
    sensor, camera = np.ones(20, np.int32), np.repeat(["a", "b"], 10)
    return Frames(np.concatenate([still, pressed]), sensor, camera, np.arange(20) < 10, 7)


def features(encoder, frames, keep, merge):
    order = patches_by_change(frames.change)
    run = jax.jit(pruned_features, static_argnames=("net", "keep", "merge"))
    return np.asarray(run(encoder.params, frames.pixels, frames.sensor, order, net=encoder.net, keep=keep, merge=merge))


def test_all_patches_give_the_features_of_the_plain_encoder(encoder, frames):
    plain = encoder.encode_touch(frames.pixels, frames.sensor)
    order = patches_by_change(frames.change)
    clips = scene.normalise_touch(frames.pixels)[:, None]
    kept = encoder.net.encode_touch(encoder.params, clips, frames.sensor, keep_ids=order)  # in another order
    np.testing.assert_allclose(kept, plain, atol=1e-6)
    np.testing.assert_allclose(features(encoder, frames, 16, False), plain, atol=1e-6)
    assert np.abs(features(encoder, frames, 8, False) - plain).max() > 1e-4


def test_the_mean_of_one_patch_is_the_patch(encoder, frames):
    """All of the merged tokens are then the patch that is left out."""
    order = patches_by_change(frames.change)
    four = np.concatenate([order, order[:, -1:], order[:, -1:], order[:, -1:]], axis=1)
    clips = scene.normalise_touch(frames.pixels)[:, None]
    wanted = encoder.net.encode_touch(encoder.params, clips, frames.sensor, keep_ids=four)
    np.testing.assert_allclose(features(encoder, frames, 15, True), wanted, atol=1e-6)


def test_the_patches_that_changed_most_are_kept(frames):
    order = patches_by_change(frames.change)
    assert (order[:10] == np.arange(16)).all(), "an untouched gel has no order"
    kept = np.take_along_axis(frames.change[10:], order[10:, :4].astype(int), axis=1)
    assert (kept == [15, 14, 13, 12]).all()


def test_a_limit_keeps_the_fewest_patches_that_hold_the_changes(encoder, frames):
    limits = {14.5: 25, 11.5: 25, 10.5: 50, 7.5: 50, 6.5: 100, -1.0: 100}
    for limit, percent in limits.items():
        kept = Embedder(encoder, frames).kept(Variant("", limit=limit))
        assert set(kept[10:]) == {percent} and set(kept[:10]) == {25 if limit > 0 else 100}


def test_frames_are_given_the_features_of_the_last_that_was_embedded(encoder, frames):
    sources = frames.sources(0.0)
    assert sources.tolist() == [0] * 10 + list(range(10, 20)) and frames.sources(None).tolist() == list(range(20))
    embedder = Embedder(encoder, frames)
    whole, reused = (embedder.features(Variant("", reuse=factor), np.arange(20)) for factor in (None, 0.0))
    np.testing.assert_array_equal(whole[0], reused[0])
    assert whole[1]["runs"] == {"100 %": 1.0}
    assert reused[1] == {"runs": {"100 %": 11 / 20, "compare": 1.0}, "reused_free": 0.9}


def test_noise_is_known_from_the_first_frame_on(frames):
    rng = np.random.default_rng(0)
    noisy = np.clip(rng.normal(UNTOUCHED, 2, (LEARNED + 10, 28, 28, 3)).round(), 0, 255).astype(np.uint8)
    many = np.zeros(len(noisy), np.int32)
    sources = Frames(noisy, many, many.astype(str), many == 0, 7).sources(3.0)
    assert set(sources) == {0}


def test_times_name_every_program(encoder):
    found = scene.times(encoder, rounds=2)["programs"]
    names = {f"{share} %{kind}" for share in (75, 50, 25) for kind in ("", " merged")}
    assert set(found) == names | {"100 %", "compare", "choose", "clip", "projection of a clip"}
    assert found["100 %"]["ratio"] == 1.0 and all(one["ms"] > 0 for one in found.values())
