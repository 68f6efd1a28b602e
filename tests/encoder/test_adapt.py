import json

import jax
import numpy as np
import pytest
from runs import run_config
from touch_world import make_touches
from weights_world import save_run

from anytouch_jax.cli import app
from anytouch_jax.config import from_json
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.adapt import adapt, choose_frames, save
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import build
from anytouch_jax.weights import checkpoint
from anytouch_jax.weights.tree import flatten

RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Three sensors at the same places: digit and gelsight are known, gelslim stands for the new
    one.
    """
    return make_touches(
        tmp_path_factory.mktemp("touches"), touches={"train": 12, "val": 4}, frames=2, each=3
    )


@pytest.fixture(scope="module")
def table(data):
    return manifests.read(data)


@pytest.fixture(scope="module")
def run(tmp_path_factory, data):
    """A stage-1 run whose tokens matter: larger than at the start of training."""
    config = run_config(data)
    params = build(config.model).init(jax.random.key(0))
    params["touch"]["sensor_tokens"] = params["touch"]["sensor_tokens"] * 20
    return save_run(
        tmp_path_factory.mktemp("runs") / "stage1", config, params, seen=["gelsight", "digit"]
    )


@pytest.fixture(scope="module")
def fitted(run, table):
    said = []
    return adapt(
        run, table, "gelslim", frames=8, labels="hardness", steps=40, log=said.append
    ), said


def test_only_the_row_of_the_new_sensor_changes_and_the_loss_falls_on_other_frames(fitted, run):
    adapted, said = fitted
    before = flatten(checkpoint.load_params(run)[0])
    after = flatten(adapted.params)
    assert said == [] and before.keys() == after.keys()
    for name, array in before.items():
        if name != "touch/sensor_tokens":
            np.testing.assert_array_equal(np.asarray(after[name]), np.asarray(array), err_msg=name)
    tokens = np.asarray(after["touch/sensor_tokens"])
    old = np.asarray(before["touch/sensor_tokens"])
    changed = np.flatnonzero(np.any(tokens != old, axis=(1, 2)))
    # gelslim: a row of the table, but never seen
    assert changed.tolist() == [2]
    # it left the universal tokens
    assert np.abs(tokens[2] - old[9]).max() > 0.01
    assert adapted.measured == "val" and adapted.after < adapted.before
    assert len(adapted.losses) == 40 and np.isfinite(adapted.losses).all()


def test_the_result_is_a_run_that_embeds(fitted, run, tmp_path):
    adapted, _ = fitted
    save(adapted, run, tmp_path / "out")
    encoder = load_encoder(tmp_path / "out")
    stills = RNG.integers(0, 256, (2, 28, 28, 3), np.uint8)
    tokens = [one.params["touch"]["sensor_tokens"][2] for one in (encoder, adapted)]
    np.testing.assert_array_equal(*tokens)
    assert (
        np.abs(
            encoder.encode_touch(stills, "gelslim") - encoder.encode_touch(stills, "universal")
        ).max()
        > 1e-4
    )
    before = load_encoder(run)
    for sensor in ("digit", "universal", "duragel"):
        row = np.full(len(stills), before.config.model.sensors.index(sensor))
        np.testing.assert_array_equal(
            encoder.encode_touch(stills, row), before.encode_touch(stills, row)
        )
    about = checkpoint.read_metadata(tmp_path / "out")
    assert about["seen"] == ["gelsight", "digit", "gelslim"] and about["source"]["frames"] == 8
    assert from_json((tmp_path / "out" / "config.json").read_text()) == adapted.config
    lines = [
        json.loads(line) for line in (tmp_path / "out" / "metrics.jsonl").read_text().splitlines()
    ]
    assert [line["step"] for line in lines] == list(range(40)) and all(
        line["loss"] > 0 for line in lines
    )
    with pytest.raises(UserError, match="is not empty; give another --out"):
        save(adapted, run, tmp_path / "out")


def test_a_sensor_outside_the_table_gets_a_new_row(run, table, tmp_path):
    adapted = adapt(run, table, "my_gel", frames=0)
    assert adapted.config.model.sensors[-1] == "my_gel" and adapted.config.model.universal_row == 9
    tokens = np.asarray(adapted.params["touch"]["sensor_tokens"])
    assert tokens.shape[0] == 11
    # no frames: the universal tokens as they are
    np.testing.assert_array_equal(tokens[10], tokens[9])
    save(adapted, run, tmp_path / "out")
    stills = RNG.integers(0, 256, (2, 28, 28, 3), np.uint8)
    encoder = load_encoder(tmp_path / "out")
    np.testing.assert_array_equal(
        encoder.encode_touch(stills, "my_gel"), encoder.encode_touch(stills, "universal")
    )


def test_frames_come_from_as_many_recordings_as_there_are(table):
    rows = choose_frames(table, "gelslim", "train", 12)
    sequence = [table.value(row, "sequence") for row in rows]
    assert len(set(sequence)) == 12 and all(name.endswith("gelslim") for name in sequence)
    rows = choose_frames(table, "gelslim", "train", 15, seed=1)
    assert (
        len(set(rows.tolist())) == 15 and len({table.value(row, "sequence") for row in rows}) == 12
    )
    few = [choose_frames(table, "gelslim", "train", 5, seed=seed) for seed in (0, 1)]
    assert not np.array_equal(*few)
    with pytest.raises(UserError, match="'train' has 24 usable frames of gelslim, not 30"):
        choose_frames(table, "gelslim", "train", 30)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"labels": None}, "--labels"),
        ({"labels": "colour"}, "no column 'colour' or 'label.colour' for --labels"),
        ({"labels": "force"}, "a column of measurements"),
        ({"labels": "split"}, "must name classes"),
        ({"sensor": "digit"}, "was trained on digit"),
        ({"sensor": "tac3d"}, "no images"),
        ({"sensor": "universal"}, "serve all sensors"),
        ({"sensor": "my_gel"}, "'train' has 0 usable frames of my_gel"),
    ],
)
def test_mistakes_are_one_sentence(run, table, change, told):
    options = {"sensor": "gelslim", "frames": 4, "labels": "hardness"} | change
    with pytest.raises(UserError, match=told) as error:
        adapt(run, table, **options)
    assert "\n" not in str(error.value)


def test_an_adapted_run_is_written_whole_or_not_at_all(run, table, tmp_path, monkeypatch):
    adapted = adapt(run, table, "gelslim", frames=4, labels="hardness", steps=1)

    def full(*args):
        raise OSError(28, "No space left on device")

    (tmp_path / "out").mkdir()
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint.Checkpoints, "save", full)
        for name in ("out", "new"):
            with pytest.raises(OSError, match="No space left"):
                save(adapted, run, tmp_path / name)
    assert list(tmp_path.iterdir()) == [tmp_path / "out"] and not any((tmp_path / "out").iterdir())
    save(adapted, run, tmp_path / "out")  # the same command again
    assert checkpoint.load_params(tmp_path / "out")[1]


def test_the_command(run, data, tmp_path, capsys):
    words = f"adapt --model {run} --data {data} --sensor gelslim --out {tmp_path / 'o'} --frames"
    fit = "8 --labels hardness --steps 40"
    for more, status, said in (
        (fit, 0, "tokens of gelslim fitted to 8 frames. The loss on frames of split val"),
        (fit, 2, "is not empty"),
    ):
        assert app.main(f"{words} {more}".split()) == status
        assert said in "".join(capsys.readouterr())
    assert app.main(f"{words.replace('/o ', '/none ')} 0".split()) == 0
    assert "gelslim has the universal tokens" in capsys.readouterr().out
