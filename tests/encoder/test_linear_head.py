"""What a calibrated head promises holds for recordings, not for frames, and to the exact rank."""

from fractions import Fraction
from math import ceil, inf

import numpy as np
import pytest

from anytouch_jax.encoder import linear_head
from anytouch_jax.encoder.linear_head import LinearHead

RECORDINGS = 300
FRACTION = 0.9


def recordings_of_unequal_length(rng):
    """Return frames of recordings: scores, and the recording of each.

    The harder a recording is, the shorter it is. Otherwise frames and recordings would agree.
    """
    difficulty = rng.uniform(0, 1, RECORDINGS)
    length = np.where(difficulty < 0.6, 40, 2)
    recording = np.repeat(np.arange(RECORDINGS), length)
    noise = 0.02 * rng.standard_normal(len(recording))
    return difficulty[recording] + noise, recording


def test_a_limit_covers_new_recordings_when_the_hard_ones_are_short():
    rng = np.random.default_rng(0)
    covered = []
    for _ in range(20):
        limit = linear_head.conformal_limit(*recordings_of_unequal_length(rng), FRACTION)
        scores, recording = recordings_of_unequal_length(rng)
        inside = np.bincount(recording, scores <= limit) / np.bincount(recording)
        covered.append(inside.mean())
    assert abs(np.mean(covered) - FRACTION) < 0.02, np.mean(covered)


@pytest.mark.parametrize(
    "level", [Fraction(1, 2), Fraction(4, 5), Fraction(9, 10), Fraction(19, 20)]
)
def test_the_limit_of_recordings_of_one_frame_has_its_exact_rank(level):
    """The smallest score that a new one exceeds with probability 1 - level at most (Vovk 2005)."""
    for count in range(9, 102):
        scores = np.random.default_rng(count).permutation(count) + 0.5
        rank = ceil((count + 1) * level)
        wanted = np.sort(scores)[rank - 1] if rank <= count else inf
        found = linear_head.conformal_limit(scores, np.arange(count), float(level))
        assert found == wanted, (count, found, wanted)


def calibration_of(times, rng):
    """Return the calibration by held-out recordings, whose one frame is given so many `times`."""
    count, width = len(times), 3
    fit, held_out = np.arange(count), np.arange(count, 2 * count)
    repeated = np.repeat(held_out, times)
    recording = np.concatenate([fit, repeated])
    val = np.arange(count, len(recording))
    features = rng.standard_normal((2 * count, width)).astype(np.float32)
    logits = 2 * (recording[:, None] % 2) - 1 + 2 * rng.standard_normal((2 * count, 1))[recording]
    classes = np.array(["a", "b"])
    sensors = np.full(len(recording), "digit")
    zeros, ones = np.zeros(width, np.float32), np.ones(width, np.float32)
    weights, bias = np.ones((width, 1), np.float32), np.zeros(1, np.float32)
    head = LinearHead(classes, weights, bias, zeros, ones, "shape", "class", 1, "f")
    truth = classes[repeated % 2]
    frames = features[recording]
    known = head.calibrated(
        logits[val], truth, repeated, frames, recording, sensors, fit, val
    ).calibration
    assert known is not None
    return known


def test_frames_of_one_recording_count_once_in_every_limit():
    """A recording whose frames are given a hundred times over changes nothing."""
    once = calibration_of(np.ones(120, int), np.random.default_rng(1))
    times = np.where(np.arange(120) % 10 == 0, 100, 1)
    often = calibration_of(times, np.random.default_rng(1))
    assert often.recordings == once.recordings == 120
    assert 0.1 < once.set_limit < 1 and 0 < once.novelty_limit < inf
    for name in ("temperature", "set_limit", "novelty_limit"):
        assert getattr(often, name) == pytest.approx(getattr(once, name), rel=1e-3), name


def test_a_recording_that_is_also_fitted_on_is_as_novel_as_a_new_one():
    """Its own frames are no references for it. They are near, and new touches would seem novel."""
    rng = np.random.default_rng(2)
    count, frames, width = 120, 6, 4
    own = rng.standard_normal((2 * count, 1, width))
    near = own + 0.01 * rng.standard_normal((2 * count, frames, width))
    features = near.reshape(-1, width).astype(np.float32)
    recording = np.repeat(np.arange(2 * count), frames)
    fit = np.flatnonzero((recording < count) & (np.arange(len(recording)) % frames > 0))
    known = np.arange(count) * frames  # frames of recordings that are fitted on, and of others
    new = known + count * frames
    classes = np.array(["a", "b"])
    zeros, ones = np.zeros(width, np.float32), np.ones(width, np.float32)
    weights, bias = np.ones((width, 1), np.float32), np.zeros(1, np.float32)
    head = LinearHead(classes, weights, bias, zeros, ones, "shape", "class", 1, "f")
    sensors = np.full(len(recording), "digit")
    limits = []
    for val in (known, new):
        logits, truth = rng.standard_normal((count, 1)), classes[val % 2]
        fitted = head.calibrated(
            logits, truth, recording[val], features, recording, sensors, fit, val
        )
        limits.append(fitted.calibration.novelty_limit)
    assert limits[0] == pytest.approx(limits[1], rel=0.3) and limits[1] > 0.5, limits
