"""Pairs: the same frame of the same touch, fine data only, no test object in training; pixels and fields in order."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from pair_world import make_pairs, row

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from experiments.translation import pairs

A, B = "gelsight_mini", "duragel"


def table(rows: list[dict[str, Any]], name: str = "m.parquet") -> manifests.Manifest:
    return manifests.from_columns({key: [one[key] for one in rows] for key in rows[0]}, f"/nowhere/{name}")


def felt(sensor: str, split: str, number: int, frames: int = 3, **changes: Any) -> list[dict[str, Any]]:
    return [row(f"{sensor}{split}{number}{t}.png", sensor, split, number, t) | changes for t in range(frames)]


def plain() -> list[dict[str, Any]]:
    return [r for s in (A, B, "digit") for split in ("train", "test") for n in range(4) for r in felt(s, split, n)]


def test_a_pair_is_one_frame_of_one_touch_by_two_sensors():
    rows = plain()
    rows = [rows[i] for i in np.random.default_rng(0).permutation(len(rows))]
    result = table(rows)
    split = pairs.find_pairs(result, A, B)
    for part, name in ((split.train, "train"), (split.test, "test")):
        assert len(part.source) == len(part.target) == 12 == len(set(part.source)) == len(set(part.target))
        for first, second in zip(part.source, part.target, strict=True):
            one, two = rows[first], rows[second]
            assert (one["sensor"], two["sensor"], one["split"], two["split"]) == (A, B, name, name)
            assert (one["touch"], one["frame_index"]) == (two["touch"], two["frame_index"])
    objects = [{rows[i]["object"] for i in part.source} for part in split]
    assert not objects[0] & objects[2] and not len(split.val.source)
    rows += felt(A, "val", 0) + felt(B, "val", 0)
    assert len(pairs.find_pairs(table(rows), A, B).val.target) == 3


def test_what_has_no_partner_is_left_out():
    rows = plain()
    rows += felt(A, "train", 8) + felt(B, "train", 8, frames=2)  # the last frame is of one sensor only
    rows += felt(A, "train", 9, grade="coarse") + felt(B, "train", 9, grade="coarse")
    rows += felt(A, "train", 10, touch=None) + felt(B, "train", 10, touch=None)
    rows += felt(A, "train", 11, grade=None) + felt(B, "train", 11, grade=None)  # a real recording has no grade
    rows += felt(A, "train", 12)
    result = pairs.find_pairs(table(rows), A, B)
    numbers = [rows[i]["object"] for i in result.train.source]
    assert len(numbers) == 12 + 2 + 3
    assert numbers.count("train thing 8") == 2 and numbers.count("train thing 11") == 3


def test_two_manifests_do_not_pair_by_an_equal_name(tmp_path):
    for k, sensor in enumerate((A, B)):
        one = [r for split in ("train", "test") for r in felt(sensor, split, 0)]
        columns = {key: [r[key] for r in one] for key in one[0]}
        file = tmp_path / f"{k}.parquet"
        manifests.write(manifests.from_columns(columns, file), file)
    joined = manifests.read([tmp_path / "0.parquet", tmp_path / "1.parquet"])
    with pytest.raises(UserError, match="no frame of one touch"):
        pairs.find_pairs(joined, A, B)


def test_an_object_on_both_sides_is_refused():
    rows = plain()
    for one in rows:
        if one["split"] == "test" and one["touch"] == "test/2":
            one["object"] = "train thing 1"
    with pytest.raises(UserError, match="'train thing 1' is in the splits train and test"):
        pairs.find_pairs(table(rows), A, B)
    other = plain() + [r | {"object": "test thing 3"} for s in (A, B) for r in felt(s, "val", 0)]
    with pytest.raises(UserError, match="'test thing 3' is in the splits val and test"):
        pairs.find_pairs(table(other), A, B)
    rows[0]["object"] = None
    with pytest.raises(UserError, match=r"row 0 of .* has no object"):
        pairs.find_pairs(table(rows), A, B)


@pytest.mark.parametrize(
    ("source", "target", "says"),
    [
        (A, A, "both sensors"),
        ("tac3d", A, "measures a field"),
        (A, "allsight", "no rows of sensor 'allsight'; it has digit, duragel, gelsight_mini"),
        ("nonsense", A, "no rows of sensor 'nonsense'"),
    ],
)
def test_sensors_that_make_no_pair(source, target, says):
    with pytest.raises(UserError, match=says):
        pairs.find_pairs(table(plain()), source, target)


def test_a_frame_felt_twice_is_refused():
    rows = plain() + felt(B, "train", 2, frames=1, sequence="again")
    with pytest.raises(UserError, match=r"row 72 of .*duragel felt frame 0 of touch 'train/2' twice \(row"):
        pairs.find_pairs(table(rows), A, B)


def test_encoders_are_trained_on_other_objects():
    taken = table(plain())
    rows = plain() + felt("digit", "train", 20) + felt("digit", "val", 21) + felt("digit", "train", 22, object=None)
    kept = pairs.without_objects(table(rows), taken)
    assert set(kept.column("object").to_pylist()) == {"train thing 20", "val thing 21", None}
    assert len(kept) == 9
    assert kept.where(0) == "row 72 of /nowhere/m.parquet"  # errors still name the rows of the file
    with pytest.raises(UserError, match="every object to train on is in the pairs"):
        pairs.without_objects(table(plain() + felt("digit", "val", 21)), taken)


def test_pixels_and_fields_come_in_the_order_of_the_rows(tmp_path):
    result = manifests.read(make_pairs(tmp_path, {"train": 5, "test": 2}))
    split = pairs.find_pairs(result, A, B)
    x, y = pairs.read_pairs(result, split.train, 14)
    assert x.shape == y.shape == (10, 14, 14, 3) and x.dtype == np.uint8
    for part, images in ((split.train.source, x), (split.train.target, y)):
        for k in (0, 7, 9):
            image = cv2.imread(str(result.file(int(part[k]))))[..., ::-1]
            np.testing.assert_array_equal(images[k], cv2.resize(image, (14, 14), interpolation=cv2.INTER_AREA))
    field_pairs = pairs.find_pairs(result, "digit", "tac3d").test
    x, y = pairs.read_pairs(result, field_pairs, 14)
    assert y.shape == (4, 20, 20, 6) and y.dtype == np.float32 and len(x) == 4
    np.testing.assert_array_equal(y[3], np.load(result.file(int(field_pairs.target[3]), "field_path")))


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (np.zeros((20, 20, 3), np.float32), r"a field is \(20, 20, 6\)"),
        (np.full((20, 20, 6), np.nan, np.float32), "finite"),
        (b"no array", "cannot be read"),
        (None, "cannot be read"),
    ],
)
def test_a_bad_field_is_named(tmp_path, content, says):
    result = manifests.read(make_pairs(tmp_path, {"train": 2, "test": 1}, frames=1))
    rows = pairs.find_pairs(result, A, "tac3d").train.target
    file = result.file(int(rows[1]), "field_path")
    if content is None:
        file.unlink()
    elif isinstance(content, bytes):
        file.write_bytes(content)
    else:
        np.save(file, content)
    with pytest.raises(UserError, match=says) as error:
        pairs.read_fields(result, rows)
    assert str(file) in str(error.value) and f"row {rows[1]}" in str(error.value)
    with pytest.raises(UserError, match="has no field_path"):
        pairs.read_fields(result, pairs.find_pairs(result, A, B).train.target)
