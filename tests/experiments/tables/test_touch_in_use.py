"""`experiments/pouring.py`, `translation.py` and `named.py` at a toy size, and again from their JSON alone."""

from __future__ import annotations

import json
import runpy
import shutil

import pytest
from places import EXPERIMENTS

from anytouch_jax.errors import UserError

SCRIPTS = EXPERIMENTS


def visit(name, monkeypatch, **environment):
    for key, value in environment.items():
        monkeypatch.setenv(key, str(value))
    return runpy.run_path(str(SCRIPTS / ("tables/named.py" if name == "named" else f"{name}/study.py")))


@pytest.mark.parametrize("name", ["pouring", "translation", "translation_3000", "named"])
def test_the_committed_page_is_what_its_files_give(name, tmp_path, monkeypatch, capsys):
    shutil.copytree(SCRIPTS / "results" / name, tmp_path / name)
    script, _, steps = name.partition("_")
    visit(script, monkeypatch, TABLE=1, STEPS1=steps, OUT=tmp_path)
    assert (tmp_path / f"{name}.md").read_text() == (SCRIPTS / "results" / f"{name}.md").read_text()


@pytest.mark.parametrize(
    "changed", [{"size": 112}, {"subtracts": False}, {"pairs": "others"}, {"encoder": "runs/stage2 (weights 0)"}]
)
def test_runs_that_are_no_rivals_make_no_table(changed, tmp_path, monkeypatch):
    shutil.copytree(SCRIPTS / "results" / "translation", tmp_path / "translation")
    file = next((tmp_path / "translation").glob("*-anytouch-frozen-*.json"))
    found = json.loads(file.read_text())
    file.write_text(json.dumps(found | {"settings": found["settings"] | changed}))
    with pytest.raises(UserError, match="make no table together"):
        visit("translation", monkeypatch, TABLE=1, OUT=tmp_path)


def test_steps_of_stage_1_are_not_for_encoders_that_are_done(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="leave it out with RUNS"):
        visit("translation", monkeypatch, RUNS=f"anytouch={tmp_path}", STEPS1=5, OUT=tmp_path)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_pouring(tmp_path, tiny_run, monkeypatch, capsys):
    size = {"QUICK": 1, "TRIALS": 2, "DEMOS": 2, "TUNE": 1, "MODES": "frozen,fine-tuned", "OUT": tmp_path}
    visit("pouring", monkeypatch, RUNS=f"anytouch={tiny_run}", **size)
    out = capsys.readouterr().out
    assert "no run is given for row t3: it is left out" in out
    names = {path.stem for path in (tmp_path / "pouring-quick").glob("*.json")}
    learned = {f"{name}-{mode}-0" for name in ("none", "static", "anytouch") for mode in ("frozen", "fine-tuned")}
    assert names == learned | {"blind-bound-0", "count-bound-0", "load-bound-0", "expert-bound-0"}
    page = (tmp_path / "pouring-quick.md").read_text()
    assert (tmp_path / "figures" / "pouring.gif").exists() and "expert" in page
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "pouring-quick").iterdir()}
    visit("pouring", monkeypatch, TABLE=1)
    assert (tmp_path / "pouring-quick.md").read_text() == page
    assert before == {path: path.stat().st_mtime_ns for path in (tmp_path / "pouring-quick").iterdir()}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_translation(tmp_path, tiny_run, monkeypatch):
    size = {"QUICK": 1, "TOUCHES": 24, "STEPS": 2, "WORK": tmp_path / "work", "OUT": tmp_path}
    visit("translation", monkeypatch, RUNS=f"anytouch={tiny_run} t3={tiny_run}", **size)
    found = [json.loads(path.read_text()) for path in (tmp_path / "translation_quick").glob("*-*.json")]
    assert len(found) == 9 and all(one["error"] > 0 for one in found)
    page = (tmp_path / "translation_quick.md").read_text()
    assert "mean of the training targets" in page and "t3, frozen" in page and "over the same encoders" in page
    visit("translation", monkeypatch, TABLE=1)
    assert (tmp_path / "translation_quick.md").read_text() == page


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_translation_trains_encoders_that_never_met_the_objects_of_the_pairs(tmp_path, monkeypatch):
    size = {"QUICK": 1, "TOUCHES": 24, "STEPS": 2, "STEPS1": 5, "TUNE": "frozen,fine", "OUT": tmp_path}
    visit("translation", monkeypatch, WORK=tmp_path / "work", STUDY=tmp_path / "study", **size)
    folder = tmp_path / "translation_quick_5"
    names = {path.stem.split("tac3d-", 1)[1] for path in folder.glob("digit-tac3d-*.json")}
    kinds = ("anytouch", "anytouch_between", "anytouch_layer_decay", "t3")
    both = {f"{name}-{tune}-0" for name in kinds for tune in ("frozen", "fine")}
    assert names == both | {"stage1-frozen-0", "pixels-scratch-0"}
    assert set(json.loads((folder / "overlap.json").read_text()).values()) == {"0"}
    stages = [path.name for path in (tmp_path / "study" / "trained").glob("stage1-*")]
    configs = [json.loads((tmp_path / "study" / "trained" / name / "config.json").read_text()) for name in stages]
    assert len(stages) == 2 and {one["run"]["steps"] for one in configs} == {5}  # AnyTouch's and T3-style
    assert "stage 1, T3-style's too, of 5 steps" in folder.with_suffix(".md").read_text()


@pytest.mark.slow
def test_named(tmp_path, monkeypatch, capsys):
    """What is trained with labels tells its own frames better than the commonest answer does; it is done once."""
    size = {"QUICK": 1, "STEPS": 60, "OUT": tmp_path, "STUDY": tmp_path / "study"}
    visit("named", monkeypatch, **size)
    found = json.loads((tmp_path / "named_quick" / "0.json").read_text())
    assert found["scores"]["indenter"]["train"] > 0.15
    features = {"AnyTouch", "trained with labels", "untrained", "pixels", "commonest"}
    assert set(found["probes"]["hardness"]["right"]) == features
    network = found["convolutional, with labels"]
    assert network["scores"]["indenter"]["train"] > 0.15
    assert network["probes"]["hardness"]["objects"] == found["probes"]["hardness"]["objects"]
    page, before = (tmp_path / "named_quick.md").read_text(), (tmp_path / "named_quick" / "0.json").stat().st_mtime_ns
    visit("named", monkeypatch, **size)
    assert (tmp_path / "named_quick.md").read_text() == page
    assert (tmp_path / "named_quick" / "0.json").stat().st_mtime_ns == before
    visit("named", monkeypatch, CONVOLUTIONS=1, **size)  # other encoders, the same network
    inside = json.loads((tmp_path / "named_convolutional_quick" / "0.json").read_text())
    assert inside["anytouch"] != found["anytouch"] and inside["probes"] != found["probes"]
    assert inside["convolutional, with labels"] == network
    assert "convolutions inside its patches" in (tmp_path / "named_convolutional_quick.md").read_text()
    assert (tmp_path / "named_quick.md").read_text() == page
