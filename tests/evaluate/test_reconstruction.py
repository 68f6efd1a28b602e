from dataclasses import replace

import jax
import numpy as np
import pytest
from tiny_models import compiled, tiny_config
from touch_world import make_touches

from anytouch_jax.config import IMAGENET_MEAN, IMAGENET_STD
from anytouch_jax.data.loading.samples import evaluation
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.evaluate import reconstruction
from anytouch_jax.evaluate.reconstruction import (
    pixel_scores,
    plain_reconstruction,
    reconstruction_panels,
)
from anytouch_jax.objectives import normalise_touch, stage1_terms
from anytouch_jax.ops.losses import normalise_patches, reconstruction_loss
from anytouch_jax.ops.tokens import patchify, random_mask

CLIP = np.random.default_rng(0).integers(0, 256, (2, 4, 28, 28, 3), np.uint8)


mask = jax.jit(random_mask, static_argnums=1)


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
    guess = plain_reconstruction(target, hidden, 3)
    result = reconstruction_loss(guess, target, hidden, next_frame=frames == 4)[1]
    assert float(result["reconstruction"]) == pytest.approx(np.mean(errors), rel=1e-5)
    assert set(result) == ({"reconstruction", "next_frame"} if frames == 4 else {"reconstruction"})
    if frames == 4:
        copy = ((target[:, :, 3] - target[:, :, 2]) ** 2).mean()
        assert float(result["next_frame"]) == pytest.approx(copy, rel=1e-5)


@pytest.mark.parametrize("background", ["keep", "subtract"])
def test_scores_are_means_over_clips(tmp_path, monkeypatch, background):
    """Five clips in batches of two, under one mask: the row that fills up the last batch does not
    count.
    """
    manifest = manifests.read(
        make_touches(tmp_path, touches={"test": 5}, sensors=("digit",), frames=4, size=28)
    )
    config = tiny_config(1)
    config = replace(config, data=replace(config.data, batch_size=2, background=background))
    net = compiled(config.model).net
    params = compiled(config.model).params
    ends = manifest.clips(4, "test")[:, -1]
    noise = np.random.default_rng(0).random((1, 16)).astype("f4")
    monkeypatch.setattr(jax.random, "uniform", lambda *_: noise.repeat(2, 0))
    result, *each = (
        pixel_scores(params, manifest, rows, net=net, config=config)
        for rows in (ends, *ends[:, None])
    )
    assert result == pytest.approx(
        {name: np.mean([one[name] for one in each]) for name in result}, rel=1e-4
    )
    ((_, batch),) = evaluation(manifest, ends[:1], config, "clip", frames=4)
    clip = batch.clip[:1]
    _, terms = stage1_terms(
        params, normalise_touch(clip), batch.sensor[:1], noise, net=net, config=config
    )
    assert each[0]["reconstruction"] == pytest.approx(float(terms["reconstruction"]), rel=1e-4)
    assert ("untouched reconstruction" in result) == (
        background == "subtract"
    ) and "plain next_frame" in result
    if background == "subtract":
        error = ((patches(clip) - patches(np.full_like(clip, 128))) ** 2).mean(-1)
        hidden = error[:, :, :3].mean(-1)[np.asarray(mask(noise, 4)[2])]
        assert each[0]["untouched reconstruction"] == pytest.approx(hidden.mean(), rel=1e-4)


# Images

CONFIG = tiny_config(1)
NET = compiled(CONFIG.model).net
PARAMS = compiled(CONFIG.model).params
SENSOR = np.asarray([0, 1], np.int32)
EDGE = 4
TITLE = 16


def cells(image):
    """The tiles of a figure (rows, columns, 28, 28, 3), their white edges checked and cut off."""
    side = 28 + EDGE
    title = image[:TITLE]
    image = image[TITLE:]
    assert 0.01 < (title < 128).mean() < 0.5  # dark words on a white strip
    grid = image.reshape(image.shape[0] // side, side, image.shape[1] // side, side, 3).transpose(
        0, 2, 1, 3, 4
    )
    assert (grid[:, :, 28:] == 255).all() and (grid[:, :, :, 28:] == 255).all()
    return grid[:, :, :28, :28]


def test_a_clip_is_shown_with_its_mask_reconstruction_and_next_frame():
    grid = cells(reconstruction_panels(PARAMS, CLIP, SENSOR, net=NET, config=CONFIG))
    assert grid.shape[:2] == (2, 3 + 3 + 3 + 2)
    # by the same draw
    patch = np.asarray(mask(jax.random.uniform(jax.random.key(0), (2, 16)), 4)[2]).reshape(2, 4, 4)
    hidden = np.repeat(np.repeat(patch, 7, axis=1), 7, axis=2)
    assert hidden.mean() == 0.75
    for sample in range(2):
        original = grid[sample, :3]
        masked = grid[sample, 3:6]
        filled = grid[sample, 6:9]
        np.testing.assert_array_equal(original, CLIP[sample, :3])
        visible = ~hidden[sample]
        for panel in (masked, filled):
            np.testing.assert_array_equal(panel[:, visible], CLIP[sample, :3][:, visible])
        assert (masked[:, hidden[sample]] == 128).all()
        assert (filled[:, hidden[sample]] != CLIP[sample, :3][:, hidden[sample]]).mean() > 0.9
        np.testing.assert_array_equal(grid[sample, 9], CLIP[sample, 3])
        assert (grid[sample, 10] != CLIP[sample, 3]).mean() > 0.9


def test_normalised_patches_are_brought_back_to_pixels(monkeypatch):
    """A network that predicts each normalised patch exactly is shown as the original, but for
    rounding.
    """

    def perfect(params, clip, sensor, noise, *, net, config):
        return normalise_patches(patchify(normalise_touch(clip), 7)), random_mask(noise, 4)[2]

    monkeypatch.setattr(reconstruction, "_predict", perfect)
    config = replace(CONFIG, objective=replace(CONFIG.objective, norm_pix_loss=True))
    grid = cells(reconstruction_panels(PARAMS, CLIP, SENSOR, net=NET, config=config)).astype(int)
    assert np.abs(grid[:, 6:9] - CLIP[:, :3].astype(int)).max() <= 1
    assert np.abs(grid[:, 10] - CLIP[:, 3].astype(int)).max() <= 1
