"""Calibration: coverage, temperature and false alarms on made touches, and what a head says about strange ones."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from anytouch_jax.encoder import linear_head, novelty
from anytouch_jax.encoder.novelty import Calibration, ContactGate
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import heads, splits
from experiments.real.trust import calibration_error

CLASSES, WIDTH = 4, 8


def touches(rng, groups, rows=6, sensor_shift=0.0):
    """Return features, class names, groups and sensors of recordings, whose rows share a shift."""
    middle = np.random.default_rng(5).standard_normal((CLASSES, WIDTH)) * 1.3
    y = np.repeat(np.arange(groups) % CLASSES, rows)
    group = np.repeat(np.arange(groups), rows)
    x = (
        middle[y]
        + np.repeat(rng.standard_normal((groups, WIDTH)), rows, 0)
        + 0.3 * rng.standard_normal((len(y), WIDTH))
    )
    sensors = np.where(group % 8 < 4, "digit", "gelsight")
    x[sensors == "gelsight"] += sensor_shift
    return x.astype(np.float32), np.array(list("abcd"))[y], group, sensors


def calibrated(x, y, groups, sensors, share=0.8, **options):
    fit, val = (np.flatnonzero((groups < share * groups.max()) == is_fit) for is_fit in (True, False))
    names, numbers = np.unique(y, return_inverse=True)
    (model,) = heads.linear_path(x[fit], numbers[fit], (0.01,))
    head = heads.linear_head(model, names, label="shape", pooling="class", frames=1, fingerprint="f")
    folds = splits.group_folds(fit, groups, numbers, 4)
    return heads.calibrate(head, x, y, groups, sensors, fit, val, folds, 0.01, **options)


@pytest.mark.parametrize(("alike", "count", "above"), [(1.0, 30, 1 / 31), (0.0, 12, 0.0)])
def test_a_limit_covers_new_groups_as_often_as_asked(alike, count, above):
    """Few groups are covered no more often than asked if their rows differ."""
    rng, inside = np.random.default_rng(0), []
    groups = np.repeat(np.arange(count), rng.integers(1, 9, count))  # of different sizes
    for _ in range(600):
        scores = alike * rng.standard_normal(count)[groups] + 0.2 * rng.standard_normal(len(groups))
        new = alike * rng.standard_normal(1) + 0.2 * rng.standard_normal(20)
        inside.append(np.mean(new <= novelty.conformal_limit(scores, groups, 0.9)))
    assert 0.9 - 0.03 < np.mean(inside) < 0.9 + above + 0.03


def test_frames_of_one_recording_count_once():
    scores, groups = np.array([1.0, 2.0, 3.0, 4.0]), np.arange(4)
    many = np.repeat(np.arange(4), (1, 1, 1, 1000))
    assert novelty.conformal_limit(scores[many], groups[many], 0.6) == novelty.conformal_limit(scores, groups, 0.6) == 3


@pytest.mark.parametrize(("groups", "is_finite"), [(8, False), (9, True)])
def test_too_few_recordings_promise_nothing(groups, is_finite):
    limit = novelty.conformal_limit(np.arange(groups, dtype=float), np.arange(groups), 0.9)
    assert np.isfinite(limit) == is_finite
    for share in (0.0, 1.0, np.nan):
        with pytest.raises(UserError, match="between 0 and 1"):
            novelty.conformal_limit(np.zeros(groups), np.arange(groups), share)
    for scores in ([], [np.nan] * groups, [0.5] * (groups - 1)):
        with pytest.raises(UserError, match="without NaN"):
            novelty.conformal_limit(scores, np.arange(len(scores) // groups * groups), 0.9)


@pytest.mark.parametrize("columns", [1, 5])
@pytest.mark.parametrize("factor", [0.3, 4.0])
def test_the_temperature_that_spoiled_logits_is_found(columns, factor):
    rng = np.random.default_rng(1)
    logits = 2 * rng.standard_normal((4000, columns))
    p = novelty.probabilities(logits)
    y = (p.cumsum(1) < rng.random(len(p))[:, None]).sum(1).clip(0, p.shape[1] - 1)
    found = novelty.fit_temperature(factor * logits, y, np.arange(len(y)))
    assert abs(np.log(found / factor)) < 0.15
    right = p.argmax(1) == y
    spoiled = novelty.probabilities(factor * logits)
    error = calibration_error(novelty.probabilities(factor * logits, found).max(1), right)
    assert error < 0.03 < calibration_error(spoiled.max(1), right)


def test_a_head_is_calibrated_on_new_recordings():
    rng = np.random.default_rng(2)
    head = calibrated(*touches(rng, 240), coverage=0.85)
    x, y, *_ = touches(rng, 400)
    seen = head.assess(x)
    inside = seen.in_set[np.arange(len(y)), np.searchsorted(head.classes, y)]
    assert abs(inside.mean() - 0.85) < 0.05
    assert calibration_error(seen.p.max(1), seen.label == y) < 0.05
    assert 0.01 < seen.novel.mean() < 0.1  # 5 % were asked for
    assert (seen.label == y)[~seen.abstains].mean() > (seen.label == y).mean() + 0.02
    assert head.assess(x + 6 * rng.standard_normal(WIDTH)).novel.mean() > 0.9
    assert head.calibration.recordings == 240


def test_few_recordings_of_wide_features_raise_no_more_false_alarms_than_asked():
    """Recordings that the whitening has seen look familiar, so they may not set the limit."""
    rng, alarms = np.random.default_rng(9), []
    for _ in range(4):
        group = np.repeat(np.arange(160), 4)
        x = (rng.standard_normal((160, 20))[group] + 0.3 * rng.standard_normal((640, 20))).astype(np.float32)
        y, known = np.array(list("abcd"))[group % 4], group < 80
        head = calibrated(x[known], y[known], group[known], np.full(known.sum(), "digit"), false_alarms=0.06)
        alarms.append(head.assess(x[~known]).novel.mean())
    assert 0.001 < np.mean(alarms) < 0.08, alarms


def test_a_training_touch_is_not_novel():
    x = np.random.default_rng(3).standard_normal((20, 6)).astype(np.float32)
    references = np.repeat(x, novelty.NEIGHBOURS, 0)
    np.testing.assert_allclose(novelty.novelty_scores(x, references), 0, atol=1e-3)
    np.testing.assert_allclose(novelty.novelty_scores(x[:1] + 3, references[:5]), 3 * np.sqrt(6), rtol=1e-4)
    own = novelty.novelty_scores(x, references, np.arange(20), np.repeat(np.arange(20), novelty.NEIGHBOURS))
    assert own.min() > 0.5
    assert np.isinf(novelty.novelty_scores(x[:1], references[:5], np.zeros(1), np.zeros(5))).all()


def test_whitened_features_have_equal_spread():
    rng = np.random.default_rng(8)
    x = (rng.standard_normal((5000, 4)) * (1, 2, 3, 4)) @ np.linalg.qr(rng.standard_normal((4, 4)))[0]
    np.testing.assert_allclose(np.cov((x @ novelty.fit_whitening(x)).T), np.eye(4), atol=0.2)
    assert np.isfinite(novelty.fit_whitening(np.ones((5, 3)))).all()


def test_references_are_spread_over_recordings():
    groups = np.repeat(np.arange(10), 50)
    chosen = novelty.choose_references(groups, 40)
    assert len(chosen) == 40 and np.bincount(groups[chosen], minlength=10).min() >= 3
    assert novelty.choose_references(groups[:3], 40).tolist() == [0, 1, 2]


def test_a_sensor_that_was_not_named_is_reported():
    rng = np.random.default_rng(4)
    head = calibrated(*touches(rng, 160, sensor_shift=5.0))
    x, _, _, sensors = touches(rng, 80, sensor_shift=5.0)
    x = head.scaled(x)
    known = head.calibration
    for name in ("digit", "gelsight"):
        assert known.sensor_warning(x[sensors == name], name) == ""
        assert f"not {name}" in known.sensor_warning(x[sensors != name], name)
        assert known.sensor_warning(x[sensors != name][:3], name) == ""  # too few frames to say
    assert "not on duragel" in known.sensor_warning(x, "duragel")
    far = x[sensors == "digit"][:9] - 8  # away from both, nearer to digit
    assert "unlike every touch of digit" in known.sensor_warning(far, "digit")


def test_a_saved_head_keeps_its_calibration(tmp_path):
    head = calibrated(*touches(np.random.default_rng(6), 60))
    linear_head.save_head(tmp_path / "h.npz", head)
    again, x = linear_head.load_head(tmp_path / "h.npz"), touches(np.random.default_rng(7), 20)[0]
    for one, two in zip(head.assess(x), again.assess(x), strict=True):
        np.testing.assert_array_equal(one, two)
    assert (again.calibration.sensors == head.calibration.sensors).all()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("temperature", 0.0), ("temperature", "1"), ("novelty_limit", np.nan), ("references", np.zeros((2, 3))),
        ("whitening", np.eye(3)),
        ("references", np.full((1, WIDTH), np.inf)), ("sensors", np.zeros(3)), ("recordings", None),
    ],
)  # fmt: skip
def test_a_damaged_calibration_is_refused(tmp_path, name, value):
    head = calibrated(*touches(np.random.default_rng(6), 60))
    linear_head.save_head(tmp_path / "h.npz", head)
    arrays = dict(np.load(tmp_path / "h.npz"))
    del arrays[f"calibration/{name}"]
    np.savez(tmp_path / "h.npz", **arrays, **({} if value is None else {f"calibration/{name}": value}))
    with pytest.raises(UserError, match=r"h\.npz is not the head"):
        linear_head.load_head(tmp_path / "h.npz")


def test_a_head_without_calibration_says_so():
    head = calibrated(*touches(np.random.default_rng(6), 60))
    bare = linear_head.LinearHead(**{**vars(head), "calibration": None})
    with pytest.raises(UserError, match="no calibration"):
        bare.assess(np.zeros((1, WIDTH)))
    assert Calibration.from_arrays({}, WIDTH) is None


def test_contact_is_a_difference_from_the_untouched_gel():
    gel = np.full((60, 80, 3), 120, np.uint8)
    pressed = gel.copy()
    pressed[20:40, 30:50] += 60
    gate = ContactGate(gel, "digit")
    assert (gate(gel), gate(pressed)) == (0.0, 1.0)
    assert np.isnan(ContactGate(None, "digit")(pressed))
    running = SimpleNamespace(background=None)  # as of a Preprocess
    gate_of = ContactGate(running, "digit")
    assert np.isnan(gate_of(pressed))
    running.background = gel
    assert (gate_of(gel), gate_of(pressed)) == (0.0, 1.0)
    with pytest.raises(UserError, match="--background"):
        gate(np.zeros((80, 60, 3), np.uint8))
