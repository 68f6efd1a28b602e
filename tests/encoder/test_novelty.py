from types import SimpleNamespace

import numpy as np
import pytest
from threadpoolctl import ThreadpoolController

from anytouch_jax.encoder import calibration, linear_head
from anytouch_jax.encoder import calibration as novelty
from anytouch_jax.encoder.linear_head import ContactGate
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import heads, splits
from experiments.real.trust import calibration_error

CLASSES = 4
WIDTH = 8


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


def calibrated(x, y, groups, sensors, fraction=0.8, **options):
    fit, val = (
        np.flatnonzero((groups < fraction * groups.max()) == is_fit) for is_fit in (True, False)
    )
    names, numbers = np.unique(y, return_inverse=True)
    (model,) = heads.linear_path(x[fit], numbers[fit], (0.01,))
    head = heads.linear_head(
        model, names, label="shape", pooling="class", frames=1, fingerprint="f"
    )
    folds = splits.group_folds(fit, groups, numbers, 4)
    return heads.calibrate_head(head, x, y, groups, sensors, fit, val, folds, 0.01, **options)


@pytest.mark.parametrize(("alike", "count", "above"), [(1.0, 30, 1 / 31), (0.0, 12, 0.0)])
def test_a_limit_covers_new_groups_as_often_as_asked(alike, count, above):
    """Few groups are covered no more often than asked if their rows differ."""
    rng = np.random.default_rng(0)
    inside = []
    # of different sizes
    groups = np.repeat(np.arange(count), rng.integers(1, 9, count))
    for _ in range(600):
        scores = alike * rng.standard_normal(count)[groups] + 0.2 * rng.standard_normal(len(groups))
        new = alike * rng.standard_normal(1) + 0.2 * rng.standard_normal(20)
        inside.append(np.mean(new <= novelty.conformal_limit(scores, groups, 0.9)))
    assert 0.9 - 0.03 < np.mean(inside) < 0.9 + above + 0.03


@pytest.mark.parametrize(("groups", "is_finite"), [(8, False), (9, True)])
def test_too_few_recordings_promise_nothing(groups, is_finite):
    limit = novelty.conformal_limit(np.arange(groups, dtype=float), np.arange(groups), 0.9)
    assert np.isfinite(limit) == is_finite
    for fraction in (0.0, 1.0, np.nan, None):
        with pytest.raises(UserError, match="between 0 and 1"):
            novelty.conformal_limit(np.zeros(groups), np.arange(groups), fraction)
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
    rng = np.random.default_rng(9)
    alarms = []
    for _ in range(4):
        group = np.repeat(np.arange(160), 4)
        x = (rng.standard_normal((160, 20))[group] + 0.3 * rng.standard_normal((640, 20))).astype(
            np.float32
        )
        y = np.array(list("abcd"))[group % 4]
        known = group < 80
        head = calibrated(
            x[known], y[known], group[known], np.full(known.sum(), "digit"), false_alarms=0.06
        )
        alarms.append(head.assess(x[~known]).novel.mean())
    assert 0.001 < np.mean(alarms) < 0.08, alarms


def test_a_sensor_that_was_not_named_is_reported():
    rng = np.random.default_rng(4)
    head = calibrated(*touches(rng, 160, sensor_shift=5.0))
    x, _, _, sensors = touches(rng, 80, sensor_shift=5.0)
    x = head.scaled(x)
    known = head.calibration
    for name in ("digit", "gelsight"):
        assert known.sensor_warning(x[sensors == name], name) == ""
        assert f"not {name}" in known.sensor_warning(x[sensors != name], name)
        # too few frames to say
        assert known.sensor_warning(x[sensors != name][:3], name) == ""
    assert "not on duragel" in known.sensor_warning(x, "duragel")
    far = x[sensors == "digit"][:9] - 8  # away from both, nearer to digit
    assert "unlike every touch of digit" in known.sensor_warning(far, "digit")


def test_a_saved_head_keeps_its_calibration(tmp_path):
    head = calibrated(*touches(np.random.default_rng(6), 60))
    linear_head.save_head(tmp_path / "h.npz", head)
    again = linear_head.load_head(tmp_path / "h.npz")
    x = touches(np.random.default_rng(7), 20)[0]
    for one, two in zip(head.assess(x), again.assess(x), strict=True):
        np.testing.assert_array_equal(one, two)
    assert (again.calibration.sensors == head.calibration.sensors).all()


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


@pytest.mark.parametrize("level", [0.5, 0.8, 0.9, 0.95])
def test_the_limit_has_the_rank_of_split_conformal_prediction(level):
    """With one row a group it is the score of rank ceil((n + 1) * level), or infinite beyond n."""
    rng = np.random.default_rng(0)
    for count in range(9, 102):
        scores = rng.permutation(count).astype(float)
        rank = int(np.ceil((count + 1) * level - 1e-9))
        wanted = np.inf if rank > count else float(rank - 1)
        assert novelty.conformal_limit(scores, np.arange(count), level) == wanted, count


def test_frames_of_one_recording_count_once():
    """Long recordings are the easy ones here: weights of frames would promise too much."""
    rng = np.random.default_rng(0)
    inside = []
    for _ in range(200):
        is_hard = rng.random(60) < 0.3
        lengths = np.where(is_hard, 2, 80)
        groups = np.repeat(np.arange(60), lengths)
        scores = np.where(is_hard, 1.0, 0.0)[groups] + 0.1 * rng.random(len(groups))
        new_is_hard = rng.random(40) < 0.3
        new = np.where(new_is_hard, 1.0, 0.0) + 0.1 * rng.random(40)
        inside.append(np.mean(new <= novelty.conformal_limit(scores, groups, 0.9)))
    assert 0.87 < np.mean(inside) < 0.95
    weights = novelty.group_weights(np.array(["a", "b", "b", "b", "b"]))
    np.testing.assert_allclose(weights, [0.5, 0.125, 0.125, 0.125, 0.125])


def test_the_temperature_is_that_of_recordings_not_of_frames():
    """One recording of 4,000 confident frames, and 200 of one frame whose logits are too large."""
    rng = np.random.default_rng(0)
    logits = np.concatenate([rng.standard_normal((200, 3)), np.full((4000, 3), [9.0, 0, 0])])
    p = novelty.probabilities(logits[:200])
    drawn = (p.cumsum(1) < rng.random(200)[:, None]).sum(1)
    y = np.concatenate([drawn, np.zeros(4000, int)])
    logits[:200] *= 4
    groups = np.concatenate([np.arange(200), np.full(4000, 200)])
    assert novelty.fit_temperature(logits, y, groups) == pytest.approx(4, rel=0.35)


def test_sets_of_a_head_hold_the_class_of_new_recordings_of_any_length():
    rng = np.random.default_rng(3)
    covered = []
    alarms = []
    for _ in range(6):
        groups, parts = 200, []
        for group in range(groups):
            is_hard = rng.random() < 0.35
            rows = 1 if is_hard else 20
            x = rng.standard_normal(WIDTH) * (2.5 if is_hard else 0.3)
            x = x + 2 * np.eye(WIDTH)[group % CLASSES]
            parts.append((x + 0.05 * rng.standard_normal((rows, WIDTH)), group, rows))
        x = np.concatenate([part for part, _, _ in parts]).astype(np.float32)
        group = np.repeat([number for _, number, _ in parts], [rows for *_, rows in parts])
        y = np.array(list("abcd"))[group % CLASSES]
        known = group < 150
        sensors = np.full(len(y), "digit")
        head = calibrated(x[known], y[known], group[known], sensors[known], fraction=0.4)
        seen = head.assess(x[~known])
        truth = np.searchsorted(head.classes, y[~known])
        inside = seen.in_set[np.arange(len(truth)), truth]
        weights = novelty.group_weights(group[~known])
        covered.append(np.average(inside, weights=weights))
        alarms.append(np.average(seen.novel, weights=weights))
    assert 0.86 < np.mean(covered) < 0.96, covered
    assert 0.01 < np.mean(alarms) < 0.09, alarms


@pytest.mark.parametrize("columns", [1, 5])
def test_confidence_is_not_above_what_the_groups_support(columns):
    """However sure the logits are; a temperature that is modest already stays."""
    rng = np.random.default_rng(2)
    groups = np.repeat(np.arange(7), 10)
    logits = 50 * rng.standard_normal((70, columns))
    found = calibration.modest_temperature(logits, groups, 0.05)
    confidence = linear_head.probabilities(logits, found).max(1).mean()
    assert found > 0.05 and confidence == pytest.approx(8 / 9, abs=1e-6)
    assert calibration.modest_temperature(logits, groups, 2 * found) == 2 * found


def test_whitening_has_one_thread_beside_a_live_page(monkeypatch):
    libraries = ThreadpoolController()
    plain = np.linalg.eigh
    seen = []

    def counted(matrix):
        seen.append({one["num_threads"] for one in libraries.info()})
        return plain(matrix)

    monkeypatch.setattr(np.linalg, "eigh", counted)
    x, _, groups, _ = touches(np.random.default_rng(0), 10)
    with libraries.limit(limits=2):
        novelty.left_out_scores(x, groups)
        after = {one["num_threads"] for one in libraries.info()}
    assert seen == [{1}] * 5 and after == {2}
