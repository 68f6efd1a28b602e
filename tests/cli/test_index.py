import os
from pathlib import Path

import pytest
from reader_world import fill

from anytouch_jax.cli.index import DatasetOptions
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.readers import READERS, IndexOptions


@pytest.fixture
def slides(tmp_path):
    names = [f"real/mug/dataset_{k}/frames/frame_{i:07d}.jpg" for k in range(5) for i in range(4)]
    fill(tmp_path / "my data", names)
    return tmp_path / "my data"


def test_a_manifest_is_written_and_the_counts_are_compared_with_the_papers(anytouch, slides, tmp_path):
    done = anytouch("data", "index", "ycb_slide", slides, "--out", tmp_path / "slides.csv", "--val", "0", "--test", "0")
    assert (done.status, done.err) == (0, "")
    manifest = manifests.read(tmp_path / "slides.csv")
    for words in (
        f"{tmp_path / 'slides.csv'}: 20 rows of 5 sequences (train 20)", "183,000 in the paper", "licence: ",
        f"content hash {manifest.content_hash}",
    ):  # fmt: skip
        assert words in done.out
    assert manifest.value(0, "path") == "my data/real/mug/dataset_0/frames/frame_0000000.jpg"
    assert anytouch("data", "index", "ycb_slide", slides).status == 0
    assert len(manifests.read(slides / "ycb_slide.parquet")) == 20  # in the folder


def test_mistakes_are_one_sentence(mistake, slides, tmp_path, monkeypatch):
    assert "ycb_slide" in mistake("data", "index", "ycb-slides", slides)
    assert "nowhere" in mistake("data", "index", "ycb_slide", tmp_path / "nowhere")
    (tmp_path / "a.zip").write_bytes(b"")
    assert "a.zip" in mistake("data", "index", "ycb_slide", tmp_path / "a.zip")
    assert "fold" in mistake("data", "index", "ycb_slide", slides, "--fold", 2)
    assert str(tmp_path / "else") in mistake(
        "data", "index", "ycb_slide", slides, "--out", tmp_path / "else" / "m.parquet"
    )
    assert "--lists" in mistake("data", "index", "objectfolder", slides, "--lists", "nowhere")
    assert "val" in mistake("data", "index", "ycb_slide", slides, "--val", 2)
    assert "m.txt" in mistake("data", "index", "ycb_slide", slides, "--out", slides / "m.txt")
    monkeypatch.setattr(os, "access", lambda *_: False)  # as for a folder of somebody else
    assert "--out" in mistake("data", "index", "ycb_slide", slides)


def test_the_help_names_every_reader_and_the_defaults_are_the_readers():
    names = (DatasetOptions.__doc__ or "").replace(".", ",")
    assert [name for name in READERS if f"{name}," not in names] == []
    options = vars(DatasetOptions("x", Path()))
    assert IndexOptions() == IndexOptions(**{name: options[name] for name in vars(IndexOptions())})
