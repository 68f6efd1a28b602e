import itertools
import json
import pickle
import sys

import h5py
import numpy as np
import pytest
from reader_world import fill
from refused import refused

from anytouch_jax.data.images import decode
from anytouch_jax.datasets.readers.common import read_pickle

PHASES = ("before", "during", "after")


def _tree(root, objects=("mug", "blue bär"), grasps=2):
    for name in objects:
        fill(
            root,
            [
                f"{name}/touch_{phase}/{n}_{f}.png"
                for phase in PHASES
                for n in range(grasps)
                for f in "AB"
            ],
        )
        fill(root, [f"{name}/vision_{phase}/{n}.png" for phase in PHASES for n in range(grasps)])
    lines = [f"{name},{n},{n % 2}" for name in objects for n in range(grasps)]
    (root / "feel.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _split(root, train, test, fold=0):
    np.save(root / f"split_{fold}.npy", {"train": train, "test": test}, allow_pickle=True)


def test_only_during_frames_are_train_and_test(tmp_path, read):
    _tree(tmp_path)
    _split(tmp_path, ["mug"], ["blue bär"])
    table = read("feel")
    assert table.report.splits == {"train": 4, "test": 4, "background": 8, "unused": 8}
    row = table.rows["blue bär/touch_during/1_B.png"]
    assert (row["split"], row["label.success"], row["grasp_group"], row["unit"]) == (
        "test",
        1,
        "blue bär/1",
        "B",
    )
    assert row["image_path"] == "blue bär/vision_during/1.png"
    assert row["background_path"] == "blue bär/touch_before/1_B.png"
    assert table.rows["mug/touch_before/0_A.png"]["label.contact"] == 0
    assert table.rows["mug/touch_after/0_A.png"]["grasp_group"] is None
    # the fingers press opposite sides: no place that two sensors felt
    assert "touch" not in row
    pairs = {}
    for one in table.rows.values():
        pairs.setdefault(one["grasp_group"], []).append(one["unit"])
    pairs.pop(None)
    assert len(pairs) == 4 and all(sorted(units) == ["A", "B"] for units in pairs.values())
    assert not table.clips(2)  # before, during, after are no clip


def test_the_fold_is_chosen_and_objects_in_no_list_are_unused(tmp_path, read):
    _tree(tmp_path)
    _split(tmp_path, ["blue bär"], ["mug"], fold=0)
    _split(tmp_path, ["mug"], [], fold=3)
    table = read("feel", fold=3)
    assert table.report.splits["train"] == 4
    assert table.rows["blue bär/touch_during/0_A.png"]["split"] == "unused"
    assert table.reasons["grasp of an object that is in no list of split 3 (split unused)"] == 2
    refused(r"no split_99\.npy or \.json for --fold 99", read, "feel", fold=99)


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_split_files_are_read_as_numpy_writes_them(tmp_path, protocol):
    same = "an object in both"
    table = {"train": ["a", same, "ü b"], "test": [same, "c", "c"], "val": []}
    array = np.empty((), object)
    array[()] = table
    path = tmp_path / "split.npy"
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(
            file, {"descr": "|O", "fortran_order": False, "shape": ()}
        )
        file.write(pickle.dumps(array, protocol))
    assert np.load(path, allow_pickle=True).item() == table
    assert read_pickle(path).item() == table


def test_json_splits_and_an_object_in_both(tmp_path, read):
    _tree(tmp_path)
    (tmp_path / "split_0.json").write_text(json.dumps({"train": ["mug"], "test": ["blue bär"]}))
    assert read("feel").report.splits["test"] == 4
    wrong = "expected the lists 'train' and 'test'"
    for train, test, words in (
        (None, [], wrong),
        ("mug", [], wrong),
        (["mug"], ["mug"], "mug is in train and in test"),
    ):
        (tmp_path / "split_0.json").write_text(json.dumps({"train": train, "test": test}))
        refused(f"split_0.json: {words}", read, "feel")


def test_without_a_split_file_objects_stay_whole(tmp_path, read):
    _tree(tmp_path, [f"o{k}" for k in range(20)], 1)
    (tmp_path / "o3/touch_during/0_A.png").unlink()
    table = read("feel", val=0.3, test=0.3)
    parts = {}
    for row in table.rows.values():
        if "_during" in row["path"]:
            parts.setdefault(row["object"], set()).add(row["split"])
    assert (
        all(len(splits) == 1 for splits in parts.values()) and len(set.union(*parts.values())) == 3
    )
    assert table.reasons["image of feel.csv that is not on disk"] == 1


@pytest.mark.parametrize("line", ["mug,1", "mug,one,1", "mug,1,2", "mug,-1,1"])
def test_a_broken_table_names_its_line(tmp_path, read, line):
    _tree(tmp_path, ("mug",), 1)
    with (tmp_path / "feel.csv").open("a") as file:
        file.write(line + "\n")
    refused(r"feel.csv, line 2: expected object,number,0 or 1", read, "feel")


def test_original_files_are_written_as_images(tmp_path, read):
    grasps = {
        "i10": (50, 0, b"mug"),
        "i2": (40, 1, b"mug"),
        "i0": (30, 1, np.frombuffer(b"blue b\xc3\xa4r", np.uint8)),
    }
    with h5py.File(tmp_path / "calandra_corl2017_000.h5", "w") as file:
        for name, (shade, success, thing) in grasps.items():
            group = file.create_group(f"data/{name}")
            group["object_name"], group.attrs["is_gripping"] = np.asarray(thing), np.bool_(success)
            for finger, phase in itertools.product("AB", PHASES):
                group[f"gelsight{finger}_{phase}"] = np.full((6, 8, 3), (shade, 0, 9), np.uint8)
    refused(r"1 original .h5 files and no feel.csv; add --export", read, "feel")
    table = read("feel", export=True)
    assert (tmp_path / "feel.csv").read_text() == "blue bär,0,1\nmug,0,1\nmug,1,0\n"
    assert len(table.rows) == 18
    # RGB stays RGB; i2 before i10
    assert decode(tmp_path / "mug/touch_during/1_A.png")[0, 0].tolist() == [50, 0, 9]
    assert table.rows["mug/touch_during/1_A.png"]["label.success"] == 0


def test_a_broken_original_file_is_an_error_and_leaves_no_table(tmp_path, read, monkeypatch):
    (tmp_path / "calandra_corl2017_000.h5").write_bytes(b"x")
    refused(r"calandra_corl2017_000.h5 is not a file of Feel: ", read, "feel", export=True)
    assert not (tmp_path / "feel.csv").exists()
    monkeypatch.setitem(sys.modules, "h5py", None)
    refused(r"pip install .anytouch_jax\[hdf5\]", read, "feel", export=True)
