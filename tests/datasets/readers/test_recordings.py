import os
from collections import Counter

import cv2
import numpy as np
import pytest
from reader_world import Table, fill
from refused import refused
from videos import write_video

from anytouch_jax.data.images import decode
from anytouch_jax.datasets.readers import IndexOptions, index
from anytouch_jax.datasets.readers.recordings import ranked_split
from anytouch_jax.errors import UserError


def test_a_folder_of_images_is_a_recording_of_the_first_folders_object(tmp_path, read):
    fill(tmp_path, [f"mug/{take}/{n}.png" for take in ("one", "two") for n in range(12)])
    fill(tmp_path, [f"ball/{n}.jpg" for n in (3, 4, 6)])
    table = read("recordings", sensor="digit", val=0, test=0)
    assert set(table["sequence"]) == {"mug/one", "mug/two", "ball"} and set(table["object"]) == {
        "mug",
        "ball",
    }
    assert set(table["sensor"]) == {"digit"} and set(table["dataset"]) == {tmp_path.name}
    assert [row["frame_index"] for path, row in table.rows.items() if "mug/one" in path] == list(
        range(12)
    )
    of_ball = [clip for clip in table.clips(2) if "ball" in clip[0]]
    # 5 is not there: no clip reaches over it
    assert of_ball == [["ball/3.jpg", "ball/4.jpg"]]


def test_files_in_or_above_the_folder_belong_to_a_recording(tmp_path, read):
    fill(
        tmp_path,
        ["background.png", "mug/photo.jpg", "mug/one/0.png", "mug/one/1.png", "mug/two/0.png"],
    )
    fill(tmp_path, ["mug/two/Background.png", "ball/0.png"])
    (tmp_path / "mug" / "caption.txt").write_text("smooth,\n cold\n", encoding="utf-8")
    (tmp_path / "mug" / "one" / "video.mp4").write_bytes(b"")
    table = read("recordings", sensor="digit", val=0, test=0)
    one, two, ball = (table.rows[path] for path in ("mug/one/1.png", "mug/two/0.png", "ball/0.png"))
    assert len(table.rows) == 4
    named = [
        [row[name] for name in ("background_path", "image_path", "text")]
        for row in (one, two, ball)
    ]
    assert named[0] == ["background.png", "mug/photo.jpg", "smooth, cold"]
    assert named[1][:2] == ["mug/two/Background.png", "mug/photo.jpg"]
    assert named[2] == ["background.png", None, None]
    assert table.reasons == {"video (--export writes its frames as images)": 1}


def test_images_in_the_folder_itself_are_one_recording(tmp_path, read):
    fill(tmp_path / "mine", ["0.png", "1.png"])
    table = read("recordings", tmp_path / "mine", sensor="digit", val=0, test=0)
    assert list(table.rows) == ["0.png", "1.png"] and set(table["sequence"]) == {"."}
    notes = read("recordings", tmp_path / "mine", sensor="digit", val=0, test=0.001).report.notes
    assert "too few objects or recordings for split test" in " ".join(notes)


def test_few_objects_fill_every_split_whatever_their_folder_is_called(tmp_path, read):
    splits = []
    for name in ("mine", "renamed"):
        fill(tmp_path / name, [f"thing {n}/{take}/0.png" for n in range(3) for take in (0, 1)])
        table = read("recordings", tmp_path / name, sensor="digit")
        splits.append({row["object"]: row["split"] for row in table.rows.values()})
    assert splits[0] == splits[1] and sorted(splits[0].values()) == ["test", "train", "val"]
    assert any("--split-by recording" in note for note in table.report.notes)


def test_ranked_splits_have_their_fractions_and_hardly_move():
    names = [f"o{n}" for n in range(40)]
    before = ranked_split(names, IndexOptions(0.2, 0.3))
    assert [list(before.values()).count(split) for split in ("val", "train", "test")] == [8, 20, 12]
    for new in (f"new {n}" for n in range(20)):
        after = ranked_split([*names, new], IndexOptions(0.2, 0.3))
        assert sum(after[name] != before[name] for name in names) <= 2
    few = {n: sorted(ranked_split(names[:n], IndexOptions(0.05, 0.05)).values()) for n in (1, 2, 3)}
    assert few == {1: ["train"], 2: ["test", "train"], 3: ["test", "train", "val"]}
    assert sorted(ranked_split(names[:3], IndexOptions(0.05, 0.9)).values()) == [
        "test",
        "train",
        "val",
    ]
    assert set(ranked_split(names, IndexOptions(0, 1)).values()) == {"test"}
    assert set(ranked_split(names, IndexOptions(0, 0)).values()) == {"train"}


def test_by_default_few_recordings_give_enough_to_test_on():
    counts = {}
    for n in (3, 6, 24, 50, 100, 200, 1000):
        parts = list(ranked_split(map(str, range(n)), IndexOptions()).values())
        counts[n] = (parts.count("val"), parts.count("test"))
    assert counts == {
        3: (1, 1),
        6: (1, 1),
        24: (2, 5),
        50: (5, 10),
        100: (5, 10),
        200: (10, 10),
        1000: (50, 50),
    }
    # a fraction that is given stays, and the other one leaves it room
    given = list(ranked_split(map(str, range(24)), IndexOptions(test=0.05)).values())
    assert (given.count("val"), given.count("test")) == (2, 1)
    assert IndexOptions(test=1.0).fractions(24) == (0.0, 1.0)
    assert IndexOptions(val=0.95).fractions(24) == pytest.approx((0.95, 0.05))


@pytest.mark.parametrize(
    ("takes", "options", "words"),
    [
        (8, {}, ""),  # 24 recordings: 6 of them
        (8, {"test": 0.05}, "split test has 3 of 24"),
        (8, {"test": 0.0}, ""),
        (2, {}, "split test has 3 of 6"),
        (8, {"split_by": "object"}, "split test has 1 of 3"),
    ],
)
def test_few_to_test_on_are_noted_with_what_to_do(tmp_path, read, takes, options, words):
    fill(tmp_path, [f"thing {n}/{k}/0.png" for n in range(3) for k in range(takes)])
    settings = {"split_by": "recording"} | options
    notes = read("recordings", tmp_path, sensor="digit", **settings).report.notes
    (note,) = [note for note in notes if "split test has" in note] or [""]
    assert note.startswith(words) and bool(note) == bool(words)
    if words:
        column = "object" if "split_by" in options else "sequence"
        assert "--test 0.3" in note and f"--leave-out {column}" in note


def test_by_recording_every_object_is_in_every_split(tmp_path, read):
    fill(
        tmp_path,
        [f"thing {n}/{take}/{k}.png" for n in range(5) for take in range(4) for k in (0, 1)],
    )
    table = read("recordings", sensor="digit", split_by="recording")
    for n in range(5):
        of = {
            row["sequence"]: row["split"]
            for row in table.rows.values()
            if row["object"] == f"thing {n}"
        }
        assert sorted(of.values()) == ["test", "train", "train", "val"]


def test_labels_are_joined_by_object_and_sequence(tmp_path, read):
    fill(tmp_path, [f"{name}/0.png" for name in ("mug/one", "mug/two", "ball/one", "cup/one")])
    labels = tmp_path / "labels.csv"
    labels.write_text(
        "object,sequence,material,label.hardness,code,unit\nmug,,clay,9,007,\n,mug/two,glass,,,left\nball,ball/one,,2.5,1,\n"
        "vase,,clay,1,1,\n"
    )
    table = read("recordings", sensor="digit", val=0, test=0, labels=labels)
    of = {row["sequence"]: row for row in table.rows.values()}
    names = ("label.material", "label.hardness", "label.code", "unit")
    assert {name: tuple(row[one] for one in names) for name, row in of.items()} == {
        "mug/one": ("clay", 9.0, "007", None),
        "mug/two": ("glass", 9.0, "007", "left"),
        "ball/one": (None, 2.5, "1", None),
        "cup/one": (None, None, None, None),
    }
    skipped = {reason: example for reason, (_, example) in table.report.skipped.items()}
    assert skipped == {
        "key of labels.csv that no recording has": "vase",
        "recording without a line in labels.csv": "cup/one",
    }


def test_a_folder_as_macos_writes_it_matches_its_label(tmp_path, read):
    fill(tmp_path, ["a\u0301/0.png"])
    (tmp_path / "labels.csv").write_text(
        "object,kind,weight\n\u00e1,oak  wood,?\n", encoding="utf-8"
    )
    table = read("recordings", sensor="digit", val=0, test=0, labels=tmp_path / "labels.csv")
    assert (
        table["label.kind"] == ["oak wood"]
        and table.rows["a\u0301/0.png"].get("label.weight") is None
    )


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            "name,material\nmug,clay\n",
            "no column object or sequence, by which labels are joined; it has name, mat",
        ),
        ("object,a,a\nmug,1,2\n", "has the column 'a' twice"),
        ("object,a\nmug,1\nmug,2\n", "line 3: mug is there twice"),
        ("object,a\n\nmug,1,2\n", "line 3: 3 cells for 2 columns"),
        ("object,a,b\nmug,1\n", "line 2: 2 cells for 3 columns"),
        (
            "object,a\nmug,Wood\n\nball,wood\n",
            "line 4: column 'a' has 'wood', and .* line 2 has 'Wood'",
        ),
        ('object,a\nmug,"x\ny"\n,1\n', "line 4: there"),
        ("object,a\n,1\n", "line 2: there is neither an object nor a sequence"),
    ],
)
def test_tables_of_labels_that_cannot_be_joined(tmp_path, read, text, says):
    fill(tmp_path, ["mug/0.png"])
    (tmp_path / "labels.csv").write_text(text)
    refused(says, read, "recordings", sensor="digit", labels=tmp_path / "labels.csv")
    refused("cannot be read", read, "recordings", sensor="digit", labels=tmp_path / "none.csv")


def test_two_fingers_in_one_folder_are_two_sequences(tmp_path, read):
    fill(tmp_path, [f"mug/one/{finger}_{n}.png" for finger in ("left", "right") for n in range(4)])
    fill(tmp_path, [f"{finger}{n}.png" for finger in ("a", "b") for n in range(2)])
    table = read("recordings", sensor="digit", val=0, test=0)
    units = {row["sequence"]: (row["unit"], row["object"]) for row in table.rows.values()}
    assert units == {
        "mug/one/left": ("left", "mug"),
        "mug/one/right": ("right", "mug"),
        "a": ("a", None),
        "b": ("b", None),
    }
    assert sum("mug" in clip[0] for clip in table.clips(3)) == 4
    assert all(len({path[:10] for path in clip}) == 1 for clip in table.clips(3))


def test_videos_become_folders_of_images(tmp_path, read):
    root = tmp_path / "mine"
    for name in ("one", "two"):
        write_video(
            root / "mug" / f"{name}.avi",
            [np.full((32, 32, 3), (200, 20 * n, 10), np.uint8) for n in range(5)],
        )
    (root / "mug" / "broken.mp4").write_bytes(b"no film")
    fill(root, ["ball/0.png"])
    table = read("recordings", root, sensor="digit", val=0, test=0)
    assert len(table.rows) == 1 and table.reasons == {
        "video (--export writes its frames as images)": 3
    }
    table = read("recordings", root, sensor="digit", val=0, test=0, export=True)
    assert len(table.clips(5)) == 2 and table.reasons["video that cannot be read"] == 1
    assert set(table["sequence"]) == {"mug/one", "mug/two", "ball"} and set(table["object"]) == {
        "mug",
        "ball",
    }
    # red first
    assert decode(root / "mug" / "two" / "000004.png")[0, 0] == pytest.approx([10, 80, 200], abs=6)


@pytest.mark.parametrize(
    ("form", "splits"),
    [
        ("{split}/{kind}", ("train", "val", "test")),
        ("{kind}/{split}", ("Training", "valid", "TEST")),
        ("data/{split}/{kind}", ("train_set", "dev", "testing")),
        ("{kind}/{split}/take", ("trn", "Validation", "eval")),
        ("{split}/{kind}", ("train2017", "val2017", "test_unseen")),
    ],
)
@pytest.mark.parametrize("count", [1, 4])
def test_split_words_decide_splits_and_name_nothing(tmp_path, read, form, splits, count):
    kinds = ("cotton", "denim")
    parts = ("train", "val", "test")
    fill(
        tmp_path,
        [
            f"{form.format(split=split, kind=kind)}/{n:03d}.png"
            for split in splits
            for kind in kinds
            for n in range(count)
        ],
    )
    table = read("recordings", sensor="digit", videos=True)
    of = dict(zip(splits, parts, strict=True))
    for path, row in table.rows.items():
        assert row["object"] in kinds and row["object"] in path and row["object"] in row["sequence"]
        assert row["split"] == next(part for split, part in of.items() if f"{split}/" in f"{path}/")
        assert not {*splits, *parts} & {*row["sequence"].split("/")}
    assert len(set(table["sequence"])) == 6
    assert "<split>/" in table.report.notes[0]
    assert (f"{splits[1]} is split val" in table.report.notes[0]) == ("val" not in splits)


def test_a_path_in_two_splits_is_refused_and_folders_outside_are_ranked(tmp_path, read):
    fill(tmp_path, ["test/a/0.png", "train/a/0.png", *(f"more {k}/0.png" for k in range(3))])
    rows = read("recordings", sensor="digit").rows.values()
    assert sorted(row["split"] for row in rows if "more" in row["sequence"]) == [
        "test",
        "train",
        "val",
    ]
    fill(tmp_path, ["train/a/valid/0.png"])
    refused("train/a/valid names two splits, train and valid", read, "recordings", sensor="digit")


def _presses(folder, names, seconds=0.0, video=False):
    """Write images of presses at random places, or of one that moves on, and the times of their
    files.
    """
    rng = np.random.default_rng(list(folder.name.encode()))
    folder.mkdir(parents=True, exist_ok=True)
    for at, name in enumerate(names):
        image = np.full((48, 64, 3), 90, np.uint8)
        place = (8 + 4 * at, 24) if video else tuple(int(x) for x in rng.integers(8, 40, 2))
        cv2.imwrite(str(folder / name), cv2.circle(image, place, 8, (220, 160, 90), -1))
        os.utime(folder / name, (1.7e9 + seconds * at,) * 2)


@pytest.mark.parametrize(
    ("names", "single", "made"),
    [
        ([f"{n:03d}.png" for n in range(9)], False, {"video": True}),
        ([f"{n:03d}.png" for n in range(9)], True, {}),  # numbered too: the images decide
        (
            [f"{n:03d}.png" for n in range(9)],
            True,
            {"video": True, "seconds": 60},
        ),  # or the times of the files
        ([f"1731000000.{33 * n:03d}.png" for n in range(9)], False, {"video": True}),
        ([f"IMG_20240105_12{n:02d}{n * n % 60:02d}.png" for n in range(9)], True, {"video": True}),
        ([f"17310000{n}7.png" for n in range(9)], True, {"video": True}),  # seconds
        ([f"{n * 7919 % 4096:x}f{n * n * 31 % 17}a.png" for n in range(9)], True, {"video": True}),
    ],
)
def test_images_that_look_like_no_video_are_single_touches(tmp_path, read, names, single, made):
    for kind in ("nut", "pin", "cap"):
        _presses(tmp_path / kind, names, **made)
    table = read("recordings", sensor="digit")
    assert len(set(table["sequence"])) == (27 if single else 3)
    assert len({row["object"] for row in table.rows.values() if row["split"] == "test"}) == (
        3 if single else 1
    )
    assert ("<touch>" in table.report.notes[0]) == single
    for choice, count in (("singles", 27), ("videos", 3)):
        assert len(set(read("recordings", sensor="digit", **{choice: True})["sequence"])) == count


def test_single_touches_are_split_by_a_group_of_the_user(tmp_path, read):
    fill(
        tmp_path,
        [
            f"{kind}/p{person}_{n}.png"
            for kind in ("nut", "pin")
            for person in range(4)
            for n in range(3)
        ],
    )
    lines = [
        f"{kind}/p{p}_{n}.png,{p}" for kind in ("nut", "pin") for p in range(4) for n in range(3)
    ]
    (tmp_path / "labels.csv").write_text("\n".join(["sequence,person", *lines]))
    for options in (
        {"split_by": r"p(\d)_"},
        {"split_by": "person", "labels": tmp_path / "labels.csv"},
    ):
        table = read("recordings", sensor="digit", singles=True, **options)
        splits = {}
        for path, row in table.rows.items():
            splits.setdefault(path.split("/p")[1][0], set()).add(row["split"])
        assert sorted(map(list, splits.values())) == [["test"], ["train"], ["train"], ["val"]]
    for wrong, words in (
        ("nobody", "is no column; give"),
        ("(x", "is no pattern"),
        ("(x)", "is in no path"),
    ):
        refused(words, read, "recordings", sensor="digit", split_by=wrong)
    refused("exclude each other", read, "recordings", sensor="digit", singles=True, videos=True)


def test_frames_without_order_in_their_names_come_by_time_when_asked(tmp_path, read):
    names = [f"{word}.png" for word in ("one", "two", "three", "four")]
    _presses(tmp_path / "mug", names, seconds=1)
    table = read("recordings", sensor="digit", videos=True)
    assert any(
        "names do not order 1 recordings clearly (first: mug); --order times" in x
        for x in table.report.notes
    )
    assert [
        path.split("/")[1] for path in read("recordings", sensor="digit", order="times")["path"]
    ] == names


def test_mistakes(tmp_path, read):
    fill(tmp_path, ["a/0.png"])
    refused("sensor 'DIGIT' is not known: did you mean digit", read, "recordings", sensor="DIGIT")
    for sensor in (None, "tac3d", "universal"):
        refused("--sensor: gelsight", read, "recordings", sensor=sensor)
    (tmp_path / "a" / "caption.txt").write_bytes(b"\xff\xfe\x00")
    refused(r"caption\.txt cannot be read as UTF-8 text", read, "recordings", sensor="digit")
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "video.mp4").write_bytes(b"")
    with pytest.raises(UserError, match=r"no frame of recordings .*--export writes its frames"):
        read("recordings", tmp_path / "empty", sensor="digit")


def test_arrays_count_where_there_is_nothing_else(tmp_path, read):
    fill(tmp_path, ["a/1.png", "a/2.png", "a/4.png"])
    for name in ("a/force.npy", "a/2.npy", "b/0.npy"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        np.save(tmp_path / name, np.zeros((8, 8, 3), np.uint8))
    table = read("recordings", sensor="digit", val=0, test=0)
    assert {path: row["frame_index"] for path, row in table.rows.items()} == {
        "a/1.png": 1,
        "a/2.png": 2,
        "a/4.png": 4,
        "b/0.npy": 0,
    }
    assert table.reasons == {"array next to images": 2}


def test_what_is_no_recording(tmp_path, read):
    fill(tmp_path, ["mug/background/0.png", "mug/1700000000.5.png", "mug/1700000000.1234567.png"])
    fill(tmp_path, [f"{tmp_path.name}/0.png", "0.png"])
    table = read("recordings", sensor="digit", val=0, test=0)
    assert [path for path in table.rows if "mug" in path] == [
        "mug/1700000000.1234567.png",
        "mug/1700000000.5.png",
    ]
    assert table.reasons == {"folder called background or photo, where one image is expected": 1}
    assert set(table["sequence"]) == {".", "mug", tmp_path.name}


def test_a_stack_of_frames_is_a_recording(tmp_path):
    frames = np.random.default_rng(0).integers(0, 256, (6, 24, 32, 3), np.uint8)
    for folder in ("mug", "ball", "both"):
        (tmp_path / folder).mkdir()
    np.save(tmp_path / "mug" / "press.npy", frames)
    np.savez(tmp_path / "ball" / "press.npz", pixels=frames, time=np.arange(6.0))
    np.savez(tmp_path / "ball" / "two.npz", left=frames, right=frames[:4])
    np.save(tmp_path / "ball" / "force.npy", np.zeros(6))
    (tmp_path / "ball" / "cut.npz").write_bytes(b"PK")
    cv2.imwrite(str(tmp_path / "both" / "0.png"), frames[0])
    np.save(tmp_path / "both" / "depth.npy", frames)
    cv2.imwrite(str(tmp_path / "mug" / "background.png"), frames[5])
    table = Table(index("recordings", tmp_path, options=IndexOptions(sensor="digit")))
    assert Counter(table["sequence"]) == {
        "mug/press": 6, "ball/press": 6, "ball/two/left": 6, "ball/two/right": 4, "both": 1,
    }  # fmt: skip
    for path, row in table.rows.items():
        if path != "both/0.png":
            np.testing.assert_array_equal(decode(tmp_path / path), frames[row["frame_index"]])
            assert row["object"] == path.split("/")[0]
    assert table.rows["mug/press.npy/3"]["background_path"] == "mug/background.png"
    assert table.rows["ball/two.npz/left/0"]["unit"] == "left"
    assert len(table.clips(3)) == 4 + 4 + 4 + 2
    assert set(table.reasons) == {
        "array next to images", "file that cannot be read",
        "array that is no image and no stack of frames",
    }  # fmt: skip
    # each is a touch alone, or ordered by the times of the files
    singles = IndexOptions(sensor="digit", singles=True)
    alone = Table(index("recordings", tmp_path, options=singles))
    assert len(set(alone["sequence"])) == 23 and not len(alone.clips(3))
    by_time = IndexOptions(sensor="digit", order="times")
    assert len(index("recordings", tmp_path, options=by_time).manifest) == 23
