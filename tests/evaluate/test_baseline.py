"""Raw pixels: area averages, the difference from the background, principal components of train."""

from __future__ import annotations

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import baseline
from anytouch_jax.evaluate.baseline import reduce

HALF = 24 * 32 * 3


def pictures(count: int, height: int = 48, width: int = 64, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, height, width, 3), np.uint8)


def raw_pixels(frames: np.ndarray, backgrounds: np.ndarray) -> np.ndarray:
    return np.stack([baseline.raw_pixels(*one) for one in zip(frames, backgrounds, strict=True)])


def test_pixels_are_block_means_in_colour() -> None:
    frames, backgrounds = pictures(3), pictures(3, seed=1)
    features = raw_pixels(frames, backgrounds)
    assert features.shape == (3, 2 * 24 * 32 * 3)
    seen, behind = (
        (one / 255).reshape(3, 24, 2, 32, 2, 3).mean((2, 4)).reshape(3, -1) for one in (frames, backgrounds)
    )
    np.testing.assert_allclose(features[:, :HALF], seen, atol=1e-6)
    np.testing.assert_allclose(features[:, HALF:], seen - behind, atol=1e-6)
    turned = raw_pixels(frames[..., ::-1], backgrounds)
    assert np.abs(turned[:, :HALF] - features[:, :HALF]).mean() > 0.05, "a colour tells a slope: it is not lost"


@pytest.mark.parametrize("shape", [(320, 240), (50, 77), (30, 33)])
def test_any_size_is_averaged_by_area(shape: tuple[int, int]) -> None:
    frame = pictures(1, *shape)
    fine = np.repeat(np.repeat(frame[0] / 255, 24, 0), 32, 1)  # 24 x 32 whole blocks, whatever the shape
    expected = fine.reshape(24, shape[0], 32, shape[1], 3).mean((1, 3))
    np.testing.assert_allclose(raw_pixels(frame, frame)[0, :HALF], expected.ravel(), atol=1e-5)


def test_a_frame_like_its_background_has_no_difference() -> None:
    frames = pictures(4)
    assert not raw_pixels(frames, frames)[:, HALF:].any()
    assert raw_pixels(frames, pictures(4, seed=2))[:, HALF:].any(axis=1).all()
    assert not baseline.raw_pixels(frames[0], None)[HALF:].any()


def test_components_are_those_of_train() -> None:
    rng = np.random.default_rng(0)
    features = rng.normal(size=(60, 10)) * np.array([9, 5, *[0.1] * 8])
    train = np.arange(60) < 40
    kept = reduce(features, train, 2)
    np.testing.assert_allclose(np.abs(np.corrcoef(kept[:, 0], features[:, 0])[0, 1]), 1, atol=0.02)
    assert np.abs(kept[train].mean(0)).max() < 1e-5
    wild = features.copy()
    wild[~train] *= 100
    np.testing.assert_allclose(reduce(wild, train, 2)[train], kept[train], atol=1e-5)


def test_few_rows_give_few_components() -> None:
    frames = pictures(12)
    assert reduce(raw_pixels(frames, pictures(12, seed=1)), np.arange(12) < 9).shape == (12, 9)


def test_mistakes() -> None:
    with pytest.raises(UserError, match=r"background \(50, 64, 3\) must be of one shape"):
        baseline.raw_pixels(pictures(1)[0], pictures(1, 50)[0])
    with pytest.raises(UserError, match="no row is marked as train"):
        reduce(np.ones((3, 2)), np.zeros(3, bool))
