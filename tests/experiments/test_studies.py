import json

import pytest

from experiments.pouring import study as pouring
from experiments.records import read_records
from experiments.translation import study as translation


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_pouring(script, tmp_path, tiny_run):
    out = tmp_path / "pouring.jsonl"
    sizes = ["--seeds", 0, "--trials", 2, "--demos", 2, "--tune", 1]
    words = [*sizes, "--runs", f"anytouch={tiny_run}", "--out", out]
    first = script(pouring, *words)
    assert first.status == 0 and "no run is given for row t3: it is left out" in first.out, (
        first.err
    )
    learned = {
        f"{name}-{mode}-0"
        for name in ("none", "static", "anytouch")
        for mode in ("frozen", "fine-tuned")
    }
    assert {*read_records(out)} == learned | {"blind-bound-0", "load-bound-0", "expert-bound-0"}
    assert script(pouring, *words).out.splitlines() == [
        "no run is given for row t3: it is left out"
    ]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_translation_trains_encoders_that_never_met_the_objects_of_the_pairs(script, tmp_path):
    out = tmp_path / "out.jsonl"
    study = tmp_path / "study"
    words = ["--quick", "--touches", 24, "--steps", 2, "--steps1", 5, "--tune", "frozen", "fine"]
    assert (
        script(
            translation, *words, "--work", tmp_path / "work", "--study", study, "--out", out
        ).status
        == 0
    )
    records = read_records(out)
    assert all(one["error"] > 0 for one in records.values())
    names = {key.removeprefix("digit-tac3d-") for key in records if key.startswith("digit-tac3d-")}
    both = {f"{name}-{tune}-0" for name in ("anytouch", "t3") for tune in ("frozen", "fine")}
    assert names == both | {"stage1-frozen-0", "pixels-scratch-0"}
    stages = [path.name for path in (study / "trained").glob("stage1-*")]
    configs = [
        json.loads((study / "trained" / name / "config.json").read_text()) for name in stages
    ]
    # AnyTouch's and T3-style
    assert len(stages) == 2 and {one["run"]["steps"] for one in configs} == {5}


def test_mistakes_are_one_sentence(script, tmp_path):
    for study, words, named in (
        (
            pouring,
            ["--runs", f"mine={tmp_path}"],
            "--runs names none, t3, static, anytouch, not mine",
        ),
        (pouring, ["--runs", "t3=gone"], "no run gone"),
        (pouring, ["--demos", "0"], "--demos must be 1 or more, not 0"),
        (translation, ["--runs", f"t3={tmp_path}", "--steps1", "5"], "--steps1"),
    ):
        found = script(study, *words)
        assert found.status == 2 and named in found.err and len(found.err.splitlines()) == 1
