"""Where a command writes is asked before its long work begins."""

from __future__ import annotations

import os

import pytest

from anytouch_jax.cli.output import check_apart, check_folder, check_home
from anytouch_jax.errors import UserError

WORK = {
    "contact": "anytouch_jax.data.prepare.contact.contact_scores",
    "verify": "anytouch_jax.data.prepare.verify.verify",
    "export": "anytouch_jax.encoder.encoder.load_encoder",
    "probe": "anytouch_jax.evaluate.probing.probe_label",
    "retrieve": "anytouch_jax.data.manifest.manifest.read",
    "bench": "experiments.benchmarks.machine.describe",
    "annotate": "anytouch_jax.data.prepare.captions.annotate",
    "report": "anytouch_jax.evaluate.report.demo_report",
    "adapt": "anytouch_jax.data.manifest.manifest.read",
    "translate": "anytouch_jax.encoder.encoder.load_encoder",
}


def test_what_is_read_is_not_written_over(tmp_path):
    path, other = tmp_path / "m.csv", tmp_path / "other.csv"
    path.write_text("mine")
    check_folder(other, read=(path,))
    check_folder(path, read=(other,))  # a result of before is made anew
    (tmp_path / "link").symlink_to(tmp_path)
    for same in (path, tmp_path / "link" / "m.csv"):
        with pytest.raises(UserError, match=r"m.csv is a file that is read; name another one with --out"):
            check_folder(same, read=(other, path))
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UserError, match="pipe is no regular file"):
        check_folder(tmp_path / "pipe")


def test_two_outputs_are_two_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    check_apart(out=tmp_path / "a", report=None, sheet=tmp_path / "b", other=None)
    with pytest.raises(UserError, match="--out and --commercial-only name the same file; give each its own"):
        check_apart(out=tmp_path / "a", commercial_only=tmp_path / "b" / ".." / "a")


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["contact", "touch.parquet", "--picture", "c.parquet", "--out", "c.parquet"], "--out and --picture name the"),
        (["contact", "touch.parquet", "--picture", "c.jpg"], "must end in .png"),
        (["verify", "touch.parquet", "--repair", "r.csv", "--out", "r.csv"], "--repair and --out name the same file"),
        (["verify", "touch.parquet", "--commercial-only", "r.csv", "--out", "r.csv"], "--commercial-only and --out"),
        (["annotate", "touch.parquet", "--sheet", "x.csv", "--out", "x.csv", "--yes"], "--out and --sheet name"),
    ],
)
def test_outputs_that_would_replace_each_other_are_refused(mistake, pressed, monkeypatch, words, told):
    monkeypatch.chdir(pressed.parent)
    monkeypatch.setattr(WORK[words[0]], lambda *args, **options: pytest.fail("the work began"))
    assert told in mistake(*words)


def test_a_picture_of_the_data_is_not_written_over(mistake, pressed, monkeypatch):
    frame = next(path for path in sorted(pressed.parent.rglob("*.png")))
    before = frame.read_bytes()
    assert "is a file that is read; name another one with --picture" in mistake(
        "contact", pressed, "--picture", frame, "--out", pressed.parent / "c.parquet"
    )
    assert frame.read_bytes() == before


def test_the_files_of_a_run_are_not_written_over(mistake, pressed, tiny_run, monkeypatch):
    monkeypatch.setattr(WORK["probe"], lambda *args, **options: pytest.fail("the work began"))
    words = ("probe", "--run", tiny_run, "--data", pressed, "--out", tiny_run / "config.json")
    assert "config.json is a file that is read" in mistake(*words)


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (["contact", "touch.parquet", "--picture", "afile/c.png"], "--picture"),
        (["verify", "touch.parquet", "--out", "afile/report.json"], "--out"),
        (["export", "--run", "nowhere", "--out", "afile/e.bin"], "--out"),
        (["probe", "--data", "touch.parquet", "--out", "afile/deep/p.json"], "--out"),
        (["retrieve", "--data", "touch.parquet", "--out", "afile/r.json"], "--out"),
        (["bench", "embed", "--quick", "--out", "afile"], "--out"),
        (["annotate", "touch.parquet", "--yes", "--sheet", "afile/look.html"], "--sheet"),
        (["report", "--data", "touch.parquet", "--stage1", "a", "--stage2", "b", "--out", "afile/r"], "--out"),
        (["adapt", "--run", "a", "--data", "touch.parquet", "--sensor", "digit", "--out", "afile/r"], "--out"),
        (
            ["translate", "--fit", "--run", ".", "--data", "t.parquet", "--from", "a", "--to", "b", "--out", "afile/t"],
            "--out",
        ),
    ],
)
def test_a_place_that_cannot_be_is_named_before_the_work(mistake, pressed, monkeypatch, words, option):
    monkeypatch.chdir(pressed.parent)
    (pressed.parent / "afile").write_text("")
    before = sorted(pressed.parent.iterdir())
    monkeypatch.setattr(WORK[words[0]], lambda *a, **k: pytest.fail("long work began"))
    assert f"afile is a file, not a folder; choose another {option}" in mistake(*words)
    assert sorted(pressed.parent.iterdir()) == before


def test_a_folder_of_results_is_not_made_before_there_are_any(tmp_path):
    check_home(tmp_path / "a" / "b")
    assert [path.name for path in tmp_path.rglob("*")] == ["a"]
    check_home(tmp_path / "a")  # one that is there will do
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="file is a file, not a folder; choose another --out"):
        check_home(tmp_path / "file")


def test_the_folder_is_made_where_it_can_be(tmp_path, monkeypatch):
    check_folder(tmp_path / "a" / "b" / "c.json")
    assert (tmp_path / "a" / "b").is_dir()
    with pytest.raises(UserError, match="b is a folder; name a file with --out"):
        check_folder(tmp_path / "a" / "b")
    with pytest.raises(UserError, match="cannot be made: File name too long; choose another --sheet"):
        check_folder(tmp_path / ("x" * 300) / "c.json", "--sheet")
    monkeypatch.setattr(os, "access", lambda *_: False)  # as for a folder of somebody else
    with pytest.raises(UserError, match="cannot be written to; choose another --out"):
        check_folder(tmp_path / "c.json")


def test_commands_do_not_write_over_their_input(anytouch, tiny_run, tmp_path):
    mine = tmp_path / "m.csv"
    mine.write_text("path,sensor,sequence,frame_index\n")
    for words in (
        ["embed", "--run", tiny_run, "--input", mine, "--out", mine],
        ["probe", "--data", mine, "--label", "object", "--run", tiny_run, "--out", mine],
        ["retrieve", "--data", mine, "--run", tiny_run, "--out", mine],
    ):
        said = anytouch(*words)
        assert said.status == 1 and "is a file that is read" in said.err, words
    assert mine.read_text().startswith("path,sensor")
    weights = tmp_path / "w.safetensors"
    assert anytouch("convert", tiny_run, weights, "--names", "own").status == 0
    assert "must end in .safetensors" in anytouch("convert", tiny_run, tiny_run / "config.json").err
    assert "is a file that is read" in anytouch("convert", weights, weights).err
