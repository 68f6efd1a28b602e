import errno
import fcntl
import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from blank_recorder import BlankRecorder

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from anytouch_jax.sim import dataset, scene
from anytouch_jax.sim.scene import Scenes

SCENES = Scenes(
    touches=10,
    objects=24,
    seed=4,
    sensors=("digit", "tac3d"),
    size=32,
    frames=4,
    vision=0.5,
    text=0.5,
)


@pytest.fixture(autouse=True)
def _no_physics(monkeypatch):
    monkeypatch.setattr(dataset, "Recorder", BlankRecorder)


def tree(folder):
    return {
        path.relative_to(folder): path.read_bytes()
        for path in sorted(Path(folder).rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(dataset, "Recorder", BlankRecorder)
        dataset.simulate(SCENES, folder)
    return folder


def test_the_manifest_is_one_that_the_project_reads(made):
    table = manifests.read(made / "manifest.parquet")
    splits = set(table.column("split").to_pylist())
    assert len(table) == 10 * 2 * 4 + 10 and splits == {"train", "val", "test", "background"}
    rows = table.table.to_pylist()
    for index, row in enumerate(rows):
        assert table.file(index).exists() and (
            row["path"].endswith(".npy") == (row["sensor"] == "tac3d")
        )
        if row["split"] == "background":
            assert row["touch"] is None and row["text"] is None and row["image_path"] is None
    clips = table.clips(4)
    assert len(clips) == 20 and all(len({rows[i]["unit"] for i in clip}) == 1 for clip in clips)
    pairs = {(row["touch"], row["sensor"]) for row in rows if row["touch"]}
    assert len(pairs) == 20
    _, splits = scene.objects_and_splits(SCENES)
    touches = [scene.draw_touch(SCENES, number, splits) for number in range(10)]
    units = [
        scene.draw_recording(SCENES, touch, sensor).unit
        for touch in touches
        for sensor in SCENES.sensors
    ]
    tints = {tuple(unit.tint) for unit in units}
    assert len(tints) == 20, (
        "every recording has a unit of its own, so no test unit is met in training"
    )


def test_fractions_and_labels_are_as_drawn(made):
    rows = [
        row for row in manifests.read(made / "manifest.parquet").table.to_pylist() if row["touch"]
    ]
    things, splits = scene.objects_and_splits(SCENES)
    for row in rows:
        touch = scene.draw_touch(SCENES, int(row["touch"]), splits)
        recording = scene.draw_recording(SCENES, touch, row["sensor"])
        thing = things[touch.object]
        assert (row["image_path"] is not None, row["text"] is not None) == (
            recording.has_photo,
            recording.has_text,
        )
        assert (row["object"], row["split"]) == (thing.name, touch.split)
        assert (
            row["label.material"] == thing.material.name
            and row["label.indenter"] == thing.shape.primitive
        )
        if row["text"]:
            assert thing.name not in row["text"].lower()
    assert (
        {row["image_path"] is None for row in rows}
        == {row["text"] is None for row in rows}
        == {True, False}
    )


def test_a_data_set_of_another_version_is_not_continued(made, monkeypatch):
    assert json.loads((made / "dataset.json").read_text())["version"] == dataset.VERSION
    monkeypatch.setattr(dataset, "VERSION", 99)
    with pytest.raises(UserError, match=r"version \d+, not 99"):
        dataset.simulate(SCENES, made)


def test_touches_from_another_number_on_are_others_of_the_same_objects(made, tmp_path):
    later = replace(SCENES, touches=2, first=2)
    dataset.simulate(later, tmp_path / "later")
    number = lambda row: row["path"].split("/")[1]  # noqa: E731
    rows = {
        number(row): row
        for row in manifests.read(tmp_path / "later" / "manifest.parquet").table.to_pylist()
    }
    assert sorted(rows) == ["000002", "000003"]
    # touch 2 of either is one and the same
    for row in manifests.read(made / "manifest.parquet").table.to_pylist():
        if number(row) in rows:
            assert row["object"] == rows[number(row)]["object"]
            assert (made / row["path"]).read_bytes() == (
                tmp_path / "later" / row["path"]
            ).read_bytes()
    assert '"first": 2' in (tmp_path / "later" / "dataset.json").read_text()
    # data sets older than the setting go on
    assert "first" not in (made / "dataset.json").read_text()
    with pytest.raises(UserError, match="first 2, not None"):
        dataset.simulate(replace(later, first=0), tmp_path / "later")


def test_a_seed_gives_the_same_bytes_and_another_seed_does_not(made, tmp_path):
    dataset.simulate(SCENES, tmp_path / "again", threads=1)
    assert tree(tmp_path / "again") == tree(made)
    dataset.simulate(replace(SCENES, seed=2), tmp_path / "other")
    assert tree(tmp_path / "other") != tree(made)


@pytest.mark.parametrize("broken_at", [0, 9, 20, 47])
def test_an_interrupted_run_goes_on_to_the_same_bytes(made, tmp_path, monkeypatch, broken_at):
    calls = []
    write = dataset._write_bytes

    def stop_once(path, data):
        calls.append(path)
        if len(calls) == broken_at + 1:
            path.with_name(path.name + ".tmp").write_bytes(data[:10])
            raise KeyboardInterrupt
        write(path, data)

    monkeypatch.setattr(dataset, "_write_bytes", stop_once)
    with pytest.raises(KeyboardInterrupt):
        dataset.simulate(SCENES, tmp_path / "cut")
    assert not (tmp_path / "cut" / "manifest.parquet").exists()
    done = []
    dataset.simulate(SCENES, tmp_path / "cut", progress=lambda n, of: done.append((n, of)))
    assert done[-1] == (10, 10) and (broken_at < 20 or done[0][0] == 0 or done[0] == (8, 10))
    assert tree(tmp_path / "cut") == tree(made)


def test_a_finished_part_is_not_made_again(tmp_path, monkeypatch):
    first: list[int] = []  # touch of what is recorded
    full = True

    class Telling(BlankRecorder):
        def record(self, recordings):
            first.append(recordings[0].touch.number)
            if full and first[-1] == dataset.GROUP:  # the second part
                raise OSError(errno.ENOSPC, "No space left on device", "somewhere")
            return super().record(recordings)

    monkeypatch.setattr(dataset, "Recorder", Telling)
    with pytest.raises(UserError, match="No space left on device; finished touches are kept"):
        dataset.simulate(SCENES, tmp_path / "full")
    assert [path.name for path in (tmp_path / "full" / "parts").iterdir()] == ["00000.parquet"]
    shutil.copytree(tmp_path / "full", tmp_path / "cut")
    first.clear()
    full = False
    dataset.simulate(SCENES, tmp_path / "full")
    # two sensors of the second part, and nothing of the first
    assert first == [dataset.GROUP] * 2
    first.clear()
    # a kill between the last two moves
    (tmp_path / "full" / "parts").mkdir()
    dataset.simulate(SCENES, tmp_path / "full")
    assert not first and not (tmp_path / "full" / "parts").exists()
    # the name without its bytes
    (tmp_path / "cut" / "parts" / "00000.parquet").write_bytes(b"")
    dataset.simulate(SCENES, tmp_path / "cut")
    assert first == [0] * 2 + [dataset.GROUP] * 2 and tree(tmp_path / "cut") == tree(
        tmp_path / "full"
    )


def test_a_folder_of_something_else_is_left_alone(made, tmp_path):
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(UserError, match="is not empty and holds no simulated data set"):
        dataset.simulate(SCENES, tmp_path)
    assert (tmp_path / "mine.txt").read_text() == "mine" and len(list(tmp_path.iterdir())) == 1
    with pytest.raises(
        UserError, match=r"holds a data set with seed 4, not 5; vision 0.5, not 0.25"
    ):
        dataset.simulate(replace(SCENES, seed=5, vision=0.25), made)
    for text in ("[1]", "", "{}"):
        (tmp_path / "dataset.json").write_text(text)
        with pytest.raises(
            UserError, match=r"dataset\.json does not hold the settings of a simulated data set"
        ):
            dataset.simulate(SCENES, tmp_path)


def test_two_processes_do_not_simulate_into_one_folder(made):
    before = tree(made)
    with open(made / "dataset.json") as mark:
        fcntl.flock(mark, fcntl.LOCK_EX)  # as another process holds it
        with pytest.raises(UserError, match="another process simulates into"):
            dataset.simulate(SCENES, made)
    assert dataset.simulate(SCENES, made) == made / "manifest.parquet" and tree(made) == before


def test_settings_are_compared_by_value(made):
    file = made / "dataset.json"
    before = file.read_bytes()
    file.write_text(json.dumps(json.loads(before)))  # formatted otherwise
    # 1 for 1.0
    whole = replace(SCENES, depth=(SCENES.depth[0], int(SCENES.depth[1])))
    assert SCENES.depth[1] == 1 and dataset.simulate(whole, made) == made / "manifest.parquet"
    file.write_bytes(before)
