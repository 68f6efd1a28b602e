"""Pixels that stage 1 is not shown: its errors and those of guesses without a model, by hand."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from tiny_models import tiny_config
from touch_world import make_touches

from anytouch_jax.config import IMAGENET_MEAN, IMAGENET_STD
from anytouch_jax.data.loading.evaluation import evaluation
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.evaluate.reconstruction import pixel_scores, plain_guess
from anytouch_jax.nn.functional import build
from anytouch_jax.objectives import normalise_touch, stage1_terms
from anytouch_jax.ops.losses import reconstruction_loss
from anytouch_jax.ops.masking import random_mask

CLIP = np.random.default_rng(0).integers(0, 256, (2, 4, 28, 28, 3), np.uint8)


def patches(clip):
    """Normalised pixels of clips u8 (B, T, 28, 28, 3) in patches of 7, (B, 16, T, 147)."""
    pixels = (clip / 255.0 - IMAGENET_MEAN) / IMAGENET_STD
    b, t = clip.shape[:2]
    return pixels.reshape(b, t, 4, 7, 4, 7, 3).transpose(0, 2, 4, 1, 3, 5, 6).reshape(b, 16, t, 147)


@pytest.mark.parametrize("frames", [1, 4])
def test_the_guesses_without_a_model(frames):
    target = patches(CLIP[:, :frames])
    hidden = np.random.default_rng(1).permuted(np.arange(16) < np.full((2, 1), 12), axis=1)
    shown = min(frames, 3)
    errors = []
    for sample in range(2):
        for patch in np.flatnonzero(hidden[sample]):
            guess = target[sample, ~hidden[sample], :shown].mean(axis=0)
            errors.append(((target[sample, patch, :shown] - guess) ** 2).mean())
    guess = plain_guess(target, hidden, 3)
    found = reconstruction_loss(guess, target, hidden, next_frame=frames == 4)[1]
    assert float(found["reconstruction"]) == pytest.approx(np.mean(errors), rel=1e-5)
    assert set(found) == ({"reconstruction", "next_frame"} if frames == 4 else {"reconstruction"})
    if frames == 4:
        copy = ((target[:, :, 3] - target[:, :, 2]) ** 2).mean()
        assert float(found["next_frame"]) == pytest.approx(copy, rel=1e-5)


@pytest.mark.parametrize("background", ["keep", "subtract"])
def test_scores_are_means_over_clips(tmp_path, background):
    """Five clips in batches of two: the row that fills up the last batch does not count."""
    manifest = manifests.read(make_touches(tmp_path, touches={"test": 5}, sensors=("digit",), frames=4, size=28))
    config = tiny_config(1)
    config = replace(config, data=replace(config.data, batch_size=2, background=background))
    ends = manifest.clips(4, "test")[:, -1]
    net = build(config.model)
    params = net.init(jax.random.key(0))
    found = pixel_scores(params, manifest, ends, config)
    sums = dict.fromkeys(found, 0.0)
    for start, (ids, batch) in zip((0, 2, 4), evaluation(manifest, ends, config, "clip", frames=4), strict=True):
        noise = jax.random.uniform(jax.random.key(start), (2, config.model.patches))
        for i in range(len(ids)):
            clip, one = batch.clip[i : i + 1], noise[i : i + 1]
            terms = stage1_terms(params, normalise_touch(clip), batch.sensor[i : i + 1], one, net=net, config=config)[1]
            hidden = np.asarray(random_mask(one, config.model.patches // 4)[2])
            target = patches(clip)
            guesses = {"plain ": plain_guess(target, hidden, 3), "untouched ": patches(np.full_like(clip, 128))}
            errors = {"": terms}
            for kind, guess in guesses.items():
                errors[kind] = reconstruction_loss(guess, target, hidden, next_frame=True)[1]
            for name in sums:
                kind, _, term = name.rpartition(" ")
                sums[name] += float(errors[f"{kind} " if kind else ""][term]) / 5
    assert found == pytest.approx(sums, rel=1e-4)
    assert ("untouched reconstruction" in found) == (background == "subtract") and "plain next_frame" in found


def test_what_cannot_be_scored_is_refused(tmp_path):
    manifest = manifests.read(make_touches(tmp_path, touches={"test": 1}, sensors=("digit",), frames=4, size=28))
    config = tiny_config(1)
    with pytest.raises(ValueError, match="at least one clip"):
        pixel_scores({}, manifest, np.zeros(0, np.int64), config)
    with pytest.raises(ValueError, match="norm_pix_loss"):
        ends = manifest.clips(4, "test")[:, -1]
        pixel_scores({}, manifest, ends, replace(config, objective=replace(config.objective, norm_pix_loss=True)))
