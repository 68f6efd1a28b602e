import json

import cv2
import numpy as np
import pytest
from reader_world import fill

from anytouch_jax.errors import UserError

REC = "0-1702507215.615537"


def _image(path, shape, kind, seed=0):
    rng = np.random.default_rng(seed)
    ramp = np.linspace(0, 200, shape[1] if kind == "touch" else shape[0])
    image = np.broadcast_to(
        ramp[None, :, None] if kind == "touch" else ramp[:, None, None], (*shape, 3)
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), (image + rng.integers(0, 20, (*shape, 3))).astype(np.uint8))


def _names(count=6):
    return [f"{i}-{0.02 * i + 0.001:.6f}.jpg" for i in range(count)]


def _recording(root, name=REC, part="data1", count=6):
    fill(
        root,
        [
            f"hct/{part}/{name}/{side}/{file}"
            for side in ("tactile", "vision")
            for file in _names(count)
        ],
    )


def _contact(root, numbers, name=REC, part="data1", background="digit_background.png"):
    keys = [f"{name}/tactile/{_names(99)[i]}" for i in numbers]
    vision = [key.replace("tactile", "vision") for key in keys]
    table = {"tactile": keys, "vision": vision, "background": [background] * len(keys)}
    (root / f"hct/{part}/contact.json").write_text(json.dumps(table))


def test_contact_photographs_captions_and_backgrounds(tmp_path, read):
    _recording(tmp_path)
    _contact(tmp_path, [2, 3, 4, 5], background=f"{REC}/tactile/{_names()[0]}")
    rows = [f'{REC}/vision/{n},{REC}/tactile/{n},bg,"smooth, hard"\n' for n in _names()[2:5]]
    (tmp_path / "hct/data1/train.csv").write_text(
        "url,tactile,tactile_background,caption\n" + "".join(rows)
    )
    table = read("tvl")
    assert table.report.splits == {"train": 4, "background": 2}
    row = table.rows[f"hct/data1/{REC}/tactile/{_names()[3]}"]
    assert (row["text"], row["label.contact"], row["frame_index"]) == ("smooth, hard", 1, 3)
    assert row["image_path"] == f"hct/data1/{REC}/vision/{_names()[3]}"
    assert row["background_path"] == f"hct/data1/{REC}/tactile/{_names()[0]}"
    assert len([c for c in table.clips(3) if table.rows[c[0]]["split"] == "train"]) == 2


def test_a_background_is_any_frame_of_a_recording_and_one_that_is_not_there_is_counted(
    tmp_path, read
):
    _recording(tmp_path, count=60)
    late = _names(60)[55]
    lost = "0-9.000001.jpg"
    keys = [f"{REC}/tactile/{name}" for name in _names(3)]
    behind = [f"{REC}/tactile/{late}", f"{REC}/tactile/{lost}", "digit_background.png"]
    contact = {"tactile": keys, "background": behind}
    (tmp_path / "hct/data1/contact.json").write_text(json.dumps(contact))
    table = read("tvl")
    behind = [table.rows[f"hct/data1/{key}"]["background_path"] for key in keys]
    assert behind == [f"hct/data1/{REC}/tactile/{late}", None, None]
    assert table.reasons["background named and not on disk (kept without)"] == 2
    fill(tmp_path, ["hct/data1/digit_background.png"])
    table = read("tvl")
    behind = [table.rows[f"hct/data1/{key}"]["background_path"] for key in keys]
    assert behind[1:] == ["hct/data1/digit_background.png"] * 2
    assert table.reasons["background named and not on disk (digit_background.png instead)"] == 1


def test_frames_are_matched_by_their_number_and_test_csv_is_the_split(tmp_path, read):
    _recording(tmp_path, count=21)
    _contact(tmp_path, [1, 11, 12])
    table = read("tvl", val=0, test=0)
    # no prefix
    assert [row["frame_index"] for row in table.rows.values() if row["label.contact"]] == [
        1,
        11,
        12,
    ]
    assert [row["frame_index"] for row in table.rows.values()] == list(range(21))
    _contact(tmp_path, range(6))
    for split, names in (("train", _names()[:3]), ("test", _names()[3:])):
        lines = "".join(f"{REC}/tactile/{name},{split}\n" for name in names)
        (tmp_path / f"hct/data1/{split}.csv").write_text(f"tactile,caption\n{lines}")
    table = read("tvl")
    assert (table.report.splits["train"], table.report.splits["test"]) == (3, 3)
    clips = [clip for clip in table.clips(3) if table.rows[clip[0]]["split"] in ("train", "test")]
    assert len(clips) == 2 and len({table.rows[clip[0]]["sequence"] for clip in clips}) == 2


def _swappable(root, swap, shapes):
    for k in range(5):
        touch, vision = ("vision", "tactile") if k in swap else ("tactile", "vision")
        for file in _names(2):
            _image(root / f"hct/data2/rec{k}/{touch}/{file}", shapes[0], "touch", k)
            _image(root / f"hct/data2/rec{k}/{vision}/{file}", shapes[1], "vision", k)


@pytest.mark.parametrize(
    "shapes", [((320, 240), (48, 64)), ((64, 64), (64, 64)), ((240, 320), (240, 320))]
)
def test_swapped_folders_are_read_the_other_way_round(tmp_path, read, shapes):
    _swappable(tmp_path, {1}, shapes)
    table = read("tvl")
    assert {path.split("/")[3] for path in table.rows if "/rec1/" in path} == {"vision"}
    assert {path.split("/")[3] for path in table.rows if "/rec1/" not in path} == {"tactile"}
    row = table.rows[f"hct/data2/rec1/vision/{_names()[0]}"]
    assert row["image_path"] == f"hct/data2/rec1/tactile/{_names()[0]}"
    assert (
        table.reasons["recording whose tactile and vision are swapped (read the other way round)"]
        == 1
    )
    # no contact.json: not known, not 0
    assert row.get("label.contact") is None
    assert len(table.rows) == 10


@pytest.mark.parametrize(
    ("swap", "scenes"), [({0, 1, 3}, 5), ({0, 1, 2, 3, 4}, 5), (set(), 5), ({0, 1, 3}, 1)]
)  # with one scene nothing says which half of the recordings is swapped: names stay
def test_touch_is_what_is_alike_however_many_recordings_are_swapped(tmp_path, read, swap, scenes):
    for k in range(5):
        scene = np.random.default_rng(k % scenes + 1).integers(0, 256, (8, 8, 3), np.uint8)
        touch, vision = ("vision", "tactile") if k in swap else ("tactile", "vision")
        _image(tmp_path / f"hct/data2/rec{k}/{touch}/{_names()[0]}", (64, 64), "touch", k)
        (tmp_path / f"hct/data2/rec{k}/{vision}").mkdir()
        assert cv2.imwrite(
            f"{tmp_path}/hct/data2/rec{k}/{vision}/{_names()[0]}", cv2.resize(scene, (64, 64))
        )
    table = read("tvl")
    sides = {path.split("/")[2]: path.split("/")[3] for path in table.rows}
    assert sides == {
        f"rec{k}": "vision" if k in swap and scenes > 1 else "tactile" for k in range(5)
    }
    assert any("may be swapped (read by their names)" in reason for reason in table.reasons) == (
        scenes == 1
    )


@pytest.mark.parametrize(
    "text",
    [
        '{"vision": []}',
        "[1, 2",
        "\xff",
        '{"tactile": [null]}',
        '{"tactile": [], "background": null}',
    ],
)
def test_a_broken_contact_json_is_an_error(tmp_path, read, text):
    _recording(tmp_path)
    (tmp_path / "hct/data1/contact.json").write_bytes(text.encode("latin1"))
    with pytest.raises(UserError, match=r"contact.json"):
        read("tvl")


def test_ssvtp_stills(tmp_path, read):
    fill(tmp_path, [f"ssvtp/images_tac/image_{i}_tac.jpg" for i in (0, 2, 10, 7)])
    fill(tmp_path, [f"ssvtp/images_rgb/image_{i}_rgb.jpg" for i in (0, 2, 10, 11)])
    (tmp_path / "ssvtp/train.csv").write_text(
        "idx,tactile,caption\n0,images_tac/image_2_tac.jpg,rough\n"
    )
    (tmp_path / "ssvtp/test.csv").write_text(
        "idx,tactile,caption\n0,images_tac/image_10_tac.jpg,\n"
    )
    table = read("ssvtp")
    assert list(table.rows) == [f"ssvtp/images_tac/image_{i}_tac.jpg" for i in (0, 2, 7, 10)]
    row = table.rows["ssvtp/images_tac/image_2_tac.jpg"]
    assert (row["text"], row["split"], row["caption_id"]) == ("rough", "train", "ssvtp_2")
    assert row["image_path"] == "ssvtp/images_rgb/image_2_rgb.jpg"
    assert table.rows["ssvtp/images_tac/image_10_tac.jpg"]["split"] == "test"
    assert table.rows["ssvtp/images_tac/image_7_tac.jpg"]["image_path"] is None
    assert table.reasons["RGB image without touch"] == 1
    assert not table.clips(2)
