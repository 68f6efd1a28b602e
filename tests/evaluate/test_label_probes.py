"""Probes of a label column of a manifest, by features of a file: no image is read."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.stats import spearmanr
from task_world import row, table

from anytouch_jax.cli.app import main
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.options import LabelProbeOptions
from anytouch_jax.evaluate.probing import leave_groups_out, probe_label, probe_table, probe_tasks
from anytouch_jax.evaluate.statistics import regression_sums, scores


def written(folder: Path, rows: list[dict[str, Any]], features: Any) -> tuple[Path, Path]:
    """A manifest and a file of features for its rows."""
    columns = table(rows).table.to_pydict()
    manifests.write(manifests.from_columns(columns, folder / "m.csv"), folder / "m.csv")
    values = np.asarray(features, np.float32)
    np.savez(folder / "f.npz", features=values, rows=np.arange(len(rows)))
    return folder / "m.csv", folder / "f.npz"


def springs(folder: Path, *, noise: float = 0.1, objects: int = 24) -> tuple[Path, Path]:
    """Objects of a measured stiffness, a quarter of them in test; features that hold it."""
    rng = np.random.default_rng(0)
    rows = []
    features = []
    for thing in range(objects):
        for number in range(4):
            rows.append(
                row(
                    path=f"{thing}_{number}.png",
                    sequence=f"s{thing}",
                    frame_index=number,
                    object=f"o{thing}",
                    split="test" if thing % 4 == 0 else "train",
                    label__stiffness=10.25 + 2.5 * thing,
                    label__count=thing,
                )
            )
            features.append([thing / 4 + rng.normal(0, noise), *rng.normal(size=9)])
    return written(folder, rows, features)


def probe(data: Path, features: Path, label: str, **options: Any) -> tuple[list[Any], list[str]]:
    said: list[str] = []
    plain: dict[str, Any] = {"features": [features], "controls": False, "seeds": 0}
    return probe_label([], [data], label, log=said.append, **plain | options), said


def test_a_measured_column_is_probed_by_regression(tmp_path):
    data, features = springs(tmp_path)
    results, said = probe(data, features, "stiffness", out=tmp_path / "o.json")
    linear, knn, constant = results
    assert linear.regression and linear.r2 > 0.95 and linear.mae < 2 < linear.baseline_mae
    assert (
        linear.low <= linear.r2 <= linear.high and linear.mae_low <= linear.mae <= linear.mae_high
    )
    assert linear.spearman_low <= linear.spearman <= linear.spearman_high <= 1
    assert linear.test_groups == 6 and knn.r2 < linear.r2
    assert constant.probe == "mean of train" and constant.r2 < 0.1 and constant.spearman is None
    assert any("stiffness holds measurements" in line for line in said)
    printed = probe_table(results)
    assert "Spearman" in printed and "R2 0." in printed and "None" not in printed
    record = json.loads((tmp_path / "o.json").read_text())[0]
    assert record["spearman"] == linear.spearman and "accuracy" not in record


def test_whole_numbers_are_classes_until_the_user_says_otherwise(tmp_path):
    data, features = springs(tmp_path)
    # classes of test that train lacks
    with pytest.raises(UserError, match="No class of test"):
        probe(data, features, "count")
    (linear, *_), said = probe(data, features, "count", regression="yes")
    assert linear.r2 > 0.95 and not any("whole numbers" in line for line in said)
    _, said = probe(data, features, "count", leave_out="sequence")
    assert any("24 whole numbers" in line and "--regression yes" in line for line in said)
    with pytest.raises(UserError, match="--regression yes"):
        probe(data, features, "stiffness", regression="no")
    with pytest.raises(UserError, match="text"):
        probe(data, features, "object", regression="yes")
    with pytest.raises(UserError, match="--save"):
        probe_label(["x"], [data], "stiffness", save=tmp_path / "h.npz")


def test_tasks_take_any_label_column(tmp_path):
    data, features = springs(tmp_path)
    plain: dict[str, Any] = {"features": [features], "controls": False, "seeds": 2, "log": str}
    (one,) = probe_tasks([], [data], ["stiffness"], **plain)["results"]
    assert one["metric"] == "r2" and one["mean"] > 0.95 and one["spearman"] > 0.95
    assert one["spearman_low"] <= one["spearman"] <= one["spearman_high"]
    with pytest.raises(UserError, match=r"no task 'tast'.*label column"):
        probe_tasks([], [data], ["tast"], **plain)


def test_a_number_is_predicted_for_groups_that_are_left_out(tmp_path):
    data, features = springs(tmp_path)
    (one,), _ = probe(data, features, "stiffness", leave_out="object")
    assert one.r2 > 0.95 and one.n_test == 96 and one.test_groups == 24
    # features that know the object alone say nothing of another one's stiffness
    thing = np.repeat(np.arange(24), 4)
    known = leave_groups_out(np.eye(24)[thing], 10.25 + thing, thing, regression=True)
    assert known.r2 < 0.1


def test_the_commands_print_it(tmp_path, monkeypatch, capsys):
    springs(tmp_path)
    monkeypatch.chdir(tmp_path)
    words = ["--features", "f.npz", "--data", "m.csv", "--no-controls"]
    for command in (["label", "--label"], ["tasks", "--tasks"]):
        assert main(["probe", *command, "stiffness", *words]) == 0
        assert "R2 0.9" in capsys.readouterr().out


def test_rank_correlation_is_scipys_and_its_interval_holds_it():
    rng = np.random.default_rng(1)
    truth = rng.normal(size=80).round(1)
    predicted = truth + rng.normal(size=80)
    groups = np.arange(80) // 2
    run = regression_sums(predicted - truth, truth - truth.mean(), groups, predicted)
    scored = scores([run], [run], True)
    assert scored["spearman"] == pytest.approx(spearmanr(predicted, truth).statistic, abs=1e-9)
    assert scored["spearman_low"] < scored["spearman"] < scored["spearman_high"]
    assert scored["spearman_high"] - scored["spearman_low"] < 0.5


def test_a_record_of_options_and_their_names_are_one_call(tmp_path):
    data, features = springs(tmp_path)
    record = LabelProbeOptions(label="stiffness", features=[features], controls=False, seeds=0)
    by_record = probe_label([], [data], options=record, log=str)
    assert by_record == probe(data, features, "stiffness")[0]
    assert probe_label([], [data], options=record, log=str, frames=1) == by_record
    with pytest.raises(TypeError, match="colour"):
        probe_label([], [data], options=record, colour=3)


def recordings(
    folder: Path, *, names: int = 3, each: int = 4, frames: int = 6
) -> tuple[Path, Path]:
    """Recordings as the page makes them: all of split train, some of each name."""
    rng = np.random.default_rng(0)
    rows = []
    features = []
    for name in range(names):
        for number in range(each):
            for frame in range(6):
                rows.append(
                    row(
                        path=f"{name}_{number}/{frame}.png",
                        sequence=f"2026_{name}_{number}",
                        frame_index=frame,
                        object=f"thing {name}",
                    )
                )
                features.append([*np.eye(3)[name] * 4 + rng.normal(size=3), *rng.normal(size=5)])
    return written(folder, rows, features)


def test_recordings_without_a_split_are_left_out_in_turn(tmp_path):
    data, features = recordings(tmp_path)
    (one,), said = probe(data, features, "object")
    assert one.n_test == one.n_train == 72 and one.test_groups == 12 and one.accuracy > 0.9
    assert "sequence left out" in one.probe
    assert sum("no split into train and test" in line for line in said) == 1
    (by_name,), said = probe(data, features, "object", leave_out="sequence")
    assert by_name == one and not any("no split" in line for line in said)
    with pytest.raises(UserError, match="released"):
        probe(data, features, "object", protocol="released")


def test_frames_of_one_recording_do_not_teach_each_other(tmp_path):
    """Features that know the recording alone: chance, where a split by frames gives 100 %."""
    data, _ = recordings(tmp_path)
    np.savez(tmp_path / "f.npz", features=np.eye(12)[np.arange(72) // 6] * 5, rows=np.arange(72))
    (one,), _ = probe(data, tmp_path / "f.npz", "object")
    assert one.accuracy < 0.5


def test_a_class_of_one_recording_is_named(tmp_path):
    data, features = recordings(tmp_path)
    columns = manifests.read(data).table.to_pydict()
    columns["object"] = [
        "alone" if one == "2026_0_0" else name
        for one, name in zip(columns["sequence"], columns["object"], strict=True)
    ]
    manifests.write(manifests.from_columns(columns, data), data)
    (one,), _ = probe(data, features, "object")
    assert any("alone" in note for note in one.notes)


def two_sensors(folder: Path, code: Any, *, splits: bool = False) -> tuple[Path, Path]:
    """Five objects with six places each, felt by two sensors; `code(thing, place, sensor)`.

    The second sensor has felt one object more. With `splits` places are of train or test.
    """
    rng = np.random.default_rng(0)
    rows = []
    features = []
    for sensor, things in (("digit", 5), ("gelsight_mini", 6)):
        for thing in range(things):
            for place in range(6):
                for frame in range(3):
                    rows.append(
                        row(
                            path=f"{sensor}/{thing}_{place}_{frame}.png",
                            sensor=sensor,
                            sequence=f"{sensor}_{thing}_{place}",
                            frame_index=frame,
                            touch=f"{thing}_{place}",
                            object=f"thing {thing}",
                            split="test" if splits and place > 3 else "train",
                        )
                    )
                    own = np.asarray(code(thing, place, sensor), float)
                    features.append(own + 0.1 * rng.normal(size=len(own)))
    return written(folder, rows, features)


ACROSS = {"train_sensor": "digit", "test_sensor": "gelsight_mini"}


@pytest.mark.parametrize("splits", [False, True])
def test_a_head_of_one_sensor_is_tested_on_another(tmp_path, splits):
    def code(thing, place, sensor):
        return [*np.eye(6)[thing], 0.3 * (sensor == "digit")]

    data, features = two_sensors(tmp_path, code, splits=splits)
    results, said = probe(data, features, "object", **ACROSS)
    linear, knn = results
    tested = 5 * (2 if splits else 6)
    for one in (linear, knn):
        assert one.accuracy > 0.95 and one.low > 0.65 and one.n_test == 3 * tested
        assert one.test_groups == tested and one.baseline == pytest.approx(0.2, abs=0.05)
    assert any("18 rows of classes that digit has not touched" in line for line in said)
    assert any("tested on gelsight_mini" in note for note in linear.notes)


def test_what_only_one_sensor_shows_does_not_carry_over(tmp_path):
    """Each sensor shows the object by a code of its own: perfect within it, chance across."""

    def code(thing, place, sensor):
        return np.eye(12)[thing + 6 * (sensor == "digit")]

    data, features = two_sensors(tmp_path, code)
    within, _ = probe(data, features, "object", sensor="digit", group="touch")
    across, _ = probe(data, features, "object", **ACROSS)
    assert within[0].accuracy > 0.95 and across[0].accuracy < 0.5


def test_a_place_that_both_sensors_felt_is_not_fitted_on(tmp_path):
    """Features know the place, not the object: only a head that has seen it would name it."""

    def code(thing, place, sensor):
        return np.eye(36)[6 * thing + place] * 3

    data, features = two_sensors(tmp_path, code)
    across, _ = probe(data, features, "object", **ACROSS)
    assert across[0].accuracy < 0.5 and across[1].accuracy < 0.5


def test_options_between_sensors_are_checked_before_an_encoder_is_loaded(tmp_path):
    data, _ = two_sensors(tmp_path, lambda *_: [0.0])
    for change, words in (
        ({"train_sensor": "digit"}, "go together"),
        ({"train_sensor": "DIGIT", "test_sensor": "digit"}, "'DIGIT'.*digit, gelsight_mini"),
        ({"train_sensor": "digit", "test_sensor": "digit"}, "the same"),
        ({**ACROSS, "sensor": "digit"}, "--sensor"),
        ({**ACROSS, "save": tmp_path / "h.npz"}, "--save"),
        ({"sensor": "DIGIT"}, "'DIGIT'"),
        ({"label": "colour"}, "'colour'"),
    ):
        with pytest.raises(UserError, match=words):
            probe_label(["no such encoder"], [data], **{"label": "object", "log": str} | change)


def test_a_number_across_sensors(tmp_path):
    data, features = two_sensors(tmp_path, lambda thing, *_: [thing, thing**2 / 5])
    columns = manifests.read(data).table.to_pydict()
    columns["label.size"] = [float(name.split()[1]) + 0.5 for name in columns["object"]]
    manifests.write(manifests.from_columns(columns, data), data)
    (linear, _), _ = probe(data, features, "size", group="touch", **ACROSS)
    assert linear.r2 > 0.9 and linear.n_test == 18 * 6
