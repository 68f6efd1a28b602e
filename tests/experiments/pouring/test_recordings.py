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
    """The manifest with other columns, beside the same pictures."""
    table = manifests.read(manifest)
    cells = {name: table.column(name).to_pylist() for name in table.table.column_names}
    for name, change in columns.items():
        cells[name] = change(cells[name])
    path = manifest.parent / f"{folder}.parquet"
    manifests.write(manifests.from_columns(cells, path), path)
    return path


def test_what_is_written_is_read(shown, manifest):
    found = recordings.read(manifest, SIDE)
    assert found.sensor == "gelsight_mini" and found.test.tolist() == [False, False, False, True]
    np.testing.assert_array_equal(found.trials.steps, shown.steps)
    taken = shown.taken
    for name in ("actions", "choices", "frames"):
        np.testing.assert_array_equal(getattr(found.trials, name)[taken], getattr(shown, name)[taken])
    assert np.isnan(found.trials.mass).all()  # no policy is told the scales
    assert pq.read_table(manifest)["label.mass"].to_pylist()[0] == pytest.approx(float(shown.mass[0, 0]))


def test_runs_of_the_test_come_last_and_parts_are_no_copies(shown, manifest):
    first = int(shown.steps[0])  # the first run is the test's, not the last
    path = changed(manifest, "turned", split=lambda x: ["test"] * first + ["train"] * (len(x) - first))
    found = recordings.read(path, SIDE)
    assert found.test.tolist() == [False, False, False, True]
    np.testing.assert_array_equal(found.trials.steps, [*shown.steps[1:], shown.steps[0]])
    learned, unseen = found.part(False), found.part(True)
    assert len(learned.steps) == COUNT - 1 and unseen.steps.tolist() == [first]
    np.testing.assert_array_equal(unseen.frames[:first, 0], shown.frames[:first, 0])
    for part in (learned, unseen):
        assert np.shares_memory(part.frames, found.trials.frames)


def test_what_is_unused_teaches_nobody_and_an_empty_choice_is_the_action(shown, manifest):
    first = int(shown.steps[0])
    path = changed(manifest, "part", **{
        "split": lambda x: ["unused"] * first + x[first:], "label.choice": lambda x: [None] * len(x),
    })  # fmt: skip
    found = recordings.read(path, SIDE)
    assert len(found.trials.steps) == COUNT - 1
    np.testing.assert_array_equal(found.trials.choices, found.trials.actions)


def test_recordings_teach_what_the_demonstrations_teach(shown, manifest, encoder):
    found = recordings.read(manifest, SIDE)
    direct = pouring_policy.learn_frozen(encoder, found._replace(trials=shown).part(False), FAST, stills=False)
    read = pouring_policy.learn_frozen(encoder, found.part(False), FAST, stills=False)
    for a, b in zip(direct.head.layers, read.head.layers, strict=True):
        np.testing.assert_array_equal(a[0], b[0])


@pytest.mark.parametrize("stills", [False, True])
def test_a_policy_on_disk_acts_as_the_one_that_learned(shown, manifest, encoder, tmp_path, stills):
    found = recordings.read(manifest, SIDE)
    policy = pouring_policy.learn_frozen(encoder, found.part(False), FAST, stills=stills, sensor=found.sensor)
    policy = pouring_policy.fine_tune(policy, found.part(False), FAST)
    recordings.save_policy(tmp_path, policy)
    again = recordings.load_policy(tmp_path)
    said = []
    for one in (policy, again):
        one.begin(COUNT)
        said.append(np.stack([one.act(frames) for frames in shown.frames]))
    np.testing.assert_array_equal(*said)
    assert again.stills == stills and again.sensor == "gelsight_mini" and again.encoder.subtracts
    assert again.encoder.trained_sensors is None  # as before: nobody told


def test_a_policy_on_disk_knows_the_sensors_of_its_encoder(shown, encoder, tmp_path):
    seen = ("digit", "gelsight_mini")
    touch = serve_unseen(encoder.params["touch"], encoder.config.model, seen, universal_drawn=True)  # as it is loaded
    encoder = replace(encoder, trained_sensors=seen, params={"touch": touch})
    recordings.save_policy(tmp_path, pouring_policy.learn_frozen(encoder, shown, FAST, stills=True))
    assert recordings.load_policy(tmp_path).encoder.trained_sensors == seen


def test_a_policy_on_disk_knows_how_its_features_are_pooled_and_its_votes(shown, encoder, tmp_path):
    policy = pouring_policy.learn_frozen(encoder, shown, replace(FAST, pooling="both", votes=5), stills=True)
    recordings.save_policy(tmp_path, policy)
    again = recordings.load_policy(tmp_path)
    assert (again.pooling, again.votes) == ("both", 5)
    with np.load(tmp_path / "policy.npz") as file:
        arrays = dict(file)
    told = json.loads(str(arrays["about"]))
    del told["pooling"], told["votes"]  # as written before policies could choose
    np.savez(tmp_path / "policy.npz", **(arrays | {"about": np.asarray(json.dumps(told))}))
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
    said = np.full((20, 2), POUR)
    said[14:] = RETRACT  # two moments late in both runs, four fifths of a second at 5 a second... of 15 and of 11
    found = recordings.compare(said, trials, 5.0)
    assert found.share == pytest.approx((13 / 15 + 9 / 11) / 2)
    assert found.balanced == pytest.approx((1 + 8 / 12) / 2)  # WAIT was never chosen
    assert found.turn == pytest.approx(0.4)
    never = recordings.compare(np.full((20, 2), WAIT), trials, 5.0)
    assert never.share == 0 and never.turn == pytest.approx(((20 - 12) + (16 - 12)) / 2 / 5)


def test_policies_are_compared_on_the_test_runs(manifest, encoder):
    found = recordings.read(manifest, SIDE)
    policy = pouring_policy.learn_frozen(encoder, found.part(False), FAST, stills=False)
    touch = recordings.agreement(policy, found.part(True), 5.0)
    blind = recordings.agreement_blind(found.part(False), found.part(True), FAST, 5.0)
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
