"""Fine-tuning: what it keeps, what it writes, and that it never ends below its start."""

import json
from dataclasses import replace

import jax
import numpy as np
import pytest
from runs import run_config
from touch_world import make_touches
from weights_world import save_run

import anytouch_jax as at
from anytouch_jax.cli import app
from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.encoder.linear_head import LinearHead, load_head
from anytouch_jax.encoder.number_head import NumberHead
from anytouch_jax.errors import UserError
from anytouch_jax.finetuning.options import Recipe
from anytouch_jax.nn.functional import build
from anytouch_jax.weights.tree import flatten

# A network of random weights has to learn more than one that was trained.
FAST = Recipe(rate=3e-2, head_rate=3e-3, passes=60, batch=16)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Discs whose force decides their size: 148 touches of one frame, each of its own object."""
    folder = tmp_path_factory.mktemp("touches")
    touches = {"train": 120, "val": 16, "test": 12}
    return make_touches(folder, touches=touches, sensors=("digit",), each=1)


@pytest.fixture(scope="module")
def run(tmp_path_factory, data):
    """A run of four random features, which a linear head reads badly."""
    config = run_config(data)
    config = replace(config, model=replace(config.model, embed=4))
    params = build(config.model).init(jax.random.key(0))
    folder = tmp_path_factory.mktemp("runs") / "stage1"
    return save_run(folder, config, params, seen=["backgroundsight", "digit"])


@pytest.fixture(scope="module")
def tuned(tmp_path_factory, data, run):
    said = []
    states = []
    result = at.finetune(
        data,
        "force",
        out=tmp_path_factory.mktemp("tuned") / "mine",
        model=run,
        options=at.FinetuneOptions(recipe=FAST, minutes=5, augment=False),
        log=said.append,
        watch=states.append,
    )
    return result, said, states


def test_a_number_is_read_better_than_by_the_linear_head(tuned):
    result, said, states = tuned
    assert result.improved and result.after > result.before
    # Twelve other groups are few: the gain on them depends on the last bits of a machine.
    assert result.test["after"] > result.test["before"] - 0.05
    assert result.test["groups"] == 12
    assert said[-1] == result.sentence and "On held-out recordings" in said[-1]
    assert [one.left for one in states] == sorted((one.left for one in states), reverse=True)
    assert states[-1].before.endswith("mean absolute error")


def test_the_folder_is_an_encoder_with_its_head(tuned, data):
    """Features, numbers and intervals come out again as they were promised."""
    result, _, _ = tuned
    encoder = at.load_encoder(result.folder, engine="xla")
    head = at.load_head(result.folder)
    assert isinstance(head, NumberHead) and head.label == "force"
    head.check(str(result.folder), encoder.fingerprint, "both", 1)
    assert not encoder.measures and not encoder.others
    table = at.read_manifest(data)
    rows = np.flatnonzero(table.text_column("split") == "test")
    _, values = embed_rows(encoder, table, rows, pooling="both", log=lambda _: None)
    one = head.assess(values)
    truth = table.number_column("label.force")[rows]
    assert np.abs(one.value - truth).mean() == pytest.approx(-result.test["after"], rel=1e-3)
    assert np.mean((one.low <= truth) & (truth <= one.high)) >= 0.75
    about = json.loads((result.folder / "finetune.json").read_text())
    assert about["improved"] and about["options"]["label"] == "force"
    assert result.sentence.startswith(about["sentence"])


def test_commands_take_the_folder_with_its_head(tuned, data, tmp_path, capsys):
    result, _, _ = tuned
    words = ["embed", "--model", str(result.folder), "--data", str(data), "--out"]
    assert app.main([*words, str(tmp_path / "f.npz")]) == 0
    arrays = np.load(tmp_path / "f.npz")
    assert {"value", "low", "high", "novel"} <= {name.rpartition("/")[2] for name in arrays.files}
    assert arrays["features"].shape[1] == 8
    # Asked for other features, the command says that its head does not read them.
    assert app.main([*words, str(tmp_path / "g.npz"), "--pooling", "class"]) == 0
    assert "needs --pooling both" in capsys.readouterr().err
    assert app.main(["info", str(result.folder / "head.npz")]) == 0
    assert "force" in capsys.readouterr().out


def test_a_second_run_refuses_and_changes_nothing(tuned, data, run):
    result, _, _ = tuned
    before = {file.name: file.read_bytes() for file in result.folder.iterdir() if file.is_file()}
    with pytest.raises(UserError, match="fine-tuned before") as error:
        at.finetune(data, "force", out=result.folder, model=run)
    assert "\n" not in str(error.value)
    assert {
        file.name: file.read_bytes() for file in result.folder.iterdir() if file.is_file()
    } == before


def test_ctrl_c_keeps_the_best(data, run, tmp_path):
    scores = []

    def watch(state):
        if state.score and state.score != state.before:
            scores.append(state.score)
            raise KeyboardInterrupt

    options = at.FinetuneOptions(recipe=FAST, minutes=5, augment=False)
    result = at.finetune(
        data, "force", out=tmp_path / "cut", model=run, options=options, watch=watch, log=len
    )
    assert len(scores) == 1 and result.improved
    assert at.load_encoder(tmp_path / "cut").fingerprint == result.head.fingerprint


def test_ctrl_c_before_the_linear_head_leaves_nothing(data, run, tmp_path):
    def watch(state):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        at.finetune(data, "force", out=tmp_path / "none", model=run, watch=watch, log=len)
    assert list(tmp_path.iterdir()) == []


def test_where_nothing_is_better_the_linear_head_and_the_encoder_stay(data, run, tmp_path):
    """A rate that ruins the features: the folder has what there was, and says so."""
    said = []
    options = at.FinetuneOptions(
        recipe=replace(FAST, rate=30.0, head_rate=30.0, passes=4), minutes=5
    )
    result = at.finetune(
        data, "hardness", out=tmp_path / "kept", model=run, options=options, log=said.append
    )
    assert not result.improved and result.after == result.before
    assert "was not better" in said[-1] and "as it was" in said[-1]
    head = load_head(tmp_path / "kept")
    assert isinstance(head, LinearHead) and head.calibration is not None
    stored = flatten(at.load_encoder(tmp_path / "kept").params)
    for name, leaf in flatten(at.load_encoder(run).params).items():
        np.testing.assert_allclose(stored[name], leaf, rtol=1e-3, atol=1e-6, err_msg=name)


@pytest.mark.parametrize(
    ("label", "changes", "words"),
    [
        ("no_such", {}, "no column 'no_such'"),
        ("force", {"minutes": 0.0}, "minutes must be above 0"),
        ("object", {}, "No class of the held-out rows"),
    ],
)
def test_a_mistake_is_one_sentence_and_nothing_is_written(
    data, run, tmp_path, label, changes, words
):
    with pytest.raises(UserError, match=words):
        at.finetune(data, label, out=tmp_path / "x", model=run, log=len, **changes)
    assert list(tmp_path.iterdir()) == []
