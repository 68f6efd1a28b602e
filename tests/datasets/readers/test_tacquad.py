import pytest
from reader_world import fill

from anytouch_jax.errors import UserError

SENSORS = ("gelsight", "digit", "duragel")


def _tree(
    root, subset="indoor", items=("apple", "tea towel"), frames=10, photos=5, windows="3,6,2,9,0,4"
):
    for item in items:
        for sensor in SENSORS:
            fill(root, [f"data_{subset}/{item}/{sensor}/{i}.png" for i in range(frames)])
            fill(root, [f"data_{subset}/{item}/img_{sensor}/{i}.png" for i in range(photos)])
    (root / f"contact_{subset}.csv").write_text(
        "".join(f"{item},{windows}\n" for item in items), encoding="utf-8-sig"
    )


def test_contact_windows_pairs_photographs_and_captions(tmp_path, read):
    _tree(tmp_path)
    table = read("tacquad", val=0, test=0)
    assert table.report.sensors == {"digit": 20, "duragel": 20, "gelsight_mini": 20}
    assert table.report.splits == {"train": 2 * (4 + 8 + 5), "background": 2 * (6 + 2 + 5)}
    row = table.rows["data_indoor/tea towel/gelsight/6.png"]
    assert (row["split"], row["label.contact"], row["touch"]) == ("train", 1, "indoor/tea towel")
    # 6 / 10 of 5 RGB images
    assert row["image_path"] == "data_indoor/tea towel/img_gelsight/3.png"
    assert row["background_path"] == "data_indoor/tea towel/gelsight/0.png"
    assert row["caption_id"] == "tacquad_indoor_1"
    free = table.rows["data_indoor/tea towel/gelsight/7.png"]
    assert (free["split"], free["label.contact"]) == ("background", 0)
    # contact from frame 0 on
    assert table.rows["data_indoor/apple/duragel/1.png"]["background_path"] is None
    touches = {row["sensor"] for row in table.rows.values() if row["touch"] == "indoor/apple"}
    assert touches == {"gelsight_mini", "digit", "duragel"}
    assert (
        len(
            [
                c
                for c in table.clips(3)
                if "/digit/" in c[0] and table.rows[c[0]]["split"] == "train"
            ]
        )
        == 2 * 6
    )


@pytest.mark.parametrize("numbers", [range(0, 20, 2), [*range(4), *range(8, 12)]])
def test_photographs_are_of_the_same_fraction_where_frames_are_missing(tmp_path, read, numbers):
    _tree(tmp_path, items=("cup",), frames=0, photos=60)
    for sensor in SENSORS:
        fill(tmp_path, [f"data_indoor/cup/{sensor}/{number}.png" for number in numbers])
    for row in read("tacquad", val=0, test=0).rows.values():
        photo = int(row["image_path"].rpartition("/")[2].removesuffix(".png"))
        assert photo == 60 * row["frame_index"] // (max(numbers) + 1)


def test_one_item_is_in_one_split_and_fine_is_unused(tmp_path, read):
    _tree(tmp_path, items=[f"o{k}" for k in range(12)], frames=4, photos=4, windows="0,3,0,3,0,3")
    _tree(tmp_path, "fine", ("ball",), windows="1,2,1,2,1,2")
    table = read("tacquad", val=0.3, test=0.3)
    splits = {}
    for row in table.rows.values():
        splits.setdefault(row["touch"], set()).add(row["split"])
    assert all(len(one) == 1 for touch, one in splits.items())
    assert splits["fine/ball"] == {"unused"}
    assert set().union(*splits.values()) == {"train", "val", "test", "unused"}
    assert any("no data_outdoor" in note for note in table.report.notes)


def test_missing_items_frames_photographs_and_tac3d_are_counted(tmp_path, read):
    _tree(tmp_path, items=("apple", "only in the list"))
    for path in sorted((tmp_path / "data_indoor/only in the list").rglob("*"), reverse=True):
        path.unlink() if path.is_file() else path.rmdir()
    (tmp_path / "data_indoor/only in the list").rmdir()
    fill(tmp_path, ["data_indoor/unknown/gelsight/0.png", "data_indoor/apple/tac3d/0.png"])
    (tmp_path / "data_indoor/apple/gelsight/5.png").unlink()
    (tmp_path / "data_indoor/apple/img_digit/1.png").unlink()
    reasons = read("tacquad").reasons
    assert reasons["item of contact_indoor.csv that is not on disk"] == 1
    assert reasons["item that is not in contact_indoor.csv"] == 1
    assert reasons["folder 'tac3d' (no sensor with images)"] == 1
    assert reasons["contact frame that is not on disk"] == 1
    assert reasons["RGB image missing (kept without)"] >= 1


def test_the_wrong_name_in_the_list_is_mended_and_noted(tmp_path, read):
    _tree(tmp_path, items=("apple", "yumaoqiu"))
    (tmp_path / "data_indoor/yumaoqiu").rename(tmp_path / "data_indoor/shuttlecock")
    table = read("tacquad", val=0, test=0)
    row = table.rows["data_indoor/shuttlecock/digit/4.png"]
    assert (row["object"], row["label.contact"], row["caption_id"]) == (
        "shuttlecock",
        1,
        "tacquad_indoor_1",
    )
    assert any("shuttlecock" in note and "yumaoqiu" in note for note in table.report.notes)
    assert not any("list" in reason or "contact_indoor" in reason for reason in table.reasons)


@pytest.mark.parametrize(
    "line", ["apple,1,2,3,4,5,x", "tea towel,0,1,0,1,0,1\ntea towel,0,1,0,1,0,1", None]
)
def test_a_broken_or_missing_list_is_an_error(tmp_path, read, line):
    _tree(tmp_path)
    (tmp_path / "contact_indoor.csv").unlink()
    says = r"expected the list contact_indoor.csv .*next to data_indoor"
    if line is not None:
        (tmp_path / "contact_indoor.csv").write_text(line)
        says = r"contact_indoor.csv, line [12]: expected a new item and six frame numbers"
    with pytest.raises(UserError, match=says):
        read("tacquad")
