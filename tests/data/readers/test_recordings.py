"""VisGel, Cloth, ObjectFolder Real, YCB-Slide and Octopi: folders of frames, with or without the authors' lists."""

import json

import pytest
from reader_world import fill

from anytouch_jax.errors import UserError


def _visgel(root, names=("a/rec_0", "a/rec_1", "größe 3/rec 2"), frames=5, place="images"):
    for kind in ("touch", "vision"):
        fill(root, [f"{place}/{kind}/{name}/frame{i:04d}.jpg" for name in names for i in range(frames)])


def test_visgel_pairs_photographs_and_takes_frame_0_as_background(tmp_path, read):
    _visgel(tmp_path)
    table = read("visgel")
    assert len(table.rows) == 15
    row = table.rows["images/touch/größe 3/rec 2/frame0002.jpg"]
    assert row["image_path"] == "images/vision/größe 3/rec 2/frame0002.jpg"
    assert row["background_path"] == "images/touch/größe 3/rec 2/frame0000.jpg"
    assert (row["sensor"], row["frame_index"]) == ("gelsight", 2)
    assert len(table.clips(3)) == 9
    assert table.clips(4)[0] == [f"images/touch/a/rec_0/frame{i:04d}.jpg" for i in range(4)]  # all four with folder


def test_visgel_contact_list_and_missing_files(tmp_path, read):
    _visgel(tmp_path)
    (tmp_path / "images/vision/a/rec_0/frame0003.jpg").unlink()
    (tmp_path / "images/touch/a/rec_1/frame0000.jpg").unlink()
    lines = ["a/rec_0/frame0003.jpg", "images/touch/a/rec_0/frame0004.jpg", "a/rec_0/frame0099.jpg"]
    (tmp_path / "contact_visgel.csv").write_text("\n".join(lines))
    table = read("visgel", val=0, test=0)
    assert table.report.splits == {"train": 2, "unused": 12}
    assert [row["frame_index"] for row in table.rows.values() if row["label.contact"]] == [3, 4]
    assert table.rows["images/touch/a/rec_0/frame0003.jpg"]["image_path"] is None
    assert table.rows["images/touch/a/rec_1/frame0001.jpg"]["background_path"] is None  # frame 0 is not there
    assert table.reasons["listed contact frame that is not on disk"] == 1
    assert table.reasons["photograph missing (kept without)"] == 1


def test_visgel_unseen_objects_are_test(tmp_path, read):
    _visgel(tmp_path, ("a/rec_0",), place="data_seen")
    _visgel(tmp_path, ("a/rec_0",), place="data_unseen")
    table = read("visgel", val=0, test=0)
    assert table.report.splits == {"train": 5, "test": 5}
    assert len(set(table["sequence"])) == 2


def test_cloth_has_its_properties(tmp_path, read):
    base = "Data_ICRA18/Data"
    fill(tmp_path, [f"{base}/{cloth}/t{k}/gelsight_frame/{i:04d}.png" for cloth in (11, 12) for k in (0, 1)
                    for i in range(4)])  # fmt: skip
    fill(tmp_path, [f"{base}/13/t0/gsframes/frame{i:06d}.jpg" for i in range(1, 4)])
    (tmp_path / base / "13/t1").mkdir()
    (tmp_path / base / "13/t1/GelSight_video.mp4").write_bytes(b"x")
    (tmp_path / "Data_ICRA18/cloth_metadata.json").write_text(json.dumps({"11": list(range(11)), "12": [0] * 11}))
    table = read("cloth")
    assert len(table.rows) == 19
    row = table.rows[f"{base}/11/t1/gelsight_frame/0003.png"]
    assert (row["object"], row["label.fuzziness"], row["label.textile_type"]) == ("11", 0, 10)
    assert table.rows[f"{base}/13/t0/gsframes/frame000002.jpg"]["label.textile_type"] is None
    assert table.reasons["cloth without properties (kept without labels)"] == 1
    assert table.reasons["video that is not unpacked (expected gelsight_frame/0000.png)"] == 1
    for wrong in ([1, 2], [None] * 11, [1.5] * 11, "eleven"):
        (tmp_path / "Data_ICRA18/cloth_metadata.json").write_text(json.dumps({"11": wrong}))
        with pytest.raises(UserError, match="cloth '11' must have 11 whole numbers"):
            read("cloth")


@pytest.mark.parametrize("layout", ["tactile/{}/tactile_data/{}/0/gelsight", "{}/tactile_data/{}/0/gelsight"])
def test_objectfolder_real_in_both_layouts(tmp_path, read, layout):
    fill(
        tmp_path, [layout.format(obj, trial) + f"/{i}.png" for obj in (1, 10, 2) for trial in (0, 1) for i in range(11)]
    )
    fill(tmp_path, [layout.format(1, 0).replace("gelsight", "camera") + "/0.png"])
    (tmp_path / "objectfolder_real_metadata.csv").write_text("Index,Name,Material\n1,Soup_Spoon,Ceramic\n")
    table = read("objectfolder_real")
    assert len(table.rows) == 66
    numbers = [row["frame_index"] for row in table.rows.values() if row["sequence"].endswith("1/tactile_data/0/0")]
    assert numbers == list(range(11))  # 10.png comes after 9.png, not after 1.png
    row = table.rows[layout.format(1, 1) + "/3.png"]
    assert (row["object"], row["label.material"], row["label.object"]) == ("1", "Ceramic", "Soup_Spoon")
    seen = [row["image_path"] for row in table.rows.values() if row.get("image_path")]
    assert seen == [layout.format(1, 0).replace("gelsight", "camera") + "/0.png"]
    by_object = {row["object"]: row["split"] for row in table.rows.values()}
    assert all(row["split"] == by_object[row["object"]] for row in table.rows.values())


def test_objectfolder_real_photographs_come_from_the_authors_list(tmp_path, read):
    fill(tmp_path, ["tactile/1/0/gelsight/0.png", "tactile/1/0/gelsight/1.png", "tactile/1/0/cam/1.png"])
    (tmp_path / "contact_text_obj.csv").write_text("1/0/gelsight/1.png,1/0/cam/1.png,17\n1/0/gelsight/7.png,x.png,3\n")
    table = read("objectfolder_real", val=0, test=0)
    row = table.rows["tactile/1/0/gelsight/1.png"]
    assert (row["image_path"], row["caption_id"], row["label.contact"]) == ("tactile/1/0/cam/1.png", "obj_17", 1)
    assert table.rows["tactile/1/0/gelsight/0.png"]["split"] == "unused"
    assert table.reasons["listed contact frame that is not on disk"] == 1


def test_ycb_slide_clips_take_every_third_frame(tmp_path, read):
    fill(tmp_path, [f"real/035_power_drill/dataset_{k}/frames/frame_{i:07d}.jpg" for k in (0, 4) for i in range(10)])
    fill(tmp_path, ["real/035_power_drill/dataset_0/webcam_frames/frame_0000000.jpg"])
    table = read("ycb_slide")
    assert set(table["stride"]) == {3}
    clips = [[table.rows[path]["frame_index"] for path in clip] for clip in table.clips(3)]
    assert clips == [[i - 6, i - 3, i] for i in range(6, 10)] * 2
    assert len(set(table["split"])) == 1  # one object
    assert not any("webcam" in path for path in table.rows)


def test_octopi_follows_its_own_sample_files(tmp_path, read):
    frames = (0, 1, 2, 7, 8)
    samples = ("physiclear_apple_0", "physiclear_apple_1", "physiclear_tea_towel_0", "physiclear_rest_0")
    fill(tmp_path, [f"processed/{name}/{i:010d}.jpg" for name in samples for i in frames])
    for split, name in zip(("train", "val", "test"), samples, strict=False):
        (tmp_path / f"processed/{split}_samples.json").write_text(json.dumps({"x": [f"C:\\out/{name}"]}))
    table = read("octopi")
    assert table.report.splits == {"train": 5, "val": 5, "test": 5, "unused": 5}
    row = table.rows[f"processed/{samples[2]}/{7:010d}.jpg"]
    assert (row["split"], row["object"], row["sensor"]) == ("test", "tea_towel", "gelsight_mini")
    assert len(table.clips(3)) == 4  # frames with gaps: only 0, 1, 2 of each sample
    (tmp_path / "processed/val_samples.json").write_text(json.dumps({"x": [samples[0]]}))
    with pytest.raises(UserError, match=f"the sample {samples[0]} is also in train_samples.json"):
        read("octopi")


def test_octopi_without_sample_files_splits_by_object(tmp_path, read):
    fill(tmp_path, [f"physiclear_o{k}_{n}/{0:010d}.jpg" for k in range(30) for n in (0, 1)])
    table = read("octopi", val=0.3, test=0.3)
    of = {}
    for row in table.rows.values():
        of.setdefault(row["object"], set()).add(row["split"])
    assert all(len(splits) == 1 for splits in of.values())
    assert set(table["split"]) == {"train", "val", "test"}


@pytest.mark.parametrize(
    ("name", "renamed", "says"),
    [
        ("visgel", "images/toch/a/frame0000.jpg", "images/touch"),
        ("cloth", "Data/nothing.txt.png", "no frame of cloth that could be used"),
        ("cloth", "Daten/11/t/gelsight_frame/0000.png", "'Data_ICRA18/Data' or a folder 'Data'"),
        ("objectfolder_real", "tactile/1/0/gelsite/0.png", "gelsight/<n>.png"),
        ("ycb_slide", "real/mug/dataset_0/frame/frame_0000000.jpg", "is ROOT the folder that holds 'real'"),
        ("octopi", "dataset/apple_0.mov.png", "process_dataset.py"),
    ],
)
def test_a_renamed_folder_is_told(tmp_path, read, name, renamed, says):
    fill(tmp_path, [renamed])
    with pytest.raises(UserError, match=says):
        read(name)


EMPTY = ("visgel", "cloth", "objectfolder_real", "ycb_slide", "octopi", "tacquad", "tvl", "ssvtp", "feel",
         "objectfolder", "real_touch", "touch_and_go")  # fmt: skip


@pytest.mark.parametrize("name", EMPTY)
def test_an_empty_folder_is_told(tmp_path, read, name):
    with pytest.raises(UserError, match=r"expected .*is ROOT the folder"):
        read(name)


def test_objectfolder_real_camera_views_lie_beside_the_touch(tmp_path, read):
    frames = [f"tactile/3/0/gelsight/{n}.png" for n in range(4)]
    fill(tmp_path, [*frames, *(f"tactile/3/0/cam_{view}/{n}.png" for view in "ab" for n in range(3))])
    fill(tmp_path, ["tactile/3/notes/0.png"])
    table = read("objectfolder_real", val=0, test=0)
    first, last = table.rows[frames[0]], table.rows[frames[3]]
    assert (first["image_path"], first["image2_path"]) == ("tactile/3/0/cam_a/0.png", "tactile/3/0/cam_b/0.png")
    assert last["image_path"] is None and last["image2_path"] is None
    assert any("its siblings" in reason for reason in table.report.skipped)
