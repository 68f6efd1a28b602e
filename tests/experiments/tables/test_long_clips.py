"""`experiments/tables/long_clips.py` on a small world: every length is scored on the same moments."""

from __future__ import annotations

import json
import runpy

import pytest
from places import EXPERIMENTS
from touch_world import make_touches

from anytouch_jax.data.manifest import manifest as manifests
from experiments.records import read_records, write_record

SCRIPT = EXPERIMENTS / "tables" / "long_clips.py"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_every_length_is_scored_on_the_same_moments(tmp_path, tiny_run, monkeypatch, capsys):
    file = make_touches(tmp_path / "data", touches={"train": 16, "val": 8, "test": 8}, frames=8, size=28, each=2)
    table = manifests.read(file)
    columns = {name: table.column(name).to_pylist() for name in table.table.column_names}
    number, frame = [int(name.split("/")[1]) for name in columns["sequence"]], columns["frame_index"]
    columns["label.slip"] = [0.1 * k * (n % 2) for n, k in zip(number, frame, strict=True)]
    columns["label.twist"] = [("clockwise", "counterclockwise")[n % 2] for n in number]
    columns["label.slide"] = [("right", "left")[n // 2 % 2] for n in number]
    manifests.write(manifests.from_columns(columns, file), file)
    monkeypatch.setenv("RUN", str(tiny_run))
    monkeypatch.setenv("DATA", str(file))
    monkeypatch.setenv("OUT", str(tmp_path / "out"))
    runpy.run_path(str(SCRIPT))
    results = tmp_path / "out" / "long_clips.jsonl"
    records = read_records(results)
    lengths = ["1-mean", "3-mean", "5-concat", "5-mean", "5-sum", "7-concat", "7-mean", "7-sum"]
    assert [*records] == [*lengths, "time"]
    assert len({json.dumps([task["test"] for task in records[key]["tasks"].values()]) for key in lengths}) == 1
    text = (tmp_path / "out" / "long_clips.md").read_text()
    assert "| 7 | concat |" in text and (tmp_path / "out" / "figures" / "long_clips.png").exists()
    write_record(results, "time", records["time"] | {"machine": "of the first call"})
    runpy.run_path(str(SCRIPT))  # what is there is not measured again
    assert "of the first call" in (tmp_path / "out" / "long_clips.md").read_text()
