import json
import os
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from blank_recorder import BlankRecorder
from checked_world import edit
from gel_images import press
from reader_world import fill

from anytouch_jax.cli.data import DatasetOptions
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.files import close_shards
from anytouch_jax.datasets import verify
from anytouch_jax.datasets.readers import READERS, IndexOptions
from anytouch_jax.sim import dataset


@pytest.fixture
def slides(tmp_path):
    names = [f"real/mug/dataset_{k}/frames/frame_{i:07d}.jpg" for k in range(5) for i in range(4)]
    fill(tmp_path / "my data", names)
    return tmp_path / "my data"


def test_a_manifest_is_written_and_the_counts_are_compared_with_the_papers(
    anytouch, slides, tmp_path
):
    done = anytouch(
        "data",
        "index",
        "ycb_slide",
        slides,
        "--out",
        tmp_path / "slides.csv",
        "--val",
        "0",
        "--test",
        "0",
    )
    assert (done.status, done.err) == (0, "")
    manifest = manifests.read(tmp_path / "slides.csv")
    for words in (
        f"{tmp_path / 'slides.csv'}: 20 rows of 5 sequences (train 20)",
        "183,000 in the paper",
        "licence: ",
        f"content hash {manifest.content_hash}",
    ):
        assert words in done.out
    assert manifest.value(0, "path") == "my data/real/mug/dataset_0/frames/frame_0000000.jpg"
    assert anytouch("data", "index", "ycb_slide", slides).status == 0
    # in the folder
    assert len(manifests.read(slides / "ycb_slide.parquet")) == 20


def test_mistakes_of_index(mistake, slides, tmp_path, monkeypatch):
    (tmp_path / "a.zip").write_bytes(b"")
    for words, named in (
        (["ycb-slides", slides], "ycb_slide"),
        (["ycb_slide", tmp_path / "nowhere"], "nowhere"),
        (["ycb_slide", tmp_path / "a.zip"], "a.zip"),
        (["ycb_slide", slides, "--fold", 2], "fold"),
        (["ycb_slide", slides, "--out", tmp_path / "else" / "m.parquet"], str(tmp_path / "else")),
        (["objectfolder", slides, "--lists", "nowhere"], "--lists"),
        (["ycb_slide", slides, "--val", 2], "val"),
        (["ycb_slide", slides, "--out", slides / "m.txt"], "m.txt"),
    ):
        assert named in mistake("data", "index", *words)
    # as for a folder of somebody else
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert "--out" in mistake("data", "index", "ycb_slide", slides)


def test_the_help_names_every_reader_and_the_defaults_are_the_readers():
    names = (DatasetOptions.__doc__ or "").replace(".", ",")
    assert [name for name in READERS if f"{name}," not in names] == []
    options = vars(DatasetOptions("x", Path()))
    assert IndexOptions() == IndexOptions(**{name: options[name] for name in vars(IndexOptions())})


@pytest.fixture(autouse=True)
def _closed():
    yield
    close_shards()


def test_a_pack_reads_like_the_files_and_lies_next_to_the_manifest(
    anytouch, pressed, mistake, tmp_path
):
    folder = pressed.with_name("touch_packed")
    done = anytouch("data", "pack", pressed)
    assert done.status == 0 and f"{folder / 'manifest.parquet'}: 10 rows" in done.out
    loose = manifests.read(pressed)
    packed = manifests.read(folder / "manifest.parquet")
    for row in range(10):
        np.testing.assert_array_equal(decode(packed.file(row)), decode(loose.file(row)))
    subprocess.run(["sha256sum", "-c", "--quiet", "SHA256SUMS"], cwd=folder, check=True)
    assert mistake("data", "pack")
    assert str(tmp_path) in mistake("data", "pack", pressed, "--out", tmp_path)
    shutil.rmtree(folder)
    assert "shard" in mistake("data", "pack", pressed, "--shard-mb", 0)
    (tmp_path / "3.png").unlink()
    named = mistake("data", "pack", pressed)
    assert f"row 3 of {pressed}" in named and "--repair" in named


SMALL = ["--objects", "6", "--frames", "2", "--size", "32"]


@pytest.fixture(autouse=True)
def _no_physics(monkeypatch):
    monkeypatch.setattr(dataset, "Recorder", BlankRecorder)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--sensors", "nose"], "no simulated sensor 'nose'"),
        (["--depth", "1", "0.5"], "depth is a range of mm"),
        (["--sensors", "tac3d", "--fields", "pressure"], "no sensor has a camera"),
    ],
)
def test_a_mistake_is_one_sentence_and_leaves_nothing(mistake, tmp_path, words, named):
    assert named in mistake("data", "simulate", "--out", tmp_path / "x", *words)
    assert not (tmp_path / "x").exists()
    (tmp_path / "file").write_text("")
    # a file is no folder
    for place in ("file", "file/below"):
        words = ("--out", tmp_path / place, "--touches", 1, "--held-out", 0)
        assert str(tmp_path / "file") in mistake("data", "simulate", *words)


def test_the_command_makes_a_data_set(anytouch, tmp_path):
    out = tmp_path / "scenes"
    outcome = anytouch(
        "data", "simulate", "--out", out, "--touches", 2, "--sensors", "digit", *SMALL
    )
    assert outcome.status == 0, outcome
    few, compiling, *_ = outcome.err.splitlines()
    assert (
        "val" in few
        and "test" in few
        and "compiling" in compiling
        and "2 touches by digit" in outcome.err
    )
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
    # nothing is left to do, nothing is compiled
    assert again.status == 0 and len(again.err.splitlines()) == 1


def test_frames_that_did_not_converge_are_counted(anytouch, tmp_path, monkeypatch):
    class Rough(BlankRecorder):
        def take(self, recording):
            take = super().take(recording)
            return take._replace(labels=take.labels | {"converged": np.array([1.0, 0.0])})

    monkeypatch.setattr(dataset, "Recorder", Rough)
    words = ["--touches", 3, "--sensors", "digit", "--fidelity", "exact", *SMALL]
    outcome = anytouch("data", "simulate", "--out", tmp_path, *words)
    assert outcome.status == 0 and "3 of 6 frames did not converge" in outcome.err


@pytest.fixture
def distinct(pressed):
    """`pressed` with no two images alike."""
    rng = np.random.default_rng(0)
    for i in range(10):
        noise = rng.integers(0, 4, (48, 48, 3), np.uint8)
        cv2.imwrite(str(pressed.parent / f"{i}.png"), press(10 * i) + noise)
    return pressed


def test_a_sound_manifest_passes(anytouch, distinct):
    done = anytouch("data", "verify", distinct)
    assert done.status == 0, done.out
    assert "10 rows, 10 files" in done.out and "No fault was found" in done.out
    assert "| CC-BY-NC-4.0 | no | 3 | mine |" in done.out and "| - | unknown | 1 |" in done.out


def test_a_broken_file_is_an_error_until_it_is_repaired(anytouch, distinct, tmp_path):
    data = (tmp_path / "7.png").read_bytes()
    (tmp_path / "7.png").write_bytes(data[: len(data) // 2])
    (tmp_path / "8.png").unlink()
    done = anytouch("data", "verify", distinct, "--out", tmp_path / "report.json")
    assert done.status == 1
    assert f"row 7 of {distinct}" in done.out and f"row 8 of {distinct}" in done.out
    report = json.loads((tmp_path / "report.json").read_text())
    assert not report["ok"] and sorted(row for f in report["findings"] for row in f["rows"]) == [
        7,
        8,
    ]
    assert anytouch("data", "verify", distinct, "--no-decode").out.count("row 7") == 0

    fixed = tmp_path / "fixed.parquet"
    done = anytouch("data", "verify", distinct, "--repair", fixed)
    assert (
        done.status == 0 and f"{fixed}: 8 of 10 rows" in done.out and "dropped 2 rows" in done.out
    )
    assert anytouch("data", "verify", fixed).status == 0
    assert len(manifests.read(distinct)) == 10


def test_what_no_repair_can_decide_and_both_sides_of_a_split_are_errors(
    anytouch, distinct, tmp_path
):
    other = edit(tmp_path / "other.parquet", distinct, split=["test"] * 10)
    done = anytouch("data", "verify", distinct, other)
    # the same images in train and test
    assert done.status == 1 and "leak_file" in done.out
    splits = ["background"] * 2 + ["train"] * 4 + ["test"] * 4
    edit(distinct, object=["mug"] * 10, split=splits, sequence=[f"{name} 1" for name in splits])
    assert anytouch("data", "verify", distinct).status == 0
    # on request
    assert anytouch("data", "verify", distinct, "--objects").status == 1
    edit(distinct, touch=["t"] * 10)
    (tmp_path / "4.png").unlink()
    done = anytouch("data", "verify", distinct, "--repair", tmp_path / "fixed.parquet")
    assert done.status == 1 and "left to you: 1 values of touch are in more than one of" in done.out
    assert "left to you: 1 rows whose path" not in done.out


def test_copies_have_commercial_rows_only_and_folders_are_exchanged_when_asked(
    anytouch, distinct, tmp_path
):
    for i in range(10):
        cv2.imwrite(str(tmp_path / f"photo{i}.png"), np.full((30, 30, 3), 20 * i, np.uint8))
    edit(distinct, image_path=[f"photo{i}.png" for i in range(10)])
    anytouch("data", "verify", distinct, "--repair", tmp_path / "back.csv", "--swap", "mine")
    back = manifests.read(tmp_path / "back.csv")
    assert back.value(3, "path") == "photo3.png" and back.value(3, "image_path") == "3.png"
    (tmp_path / "5.png").unlink()
    words = ["--repair", tmp_path / "fixed.parquet", "--commercial-only", tmp_path / "free.parquet"]
    done = anytouch("data", "verify", distinct, *words)
    assert "free.parquet: 5 rows" in done.out and " 3 " in done.out and " 1 " in done.out
    assert manifests.read(tmp_path / "free.parquet").column("license").to_pylist() == ["MIT"] * 5


def test_mistakes_of_verify(mistake, distinct, tmp_path, monkeypatch):
    for words, named in (
        (["--swap", "mine"], "--repair"),
        (["--swap", "x", "--repair", tmp_path / "o.csv"], "'x'"),
        (["--repair", distinct], str(distinct)),
        (["--repair", tmp_path / "below" / "o.csv"], "below"),
    ):
        assert named in mistake("data", "verify", distinct, *words)
    edit(distinct, license=[None] * 10)
    monkeypatch.setattr(verify, "verify", lambda *_, **__: pytest.fail("the work was begun"))
    assert mistake("data", "verify", distinct, "--commercial-only", tmp_path / "c.csv")
    assert not (tmp_path / "c.csv").exists()
