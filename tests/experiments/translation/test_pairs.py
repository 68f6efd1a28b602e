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
