"""Frames of one recording are alike. What a probe says is of recordings, and of none that it saw.

Here the length, the weight and the label of recordings go with what is measured. Where they vary
independently of it, an error of weighting or a leak cannot be seen.
"""

import numpy as np
import pytest

from anytouch_jax.evaluate import heads, probing, saved_heads, task_scores
from anytouch_jax.evaluate.feature_cache import FeatureSource, FeatureStore
from anytouch_jax.evaluate.heads import ProbeHead
from anytouch_jax.evaluate.splits import RowRoles
from anytouch_jax.evaluate.task_plans import TaskPlan
from anytouch_jax.evaluate.tasks import Task, TaskRows

WIDTH = 6


def repeated(times, *columns):
    return [np.repeat(column, times, axis=0) for column in columns]


@pytest.mark.parametrize(("regression", "left_out"), [(False, False), (True, False), (False, True)])
def test_more_frames_of_the_same_recordings_make_no_interval_narrower(regression, left_out):
    rng = np.random.default_rng(0)
    count, frames = 80, 16
    x = rng.standard_normal((count, WIDTH)).astype(np.float32)
    value = x[:, 0] + 0.8 * rng.standard_normal(count)
    labels = value if regression else np.where(value > 0, "soft", "hard")
    groups = np.array([f"recording {number}" for number in range(count)])
    split = np.where(np.arange(count) % 2, "train", "test")

    def interval(x, labels, groups, split):
        if left_out:
            found = probing.leave_groups_out(x, labels, groups, penalties=(0.1,))
        else:
            options = {"regression": regression, "seeds": 0}
            head = ProbeHead(options=(0.1,))
            found = probing.probe_features(x, labels, groups, split, head, **options)
        return np.array([found.low, found.r2 if regression else found.accuracy, found.high])

    once = interval(x, labels, groups, split)
    often = interval(*repeated(frames, x, labels, groups, split))
    assert once[2] - once[0] > 0.1
    np.testing.assert_allclose(often, once, atol=0.02)


def test_the_components_of_pixels_are_those_of_rows_that_are_not_tested():
    """Else the control would know the images of the test, and the encoder would not."""
    rng = np.random.default_rng(0)
    count = 48
    groups = np.array([f"thing {number // 4}" for number in range(count)])
    tested = np.arange(count) // 4 % 3 == 0
    y = np.arange(count) // 4 % 2
    split = np.where(tested, "test", "train")
    same = np.full(count, "digit")
    rows = TaskRows(np.arange(count)[:, None], y.astype(str), groups, split, same, same, ())
    everything = np.ones(count, bool)
    roles = RowRoles(y, groups, tested, everything, everything)
    task = Task("shape", "label.shape")
    plan = TaskPlan(task, rows, roles, np.array(["0", "1"]), 1, [])
    pixels = rng.standard_normal((count, 200)).astype(np.float32)
    others = np.where(tested[:, None], 50 * rng.standard_normal((count, 200)), pixels)
    seen = []
    for values in (pixels, others.astype(np.float32)):
        store = FeatureStore(lambda ids, frames, values=values: values[ids])
        source = FeatureSource("raw pixels", store, None, "common")
        seen.append(task_scores._labelled(source, plan).x)
    np.testing.assert_allclose(seen[0][~tested], seen[1][~tested], atol=1e-4)
    assert np.abs(seen[0][tested] - seen[1][tested]).max() > 1


def drawn(rng, recordings, frames=6, width=100):
    """Return frames whose class only their recording tells: features, names and recordings."""
    own = rng.standard_normal((recordings, width))
    recording = np.repeat(np.arange(recordings), frames)
    noise = 0.05 * rng.standard_normal((len(recording), width))
    names = rng.permutation(np.array(["cup", "key"] * (recordings // 2)))
    return (own[recording] + noise).astype(np.float32), names[recording], recording.astype(str)


def test_a_head_that_knows_only_its_recordings_is_calibrated_as_one_that_guesses():
    """It names all frames of train rightly, so others must calibrate it."""
    rng = np.random.default_rng(0)
    x, names, recording = drawn(rng, 60)
    same = np.full(len(x), "digit")
    train = np.full(len(x), "train")
    rows = TaskRows(np.arange(len(x))[:, None], names, recording, train, same, same, ())
    classes, numbers = np.unique(names, return_inverse=True)
    (model,) = heads.linear_path(x, numbers, (0.001,))
    about = {"label": "object", "pooling": "class", "frames": 1, "fingerprint": "f"}
    head = heads.linear_head(model, classes, **about)
    assert (head(x)[0] == names).mean() > 0.95
    head = saved_heads.calibrated(head, x, rows, 0.001, lambda _: None)
    known = head.calibration
    assert known.recordings == 60 and known.temperature > 2
    x, names, _ = drawn(rng, 200)
    seen = head.assess(x)
    inside = seen.in_set[np.arange(len(x)), np.searchsorted(classes, names)]
    assert inside.mean() > 0.85, "the set of a new recording holds its class as often as promised"


def test_a_row_that_counts_nine_times_moves_mean_and_scale_as_nine_rows():
    """The rows with the largest features count most, so a mean without weights is far off."""
    rng = np.random.default_rng(0)
    x = rng.standard_normal((300, WIDTH)).astype(np.float32)
    times = np.where(x[:, 0] > 0.5, 9, 1)
    y = (x[:, 0] + rng.standard_normal(300) > 0.5).astype(int)
    for scaling in ("column", "common"):
        weights = times.astype(np.float32)
        (counted,) = heads.linear_path(x, y, (0.1,), scaling=scaling, weights=weights)
        (given,) = heads.linear_path(*repeated(times, x, y), (0.1,), scaling=scaling)
        np.testing.assert_allclose(counted.mean, given.mean, atol=1e-5)
        np.testing.assert_allclose(counted.scale, given.scale, rtol=1e-4)
        np.testing.assert_allclose(counted.fit.weights, given.fit.weights, atol=5e-3)
