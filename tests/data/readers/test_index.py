"""What holds for every reader: options, places of the manifest, hash splits; and the three small ones."""

import json
import os
from dataclasses import replace

import numpy as np
import pytest
from reader_world import fill

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.readers import READERS, DatasetIndex, IndexOptions, index
from anytouch_jax.data.readers.common import hash_split
from anytouch_jax.errors import UserError


def _ycb(root, objects=("mug",), frames=4):
    fill(root, [f"real/{name}/dataset_0/frames/frame_{i:07d}.jpg" for name in objects for i in range(frames)])


def test_every_reader_says_what_it_is():
    assert all(one.name == name for name, one in READERS.items())
    known = set(IndexOptions.__dataclass_fields__)
    for one in READERS.values():
        assert one.license and one.citation and set(one.uses) <= known
    total = sum(one.paper for one in READERS.values() if one.paper)
    assert abs(total - 2_481_703) < 450_000  # the paper's table sums to 2.9 million, its text says 2,481,703


def test_an_unknown_name_is_answered_with_the_nearest(tmp_path):
    with pytest.raises(UserError, match=r"no reader is called 'Touch-and-go'; did you mean touch_and_go"):
        index("Touch-and-go", tmp_path)


@pytest.mark.parametrize("bad", [{"val": -0.1}, {"val": 0.6, "test": 0.5}, {"test": 2}])
def test_shares_are_checked(bad):
    with pytest.raises(UserError, match="are shares"):
        IndexOptions(**bad)


def test_an_option_that_is_not_heeded_is_an_error(tmp_path):
    _ycb(tmp_path)
    with pytest.raises(UserError, match="the reader ycb_slide does not use the option fold; it uses val, test"):
        index("ycb_slide", tmp_path, options=IndexOptions(fold=1))


def test_the_manifest_may_lie_above_the_data_but_not_elsewhere(tmp_path, read):
    _ycb(tmp_path / "a b" / "ycb")
    table = read("ycb_slide", tmp_path / "a b" / "ycb", tmp_path / "all.csv")
    assert next(iter(table.rows)) == "a b/ycb/real/mug/dataset_0/frames/frame_0000000.jpg"
    with pytest.raises(UserError, match=r"must lie in .* or in a folder above it"):
        index("ycb_slide", tmp_path / "a b", tmp_path / "c" / "m.parquet")
    with pytest.raises(UserError, match=r"ends in .csv or .parquet"):
        index("ycb_slide", tmp_path / "a b", tmp_path / "m.json")
    with pytest.raises(UserError, match="there is no folder"):
        index("ycb_slide", tmp_path / "nowhere")


def test_a_failed_write_is_told_and_leaves_the_old_file(tmp_path, monkeypatch):
    _ycb(tmp_path)
    before = index("ycb_slide", tmp_path).out.read_bytes()
    monkeypatch.setattr(os, "replace", lambda *_: (_ for _ in ()).throw(PermissionError(13, "Permission denied")))
    with pytest.raises(UserError, match=r"cannot be written: Permission denied; name another file with --out"):
        index("ycb_slide", tmp_path, options=IndexOptions(val=0.5))
    assert (tmp_path / "ycb_slide.parquet").read_bytes() == before
    assert sorted(os.listdir(tmp_path)) == ["real", "ycb_slide.parquet"]


def test_links_hidden_files_and_odd_names_are_counted_not_followed(tmp_path, read):
    root = tmp_path / "data"
    _ycb(root)
    frames = root / "real/mug/dataset_0/frames"
    fill(tmp_path, ["outside/frame_0000009.jpg"])
    (frames / "frame_0000008.jpg").symlink_to(tmp_path / "outside/frame_0000009.jpg")
    (root / "real/link").symlink_to(root / "real", target_is_directory=True)  # a loop, if it were followed
    fill(root, ["real/mug/dataset_0/frames/._frame_0000007.jpg", "real/mug/dataset_0/frames/frame_0000002.png"])
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
    _ycb(tmp_path, ("a", "b"), 50)
    seen = []
    real_stat, real_scan = os.stat, os.scandir
    monkeypatch.setattr(os, "stat", lambda path, *a, **k: (seen.append(os.fspath(path)), real_stat(path, *a, **k))[1])
    scans = []
    monkeypatch.setattr(os, "scandir", lambda path: (scans.append(os.fspath(path)), real_scan(path))[1])
    READERS["ycb_slide"].read(DatasetIndex("ycb_slide", tmp_path))
    assert not [path for path in seen if str(path).endswith(".jpg")]
    assert len(scans) == len(set(scans)) == 1 + 2 + 2  # real, the objects, their frames: each once


def test_hash_splits_are_stable_disjoint_and_of_the_asked_share():
    options = IndexOptions(val=0.1, test=0.2)
    of = {f"o{k}": hash_split("x", f"o{k}", options) for k in range(4000)}
    shares = {split: sum(one == split for one in of.values()) / len(of) for split in ("train", "val", "test")}
    assert shares == pytest.approx({"train": 0.7, "val": 0.1, "test": 0.2}, abs=0.03)
    assert [hash_split("ycb_slide", name, IndexOptions(0.5, 0.25)) for name in ("mug", "hammer", "ball")] == [
        "test",
        "val",
        "test",
    ]  # fixed: a change of the rule moves every published split
    wider = replace(options, test=0.4)
    assert all(hash_split("x", name, wider) != "train" for name, split in of.items() if split != "train")
    assert {hash_split("x", f"o{k}", IndexOptions(0, 0)) for k in range(50)} == {"train"}
    assert {hash_split("x", f"o{k}", IndexOptions(0, 1)) for k in range(50)} == {"test"}


def test_columns_have_a_value_for_every_row_and_a_list_for_every_path(tmp_path):
    rows = DatasetIndex("x", tmp_path)
    with pytest.raises(ValueError, match="'frame_index' has 1 values for 2 rows"):
        DatasetIndex("x", tmp_path).add(["a", "b"], frame_index=[1])
    rows.add(["a", "b"], sensor="digit", frame_index=[0, 1], unit=None)
    rows.add(["c"], sensor="digit", object="mug")
    columns = rows.columns()
    assert columns["object"] == [None, None, "mug"] and columns["frame_index"] == [0, 1, None]
    assert "unit" not in columns and columns["split"] == [None] * 3  # a required column stays, to be an error later


def test_numbers_order_frames_and_folders_naturally(tmp_path):
    fill(tmp_path, ["f10/x.png", "f9/x.png", "2.png", "10.png", "1.png", "٣.png"])
    rows = DatasetIndex("x", tmp_path)
    folders, files = rows.listing(".")
    assert folders == ["f9", "f10"]
    assert [name for _, name in rows.numbered(files, r"([0-9]+)\.png", "")] == ["1.png", "2.png", "10.png"]


def test_objectfolder_has_two_sensors_and_its_own_splits(tmp_path, read):
    fill(tmp_path, [f"obj1.0/{k}/{n}.png" for k in (1, 100) for n in range(3)])
    fill(tmp_path, [f"obj2.0/touch/{k}/{n}.png" for k in (100, 101, 1000) for n in range(3)])
    (tmp_path / "obj2.0/label.json").write_text(json.dumps({"1": 4, "100": 0, "101": "2"}))
    split = {"train": [["1", 0], ["101", "1"]], "test": [["1", 2], ["100", 0], ["101", 9]]}
    (tmp_path / "obj2.0/split.json").write_text(json.dumps(split))
    table = read("objectfolder")
    assert table.report.sensors == {"tacto": 6, "taxim": 6}
    assert table.report.splits == {"train": 2, "test": 2, "unused": 8}
    row = table.rows["obj2.0/touch/101/1.png"]
    assert (row["label.material"], row["split"], row["dataset"]) == (2, "train", "objectfolder2")
    assert table.rows["obj2.0/touch/1000/1.png"]["label.material"] is None
    assert table.reasons["id that does not belong to obj2.0/touch (1.0 ends at 100)"] == 1
    assert table.reasons["picture of split.json that is not on disk"] == 1
    (tmp_path / "obj2.0/split.json").write_text(json.dumps({"train": [["1", 0]], "test": [["1", 0]]}))
    with pytest.raises(UserError, match=r"\[1, 0\] is in train and in test"):
        read("objectfolder")
    (tmp_path / "obj2.0/split.json").write_text(json.dumps({"train": ["1"]}))
    with pytest.raises(UserError, match="is not as expected"):
        read("objectfolder")
    (tmp_path / "obj2.0/split.json").unlink()
    with pytest.raises(UserError, match=r"expected split.json in"):
        read("objectfolder")


def test_real_touch_is_checked_and_written_anew(tmp_path, read):
    fill(tmp_path, ["a/0.png", "a/1.png", "a/bg.png"])
    head = "path,sensor,sequence,frame_index,split,dataset,license,commercial,background_path,image_path,label.slip\n"
    lines = [f"a/{i}.png,digit,a,{i},train,x,MIT,1,a/bg.png,a/lost.png,{i}\n" for i in range(3)]
    (tmp_path / "manifest.csv").write_text(head + "".join(lines))
    table = read("real_touch")
    assert len(table.rows) == 2
    assert table.rows["a/1.png"]["label.slip"] == 1
    assert table.rows["a/1.png"]["background_path"] == "a/bg.png"
    assert table.reasons == {
        "file of the manifest that is not on disk": 1,
        "image_path that is not on disk (kept without)": 2,
    }
    with pytest.raises(UserError, match="the pack's own manifest"):
        index("real_touch", tmp_path, tmp_path / "manifest.csv")
    (tmp_path / "manifest.csv").write_text(head + lines[0] + lines[0])
    with pytest.raises(UserError, match="repeats frame_index 0"):
        read("real_touch")


def test_taxim_presses_become_pictures(tmp_path, read):
    calib = tmp_path / "calib"
    images = np.zeros((5, 6, 8, 3), np.uint8)
    images[:, :, :, 0] = np.arange(5, dtype=np.uint8)[:, None, None]  # blue: the pack is BGR
    (calib / "gelsight").mkdir(parents=True)
    np.savez(
        calib / "gelsight/dataPack.npz",
        f0=images[0],
        imgs=images,
        touch_center=np.ones((5, 2)),
        touch_radius=np.arange(5),
    )
    root = tmp_path / "out"
    root.mkdir()
    table = read("taxim_presses", root, lists=calib, val=0, test=0)
    assert table.report.splits == {"train": 5, "background": 1}
    row = table.rows["taxim_presses/gelsight/press_03.png"]
    assert (row["label.radius_px"], row["label.contact"]) == (3.0, 1)
    picture = manifests.read(table.report.out)
    from anytouch_jax.data.images import decode

    assert decode(picture.file(3))[0, 0].tolist() == [0, 0, 3]
    assert table.reasons == {"sensor without dataPack.npz": 1}
    (calib / "gelsight/dataPack.npz").write_bytes(b"broken")
    with pytest.raises(UserError, match=r"dataPack.npz is not a calibration pack"):
        read("taxim_presses", root, lists=calib)


def test_a_folder_that_leads_elsewhere_is_refused(tmp_path):
    away = tmp_path / "big" / "real" / "apple" / "dataset_0" / "frames"
    away.mkdir(parents=True)
    for number in range(4):
        (away / f"frame_{number:07d}.jpg").write_bytes(b"x")
    (tmp_path / "root").mkdir()
    (tmp_path / "root" / "real").symlink_to(tmp_path / "big" / "real")
    with pytest.raises(UserError, match="leads out of"):
        index("ycb_slide", tmp_path / "root")
    assert not list((tmp_path / "root").glob("*.parquet"))


def test_photographs_that_lie_elsewhere_are_refused(tmp_path):
    for name in ("tac", "rgb"):
        (tmp_path / f"images_{name}").mkdir()
        (tmp_path / f"images_{name}" / f"image_0_{name}.jpg").write_bytes(b"x")
    root = tmp_path / "root" / "ssvtp"
    root.mkdir(parents=True)
    (tmp_path / "images_tac").rename(root / "images_tac")
    (root / "images_rgb").symlink_to(tmp_path / "images_rgb")
    with pytest.raises(UserError, match="images_rgb leads out of"):
        index("ssvtp", tmp_path / "root")
