import numpy as np
import pytest
from blank_recorder import BlankRecorder

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.sim import dataset

SMALL = ["--objects", "6", "--frames", "2", "--size", "32"]


@pytest.fixture(autouse=True)
def _no_physics(monkeypatch):
    monkeypatch.setattr(dataset, "Recorder", BlankRecorder)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--sensors", "nose"], "no simulated sensor 'nose'"),
        (["--depth", "1", "0.5"], "depth is a range of mm"),
        (["--threads", "0"], "--threads must be 1 to 1024"),
        (["--sensors", "tac3d", "--fields", "pressure"], "no sensor has a camera"),
        (["--size", "8"], "size is 16 to 4096"),
        (["--size", "20000"], "size is 16 to 4096"),
    ],
)
def test_a_mistake_is_one_sentence_and_leaves_nothing(mistake, tmp_path, words, named):
    assert named in mistake("data", "simulate", "--out", tmp_path / "x", *words)
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("place", ["file", "file/below"])
def test_a_file_is_no_folder(mistake, tmp_path, place):
    (tmp_path / "file").write_text("")
    words = ("--touches", 1, "--held-out", 0)
    assert str(tmp_path / "file") in mistake("data", "simulate", "--out", tmp_path / place, *words)


def test_the_command_makes_a_data_set(anytouch, tmp_path):
    out = tmp_path / "scenes"
    outcome = anytouch("data", "simulate", "--out", out, "--touches", 2, "--sensors", "digit", *SMALL)
    assert outcome.status == 0, outcome
    few, compiling, *_ = outcome.err.splitlines()
    assert "val" in few and "test" in few and "compiling" in compiling and "2 touches by digit" in outcome.err
    assert len(manifests.read(out / "manifest.parquet")) == 2 * 2 + 2


def test_without_a_terminal_every_tenth_of_the_touches_is_a_line(anytouch, tmp_path, monkeypatch):
    monkeypatch.setattr(dataset, "GROUP", 1)
    words = ["--sensors", "digit", "--vision", "0", "--held-out", "0", *SMALL]
    outcome = anytouch("data", "simulate", "--out", tmp_path / "scenes", "--touches", 25, *words)
    assert outcome.status == 0, outcome
    assert [line for line in outcome.err.splitlines() if " of 25 touches" in line] == [
        f"{done} of 25 touches" for done in (3, 5, 8, 10, 13, 15, 18, 20, 23, 25)
    ]
    again = anytouch("data", "simulate", "--out", tmp_path / "scenes", "--touches", 25, *words)
    assert again.status == 0 and len(again.err.splitlines()) == 1  # nothing is left to do, nothing is compiled


def test_frames_that_did_not_converge_are_counted(anytouch, tmp_path, monkeypatch):
    class Rough(BlankRecorder):
        def take(self, recording):
            take = super().take(recording)
            return take._replace(labels=take.labels | {"converged": np.array([1.0, 0.0])})

    monkeypatch.setattr(dataset, "Recorder", Rough)
    words = ["--touches", 3, "--sensors", "digit", "--fidelity", "exact", *SMALL]
    outcome = anytouch("data", "simulate", "--out", tmp_path, *words)
    assert outcome.status == 0 and "3 of 6 frames did not converge" in outcome.err
