from reader_world import fill


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
