"""Studies at toy sizes: what they record, and that nothing is done twice (slow)."""

from __future__ import annotations

import json

import pytest
from scripts import visit
from touch_world import make_touches

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from experiments.records import read_records, write_record
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
    assert (tmp_path / "figures" / "pouring_frames.png").exists()
    before = results.stat().st_mtime_ns
    visit(monkeypatch, "pouring/study.py")
    assert results.stat().st_mtime_ns == before


def test_steps_of_stage_1_are_not_for_encoders_that_are_done(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="leave it out with RUNS"):
        visit(monkeypatch, "translation/study.py", RUNS=f"anytouch={tmp_path}", STEPS1=5, OUT=tmp_path)


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
    assert set(read_records(results)["overlap"].values()) == {"0"}
    stages = [path.name for path in (tmp_path / "study" / "trained").glob("stage1-*")]
    configs = [json.loads((tmp_path / "study" / "trained" / name / "config.json").read_text()) for name in stages]
    assert len(stages) == 2 and {one["run"]["steps"] for one in configs} == {5}  # AnyTouch's and T3-style


@pytest.mark.slow
def test_a_trial_from_data_to_page(tmp_path, monkeypatch, capsys):
    small = {"TOUCHES": 220, "MORE": 8, "OBJECTS": 60, "STEPS1": 1, "STEPS2": 1, "SEEDS": 0, "GRADES": "fine"}
    visit(monkeypatch, "tables/teaching.py", WORK=tmp_path / "work", OUT=tmp_path / "out", **small)
    assert set(read_records(tmp_path / "out" / "teaching.jsonl")["fine-0"]["probes"]) > {"indenter", "material"}
    written = (tmp_path / "out" / "teaching.jsonl").stat().st_mtime_ns
    visit(
        monkeypatch, "tables/teaching.py", WORK=tmp_path / "work", OUT=tmp_path / "out", **small
    )  # what is there is not done again
    assert (tmp_path / "out" / "teaching.jsonl").stat().st_mtime_ns == written


@pytest.mark.slow
def test_named(tmp_path, monkeypatch, capsys):
    """Training with labels predicts its own frames better than the commonest answer does; it is done once."""
    size = {"QUICK": 1, "STEPS": 60, "OUT": tmp_path, "STUDY": tmp_path / "study"}
    visit(monkeypatch, "tables/caption_probes.py", **size)
    result = read_records(tmp_path / "named_quick.jsonl")["0"]
    assert result["scores"]["indenter"]["train"] > 0.15
    features = {"AnyTouch", "trained with labels", "untrained", "pixels", "commonest"}
    assert set(result["probes"]["hardness"]["right"]) == features
    network = result["convolutional, with labels"]
    assert network["scores"]["indenter"]["train"] > 0.15
    assert network["probes"]["hardness"]["objects"] == result["probes"]["hardness"]["objects"]
    before = (tmp_path / "named_quick.jsonl").stat().st_mtime_ns
    visit(monkeypatch, "tables/caption_probes.py", **size)
    assert (tmp_path / "named_quick.jsonl").stat().st_mtime_ns == before
    visit(monkeypatch, "tables/caption_probes.py", CONVOLUTIONS=1, **size)  # other encoders, the same network
    inside = read_records(tmp_path / "named_convolutional_quick.jsonl")["0"]
    assert inside["anytouch"] != result["anytouch"] and inside["probes"] != result["probes"]
    assert inside["convolutional, with labels"] == network


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
    places = {"RUN": tiny_run, "DATA": file, "OUT": tmp_path / "out"}
    visit(monkeypatch, "tables/long_clips.py", **places)
    results = tmp_path / "out" / "long_clips.jsonl"
    records = read_records(results)
    lengths = ["1-mean", "3-mean", "5-concat", "5-mean", "5-sum", "7-concat", "7-mean", "7-sum"]
    assert [*records] == [*lengths, "time"]
    assert len({json.dumps([task["test"] for task in records[key]["tasks"].values()]) for key in lengths}) == 1
    write_record(results, "time", records["time"] | {"machine": "of the first call"})
    visit(monkeypatch, "tables/long_clips.py")  # what is there is not measured again
    assert read_records(results)["time"]["machine"] == "of the first call"
