import pytest
from reader_world import fill
from refused import refused

VIDEO = "20220601_182052"


def _tree(root, frames=range(10, 40), video=VIDEO, photos=True):
    fill(root, [f"dataset/{video}/gelsight_frame/{i:010d}.jpg" for i in frames])
    if photos:
        fill(root, [f"dataset/{video}/video_frame/{i:010d}.jpg" for i in frames])


def _list(root, name, entries, video=VIDEO):
    text = "".join(f"{video}/{i:010d}.jpg,{label}\n" for i, label in entries)
    (root / name).write_text(text, encoding="utf-8")


def _both(root):
    _tree(root)
    _list(root, "train.txt", [(i, 3) for i in range(14, 20)])
    _list(root, "test.txt", [(i, 7) for i in range(24, 29)])


def _at(table, i, video=VIDEO):
    return table.rows[f"dataset/{video}/gelsight_frame/{i:010d}.jpg"]


def test_lists_labels_photographs_and_backgrounds(tmp_path, read):
    _both(tmp_path)
    table = read("touch_and_go")
    assert table.report.splits == {"train": 6, "test": 5}
    row = _at(table, 16)
    assert row["image_path"] == f"dataset/{VIDEO}/video_frame/{16:010d}.jpg"
    # 4 before the touch at 14
    assert row["background_path"] == f"dataset/{VIDEO}/gelsight_frame/{10:010d}.jpg"
    assert (row["label.material"], row["label.hardness"], row["label.contact"]) == (3, "hard", 1)
    test = _at(table, 24)
    assert (test["label.material"], test["label.hardness"], test["downstream_test"]) == (
        7,
        "soft",
        "material",
    )
    assert row["downstream_test"] is None
    assert table.reasons["frame in no list (no contact)"] == 30 - 11
    assert {row["sequence"] for row in table.rows.values()} == {f"{VIDEO}/14", f"{VIDEO}/24"}
    assert len(table.clips(3)) == 4 + 3  # six and five frames in a row
    assert (table.report.reader.paper, table.report.frames) == (250_000, 11)
    assert any("250,000" in line for line in table.report.lines())


def test_label_txt_adds_contact_frames_without_a_label(tmp_path, read):
    _both(tmp_path)
    _list(tmp_path, "label.txt", [(i, 3) for i in range(14, 22)] + [(30, -1)])
    table = read("touch_and_go")
    assert len(table.rows) == 6 + 5 + 2 + 1
    assert (_at(table, 20)["split"], _at(table, 20)["label.material"]) == ("train", None)
    # not a frame of a listed touch
    assert _at(table, 20)["sequence"] != _at(table, 14)["sequence"]


def test_minus_one_is_no_label_and_background_lists_and_windows_line_ends_are_read(tmp_path, read):
    _tree(tmp_path)
    lines = [f"{VIDEO}/{14:010d}.jpg,-1", f"{VIDEO}/{15:010d}.jpg,0", ""]
    (tmp_path / "train.txt").write_bytes(b"\xef\xbb\xbf" + "\r\n".join(lines).encode())
    (tmp_path / "test_bg.txt").write_text(f"{VIDEO}/{20:010d}.jpg,5,{16:010d}.jpg\n")
    table = read("touch_and_go")
    assert table.report.splits == {"train": 2, "test": 1} and _at(table, 15)["label.material"] == 0
    assert (_at(table, 14)["label.material"], _at(table, 14)["label.hardness"]) == (None, None)
    assert _at(table, 20)["background_path"].endswith(f"{16:010d}.jpg")


def test_the_task_decides_the_split_and_the_other_test_is_marked(tmp_path, read):
    _both(tmp_path)
    _list(tmp_path, "train_rough.txt", [(24, 0), (25, 0)])
    _list(tmp_path, "test_rough.txt", [(16, 1), (17, 1)])
    material = read("touch_and_go")
    rough = read("touch_and_go", task="rough")
    assert (_at(material, 16)["split"], _at(material, 16)["downstream_test"]) == ("train", "rough")
    assert (_at(rough, 16)["split"], _at(rough, 16)["label.rough"]) == ("test", 1)
    assert _at(rough, 24)["split"] == "train"
    assert _at(rough, 24)["downstream_test"] == "material"
    clips = rough.clips(3)
    assert all(len({rough.rows[path]["split"] for path in clip}) == 1 for clip in clips)


def test_what_is_missing_is_counted(tmp_path, read):
    _both(tmp_path)
    _tree(tmp_path, range(14, 16), "20220602_000000", photos=False)
    (tmp_path / f"dataset/{VIDEO}/gelsight_frame/{15:010d}.jpg").unlink()
    fill(tmp_path, [f"dataset/{VIDEO}/gelsight_frame/Kopie von 14.jpg"])
    (tmp_path / "dataset/packed").mkdir()
    (tmp_path / "dataset/packed/gelsight.mp4").write_bytes(b"x")
    with (tmp_path / "train.txt").open("a") as file:
        file.write("20220602_000000/0000000014.jpg,1\n20229999_999999/0000000001.jpg,2\n")
    reasons = read("touch_and_go").reasons
    assert reasons["listed frame that is not on disk"] == 1
    assert reasons["listed frame whose video is not on disk"] == 1
    assert reasons["RGB image missing (kept without)"] == 1
    assert reasons["file that is not a frame by its name"] == 1
    assert reasons["video that is not unpacked (run the dataset's extract_frame.py)"] == 1


def test_lists_may_be_elsewhere(tmp_path, read):
    root = tmp_path / "daten für touch"
    lists = tmp_path / "lists"
    lists.mkdir()
    _tree(root)
    _list(lists, "train.txt", [(14, 3)])
    _list(lists, "test.txt", [(20, 3)])
    assert len(read("touch_and_go", root, lists=lists).rows) == 2
    refused(r"expected the list train.txt in .*fredfyyang/Touch-and-Go", read, "touch_and_go", root)
    refused(
        r"expected dataset/.*is ROOT the folder that holds 'dataset'",
        read,
        "touch_and_go",
        root / "dataset",
    )


@pytest.mark.parametrize(
    ("name", "line", "says"),
    [
        ("train.txt", "nonsense", "line 7: expected video/frame.jpg,label but found nonsense"),
        ("train.txt", f"{VIDEO}/{30:010d}.jpg,wood", "line 7"),
        ("train.txt", f"{VIDEO}/{24:010d}.jpg,3", "in the train and in the test list of material"),
    ],
)
def test_broken_lists_name_the_line(tmp_path, read, name, line, says):
    _both(tmp_path)
    with (tmp_path / name).open("a") as file:
        file.write(line + "\n")
    refused(says, read, "touch_and_go")


def test_frames_of_a_touch_that_is_tested_are_not_trained_on(tmp_path, read):
    _both(tmp_path)  # 24 to 28 are a test
    _list(tmp_path, "label.txt", [(i, 3) for i in range(14, 32)])
    table = read("touch_and_go")
    assert {i: _at(table, i)["split"] for i in (14, 23, 24, 28, 29, 31)} == {
        14: "train",
        23: "unused",
        24: "test",
        28: "test",
        29: "unused",
        31: "unused",
    }
