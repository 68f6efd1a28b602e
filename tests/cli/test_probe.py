import json

import pytest


def test_a_label_is_reported_on_test_and_written_as_json(
    tmp_path, world, tiny_run, anytouch, mistake
):
    words = ("probe", "label", "--data", world, "--model", tiny_run, "--seeds", 2)
    done = anytouch(*words, "--label", "object", "--no-controls", "--out", tmp_path / "probe.json")
    assert done.status == 0, done.err
    assert f"{tiny_run}: linear" in done.out and f"{tiny_run}: kNN" in done.out
    assert "raw pixels" not in done.out and "random" not in done.out
    assert json.loads((tmp_path / "probe.json").read_text())
    assert "'taste'" in mistake(*words, "--label", "taste")


@pytest.mark.parametrize(
    ("typed", "named"),
    [
        ("label --leave-out object --group unit --seeds 3", ["--group", "--seeds"]),
        ("label --leave-out object --protocol released", ["--protocol"]),
        ("label --train-sensor a --test-sensor b --seeds 3", ["--seeds", "--train-sensor"]),
        ("label --save h.npz --model a b", ["--save", "--model"]),
        ("label --save h.json --model a", ["--save", ".npz"]),
        ("label --model a --save h.npz --out h.npz", ["--save", "--out"]),
        ("label --out nowhere.csv/deep/p.json", ["nowhere.csv"]),
        ("tasks --cache afile", ["--cache", "afile"]),
        ("tasks --tasks slip --aggregation concat", ["--aggregation"]),
        ("tasks --frames 1 --order repeated", ["--order"]),
    ],
)
def test_options_that_do_not_go_together_are_named(mistake, tmp_path, monkeypatch, typed, named):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "afile").write_text("")
    command, *words = typed.split()
    sentence = mistake("probe", command, "--data", "nowhere.csv", *words)
    assert all(name in sentence for name in named), sentence


@pytest.mark.parametrize(
    "typed",
    [
        "label --label slip --frames 3 --pooling mean --protocol released --seeds 2",
        "label --leave-out object --where force 1 --sensor digit",
        "label --leave-out sequence --model a --save h.npz --coverage 0.8",
        "tasks --tasks all --order shuffled --cache c --aggregation sum --frames 6 --max-rows 9 "
        "--heads linear knn",
        "tasks --tasks slip force --train-sensors digit gelslim --test-units cam0_* b",
        "benchmark --benchmark feel_grasp --train-sensors digit --seeds 2 --cache c",
    ],
)
def test_options_that_go_together_reach_the_manifest(mistake, tmp_path, monkeypatch, typed):
    monkeypatch.chdir(tmp_path)
    command, *words = typed.split()
    # the manifest is missing
    assert "nowhere.csv" in mistake("probe", command, "--data", "nowhere.csv", *words)
