import json

import pytest
from touch_world import make_touches


@pytest.fixture(scope="module")
def touches(tmp_path_factory):
    return make_touches(tmp_path_factory.mktemp("touches"), touches={"train": 4, "val": 4, "test": 4}, each=1)


def test_a_label_is_reported_on_test_and_written_as_json(tmp_path, world, tiny_run, anytouch, mistake):
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
        ("label --leave-out object --protocol published", ["--protocol"]),
        ("label --leave-out object --model a --save h.npz", ["--save"]),
        ("label --save h.npz --model a b", ["--save", "--model"]),
        ("label --save h.json --model a", ["--save", ".npz"]),
        ("label --model a --save h.npz --out h.npz", ["--save", "--out"]), ("label --frames -1", ["--frames"]),
        ("label --seeds -3", ["--seeds"]), ("label --out nowhere.csv/deep/p.json", ["nowhere.csv"]),
        ("tasks --tasks slip --join concat", ["--join"]), ("tasks --frames 1 --order repeated", ["--order"]),
        ("tasks --cache afile", ["--cache", "afile"]), ("tasks --frames 0", ["--frames"]),
        ("tasks --max-rows 0", ["--max-rows"]),
    ],
)  # fmt: skip
def test_options_that_do_not_go_together_are_named(mistake, tmp_path, monkeypatch, typed, named):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "afile").write_text("")
    command, *words = typed.split()
    sentence = mistake("probe", command, "--data", "nowhere.csv", *words)
    assert all(name in sentence for name in named), sentence


@pytest.mark.parametrize(
    "typed",
    [
        "label --label slip --frames 3 --pooling mean --protocol published --seeds 2",
        "label --leave-out object --where force 1 --sensor digit",
        "tasks --tasks all --order shuffled --cache c --join sum --frames 6 --max-rows 9 --heads linear knn",
        "tasks --tasks slip force --train-sensors digit gelslim --test-units cam0_* b",
        "benchmark --benchmark feel_grasp --train-sensors digit --seeds 2 --cache c",
    ],
)
def test_options_that_go_together_reach_the_manifest(mistake, tmp_path, monkeypatch, typed):
    monkeypatch.chdir(tmp_path)
    command, *words = typed.split()
    assert "nowhere.csv" in mistake("probe", command, "--data", "nowhere.csv", *words)  # the manifest is missing


@pytest.mark.parametrize(
    ("typed", "named"),
    [
        ("label --label object", "train"),  # whole objects are held out
        ("label --label force", "force"),
        ("label --label split", "label"),
        ("label --label object --where nothing 1", "nothing"),
        ("label --label object --sensor xyz", "xyz"),
        ("tasks --tasks hardness --order shuffled", "--order"),
        ("tasks --tasks taste", "taste"),
        ("benchmark --benchmark mnist", "mnist"),
    ],
)
def test_a_label_or_a_task_that_cannot_be_probed_is_named_before_the_work(anytouch, touches, monkeypatch, typed, named):
    monkeypatch.setattr("anytouch_jax.evaluate.feature_cache.FeatureStore.get", None)
    command, *words = typed.split()
    done = anytouch("probe", command, "--data", touches, *words)
    assert done.status == 2 and named in done.err.splitlines()[-1] and "Traceback" not in done.err


def test_unknown_heads_are_a_usage_error(anytouch):
    done = anytouch("probe", "tasks", "--data", "nowhere.csv", "--heads", "gradien")
    assert done.status == 2 and "gradien" in done.err
