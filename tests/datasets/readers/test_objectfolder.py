import json

import pytest
from reader_world import fill
from refused import refused


def test_objectfolder_has_two_sensors_and_published_splits(tmp_path, read):
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
    assert table.reasons["image of split.json that is not on disk"] == 1
    (tmp_path / "obj2.0/split.json").write_text(
        json.dumps({"train": [["1", 0]], "test": [["1", 0]]})
    )
    refused(r"split.json: \(1, 0\) is in train and in test", read, "objectfolder")
    (tmp_path / "obj2.0/split.json").write_text(json.dumps({"train": ["1"]}))
    refused("is not as expected", read, "objectfolder")
    (tmp_path / "obj2.0/split.json").unlink()
    refused(r"expected split.json in", read, "objectfolder")


@pytest.mark.parametrize(
    "layout", ["tactile/{}/tactile_data/{}/0/gelsight", "{}/tactile_data/{}/0/gelsight"]
)
def test_objectfolder_real_in_both_layouts(tmp_path, read, layout):
    folders = [layout.format(obj, trial) for obj in (1, 10, 2) for trial in (0, 1)]
    fill(tmp_path, [f"{folder}/{i}.png" for folder in folders for i in range(11)])
    fill(tmp_path, [layout.format(1, 0).replace("gelsight", "camera") + "/0.png"])
    (tmp_path / "objectfolder_real_metadata.csv").write_text(
        "Index,Name,Material\n1,Soup_Spoon,Ceramic\n"
    )
    table = read("objectfolder_real")
    assert len(table.rows) == 66
    numbers = [
        row["frame_index"]
        for row in table.rows.values()
        if row["sequence"].endswith("1/tactile_data/0/0")
    ]
    # 10.png comes after 9.png, not after 1.png
    assert numbers == list(range(11))
    row = table.rows[layout.format(1, 1) + "/3.png"]
    assert (row["object"], row["label.material"], row["label.object"]) == (
        "1",
        "Ceramic",
        "Soup_Spoon",
    )
    collected = [row["image_path"] for row in table.rows.values() if row.get("image_path")]
    assert collected == [layout.format(1, 0).replace("gelsight", "camera") + "/0.png"]
    by_object = {row["object"]: row["split"] for row in table.rows.values()}
    assert all(row["split"] == by_object[row["object"]] for row in table.rows.values())


def test_objectfolder_real_photographs_come_from_the_authors_list(tmp_path, read):
    fill(
        tmp_path,
        ["tactile/1/0/gelsight/0.png", "tactile/1/0/gelsight/1.png", "tactile/1/0/cam/1.png"],
    )
    (tmp_path / "contact_text_obj.csv").write_text(
        "1/0/gelsight/1.png,1/0/cam/1.png,17\n1/0/gelsight/7.png,x.png,3\n"
    )
    table = read("objectfolder_real", val=0, test=0)
    row = table.rows["tactile/1/0/gelsight/1.png"]
    assert (row["image_path"], row["caption_id"], row["label.contact"]) == (
        "tactile/1/0/cam/1.png",
        "obj_17",
        1,
    )
    assert table.rows["tactile/1/0/gelsight/0.png"]["split"] == "unused"
    assert table.reasons["listed contact frame that is not on disk"] == 1


def test_objectfolder_real_camera_views_are_siblings_of_the_touch(tmp_path, read):
    frames = [f"tactile/3/0/gelsight/{n}.png" for n in range(4)]
    fill(
        tmp_path, [*frames, *(f"tactile/3/0/cam_{view}/{n}.png" for view in "ab" for n in range(3))]
    )
    fill(tmp_path, ["tactile/3/notes/0.png"])
    table = read("objectfolder_real", val=0, test=0)
    first = table.rows[frames[0]]
    last = table.rows[frames[3]]
    assert (first["image_path"], first["image2_path"]) == (
        "tactile/3/0/cam_a/0.png",
        "tactile/3/0/cam_b/0.png",
    )
    assert last["image_path"] is None and last["image2_path"] is None
    assert any("its siblings" in reason for reason in table.report.skipped)
