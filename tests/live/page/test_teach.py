"""The accuracy that the page shows of a taught head is on recordings that no fit has seen."""

import threading
import time

import numpy as np
import pytest
from tiny_models import tiny_config

from anytouch_jax.encoder.encoder import random_encoder
from anytouch_jax.encoder.linear_head import load_head
from anytouch_jax.live.page.longer import LongerTraining
from anytouch_jax.live.page.teach import LiveRecorder, Teacher

RECORDINGS = 16
FRAMES = 6
WIDTH = 16
PRESSED = 50.0  # a contact score


@pytest.fixture(scope="module")
def encoder():
    return random_encoder(tiny_config())


def taught(encoder, folder, names, features, sensor="digit"):
    """Return the teacher of recordings of these names, with features (recordings, FRAMES, WIDTH).

    Every recording has images of its own, and its frames differ by noise.
    """
    rng = np.random.default_rng(1)
    recorder = LiveRecorder(folder, sensor)
    for name, several in zip(names, features, strict=True):
        look = rng.integers(40, 200, (6, 8, 3))
        recorder.start(name, np.full((24, 32, 3), 128, np.uint8))
        for values in several:
            image = look.repeat(4, 0).repeat(4, 1) + rng.integers(0, 6, (24, 32, 3))
            recorder.add(image.astype(np.uint8), PRESSED, values.astype(np.float32))
        recorder.stop()
    teacher = Teacher(encoder, recorder, log=lambda _: None)
    teacher.train()
    end = time.monotonic() + 600
    while teacher.about()["training"] and time.monotonic() < end:
        time.sleep(0.02)
    about = teacher.about()
    assert about["trained"] and not about["fault"] and not about["training"], about
    return teacher


def by_recording(rng):
    """Return features that tell recordings apart, and nothing else."""
    own = 3 * rng.standard_normal((RECORDINGS, 1, WIDTH))
    return own + 0.1 * rng.standard_normal((RECORDINGS, FRAMES, WIDTH))


def test_a_label_that_only_the_recording_carries_is_named_by_chance(encoder, tmp_path):
    """Frames of one recording are alike: a fit on some of them would name the others."""
    rng = np.random.default_rng(0)
    names = rng.permutation(["cup", "key"] * (RECORDINGS // 2))
    teacher = taught(encoder, tmp_path / "touches", names, by_recording(rng))
    result = teacher.about()["result"]
    assert result["chance"] == pytest.approx(0.5)
    for name in ("right", "pixels"):
        assert 0.1 < result[name] < 0.75, (name, result)
        width = result[f"{name}_high"] - result[f"{name}_low"]
        assert width > 0.3, "an interval over so many recordings, not over their frames"
    known = teacher.head.calibration
    assert known.recordings == RECORDINGS
    assert known.temperature > 1, "the head is no surer of new recordings than it is right"


def test_a_label_that_touches_carry_is_named_on_new_recordings(encoder, tmp_path):
    rng = np.random.default_rng(0)
    names = np.array(["cup", "key"] * (RECORDINGS // 2))
    features = by_recording(rng)
    features[..., : WIDTH // 2] += 8.0 * (names == "cup")[:, None, None]
    result = taught(encoder, tmp_path / "touches", names, features).about()["result"]
    assert result["right"] > 0.95 and result["pixels"] < 0.75


def test_pages_on_two_sensors_have_a_head_each_in_one_folder(encoder, tmp_path):
    rng = np.random.default_rng(0)
    names = np.array(["cup", "key"] * 3)
    heads = {}
    for sensor in ("digit", "gelsight"):
        features = by_recording(rng)[:6]
        heads[sensor] = taught(encoder, tmp_path / "touches", names, features, sensor).head
    folder = tmp_path / "touches"
    assert (folder / "head.npz").is_file() and (folder / "head_gelsight.npz").is_file()
    for sensor, head in heads.items():
        again = Teacher(encoder, LiveRecorder(folder, sensor), log=lambda _: None)
        np.testing.assert_array_equal(again.head.weights, head.weights)
        file = again.about()["file"]
        np.testing.assert_array_equal(load_head(file).weights, head.weights)


def test_what_was_trained_longer_is_of_one_sensor(tmp_path):
    """A page finds its own folder, and that of another sensor is not replaced."""
    folder = tmp_path / "touches"
    shown = {}
    for sensor in ("digit", "gelsight", "digit"):
        recorder = LiveRecorder(folder, sensor)
        shown[sensor] = LongerTraining(None, recorder, print).about()["folder"]
        tuned = folder / "tuned"
        if not tuned.is_dir():
            tuned.mkdir(parents=True)
            (tuned / "sensor.txt").write_text(sensor)
    assert shown == {
        "digit": str(folder / "tuned"),
        "gelsight": str(folder / "tuned_gelsight"),
    }


def test_the_page_hears_at_once_that_it_trains(encoder, tmp_path, monkeypatch):
    recorder = LiveRecorder(tmp_path, "digit")
    for name in ("cup", "key"):
        recorder.start(name, None)
        recorder.add(np.zeros((8, 8, 3), np.uint8), PRESSED, np.zeros(WIDTH, np.float32))
        recorder.stop()
    teacher = Teacher(encoder, recorder, log=lambda _: None)
    ends = threading.Event()
    monkeypatch.setattr(teacher, "_fit", lambda _: ends.wait(60))
    before = teacher.version
    teacher.train()
    noticed = teacher.version
    ends.set()
    assert noticed > before
