"""`experiments/teaching.py`: its committed page is what its files give, and a trial of it runs from top to bottom."""

from __future__ import annotations

import json
import runpy
import shutil

import pytest
from places import EXPERIMENTS

SCRIPT = EXPERIMENTS / "tables" / "teaching.py"
RESULTS = EXPERIMENTS / "results"


def run(monkeypatch: pytest.MonkeyPatch, **settings: object) -> None:
    for name, value in settings.items():
        monkeypatch.setenv(name, str(value))
    runpy.run_path(str(SCRIPT))


def test_the_committed_page_is_what_its_files_give(tmp_path, monkeypatch, capsys):
    shutil.copytree(RESULTS / "teaching", tmp_path / "teaching")
    run(monkeypatch, TABLE=1, OUT=tmp_path)
    assert (tmp_path / "teaching.md").read_text() == (RESULTS / "teaching.md").read_text()
    file = tmp_path / "teaching" / "fine-1.json"
    found = json.loads(file.read_text())
    file.write_text(json.dumps(found | {"settings": found["settings"] | {"steps": [600, 1000]}}))
    with pytest.raises(SystemExit, match="made by different settings"):
        run(monkeypatch, TABLE=1, OUT=tmp_path)
    found["retrieval"]["top1"]["objects"]["an object of other data"] = 1
    file.write_text(json.dumps(found))
    with pytest.raises(SystemExit, match="are of different data"):
        run(monkeypatch, TABLE=1, OUT=tmp_path)
    file.unlink()
    with pytest.raises(SystemExit, match=r"fine-1\.json: run this page without TABLE=1"):
        run(monkeypatch, TABLE=1, OUT=tmp_path)


def test_the_page_of_convolutions_is_what_its_files_give(tmp_path, monkeypatch, capsys):
    shutil.copytree(RESULTS / "teaching_convolutional", tmp_path / "teaching_convolutional")
    run(monkeypatch, TABLE=1, CONVOLUTIONS=1, OUT=tmp_path)
    page = (tmp_path / "teaching_convolutional.md").read_text()
    assert page == (RESULTS / "teaching_convolutional.md").read_text()
    assert "CONVOLUTIONS=1 python experiments/teaching.py" in page and "convolutions inside its patches" in page
    assert not (tmp_path / "teaching.md").exists()


@pytest.mark.slow
def test_a_trial_from_data_to_page(tmp_path, monkeypatch, capsys):
    small = {"TOUCHES": 220, "MORE": 8, "OBJECTS": 60, "STEPS1": 1, "STEPS2": 1, "SEEDS": 0, "GRADES": "fine"}
    run(monkeypatch, WORK=tmp_path / "work", OUT=tmp_path / "out", **small)
    page = (tmp_path / "out" / "teaching.md").read_text()
    assert "TOUCHES=220 MORE=8 OBJECTS=60 STEPS1=1 STEPS2=1 SEEDS=0 GRADES=fine" in page and "| indenter |" in page
    written = (tmp_path / "out" / "teaching" / "fine-0.json").stat().st_mtime_ns
    run(monkeypatch, WORK=tmp_path / "work", OUT=tmp_path / "out", **small)  # what is there is not done again
    assert (tmp_path / "out" / "teaching" / "fine-0.json").stat().st_mtime_ns == written
