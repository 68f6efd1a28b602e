import io
import json
import tarfile

import pyarrow as pa
import pyarrow.parquet
import pytest

from anytouch_jax.data.images import decode
from anytouch_jax.datasets.readers import IndexOptions, index
from anytouch_jax.errors import UserError
from tests.data.manifest.test_containers import png


def table_of(root, name, **options):
    report = index(name, root, options=IndexOptions(**options))
    return report, report.manifest.table.to_pylist()


def write_corpus(root, source, split, rows):
    """A shard of gelsight-mini-pretrain with some of its 30 columns."""
    columns = {"image": [png(row["value"]) for row in rows], "source": [source] * len(rows)}
    columns |= {
        "split": [split] * len(rows),
        "markered": [True] * len(rows),
        "domain": ["real"] * len(rows),
    }
    for name in ("capture", "frame_idx", "obj_name", "f_z", "side"):
        columns[name] = [row.get(name) for row in rows]
    (root / source).mkdir(parents=True, exist_ok=True)
    pa.parquet.write_table(
        pa.table(columns), root / source / f"{split}-00000.parquet", row_group_size=2
    )


@pytest.fixture
def corpus(tmp_path):
    video = [{"capture": "ep1", "frame_idx": i, "value": i} for i in range(4)]
    write_corpus(tmp_path, "gelslam", "train", video)
    presses = [
        {"capture": "ball", "obj_name": "sphere", "f_z": -1.5 * i, "value": 10 + i}
        for i in range(3)
    ]
    write_corpus(tmp_path, "feats", "test_unknown_indenters", presses)
    write_corpus(tmp_path, "sparsh_force", "train", [{"capture": "c", "value": 20}])
    write_corpus(tmp_path, "mystery", "train", [{"capture": "c", "value": 30}])
    return tmp_path


def test_rows_stay_in_their_shards_with_the_licence_of_their_source(corpus):
    report, rows = table_of(corpus, "gelsight_mini_pretrain")
    assert [decode(report.manifest.file(i))[0, 0, 0] for i in range(len(rows))] == [
        10,
        11,
        12,
        0,
        1,
        2,
        3,
        30,
        20,
    ]
    assert [row["path"] for row in rows[:2]] == [
        f"feats/test_unknown_indenters-00000.parquet/image/{i}" for i in (0, 1)
    ]
    video = [row for row in rows if row["dataset"].endswith("/gelslam")]
    assert [row["frame_index"] for row in video] == [0, 1, 2, 3] and len(
        {row["sequence"] for row in video}
    ) == 1
    assert len(report.manifest.clips(3)) == 2  # of the video alone
    presses = rows[:3]
    assert {row["split"] for row in presses} == {"test"} and [
        row["label.force_z"] for row in presses
    ] == [0, -1.5, -3]
    licences = {
        row["dataset"].rpartition("/")[2]: (row["license"], row["commercial"]) for row in rows
    }
    assert licences["gelslam"] == ("MIT", True) and licences["sparsh_force"] == (
        "CC-BY-NC-4.0",
        False,
    )
    assert licences["mystery"] == ("not stated", False) and "unknown source" in " ".join(
        report.skipped
    )
    assert rows[0]["label.markered"] == 1


def write_samples(file, samples):
    """A tar with a file for each (name, data): numbers are images of that grey, others JSON or
    text.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    with tarfile.open(file, "w") as archive:
        for name, value in samples:
            text = value if isinstance(value, str) else json.dumps(value)
            data = png(value) if isinstance(value, int) else text.encode()
            info = tarfile.TarInfo(name)
            info.size = len(data)
            archive.addfile(info, io.BytesIO(data))


def write_tar(file, samples):
    """A tar with an image and JSON for each key: (grey, labels)."""
    files = {
        key: (("png", value), ("json", json.dumps(labels)))
        for key, (value, labels) in samples.items()
    }
    write_samples(
        file, [(f"{key}.{end}", data) for key, both in files.items() for end, data in both]
    )


def test_fota_names_sensors_by_data_set_and_takes_labels_from_json(tmp_path):
    pose = {"x_mm": 1.5, "object_name": "key1", "nested": [1, 2]}
    write_tar(
        tmp_path / "panda_key1_Mini_Mini_left/train/data-000000.tar",
        {"a-0": (1, pose), "a-1": (2, pose)},
    )
    contact = {"has_contact": True, "contact_class": "rock"}
    write_tar(
        tmp_path / "touch_and_go" / "val" / "data-000000.tar",
        {"b": (3, json.dumps(contact)), "c": (4, contact)},
    )
    report, rows = table_of(tmp_path, "fota")
    assert [row["sensor"] for row in rows] == ["gelsight_mini"] * 2 + ["gelsight"] * 2
    assert [row["split"] for row in rows] == ["train"] * 2 + ["val"] * 2
    assert [decode(report.manifest.file(i))[0, 0, 0] for i in range(4)] == [1, 2, 3, 4]
    assert rows[0]["object"] == "key1" and rows[0]["label.x_mm"] == 1.5
    assert [row["label.contact"] for row in rows] == [None, None, 1, 1] and rows[2][
        "label.contact_class"
    ] == "rock"
    assert len({row["sequence"] for row in rows}) == 4 and report.reader.license == "MIT"
    with pytest.raises(UserError, match="--sensor"):
        write_tar(tmp_path / "unheard" / "train" / "data-000000.tar", {"a": (1, {})})
        table_of(tmp_path, "fota")


def test_any_webdataset_is_read_with_a_sensor(tmp_path):
    write_tar(
        tmp_path / "shards" / "00.tar",
        {str(i): (i, {"hardness": i if i else "soft"}) for i in range(5)},
    )
    _, rows = table_of(tmp_path, "webdataset", sensor="digit", val=0.0, test=0.5)
    assert [row["path"] for row in rows] == [f"shards/00.tar/{2 * i}" for i in range(5)]
    assert [row["label.hardness"] for row in rows] == ["soft", "1", "2", "3", "4"]
    (tmp_path / "shards" / "01.tar").write_bytes(b"no tar" * 200)
    with pytest.raises(UserError, match=r"01\.tar is no whole tar"):
        table_of(tmp_path, "webdataset", sensor="digit")
    deep: object = 0
    for _ in range(80):
        deep = [deep]
    write_tar(tmp_path / "shards" / "01.tar", {"x": (1, {"hardness": deep})})
    with pytest.raises(UserError, match=r"01\.tar, x\.json has more than 64 levels of JSON"):
        table_of(tmp_path, "webdataset", sensor="digit", val=0.0, test=0.5)


@pytest.mark.parametrize(
    ("fields", "touches", "photo"),
    [
        ({"left.png": 1, "right.png": 2, "rgb.jpg": 3}, {"left": 1, "right": 2}, 3),
        ({"tactile.png": 1, "png": 3}, {None: 1}, None),  # what else is not known to be touch
        (
            {"gelsight.left.PNG": 1, "gelsight.right.png": 2, "wrist_camera.png": 3},
            {"gelsight.left": 1, "gelsight.right": 2},
            3,
        ),
        ({"png": 1, "photo.png": 3, "depth.png": 4, "mask.png": 5}, {None: 1}, 3),
        ({"visual.png": 3, "background.png": 6, "touch.png": 1}, {None: 1}, 3),
        ({"rgb.png": 3}, {}, 3),
    ],
)
def test_a_sample_of_webdataset_has_touches_photographs_labels_and_captions(
    tmp_path, fields, touches, photo
):
    more = {
        "caption.txt": "rough\n and cold",
        "cls": "3",
        "force.json": {"f": [1.5, 2], "pose": {"x": 1}},
        "npy": "?",
    }
    samples = [
        (f"a/00{n}.{field}", value) for n in range(20) for field, value in (fields | more).items()
    ]
    samples += [("a/plain.png", 9)]
    write_samples(tmp_path / "00.tar", samples)
    # the same keys in another shard
    write_samples(tmp_path / "01.tar", samples)
    report, rows = table_of(tmp_path, "webdataset", sensor="digit", val=0.3, test=0.3)
    assert len(rows) == 2 * (1 + 20 * len(touches))
    assert len({row["sequence"] for row in rows}) == len(rows)
    splits = {}
    for at, row in enumerate(rows):
        key = row["sequence"].partition("a/")[2].split("/")[0]
        splits.setdefault(key, set()).add(row["split"])
        if key != "plain":
            assert decode(report.manifest.file(at))[0, 0, 0] == touches[row.get("unit")]
            assert row["text"] == "rough and cold" and row["label.cls"] == 3
            assert (row["label.f_0"], row["label.f_1"], row["label.pose_x"]) == (1.5, 2, 1)
            shown = (
                row.get("image_path") and decode(report.manifest.file(at, "image_path"))[0, 0, 0]
            )
            assert shown == photo
    assert all(len(one) == 1 for one in splits.values())
    assert (report.left_out > 0) == bool({"mask.png", "png"} & {*fields} and len(fields) in (2, 4))
    assert report.skipped["file of a sample that is no image, label or text"][0] == 40


def test_fields_are_chosen_by_keys_and_shards_and_json_state_splits(tmp_path):
    for shard, split in (("x-training-00", None), ("validation/00", None), ("00", "test")):
        about = {"split": split} if split else {}
        write_samples(
            tmp_path / f"{shard}.tar", [("k.foo.png", 1), ("k.png", 2), ("k.json", about)]
        )
    _, rows = table_of(tmp_path, "webdataset", sensor="digit", keys=("foo.png",))
    assert sorted(row["split"] for row in rows) == ["test", "train", "val"]
    assert all(row["path"].endswith("/0") for row in rows)
