import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.config import DataConfig, preset
from anytouch_jax.config.augmentation import TouchAugmentation
from anytouch_jax.data.transforms import touch_transform
from anytouch_jax.sim.preparation import _warped, augmented

TINY = preset("tiny").with_settings({"data.jitter": (0.0,) * 4})


def test_augmentation_moves_all_frames_alike():
    clip = np.zeros((3, 2, 20, 20, 3), np.uint8)
    clip[:, :, 4:9, 11:15] = 200
    config = TINY.with_settings({"data.affine": (20.0, 0.1, 0.2), "data.flip": 0.5})
    moved = np.asarray(augmented(jax.random.key(2), clip, config))
    np.testing.assert_array_equal(moved[:, 0], moved[:, 1])
    assert np.abs(moved[0].astype(int) - clip[0]).max() > 0 and moved.max() > 150


class FixedDraws:
    """A generator whose next draws are given."""

    def __init__(self, tosses, draws):
        self.tosses = tosses
        self.draws = draws

    def random(self, count):
        return np.array(self.tosses[:count])

    def uniform(self, low, high, count):
        assert (low, high, count) == (-1, 1, len(self.draws))
        return np.array(self.draws)


@pytest.mark.parametrize(
    ("tosses", "turn", "zoom", "across", "down"),
    [
        ((0.9, 0.9), 0.0, 0.0, 0.0, 0.0),
        ((0.1, 0.9), 0.0, 0.0, 0.6, 0.0),
        ((0.9, 0.1), 0.7, 0.0, 0.0, 0.0),
        ((0.9, 0.9), 0.0, -0.8, 0.0, -0.5),
        ((0.1, 0.1), -0.9, 0.6, -0.7, 0.4),
    ],
)
def test_numpy_and_jax_augment_alike(tosses, turn, zoom, across, down):
    """The same draws give the same image, to the rounding of OpenCV's fixed point."""
    # Turns are drawn to both sides alike, and the two forms count them in opposite directions.
    config = DataConfig(flip=0.5, affine=(30.0, 0.2, 0.5), jitter=(0.0,) * 4)
    size = 40
    row, column = np.mgrid[:size, :size] / size
    waves = [np.sin(5 * row + 3 * column), np.cos(7 * column - 2 * row), row * column]
    image = np.stack([120 + 100 * wave for wave in waves], -1).astype(np.uint8)
    host = touch_transform(
        image[None], size, FixedDraws(tosses, (turn, zoom, across, down)), config
    )
    flipped = image[:, :: -1 if tosses[0] < 0.5 else 1][:: -1 if tosses[1] < 0.5 else 1]
    draws = jnp.array([-turn, zoom, down, across, 0.0], jnp.float32)
    device = _warped(flipped[None], draws, TouchAugmentation.of(config))
    apart = np.abs(host.astype(int) - np.asarray(device, int))
    assert apart.max() <= 4 and apart.mean() < 0.5


def test_a_run_flips_on_the_device_as_often_as_in_the_loader():
    clip = np.zeros((400, 1, 8, 8, 3), np.uint8)
    clip[:, :, :2, :3] = 200
    for flip in (0.0, 0.3, 1.0):
        moved = np.asarray(
            augmented(jax.random.key(0), clip, TINY.with_settings({"data.flip": flip}))
        )
        across = (moved[:, 0, :, -1, 0] > 0).any(1).mean()
        down = (moved[:, 0, -1, :, 0] > 0).any(1).mean()
        np.testing.assert_allclose((across, down), flip, atol=0.07)
