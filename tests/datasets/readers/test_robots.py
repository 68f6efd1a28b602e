import json

from reader_world import fill
from refused import refused


def test_ycb_slide_clips_take_every_third_frame(tmp_path, read):
    fill(
        tmp_path,
        [
            f"real/035_power_drill/dataset_{k}/frames/frame_{i:07d}.jpg"
            for k in (0, 4)
            for i in range(10)
        ],
    )
    fill(tmp_path, ["real/035_power_drill/dataset_0/webcam_frames/frame_0000000.jpg"])
    table = read("ycb_slide")
    assert set(table["stride"]) == {3}
    clips = [[table.rows[path]["frame_index"] for path in clip] for clip in table.clips(3)]
    assert clips == [[i - 6, i - 3, i] for i in range(6, 10)] * 2
    assert len(set(table["split"])) == 1  # one object
    assert not any("webcam" in path for path in table.rows)


def _visgel(root, names=("a/rec_0", "a/rec_1", "größe 3/rec 2"), frames=5, place="images"):
    for kind in ("touch", "vision"):
        fill(
            root,
            [f"{place}/{kind}/{name}/frame{i:04d}.jpg" for name in names for i in range(frames)],
        )


def test_visgel_pairs_photographs_and_takes_frame_0_as_background(tmp_path, read):
    _visgel(tmp_path)
    table = read("visgel")
    assert len(table.rows) == 15
    row = table.rows["images/touch/größe 3/rec 2/frame0002.jpg"]
    assert row["image_path"] == "images/vision/größe 3/rec 2/frame0002.jpg"
    assert row["background_path"] == "images/touch/größe 3/rec 2/frame0000.jpg"
    assert (row["sensor"], row["frame_index"]) == ("gelsight", 2)
    assert len(table.clips(3)) == 9
    # all four with folder
    assert table.clips(4)[0] == [f"images/touch/a/rec_0/frame{i:04d}.jpg" for i in range(4)]


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
    # frame 0 is not there
    assert table.rows["images/touch/a/rec_1/frame0001.jpg"]["background_path"] is None
    assert table.reasons["listed contact frame that is not on disk"] == 1
    assert table.reasons["RGB image missing (kept without)"] == 1


def test_visgel_unseen_objects_are_test(tmp_path, read):
    _visgel(tmp_path, ("a/rec_0",), place="data_seen")
    _visgel(tmp_path, ("a/rec_0",), place="data_unseen")
    table = read("visgel", val=0, test=0)
    assert table.report.splits == {"train": 5, "test": 5}
    assert len(set(table["sequence"])) == 2


def test_cloth_has_its_properties(tmp_path, read):
    base = "Data_ICRA18/Data"
    fill(
        tmp_path,
        [
            f"{base}/{cloth}/t{k}/gelsight_frame/{i:04d}.png"
            for cloth in (11, 12)
            for k in (0, 1)
            for i in range(4)
        ],
    )
    fill(tmp_path, [f"{base}/13/t0/gsframes/frame{i:06d}.jpg" for i in range(1, 4)])
    (tmp_path / base / "13/t1").mkdir()
    (tmp_path / base / "13/t1/GelSight_video.mp4").write_bytes(b"x")
    (tmp_path / "Data_ICRA18/cloth_metadata.json").write_text(
        json.dumps({"11": list(range(11)), "12": [0] * 11})
    )
    table = read("cloth")
    assert len(table.rows) == 19
    row = table.rows[f"{base}/11/t1/gelsight_frame/0003.png"]
    assert (row["object"], row["label.fuzziness"], row["label.textile_type"]) == ("11", 0, 10)
    assert table.rows[f"{base}/13/t0/gsframes/frame000002.jpg"]["label.textile_type"] is None
    assert table.reasons["cloth without properties (kept without labels)"] == 1
    assert table.reasons["video that is not unpacked (expected gelsight_frame/0000.png)"] == 1
    for wrong in ([1, 2], [None] * 11, [1.5] * 11, "eleven"):
        (tmp_path / "Data_ICRA18/cloth_metadata.json").write_text(json.dumps({"11": wrong}))
        refused("cloth '11' must have 11 whole numbers", read, "cloth")


def test_octopi_follows_its_sample_files(tmp_path, read):
    frames = (0, 1, 2, 7, 8)
    samples = (
        "physiclear_apple_0",
        "physiclear_apple_1",
        "physiclear_tea_towel_0",
        "physiclear_rest_0",
    )
    fill(tmp_path, [f"processed/{name}/{i:010d}.jpg" for name in samples for i in frames])
    for split, name in zip(("train", "val", "test"), samples, strict=False):
        (tmp_path / f"processed/{split}_samples.json").write_text(
            json.dumps({"x": [f"C:\\out/{name}"], "y": [f"no_{split}"]})
        )
    table = read("octopi")
    assert table.reasons["sample of *_samples.json that is not on disk"] == 3
    assert table.report.splits == {"train": 5, "val": 5, "test": 5, "unused": 5}
    row = table.rows[f"processed/{samples[2]}/{7:010d}.jpg"]
    assert (row["split"], row["object"], row["sensor"]) == ("test", "tea_towel", "gelsight_mini")
    # frames with gaps: only 0, 1, 2 of each sample
    assert len(table.clips(3)) == 4
    (tmp_path / "processed/val_samples.json").write_text(json.dumps({"x": [samples[0]]}))
    refused(f"{samples[0]} is in train and in val", read, "octopi")


def test_octopi_without_sample_files_splits_by_object(tmp_path, read):
    fill(tmp_path, [f"physiclear_o{k}_{n}/{0:010d}.jpg" for k in range(30) for n in (0, 1)])
    table = read("octopi", val=0.3, test=0.3)
    of = {}
    for row in table.rows.values():
        of.setdefault(row["object"], set()).add(row["split"])
    assert all(len(splits) == 1 for splits in of.values())
    assert set(table["split"]) == {"train", "val", "test"}
