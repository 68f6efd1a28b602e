"""Training longer on the page: its course, its end, and what names afterwards."""

import os
import time

import numpy as np
import pytest

from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.encoder.linear_head import HEAD
from anytouch_jax.errors import UserError
from anytouch_jax.live.page import longer
from anytouch_jax.live.page.fitting import false_alarms_of
from anytouch_jax.live.page.teach import LiveRecorder, Teacher

PRESSED = 50.0  # a contact score


@pytest.fixture
def teacher(tiny_run, tmp_path, monkeypatch):
    """Two names, four recordings of each, which differ by their images."""
    monkeypatch.setattr(longer, "MINUTES", 1.0)
    rng = np.random.default_rng(0)
    recorder = LiveRecorder(tmp_path / "touches", "digit")
    grey = np.full((24, 32, 3), 128, np.uint8)
    for number in range(8):
        look = rng.integers(60, 190, (3, 4, 3)).repeat(8, 0).repeat(8, 1)
        recorder.start(("cup", "key")[number % 2], grey)
        for _ in range(4):
            image = look + rng.integers(0, 6, look.shape)
            recorder.add(image.astype(np.uint8), PRESSED, np.zeros(12, np.float32))
        recorder.stop()
    return Teacher(load_encoder(tiny_run), recorder, log=lambda _: None)


def wait(teacher):
    end = time.monotonic() + 120
    while teacher.longer.is_on and time.monotonic() < end:
        time.sleep(0.05)
    return teacher.about()["longer"]


def test_the_page_names_by_what_was_trained_longer(teacher):
    assert not teacher.about()["longer"]["used"]
    teacher.train_longer()
    with pytest.raises(UserError, match="training already"):
        teacher.longer.start()
    about = wait(teacher)
    assert not about["fault"] and about["used"] and about["said"], about
    assert about["before"].endswith("%")
    tuned = teacher.longer.tuned
    assert sorted(tuned.head.classes) == ["cup", "key"]
    prepared = tuned.encoder.prepare(np.full((24, 32, 3), 90, np.uint8))
    assert tuned.features(prepared, 0).shape == tuned.head.mean.shape
    folder = teacher.head_file.parent / "tuned"
    assert not list(folder.parent.glob(".tuned*")), "nothing half made is left"

    # The next start goes on with it, unless a head was trained after it.
    again = longer.LongerTraining(teacher._encoder, teacher._recorder, print)
    again.reopen(teacher.head_file)
    assert again.tuned is not None
    teacher.head_file.write_bytes(b"newer")
    later = (folder / HEAD).stat().st_mtime + 5
    os.utime(teacher.head_file, (later, later))
    again.tuned = None
    again.reopen(teacher.head_file)
    assert again.tuned is None
    teacher.longer.forget()
    assert not teacher.about()["longer"]["used"]


def test_nine_recordings_tell_what_is_new_after_both_trainings():
    # What training longer leaves is calibrated as the head before it was.
    assert [false_alarms_of(count) for count in (8, 9, 12, 40)] == [0.05, 0.1, 0.08, 0.05]


def test_it_can_be_stopped_and_needs_two_names(teacher):
    teacher.longer.stop()
    teacher.longer.start()
    teacher.longer.stop()
    about = wait(teacher)
    assert about["used"] and not about["on"] and about["left"] == 0
    for name in ("cup", "key"):
        for _ in range(4):
            if name in teacher.about()["names"]:
                teacher.leave_out(teacher.about()["names"][name]["last"])
    with pytest.raises(UserError, match="two names"):
        teacher.train_longer()
