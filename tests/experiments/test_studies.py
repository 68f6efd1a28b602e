import json

import pytest
from scripts import visit

from experiments.records import read_records
from experiments.translation.settings import runs_of


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_pouring(tmp_path, tiny_run, monkeypatch, capsys):
    size = {"QUICK": 1, "TRIALS": 2, "DEMOS": 2, "TUNE": 1, "MODES": "frozen,fine-tuned", "OUT": tmp_path}
    visit(monkeypatch, "pouring/study.py", RUNS=f"anytouch={tiny_run}", **size)
    out = capsys.readouterr().out
    assert "no run is given for row t3: it is left out" in out
    results = tmp_path / "pouring-quick.jsonl"
    learned = {f"{name}-{mode}-0" for name in ("none", "static", "anytouch") for mode in ("frozen", "fine-tuned")}
    assert {*read_records(results)} == learned | {"blind-bound-0", "count-bound-0", "load-bound-0", "expert-bound-0"}
    before = results.stat().st_mtime_ns
    visit(monkeypatch, "pouring/study.py")
    assert results.stat().st_mtime_ns == before


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_translation(tmp_path, tiny_run, monkeypatch):
    size = {"QUICK": 1, "TOUCHES": 24, "STEPS": 2, "WORK": tmp_path / "work", "OUT": tmp_path}
    visit(monkeypatch, "translation/study.py", RUNS=f"anytouch={tiny_run} t3={tiny_run}", **size)
    result = list(runs_of(tmp_path / "translation_quick.jsonl").values())
    assert len(result) == 9 and all(one["error"] > 0 for one in result)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_translation_trains_encoders_that_never_met_the_objects_of_the_pairs(tmp_path, monkeypatch):
    size = {"QUICK": 1, "TOUCHES": 24, "STEPS": 2, "STEPS1": 5, "TUNE": "frozen,fine", "OUT": tmp_path}
    visit(monkeypatch, "translation/study.py", WORK=tmp_path / "work", STUDY=tmp_path / "study", **size)
    results = tmp_path / "translation_quick_5.jsonl"
    names = {key.removeprefix("digit-tac3d-") for key in runs_of(results) if key.startswith("digit-tac3d-")}
    kinds = ("anytouch", "anytouch_between", "anytouch_layer_decay", "t3")
    both = {f"{name}-{tune}-0" for name in kinds for tune in ("frozen", "fine")}
    assert names == both | {"stage1-frozen-0", "pixels-scratch-0"}
    stages = [path.name for path in (tmp_path / "study" / "trained").glob("stage1-*")]
    configs = [json.loads((tmp_path / "study" / "trained" / name / "config.json").read_text()) for name in stages]
    assert len(stages) == 2 and {one["run"]["steps"] for one in configs} == {5}  # AnyTouch's and T3-style
