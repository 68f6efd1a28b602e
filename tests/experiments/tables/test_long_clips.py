"""`experiments/long_clips.py` from top to bottom on a small world: every length is scored on the same moments."""

from __future__ import annotations

import json
import runpy
import shutil

import pytest
from places import EXPERIMENTS
from touch_world import make_touches

from anytouch_jax.data.manifest import manifest as manifests

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
    files = sorted((tmp_path / "out" / "long_clips").glob("*.json"))
    assert [one.stem for one in files] == [
        "1-mean", "3-mean", "5-concat", "5-mean", "5-sum", "7-concat", "7-mean", "7-sum", "time"
    ]  # fmt: skip
    looks = [json.loads(one.read_text()) for one in files[:-1]]
    assert len({json.dumps([task["test"] for task in one["tasks"].values()]) for one in looks}) == 1
    text = (tmp_path / "out" / "long_clips.md").read_text()
    assert "| 7 | concat |" in text and (tmp_path / "out" / "figures" / "long_clips.png").exists()
    written = {one: one.stat().st_mtime_ns for one in files}
    (tmp_path / "out" / "long_clips" / "5-sum.json").unlink()
    runpy.run_path(str(SCRIPT))  # what is there is not done again
    assert [one.stem for one in files if one.stat().st_mtime_ns != written[one]] == ["5-sum"]
    assert (tmp_path / "out" / "long_clips.md").read_text() == text


def test_the_committed_page_is_what_its_files_give(tmp_path, monkeypatch, capsys):
    shutil.copytree(EXPERIMENTS / "results" / "long_clips", tmp_path / "long_clips")
    for name, value in {"TABLE": "1", "OUT": str(tmp_path), "RUN": "nowhere", "DATA": "nowhere"}.items():
        monkeypatch.setenv(name, value)
    runpy.run_path(str(SCRIPT))
    assert (tmp_path / "long_clips.md").read_text() == (EXPERIMENTS / "results" / "long_clips.md").read_text()
    (tmp_path / "long_clips" / "7-sum.json").unlink()
    with pytest.raises(SystemExit, match=r"7-sum\.json: run this page without TABLE=1"):
        runpy.run_path(str(SCRIPT))
