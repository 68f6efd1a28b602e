import re

import pytest
import synthetic

from experiments.records import read_records
from experiments.tables import plan, work
from experiments.tables import run as matrix


def test_tables_are_rendered_from_the_files_alone(tmp_path, capsys):
    leaves = [leaf for leaf in plan.leaves(plan.FULL) if leaf.question == "q1"]
    synthetic.write(tmp_path / "matrix.jsonl", leaves)
    assert matrix.main(["--render", "--out", str(tmp_path), "--work", str(tmp_path / "never")]) == 0
    text = (tmp_path / "sensors.md").read_text()
    assert str(tmp_path / "sensors.md") in capsys.readouterr().out and not (tmp_path / "never").exists()
    assert "| material | gelsight | 50.0 [50.0, 50.0] | - | - |" in text


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--set", "depth=3"], "--set depth=3: choose among own, "),
        (["--set", "steps1=many"], "'many' is no number"),
        (["--set", "own=0"], "--set own=0: 1 or more"),
        (["--set", "match_head=foo"], "--set match_head=foo: choose among mlp, cosine, none"),
        (["--set", "seeds=0,0,1"], "--set seeds=0,0,1: each seed once"),
        (["--only", "q9"], "there is no question 'q9'; choose among q2, q3"),
    ],
)
def test_mistakes_are_one_sentence(words, sentence, capsys):
    assert matrix.main(["--plan", *words]) == 2
    error = capsys.readouterr().err
    assert sentence in error and len(error.splitlines()) == 1


def test_objects_held_out_of_one_data_set_are_held_out_of_the_other(tmp_path, capsys):
    for size in (plan.FULL, plan.QUICK):
        work.check_objects(size)
    for changes in (["own=150"], ["coarse=100", "objects=180"]):
        words = ["--work", str(tmp_path / "work"), "--set", *changes]
        assert matrix.main(words) == 2
        error = capsys.readouterr().err
        assert re.search(r"the object .* would be in \w+ of own and in \w+ of (fine|coarse): give both", error)
        assert len(error.splitlines()) == 1 and not (tmp_path / "work").exists()
        mended = int(re.search(r"--set objects=(\d+)", error).group(1))
        work.check_objects(matrix.size_of(False, [*changes, f"objects={mended}"]))


def test_results_of_another_simulator_or_size_are_never_mixed_nor_written_over(tmp_path, capsys):
    words = ["--quick", "--work", str(tmp_path / "work"), "--out", str(tmp_path)]
    path, leaves = tmp_path / "matrix.jsonl", plan.leaves(plan.QUICK)
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
    sizes = {"own": 24, "fine": 24, "coarse": 24, "other": 24, "objects": 24, "frames": 6, "steps1": 2, "steps2": 2}
    words = ["--quick", "--set", *(f"{name}={number}" for name, number in sizes.items())]
    words += ["--only", "q2", "--work", str(tmp_path / "work"), "--out", str(tmp_path / "out")]
    assert matrix.main(words) == 0, capsys.readouterr().err
    records = read_records(tmp_path / "out" / "matrix.jsonl")
    ways = ("aligned", "contact", "masked", "matched", "matched_mlp", "pixels", "untrained")
    assert [*records] == [f"q2-{way}-0" for way in ways]
    stored = records["q2-matched-0"]
    assert [one["stage"] for one in stored["trained"]] == [1, 2] and stored["trained"][0]["config"]["run"]["steps"] == 2
    assert all(len(value) == 64 for value in stored["data"].values()) and stored["machine"] and stored["source"]
    assert {row["task"] for row in stored["rows"]} >= {"top-1", "silhouette by sensor"} and len(stored["points"]) > 4
    assert records["q2-untrained-0"]["untrained"]["model"]["embed"] == 32
    assert records["q2-pixels-0"]["untrained"] is None
    trained = sorted((tmp_path / "work" / "trained").iterdir())
    assert len(trained) == 4  # one stage 1, three stages 2
    capsys.readouterr()
    assert matrix.main(words) == 0  # all is there
    assert "0 runs made, 7 were there, 0 failed" in capsys.readouterr().out
    assert (tmp_path / "out" / "space.md").exists() and (tmp_path / "out" / "figures" / "space.png").exists()
