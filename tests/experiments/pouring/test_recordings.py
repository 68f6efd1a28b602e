"""Recorded runs of pouring: what is written is read, mistakes are named, a policy on disk acts as the one that learned.

The recordings are those of the simulation: real ones have the same form.
"""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from tiny_models import tiny_config

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.encoder import random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.weights.compatible import serve_unseen
from experiments.pouring import policy as pouring_policy
from experiments.pouring import recordings
from experiments.pouring import trials as pouring
from experiments.pouring.physics import POUR, RETRACT, WAIT, Task
from experiments.pouring.policy import Learning

pytestmark = pytest.mark.slow  # the fixture renders demonstrations

SIDE, COUNT = 28, 4
TASK = replace(Task(), limit=9)
FAST = Learning(steps=20, width=8, tune_steps=2, tune_runs=2)


@pytest.fixture(scope="module")
def shown() -> pouring.Trials:
    return pouring_policy.demonstrate(TASK, 0, COUNT, side=SIDE)


@pytest.fixture(scope="module")
def manifest(shown, tmp_path_factory):
    return recordings.write(tmp_path_factory.mktemp("recordings"), shown, TASK)


@pytest.fixture(scope="module")
def encoder():
    config = tiny_config()
    return random_encoder(replace(config, data=replace(config.data, background="subtract")))


def changed(manifest, folder, **columns):
    """The manifest with other columns, next to the same pictures."""
    table = manifests.read(manifest)
    cells = {name: table.column(name).to_pylist() for name in table.table.column_names}
    for name, change in columns.items():
        cells[name] = change(cells[name])
    path = manifest.parent / f"{folder}.parquet"
    manifests.write(manifests.from_columns(cells, path), path)
    return path


def test_what_is_written_is_read(shown, manifest):
    result = recordings.read(manifest, SIDE)
    assert result.sensor == "gelsight_mini" and result.test.tolist() == [False, False, False, True]
    np.testing.assert_array_equal(result.trials.steps, shown.steps)
    taken = shown.taken
    for name in ("actions", "choices", "frames"):
        np.testing.assert_array_equal(getattr(result.trials, name)[taken], getattr(shown, name)[taken])
    assert np.isnan(result.trials.mass).all()  # no policy gets the mass
    assert pq.read_table(manifest)["label.mass"].to_pylist()[0] == pytest.approx(float(shown.mass[0, 0]))


def test_runs_of_the_test_come_last_and_parts_are_no_copies(shown, manifest):
    first = int(shown.steps[0])  # the first run is the test's, not the last
    path = changed(manifest, "turned", split=lambda x: ["test"] * first + ["train"] * (len(x) - first))
    result = recordings.read(path, SIDE)
    assert result.test.tolist() == [False, False, False, True]
    np.testing.assert_array_equal(result.trials.steps, [*shown.steps[1:], shown.steps[0]])
    learned, unseen = result.part(False), result.part(True)
    assert len(learned.steps) == COUNT - 1 and unseen.steps.tolist() == [first]
    np.testing.assert_array_equal(unseen.frames[:first, 0], shown.frames[:first, 0])
    for part in (learned, unseen):
        assert np.shares_memory(part.frames, result.trials.frames)


def test_what_is_unused_teaches_nobody_and_an_empty_choice_is_the_action(shown, manifest):
    first = int(shown.steps[0])
    path = changed(manifest, "part", **{
        "split": lambda x: ["unused"] * first + x[first:], "label.choice": lambda x: [None] * len(x),
    })  # fmt: skip
    result = recordings.read(path, SIDE)
    assert len(result.trials.steps) == COUNT - 1
    np.testing.assert_array_equal(result.trials.choices, result.trials.actions)


def test_recordings_teach_what_the_demonstrations_teach(shown, manifest, encoder):
    result = recordings.read(manifest, SIDE)
    direct = pouring_policy.learn_frozen(encoder, result._replace(trials=shown).part(False), FAST, stills=False)
    read = pouring_policy.learn_frozen(encoder, result.part(False), FAST, stills=False)
    for a, b in zip(direct.head.layers, read.head.layers, strict=True):
        np.testing.assert_array_equal(a[0], b[0])


@pytest.mark.parametrize("stills", [False, True])
def test_a_policy_on_disk_acts_as_the_one_that_learned(shown, manifest, encoder, tmp_path, stills):
    result = recordings.read(manifest, SIDE)
    policy = pouring_policy.learn_frozen(encoder, result.part(False), FAST, stills=stills, sensor=result.sensor)
    policy = pouring_policy.fine_tune(policy, result.part(False), FAST)
    recordings.save_policy(tmp_path, policy)
    again = recordings.load_policy(tmp_path)
    lines = []
    for one in (policy, again):
        one.begin(COUNT)
        lines.append(np.stack([one.act(frames) for frames in shown.frames]))
    np.testing.assert_array_equal(*lines)
    assert again.stills == stills and again.sensor == "gelsight_mini" and again.encoder.subtracts
    assert again.encoder.trained_sensors is None  # as before: unknown


def test_a_policy_on_disk_knows_the_sensors_of_its_encoder(shown, encoder, tmp_path):
    received = ("digit", "gelsight_mini")
    touch = serve_unseen(
        encoder.params["touch"], encoder.config.model, received, universal_drawn=True
    )  # as it is loaded
    encoder = replace(encoder, trained_sensors=received, params={"touch": touch})
    recordings.save_policy(tmp_path, pouring_policy.learn_frozen(encoder, shown, FAST, stills=True))
    assert recordings.load_policy(tmp_path).encoder.trained_sensors == received


def test_a_policy_on_disk_knows_how_its_features_are_pooled_and_its_votes(shown, encoder, tmp_path):
    policy = pouring_policy.learn_frozen(encoder, shown, replace(FAST, pooling="both", votes=5), stills=True)
    recordings.save_policy(tmp_path, policy)
    again = recordings.load_policy(tmp_path)
    assert (again.pooling, again.votes) == ("both", 5)
    with np.load(tmp_path / "policy.npz") as file:
        arrays = dict(file)
    reported = json.loads(str(arrays["about"]))
    del reported["pooling"], reported["votes"]  # as written before policies could choose
    np.savez(tmp_path / "policy.npz", **(arrays | {"about": np.asarray(json.dumps(reported))}))
    again = recordings.load_policy(tmp_path)
    assert (again.pooling, again.votes) == ("class", 1)


def test_a_policy_takes_frames_of_the_camera(shown, encoder):
    policy = pouring_policy.learn_frozen(encoder, shown, FAST, stills=False)
    large = np.repeat(np.repeat(shown.frames[:, :1], 4, 2), 4, 3)
    policy.begin(1)
    wide = [policy.act(frames) for frames in large]
    policy.begin(1)
    np.testing.assert_array_equal(wide, [policy.act(frames) for frames in shown.frames[:, :1]])


def test_agreement_with_the_hand(shown):
    same = recordings.compare(shown.choices, shown, 5.0)
    assert same == (1.0, 1.0, 0.0)
    choices = np.full((20, 2), POUR)
    choices[12:] = RETRACT
    trials = pouring.Trials(np.zeros(2), np.array([20, 16]), choices, choices, *[np.zeros((20, 2))] * 3, None)
    lines = np.full((20, 2), POUR)
    lines[14:] = RETRACT  # two moments late in both runs, four fifths of a second at 5 a second... of 15 and of 11
    result = recordings.compare(lines, trials, 5.0)
    assert result.share == pytest.approx((13 / 15 + 9 / 11) / 2)
    assert result.balanced == pytest.approx((1 + 8 / 12) / 2)  # WAIT was never chosen
    assert result.turn == pytest.approx(0.4)
    never = recordings.compare(np.full((20, 2), WAIT), trials, 5.0)
    assert never.share == 0 and never.turn == pytest.approx(((20 - 12) + (16 - 12)) / 2 / 5)


def test_policies_are_compared_on_the_test_runs(manifest, encoder):
    result = recordings.read(manifest, SIDE)
    policy = pouring_policy.learn_frozen(encoder, result.part(False), FAST, stills=False)
    touch = recordings.agreement(policy, result.part(True), 5.0)
    blind = recordings.agreement_blind(result.part(False), result.part(True), FAST, 5.0)
    assert 0 <= touch.share <= 1 and 0 <= blind.share <= 1


@pytest.mark.parametrize(
    ("columns", "sentence"),
    [
        ({"label.action": lambda x: ["tilt", *x[1:]]}, "'tilt' is no action; use pour, wait, retract"),
        ({"label.action": lambda x: [None, *x[1:]]}, "label.action must be"),
        ({"frame_index": lambda x: [i + (i > 4) for i in x]}, "frame 4 is followed by 6, a gap or a repeat"),
        ({"split": lambda x: ["train"] * len(x)}, "runs of split test are needed"),
        ({"sensor": lambda x: ["digit", *x[1:]]}, "one sensor a policy, not digit, gelsight_mini"),
        (
            {"sequence": lambda x: [f"{i // 3}" for i in range(len(x))], "split": lambda x: ["train"] * len(x)},
            "has 3 frames; 3 standing ones",
        ),
        ({"split": lambda x: ["test", *x[1:]]}, "is in the splits test and train; a run is of one"),
        ({"split": lambda x: ["unused"] * len(x)}, "no row is of split train, val, test"),
    ],
)
def test_mistakes_are_named(manifest, columns, sentence):
    path = changed(manifest, "wrong", **columns)
    with pytest.raises(UserError, match=sentence.replace("?", r"\?")):
        recordings.read(path, SIDE)


def test_rows_that_take_no_part_need_no_action(manifest):
    def last(value):
        return lambda x: [*x[:-1], value]

    runs = {"sequence": last("gel"), "frame_index": last(0), "split": last("background")}
    path = changed(manifest, "gel", **runs, **{"label.action": last(None), "sensor": last("digit")})
    assert recordings.read(path, SIDE).sensor == "gelsight_mini"


def test_files_that_do_not_belong_together(shown, encoder, tmp_path):
    policy = pouring_policy.learn_frozen(encoder, shown, FAST, stills=False)
    recordings.save_policy(tmp_path / "one", policy)
    other = pouring_policy.learn_frozen(random_encoder(tiny_config(), 1), shown, FAST, stills=False)
    recordings.save_policy(tmp_path / "two", other)
    (tmp_path / "one" / "encoder.safetensors").write_bytes((tmp_path / "two" / "encoder.safetensors").read_bytes())
    with pytest.raises(UserError, match="another encoder"):
        recordings.load_policy(tmp_path / "one")
    whole = (tmp_path / "two" / "policy.npz").read_bytes()
    for damaged in (b"no", b"", whole[: len(whole) // 2]):
        (tmp_path / "two" / "policy.npz").write_bytes(damaged)
        with pytest.raises(UserError, match="no pouring policy"):
            recordings.load_policy(tmp_path / "two")
