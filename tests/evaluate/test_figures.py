"""Figures, checked by hand."""

from dataclasses import replace

import cv2
import jax
import numpy as np
import pytest
from tiny_models import tiny_config

from anytouch_jax.evaluate import figures
from anytouch_jax.evaluate.figures import reconstruction_panels, write_png
from anytouch_jax.nn.functional import build
from anytouch_jax.objectives import normalise_touch
from anytouch_jax.ops.losses import normalise_patches
from anytouch_jax.ops.masking import random_mask
from anytouch_jax.ops.tokens import patchify

CONFIG = tiny_config(1)
NET = build(CONFIG.model)
PARAMS = NET.init(jax.random.key(0))
CLIP = np.random.default_rng(0).integers(0, 256, (2, 4, 28, 28, 3), np.uint8)
SENSOR = np.asarray([0, 1], np.int32)
EDGE, TITLE = 4, 16


def cells(image):
    """The tiles of a figure (rows, columns, 28, 28, 3), their white edges checked and cut off."""
    side, title, image = 28 + EDGE, image[:TITLE], image[TITLE:]
    assert 0.01 < (title < 128).mean() < 0.5  # dark words on a white strip
    grid = image.reshape(image.shape[0] // side, side, image.shape[1] // side, side, 3).transpose(0, 2, 1, 3, 4)
    assert (grid[:, :, 28:] == 255).all() and (grid[:, :, :, 28:] == 255).all()
    return grid[:, :, :28, :28]


def hidden_pixels(clip, seed=0):
    """Which pixels (B, 28, 28) the figure hides, by the same draw."""
    noise = jax.random.uniform(jax.random.key(seed), (len(clip), 16))
    hidden = np.asarray(random_mask(noise, 4)[2]).reshape(-1, 4, 4)
    return np.repeat(np.repeat(hidden, 7, axis=1), 7, axis=2)


def test_a_clip_is_shown_with_its_mask_reconstruction_and_next_frame():
    grid = cells(reconstruction_panels(PARAMS, CLIP, SENSOR, net=NET, config=CONFIG))
    assert grid.shape[:2] == (2, 3 + 3 + 3 + 2)
    hidden = hidden_pixels(CLIP)
    assert hidden.mean() == 0.75
    for sample in range(2):
        original, masked, filled = grid[sample, :3], grid[sample, 3:6], grid[sample, 6:9]
        np.testing.assert_array_equal(original, CLIP[sample, :3])
        seen = ~hidden[sample]
        for panel in (masked, filled):
            np.testing.assert_array_equal(panel[:, seen], CLIP[sample, :3][:, seen])
        assert (masked[:, hidden[sample]] == 128).all()
        assert (filled[:, hidden[sample]] != CLIP[sample, :3][:, hidden[sample]]).mean() > 0.9
        np.testing.assert_array_equal(grid[sample, 9], CLIP[sample, 3])
        assert (grid[sample, 10] != CLIP[sample, 3]).mean() > 0.9


def test_a_still_has_three_panels_and_the_mask_follows_the_seed():
    still = CLIP[:, :1]
    first, second = (
        cells(reconstruction_panels(PARAMS, still, SENSOR, net=NET, config=CONFIG, seed=seed)) for seed in (0, 5)
    )
    assert first.shape[:2] == (2, 3)
    for grid, seed in ((first, 0), (second, 5)):
        np.testing.assert_array_equal((grid[:, 1] == 128).all(-1), hidden_pixels(still, seed))


def test_normalised_patches_are_brought_back_to_pixels(monkeypatch):
    """A network that predicts each normalised patch exactly is shown as the original, but for rounding."""

    def perfect(params, clip, sensor, noise, *, net, config):
        return normalise_patches(patchify(normalise_touch(clip), 7)), random_mask(noise, 4)[2]

    monkeypatch.setattr(figures, "_predict", perfect)
    config = replace(CONFIG, objective=replace(CONFIG.objective, norm_pix_loss=True))
    grid = cells(reconstruction_panels(PARAMS, CLIP, SENSOR, net=NET, config=config)).astype(int)
    assert np.abs(grid[:, 6:9] - CLIP[:, :3].astype(int)).max() <= 1
    assert np.abs(grid[:, 10] - CLIP[:, 3].astype(int)).max() <= 1


def test_a_figure_is_written_whole_or_not_at_all(tmp_path, monkeypatch):
    path = tmp_path / "figures" / "a.png"
    write_png(path, CLIP[0, 0])
    np.testing.assert_array_equal(cv2.imread(str(path))[..., ::-1], CLIP[0, 0])
    before = path.read_bytes()

    def full(self, data):
        with open(self, "wb") as file:
            file.write(data[:10])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", full)
    with pytest.raises(OSError, match=r"No space left .*a\.png"):
        write_png(path, CLIP[0, 1])
    assert path.read_bytes() == before and [p.name for p in path.parent.iterdir()] == ["a.png"]
