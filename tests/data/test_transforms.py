import colorsys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from anytouch_jax.config import DataConfig
from anytouch_jax.data import transforms as t

PLAIN = DataConfig(flip=0.0, jitter=(0.0, 0.0, 0.0, 0.0))
RNG = np.random.default_rng(0)
CLIP = RNG.integers(0, 256, (3, 24, 32, 3), np.uint8)


def _rng(*key):
    return np.random.default_rng(key or 0)


def test_the_whole_image_is_resized_without_a_crop():
    frame = np.zeros((1, 40, 80, 3), np.uint8)
    # the upper left quarter stays the upper left quarter
    frame[0, :20, :40] = 200
    out = t.touch_transform(frame, 20, _rng(), PLAIN)
    assert out.shape == (1, 20, 20, 3) and out.dtype == np.uint8
    assert (out[0, :10, :10] == 200).all() and not out[0, 10:].any() and not out[0, :, 10:].any()
    np.testing.assert_array_equal(out, t.touch_evaluation(frame, 20))


def test_shrinking_averages_and_does_not_alias():
    board = np.indices((64, 64)).sum(0) % 2 * 255
    frame = np.stack([board] * 3, -1).astype(np.uint8)
    assert np.abs(t.touch_evaluation([frame], 16).astype(int) - 127).max() <= 1
    assert np.abs(t.vision_evaluation(frame, 16).astype(int) - 127).max() <= 12


def test_a_frame_is_smooth_where_it_is_enlarged_on_one_side_alone():
    ramp = np.repeat(16 * np.arange(8, dtype=np.uint8), 64 * 3).reshape(8, 64, 3)
    out = t.touch_evaluation([ramp], 16)[0].astype(int)
    assert (np.diff(out[1:-1], axis=0) == 8).all()  # no steps of two rows
    turned = t.touch_evaluation([ramp.transpose(1, 0, 2).copy()], 16)[0].astype(int)
    assert (np.diff(turned[:, 1:-1], axis=1) == 8).all()


def test_flips_are_exact_mirrors_in_all_four_forms():
    plain = t.touch_evaluation(CLIP, 16)
    forms = {0: plain, 1: plain[:, :, ::-1], 2: plain[:, ::-1], 3: plain[:, ::-1, ::-1]}
    collected = set()
    for key in range(40):
        out = t.touch_transform(CLIP, 16, _rng(key), replace(PLAIN, flip=0.5))
        match = [name for name, form in forms.items() if np.array_equal(out, form)]
        assert len(match) == 1
        collected.add(match[0])
    assert collected == {0, 1, 2, 3}
    both = t.touch_transform(CLIP, 16, _rng(), replace(PLAIN, flip=1.0))
    np.testing.assert_array_equal(both, forms[3])


def _blob(affine, key):
    """Area of a disc after a map, and its place from the middle, as fractions of the image."""
    disc = cv2.circle(np.zeros((64, 64, 3), np.uint8), (32, 32), 10, (255, 255, 255), -1)
    out = t.touch_transform([disc], 64, _rng(key), replace(PLAIN, affine=affine))[0, ..., 0] / 255
    rows, columns = np.indices(out.shape)
    return out.mean(), np.array([(columns * out).sum(), (rows * out).sum()]) / out.sum() / 64 - 0.5


def test_an_affine_map_turns_grows_and_moves_within_its_bounds():
    area, middle = _blob((0.0, 0.0, 0.0), 0)
    moved = []
    grown = []
    for key in range(40):
        same, here = _blob((180.0, 0.0, 0.0), key)
        # a disc looks alike from all sides
        assert abs(same / area - 1) < 0.02 and np.abs(here - middle).max() < 0.02
        same, here = _blob((0.0, 0.2, 0.0), key)
        assert abs(same / area - 1) < 0.02
        moved.append(here - middle)
        grown.append(_blob((0.0, 0.0, 0.5), key)[0] / area)
    moved = np.array(moved)
    grown = np.array(grown)
    # in both directions, both ways
    assert 0.15 < np.abs(moved).max() <= 0.201 and np.abs(moved.mean(0)).max() < 0.06
    assert 1.5**-2 * 0.97 < grown.min() < 0.6 and 1.7 < grown.max() < 1.5**2 * 1.03


def test_a_turn_is_a_turn_and_edges_are_mirrored():
    line = np.zeros((65, 65, 3), np.uint8)
    line[32] = 255
    angles = set()
    for key in range(6):
        out = t.touch_transform([line], 65, _rng(key), replace(PLAIN, affine=(90.0, 0.0, 0.0)))[
            0, ..., 0
        ]
        rows, columns = np.nonzero(out[12:-12, 12:-12] > 127)
        angles.add(
            round(float(np.degrees(np.linalg.eigh(np.cov(columns, rows))[1][:, 1] @ [0, 1])))
        )
    assert len(angles) >= 5
    flat = np.full((1, 24, 24, 3), 90, np.uint8)
    np.testing.assert_array_equal(
        t.touch_transform(flat, 24, _rng(), replace(PLAIN, affine=(30.0, 0.3, 0.3))), flat
    )


def _slow_jitter(frame, factors, order):
    """torchvision's ColorJitter on floats, pixel by pixel."""
    grey = np.array([0.2989, 0.587, 0.114])
    x = frame.astype(np.float64) / 255
    for operation in order:
        f = factors[operation]
        if operation == 0:
            x = x * f
        elif operation == 1:
            x = f * x + (1 - f) * (x @ grey).mean()
        elif operation == 2:
            x = f * x + (1 - f) * (x @ grey)[..., None]
        else:
            turned = []
            for pixel in x.reshape(-1, 3):
                h, s, v = colorsys.rgb_to_hsv(*pixel)
                turned.append(colorsys.hsv_to_rgb((h + f) % 1, s, v))
            x = np.array(turned).reshape(x.shape)
        x = np.clip(x, 0, 1)
    return x * 255


@pytest.mark.parametrize("key", range(12))
def test_jitter_is_torchvisions_within_half_a_level(key):
    jitter = (0.4, 0.4, 0.5, 0.3)
    frame = RNG.integers(0, 256, (10, 10, 3), np.uint8)
    frame[:3] = frame[:3, :, :1]  # grey pixels have no hue
    rng = _rng(key)
    draw = rng.random(4)
    order = rng.permutation(4)
    low = np.array([0.6, 0.6, 0.5, -0.3])
    high = np.array([1.4, 1.4, 1.5, 0.3])
    want = _slow_jitter(frame, low + (high - low) * draw, order)
    got = t.colour_jitter(frame[None], _rng(key), jitter)[0]
    assert np.abs(got - want).max() <= 0.51


def test_all_frames_of_a_clip_fraction_one_draw():
    same = np.stack([CLIP[0]] * 4)
    out = t.touch_transform(same, 16, _rng(5), DataConfig())
    for frame in out[1:]:
        np.testing.assert_array_equal(frame, out[0])
    lock = t.touch_transform(CLIP[:1], 16, _rng(5), DataConfig())
    together = t.touch_transform(CLIP, 16, _rng(5), DataConfig())
    np.testing.assert_array_equal(lock[0], together[0])
    assert not np.array_equal(out, t.touch_transform(same, 16, _rng(6), DataConfig()))


def test_augmentation_is_a_function_of_seed_epoch_and_row():
    def draw(*key):
        return t.touch_transform(CLIP, 16, t.augmentation_rng(*key), DataConfig())

    base = draw(1, 2, 3)
    np.testing.assert_array_equal(base, draw(1, 2, 3))
    for other in ((0, 2, 3), (1, 0, 3), (1, 2, 0), (3, 2, 1), (1, 2, 3, t.VISION)):
        assert not np.array_equal(base, draw(*other)), other
    draw(-1, 0, 0)  # a negative seed is a seed


@pytest.mark.parametrize("shape", [(30, 50), (50, 30), (20, 20), (9, 14), (400, 300), (401, 30)])
def test_vision_keeps_a_flat_image_flat_at_any_size(shape):
    out = t.vision_evaluation(np.full((*shape, 3), (10, 130, 250), np.uint8), 20)
    assert out.shape == (20, 20, 3) and out.dtype == np.uint8
    np.testing.assert_array_equal(out, np.broadcast_to(np.array([10, 130, 250]), out.shape))


@pytest.mark.parametrize(("excess", "start"), [(3, 2), (5, 2), (7, 4)])
def test_an_odd_excess_is_cropped_as_clip_crops_it(excess, start):
    """torchvision's CenterCrop, round((n - size) / 2): a half goes to the even number."""
    image = RNG.integers(0, 256, (20, 20 + excess, 3), np.uint8)
    np.testing.assert_array_equal(t.vision_evaluation(image, 20), image[:, start : start + 20])
    upright = image.transpose(1, 0, 2).copy()
    np.testing.assert_array_equal(t.vision_evaluation(upright, 20), upright[start : start + 20])


def test_vision_resize_is_bicubic():
    # Twice as large: OpenCV's kernel differs (a = -0.75), so the weights are written out: a = -0.5
    # at +-1/4, +-3/4 ...
    ramp = np.zeros((8, 8, 3), np.uint8)
    ramp[:, 4] = 128
    out = t.vision_evaluation(ramp, 16)[8, :, 0].astype(float)

    def kernel(x):
        x = abs(x)
        if x < 1:
            return 1.5 * x**3 - 2.5 * x**2 + 1
        if x < 2:
            return -0.5 * x**3 + 2.5 * x**2 - 4 * x + 2
        return 0.0

    want = [128 * kernel((i + 0.5) / 2 - 4.5) for i in range(16)]
    assert np.abs(out - np.clip(want, 0, 255)).max() <= 0.51
    gradient = np.tile(np.arange(0, 240, 4, dtype=np.uint8)[None, :, None], (60, 1, 3))
    line = t.vision_evaluation(gradient, 20)[10, 3:-3, 0].astype(float)
    # a straight line stays straight
    assert np.abs(np.diff(line) - 12).max() <= 1


def test_vision_flip_is_an_exact_mirror_and_rotation_turns():
    image = RNG.integers(0, 256, (20, 20, 3), np.uint8)
    mirrored = t.vision_transform(image, 20, _rng(), rotation=0.0, flip=1.0)
    np.testing.assert_array_equal(mirrored, t.vision_evaluation(image[:, ::-1], 20))
    np.testing.assert_array_equal(t.vision_transform(image, 20, _rng(), 0.0, 0.0), image)
    bar = np.zeros((101, 101, 3), np.uint8)
    bar[48:53] = 255
    angles = []
    for key in range(60):
        out = t.vision_transform(bar, 101, _rng(key), rotation=20.0)
        y, x = np.nonzero(out[..., 0] > 127)
        angles.append(np.degrees(np.arctan(np.polyfit(x, y, 1)[0])))
        assert out[50, 50, 0] == 255  # about the centre
    assert 15 < max(angles) < 20.5 and -20.5 < min(angles) < -15


def test_a_frame_is_turned_clockwise_then_mirrored():
    frame = np.arange(6, dtype=np.uint8).reshape(2, 3, 1)  # 0 1 2 / 3 4 5
    wanted = {
        (0, "none"): [[0, 1, 2], [3, 4, 5]],
        (90, "none"): [[3, 0], [4, 1], [5, 2]],
        (180, "none"): [[5, 4, 3], [2, 1, 0]],
        (270, "none"): [[2, 5], [1, 4], [0, 3]],
        (0, "across"): [[2, 1, 0], [5, 4, 3]],
        (90, "down"): [[5, 2], [4, 1], [3, 0]],
    }
    for (rotate, flip), pixels in wanted.items():
        assert t.orient_frame(frame, rotate, flip)[..., 0].tolist() == pixels
