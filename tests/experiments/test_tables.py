import dataclasses
import json
import re
from types import SimpleNamespace

import pytest
import synthetic

from anytouch_jax.data.manifest import manifest as manifests
from experiments.records import read_records
from experiments.tables import plan
from experiments.tables import run as matrix
from experiments.tables import work as works
from experiments.tables.work import DONE, Work

LEAVES = plan.leaves(plan.FULL)
BY_NAME = {(leaf.question, leaf.name, leaf.seed): leaf for leaf in LEAVES}


def stages(question: str, name: str, seed: int = 0) -> dict[int, str]:
    return {one.config.stage: one.key for one in BY_NAME[question, name, seed].trainings}


def test_one_stage_1_serves_all_that_start_from_it():
    whole = stages("q3", "anytouch")
    for name in ("anytouch", "no_text", "no_vision", "no_text_aligned", "no_matching", "no_stage2"):
        assert stages("ablations", name)[1] == whole[1], name
    assert stages("q2", "masked") == {1: whole[1]} and stages("q2", "matched") == whole
    # one model under the names of two tables
    assert stages("q3", "static_only") == stages("ablations", "no_dynamic")
    for other in (
        stages("ablations", "no_universal"),
        stages("ablations", "no_dynamic"),
        stages("q3", "t3"),
    ):
        assert other[1] != whole[1]
    assert stages("q3", "anytouch", 1)[1] != whole[1]
    second = {
        stages("ablations", name)[2]
        for name in ("anytouch", "no_text", "no_vision", "no_matching", "no_stage1")
    }
    assert len(second) == 5


def test_the_unseen_sensor_is_in_no_training():
    for leaf in LEAVES:
        for one in leaf.trainings:
            names = [*one.config.data.manifests, *one.config.model.sensors]
            assert not any(plan.UNSEEN in name for name in names), leaf.key


def test_an_identity_is_of_one_run_and_hangs_on_the_simulator_and_not_on_the_name_of_a_size(
    monkeypatch,
):
    again = {leaf.key: leaf.identity for leaf in plan.leaves(plan.FULL)}
    assert len(again) == len(set(again.values())) == len(LEAVES)
    assert again == {leaf.key: leaf.identity for leaf in LEAVES}
    named = plan.leaves(dataclasses.replace(plan.FULL, name="changed", seeds=(0, 1, 2, 3)))
    assert again.items() <= {leaf.key: leaf.identity for leaf in named}.items()
    longer = plan.leaves(dataclasses.replace(plan.FULL, steps1=181))
    assert not {leaf.identity for leaf in longer} & set(again.values())
    monkeypatch.setattr("anytouch_jax.sim.dataset.VERSION", plan.simulator() + 1)
    assert not {leaf.identity for leaf in plan.leaves(plan.FULL)} & set(again.values())


LEAF = next(leaf for leaf in plan.leaves(plan.QUICK) if leaf.name == "+".join(plan.SENSORS[:2]))
FIRST = LEAF.trainings[0]


def write_data(folder, text):
    """Both sensors' manifests with a row of `text`, and every data set marked as made."""
    for name in LEAF.model.manifests:
        path = folder / f"{name}.parquet"
        columns = {
            "path": ["a.jpg"],
            "sensor": ["digit"],
            "sequence": ["a"],
            "frame_index": [0],
            "split": ["train"],
        }
        manifests.write(manifests.from_columns(columns | {"text": [text]}, path), path)
    for one in plan.scenes(LEAF.size):
        (folder / one.name).mkdir(exist_ok=True)
        (folder / one.name / DONE).write_text(
            json.dumps({"of": works._of(one, LEAF.size), "seconds": 1})
        )


def test_a_training_on_other_data_is_not_finished_and_starts_again(tmp_path, monkeypatch):
    kept: list[bool] = []

    def pretrain(config, run, *, init, log):
        kept.append((run / "weights").exists())
        (run / "weights").touch()
        return SimpleNamespace(interrupted=None, resumed=0)

    monkeypatch.setattr(works, "pretrain", pretrain)
    write_data(tmp_path, "one")
    work = Work(tmp_path, log=(lines := []).append)
    sets = {"own", "fine", "coarse", "other"}
    assert work.ready(LEAF) == sets
    for one in LEAF.trainings:
        work.train(one)
    assert work.ready(LEAF) == sets | {one.key for one in LEAF.trainings}
    write_data(tmp_path, "two")
    assert work.ready(LEAF) == sets
    work.train(FIRST)
    assert kept[-1] is False  # nothing is left of the first one
    assert f"  {FIRST.key} was trained on other data: it starts again" in lines
    assert work.ready(LEAF) == sets | {FIRST.key}


def test_tables_are_rendered_from_the_files_alone(tmp_path, capsys):
    leaves = [leaf for leaf in plan.leaves(plan.FULL) if leaf.question == "q1"]
    synthetic.write(tmp_path / "matrix.jsonl", leaves)
    assert matrix.main(["--render", "--out", str(tmp_path), "--work", str(tmp_path / "never")]) == 0
    text = (tmp_path / "sensors.md").read_text()
    assert (
        str(tmp_path / "sensors.md") in capsys.readouterr().out
        and not (tmp_path / "never").exists()
    )
    assert "| material | gelsight | 50.0 [50.0, 50.0] | - | - |" in text


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--set", "depth=3"], "--set has no setting called depth. Choose from name, own, "),
        (["--set", "steps1=many"], "--set.steps1 must be int, not 'many'"),
        (["--set", "own=0"], "--set own must be 1 or more, not 0"),
        (["--set", "match_head=foo"], "--set.match_head must be one of mlp, cosine, none"),
        (["--only", "q9"], "there is no question 'q9'; choose among q2, q3"),
    ],
)
def test_mistakes_are_one_sentence(words, sentence, capsys):
    assert matrix.main(["--plan", *words]) == 2
    error = capsys.readouterr().err
    assert sentence in error and len(error.splitlines()) == 1


def test_objects_held_out_of_one_data_set_are_held_out_of_the_other(tmp_path, capsys):
    for size in (plan.FULL, plan.QUICK):
        works.check_objects(size)
    for changes in (["own=150"], ["coarse=100", "objects=180"]):
        words = ["--work", str(tmp_path / "work"), "--set", *changes]
        assert matrix.main(words) == 2
        error = capsys.readouterr().err
        assert re.search(
            r"the object .* would be in \w+ of own and in \w+ of (fine|coarse): give both", error
        )
        assert len(error.splitlines()) == 1 and not (tmp_path / "work").exists()
        mended = int(re.search(r"--set objects=(\d+)", error).group(1))
        works.check_objects(matrix.size_of(False, [*changes, f"objects={mended}"]))


def test_results_of_another_simulator_or_size_are_never_mixed_nor_written_over(tmp_path, capsys):
    words = ["--quick", "--work", str(tmp_path / "work"), "--out", str(tmp_path)]
    path = tmp_path / "matrix.jsonl"
    leaves = plan.leaves(plan.QUICK)
    settings = plan.settings(plan.QUICK)
    for change in ({"simulator": 1}, {"settings": settings | {"steps1": 999}}):
        synthetic.write(path, leaves[:2])
        synthetic.change(path, leaves[1].key, **change)
        before = path.read_text()
        assert matrix.main(words) == 2
        error = capsys.readouterr().err
        assert leaves[1].question in error and "OUT=" in error and len(error.splitlines()) == 1
        assert path.read_text() == before and not (tmp_path / "work").exists()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_the_whole_way_at_the_smallest_size(tmp_path, capsys):
    sizes = {
        "own": 24,
        "fine": 24,
        "coarse": 24,
        "other": 24,
        "objects": 24,
        "frames": 6,
        "steps1": 2,
        "steps2": 2,
    }
    words = ["--quick", "--set", *(f"{name}={number}" for name, number in sizes.items())]
    words += ["--only", "q2", "--work", str(tmp_path / "work"), "--out", str(tmp_path / "out")]
    assert matrix.main(words) == 0, capsys.readouterr().err
    records = read_records(tmp_path / "out" / "matrix.jsonl")
    ways = ("aligned", "contact", "masked", "matched", "matched_mlp", "pixels", "untrained")
    assert [*records] == [f"q2-{way}-0" for way in ways]
    stored = records["q2-matched-0"]
    assert [one["stage"] for one in stored["trained"]] == [1, 2] and stored["trained"][0]["config"][
        "run"
    ]["steps"] == 2
    assert all(len(value) == 64 for value in stored["data"].values()) and stored["machine"]
    assert {row["task"] for row in stored["rows"]} >= {"top-1", "silhouette by sensor"} and len(
        stored["points"]
    ) > 4
    assert records["q2-untrained-0"]["untrained"]["model"]["embed"] == 32
    assert records["q2-pixels-0"]["untrained"] is None
    trained = sorted((tmp_path / "work" / "trained").iterdir())
    assert len(trained) == 4  # one stage 1, three stages 2
    capsys.readouterr()
    assert matrix.main(words) == 0  # all is there
    assert "0 runs made, 7 were there, 0 failed" in capsys.readouterr().out
    assert (tmp_path / "out" / "space.md").exists() and (
        tmp_path / "out" / "figures" / "space.png"
    ).exists()
