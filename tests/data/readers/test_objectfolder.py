import json

import pytest
from reader_world import fill

from anytouch_jax.errors import UserError


def test_objectfolder_has_two_sensors_and_published_splits(tmp_path, read):
    fill(tmp_path, [f"obj1.0/{k}/{n}.png" for k in (1, 100) for n in range(3)])
    fill(tmp_path, [f"obj2.0/touch/{k}/{n}.png" for k in (100, 101, 1000) for n in range(3)])
    (tmp_path / "obj2.0/label.json").write_text(json.dumps({"1": 4, "100": 0, "101": "2"}))
    split = {"train": [["1", 0], ["101", "1"]], "test": [["1", 2], ["100", 0], ["101", 9]]}
    (tmp_path / "obj2.0/split.json").write_text(json.dumps(split))
    table = read("objectfolder")
    assert table.report.sensors == {"tacto": 6, "taxim": 6}
    assert table.report.splits == {"train": 2, "test": 2, "unused": 8}
    row = table.rows["obj2.0/touch/101/1.png"]
    assert (row["label.material"], row["split"], row["dataset"]) == (2, "train", "objectfolder2")
    assert table.rows["obj2.0/touch/1000/1.png"]["label.material"] is None
    assert table.reasons["id that does not belong to obj2.0/touch (1.0 ends at 100)"] == 1
    assert table.reasons["picture of split.json that is not on disk"] == 1
    (tmp_path / "obj2.0/split.json").write_text(json.dumps({"train": [["1", 0]], "test": [["1", 0]]}))
    with pytest.raises(UserError, match=r"split.json: \(1, 0\) is in train and in test"):
        read("objectfolder")
    (tmp_path / "obj2.0/split.json").write_text(json.dumps({"train": ["1"]}))
    with pytest.raises(UserError, match="is not as expected"):
        read("objectfolder")
    (tmp_path / "obj2.0/split.json").unlink()
    with pytest.raises(UserError, match=r"expected split.json in"):
        read("objectfolder")
