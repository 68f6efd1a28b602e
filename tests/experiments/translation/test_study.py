"""The translation study at a toy size, and its page again from the records."""

from __future__ import annotations

import json
import runpy

import pytest
from places import EXPERIMENTS

from anytouch_jax.errors import UserError
from experiments.records import read_records
from experiments.translation.page import runs_of


def visit(monkeypatch, **environment):
    for key, value in environment.items():
        monkeypatch.setenv(key, str(value))
    return runpy.run_path(str(EXPERIMENTS / "translation/study.py"))


def test_steps_of_stage_1_are_not_for_encoders_that_are_done(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="leave it out with RUNS"):
        visit(monkeypatch, RUNS=f"anytouch={tmp_path}", STEPS1=5, OUT=tmp_path)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_translation(tmp_path, tiny_run, monkeypatch):
    size = {"QUICK": 1, "TOUCHES": 24, "STEPS": 2, "WORK": tmp_path / "work", "OUT": tmp_path}
    visit(monkeypatch, RUNS=f"anytouch={tiny_run} t3={tiny_run}", **size)
    found = list(runs_of(tmp_path / "translation_quick.jsonl").values())
    assert len(found) == 9 and all(one["error"] > 0 for one in found)
    page = (tmp_path / "translation_quick.md").read_text()
    assert "mean of the training targets" in page and "t3, frozen" in page and "over the same encoders" in page
    visit(monkeypatch, TABLE=1)
    assert (tmp_path / "translation_quick.md").read_text() == page


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_translation_trains_encoders_that_never_met_the_objects_of_the_pairs(tmp_path, monkeypatch):
    size = {"QUICK": 1, "TOUCHES": 24, "STEPS": 2, "STEPS1": 5, "TUNE": "frozen,fine", "OUT": tmp_path}
    visit(monkeypatch, WORK=tmp_path / "work", STUDY=tmp_path / "study", **size)
    results = tmp_path / "translation_quick_5.jsonl"
    names = {key.removeprefix("digit-tac3d-") for key in runs_of(results) if key.startswith("digit-tac3d-")}
    kinds = ("anytouch", "anytouch_between", "anytouch_layer_decay", "t3")
    both = {f"{name}-{tune}-0" for name in kinds for tune in ("frozen", "fine")}
    assert names == both | {"stage1-frozen-0", "pixels-scratch-0"}
    assert set(read_records(results)["overlap"].values()) == {"0"}
    stages = [path.name for path in (tmp_path / "study" / "trained").glob("stage1-*")]
    configs = [json.loads((tmp_path / "study" / "trained" / name / "config.json").read_text()) for name in stages]
    assert len(stages) == 2 and {one["run"]["steps"] for one in configs} == {5}  # AnyTouch's and T3-style
    assert "stage 1, T3-style's too, of 5 steps" in results.with_suffix(".md").read_text()
