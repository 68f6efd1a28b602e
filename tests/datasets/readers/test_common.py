import os
from dataclasses import replace

import pytest
from reader_world import fill, fill_ycb

from anytouch_jax.datasets.readers import READERS, DatasetIndex, IndexOptions
from anytouch_jax.datasets.readers.common import hash_split
from anytouch_jax.errors import UserError


@pytest.mark.parametrize("bad", [{"val": -0.1}, {"val": 0.6, "test": 0.5}, {"test": 2}])
def test_fractions_are_checked(bad):
    with pytest.raises(UserError, match="are fractions"):
        IndexOptions(**bad)


def test_links_hidden_files_and_odd_names_are_counted_not_followed(tmp_path, read):
    root = tmp_path / "data"
    fill_ycb(root)
    frames = root / "real/mug/dataset_0/frames"
    fill(tmp_path, ["outside/frame_0000009.jpg"])
    (frames / "frame_0000008.jpg").symlink_to(tmp_path / "outside/frame_0000009.jpg")
    # a loop, if it were followed
    (root / "real/link").symlink_to(root / "real", target_is_directory=True)
    fill(
        root,
        [
            "real/mug/dataset_0/frames/._frame_0000007.jpg",
            "real/mug/dataset_0/frames/frame_0000002.png",
        ],
    )
    (frames / "frame_2.jpg").write_bytes((frames / "frame_0000002.jpg").read_bytes())
    with open(os.path.join(os.fsencode(frames), b"frame_\xff.jpg"), "wb") as file:
        file.write(b"x")
    table = read("ycb_slide", root)
    assert len(table.rows) == 4
    assert table.reasons["symbolic link (a manifest's paths may not leave its folder)"] == 2
    assert table.reasons["hidden or system file"] == 1
    assert table.reasons["second file of one frame number"] == 1
    assert table.reasons["name that is not UTF-8"] == 1
    assert table.reasons["file that is not a frame by its name"] == 1
    assert sum("left out" in line for line in table.report.lines()) == len(table.reasons)


def test_no_frame_is_opened_or_stated(tmp_path, monkeypatch):
    fill_ycb(tmp_path, ("a", "b"), 50)
    paths = []
    scans = []
    real_stat = os.stat
    real_scan = os.scandir
    monkeypatch.setattr(
        os,
        "stat",
        lambda path, *a, **k: (paths.append(os.fspath(path)), real_stat(path, *a, **k))[1],
    )
    monkeypatch.setattr(
        os, "scandir", lambda path: (scans.append(os.fspath(path)), real_scan(path))[1]
    )
    READERS["ycb_slide"].read(DatasetIndex("ycb_slide", tmp_path))
    assert not [path for path in paths if str(path).endswith(".jpg")]
    # real, the objects, their frames: each once
    assert len(scans) == len(set(scans)) == 1 + 2 + 2


def test_hash_splits_are_stable_disjoint_and_of_the_wanted_fraction():
    options = IndexOptions(val=0.1, test=0.2)
    of = {f"o{k}": hash_split("x", f"o{k}", options) for k in range(4000)}
    fractions = {
        split: sum(one == split for one in of.values()) / len(of)
        for split in ("train", "val", "test")
    }
    assert fractions == pytest.approx({"train": 0.7, "val": 0.1, "test": 0.2}, abs=0.03)
    fixed = [
        hash_split("ycb_slide", name, IndexOptions(0.5, 0.25)) for name in ("mug", "hammer", "ball")
    ]
    # a change of the rule moves every published split
    assert fixed == ["test", "val", "test"]
    wider = replace(options, test=0.4)
    assert all(
        hash_split("x", name, wider) != "train" for name, split in of.items() if split != "train"
    )
    assert {hash_split("x", f"o{k}", IndexOptions(0, 0)) for k in range(50)} == {"train"}
    assert {hash_split("x", f"o{k}", IndexOptions(0, 1)) for k in range(50)} == {"test"}


def test_a_split_by_hash_that_tests_few_is_noted(tmp_path, read):
    fill_ycb(tmp_path, ("a", "b", "c"), 2)
    assert "split test has 0 of 3 objects" in " ".join(read("ycb_slide", tmp_path).report.notes)
    fill_ycb(tmp_path, [f"o{k}" for k in range(30)], 2)
    some = read("ycb_slide", tmp_path, test=0.5).report
    assert "split test has" not in " ".join(some.notes)
