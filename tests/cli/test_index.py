"""`anytouch index`: from a folder as it was unpacked to a manifest."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from reader_world import fill

from anytouch_jax.cli.options_data import Index
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.readers import READERS, IndexOptions


@pytest.fixture
def slides(tmp_path):
    names = [f"real/mug/dataset_{k}/frames/frame_{i:07d}.jpg" for k in range(5) for i in range(4)]
    fill(tmp_path / "my data", names)
    return tmp_path / "my data"


def test_a_manifest_is_written_and_the_counts_stand_beside_the_papers(anytouch, slides, tmp_path):
    said = anytouch("index", "ycb_slide", slides, "--out", tmp_path / "slides.csv", "--val", "0", "--test", "0")
    assert (said.status, said.err) == (0, "")
    assert f"{tmp_path / 'slides.csv'}: 20 rows of 5 sequences (train 20)" in said.out
    assert "183,000 in the paper" in said.out and "licence: " in said.out and "content hash " in said.out
    manifest = manifests.read(tmp_path / "slides.csv")
    assert manifest.value(0, "path") == "my data/real/mug/dataset_0/frames/frame_0000000.jpg"
    assert manifest.content_hash in said.out


def test_without_out_it_lies_in_the_folder(anytouch, slides):
    assert anytouch("index", "ycb_slide", slides).status == 0
    assert len(manifests.read(slides / "ycb_slide.parquet")) == 20


def test_mistakes_are_one_sentence(mistake, slides, tmp_path, monkeypatch):
    assert "did you mean ycb_slide?" in mistake("index", "ycb-slides", slides)
    assert "there is no folder" in mistake("index", "ycb_slide", tmp_path / "nowhere")
    (tmp_path / "a.zip").write_bytes(b"")
    assert "a.zip is a file; ROOT is the folder that" in mistake("index", "ycb_slide", tmp_path / "a.zip")
    assert "does not use the option fold" in mistake("index", "ycb_slide", slides, "--fold", 2)
    assert "must lie in" in mistake("index", "ycb_slide", slides, "--out", tmp_path / "else" / "m.parquet")
    assert "nowhere; --lists is the folder" in mistake("index", "objectfolder", slides, "--lists", "nowhere")
    assert "both at least 0" in mistake("index", "ycb_slide", slides, "--val", 2)
    assert "ends in .csv or .parquet" in mistake("index", "ycb_slide", slides, "--out", slides / "m.txt")
    monkeypatch.setattr(os, "access", lambda *_: False)  # as for a folder of somebody else
    assert "is read-only; name another file with --out" in mistake("index", "ycb_slide", slides)


def test_what_is_left_out_is_counted_with_its_first_file(anytouch, slides):
    (slides / "real/mug/dataset_0/frames/frame_0000009.jpg").symlink_to(slides / "elsewhere.jpg")
    out = anytouch("index", "ycb_slide", slides).out
    assert "left out or noted, " in out and "frame_0000009.jpg" in out


def test_the_help_names_every_reader_and_the_defaults_are_the_readers():
    assert Index.__doc__ is not None
    assert [name for name in READERS if f"{name}," not in Index.__doc__ and f"{name}." not in Index.__doc__] == []
    given = Index("x", Path())
    assert IndexOptions() == IndexOptions(
        given.val, given.test, given.lists, given.task, given.fold, given.export, given.sensor
    )
