"""`anytouch probe`: options that would do nothing are refused, before anything is read."""

from __future__ import annotations

import pytest
from touch_world import make_touches

from anytouch_jax.evaluate import feature_cache

BATTERY = "nothing without --tasks or --benchmark"
LABEL = "nothing beside --tasks or --benchmark"
BENCHMARK = "nothing beside --benchmark, which has the authors' settings"


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--train-units", "a"], f"--train-units does {BATTERY}; leave it out; or name tasks: --tasks all"),
        (["--heads", "knn", "--order", "shuffled"], f"--heads, --order do {BATTERY}; leave them out"),
        (["--test-units", "b", "--cache", "c"], f"--test-units, --cache do {BATTERY}"),
        (["--join", "sum", "--max-rows", "9"], f"--join, --max-rows do {BATTERY}"),
        (["--train-sensors", "digit", "--test-sensors", "digit"], f"--train-sensors, --test-sensors do {BATTERY}"),
        (["--tasks", "all", "--label", "slip"], f"--label does {LABEL}, which have labels and groups of their own"),
        (["--tasks", "all", "--group", "unit", "--leave-out", "object"], f"--group, --leave-out do {LABEL}"),
        (["--benchmark", "feel_grasp", "--where", "force", "1", "--sensor", "digit"], f"--where, --sensor do {LABEL}"),
        (["--benchmark", "feel_grasp", "--heads", "knn", "--frames", "3"], f"--frames, --heads do {BENCHMARK}"),
        (["--benchmark", "feel_grasp", "--pooling", "mean"], f"--pooling does {BENCHMARK}; leave it out"),
        (
            ["--benchmark", "feel_grasp", "--join", "sum", "--protocol", "published"],
            f"--join, --protocol do {BENCHMARK}",
        ),
        (
            ["--leave-out", "object", "--group", "unit", "--seeds", "3"],
            "--group, --seeds do nothing beside --leave-out",
        ),
        (["--leave-out", "object", "--protocol", "published"], "--protocol does nothing beside --leave-out"),
        (["--tasks", "slip", "--join", "concat"], "--join does nothing without --frames"),
        (["--benchmark", "feel_grasp", "--order", "shuffled"], "--order does nothing for stills"),
        (["--tasks", "all", "--frames", "1", "--order", "repeated"], "--order does nothing for stills"),
        (["--tasks", "all", "--cache", __file__], "test_probe.py is a file, not a folder; choose another --cache"),
        (["--tasks", "slip", "--frames", "0"], "--frames must be 1 or more, not 0"),
        (["--label", "slip", "--frames", "-1"], "--frames must be 1 or more, not -1"),
    ],
)
def test_what_would_do_nothing_is_refused(mistake, words, told):
    assert told in mistake("probe", "--data", "nowhere.csv", *words)


@pytest.fixture(scope="module")
def touches(tmp_path_factory):
    return make_touches(tmp_path_factory.mktemp("touches"), touches={"train": 4, "val": 4, "test": 4}, each=1)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--label", "object"], "class of test is in train"),
        (["--label", "force"], "a measured quantity"),
        (["--label", "split"], "on every row of train"),
        (["--tasks", "hardness", "--order", "shuffled"], "--order has no effect on stills"),
    ],
)
def test_a_label_that_cannot_be_probed_is_told_before_the_work(anytouch, touches, monkeypatch, words, told):
    monkeypatch.setattr(feature_cache.FeatureStore, "get", lambda *_, **__: pytest.fail("the work was begun"))
    said = anytouch("probe", "--data", touches, *words)
    assert said.status == 1 and told in said.err.splitlines()[-1] and "Traceback" not in said.err


@pytest.mark.parametrize(
    "words",
    [
        ["--label", "slip", "--frames", "3", "--pooling", "mean", "--protocol", "published", "--seeds", "2"],
        ["--leave-out", "object", "--where", "force", "1", "--sensor", "digit"],
        ["--tasks", "all", "--order", "shuffled", "--cache", "c", "--join", "sum", "--frames", "6", "--max-rows", "9"],
        ["--benchmark", "feel_grasp", "--train-sensors", "digit", "--seeds", "2", "--cache", "c"],
    ],
)
def test_what_is_used_is_not_refused(mistake, words):
    assert "nowhere.csv" in mistake("probe", "--data", "nowhere.csv", *words)  # the manifest is what is missing
