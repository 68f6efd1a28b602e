import json

import pytest
from reader_world import fill

from anytouch_jax.errors import UserError


def test_octopi_follows_its_sample_files(tmp_path, read):
    frames = (0, 1, 2, 7, 8)
    samples = ("physiclear_apple_0", "physiclear_apple_1", "physiclear_tea_towel_0", "physiclear_rest_0")
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
    assert len(table.clips(3)) == 4  # frames with gaps: only 0, 1, 2 of each sample
    (tmp_path / "processed/val_samples.json").write_text(json.dumps({"x": [samples[0]]}))
    with pytest.raises(UserError, match=f"{samples[0]} is in train and in val"):
        read("octopi")


def test_octopi_without_sample_files_splits_by_object(tmp_path, read):
    fill(tmp_path, [f"physiclear_o{k}_{n}/{0:010d}.jpg" for k in range(30) for n in (0, 1)])
    table = read("octopi", val=0.3, test=0.3)
    of = {}
    for row in table.rows.values():
        of.setdefault(row["object"], set()).add(row["split"])
    assert all(len(splits) == 1 for splits in of.values())
    assert set(table["split"]) == {"train", "val", "test"}
