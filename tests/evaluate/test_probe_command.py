"""Which rows a probe of a manifest takes, how they are grouped, and which of its test was described in pre-training."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from anytouch_jax.cli.options import Probe
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import probe_command

COUNT = 24


@pytest.fixture
def manifest(tmp_path):
    """Six objects, of two recordings of two frames: the first two have a caption in train, the third one in test."""
    number = np.arange(COUNT)
    split = np.where(number % 4 < 2, "train", "test")
    objects = np.array([f"object {n // 4}" for n in number])
    described = np.isin(objects, ["object 0", "object 1"]) & (split == "train")
    described |= (objects == "object 2") & (split == "test")
    columns = {
        "path": [f"{n}.png" for n in number],
        "sensor": ["digit"] * COUNT,
        "sequence": [f"s{n // 2}" for n in number],
        "frame_index": (number % 2).tolist(),
        "split": split.tolist(),
        "object": objects.tolist(),
        "text": ["rough" if one else None for one in described],
        "label.slip": ["yes" if n % 4 == 1 else "no" for n in number],
        "label.score": number.tolist(),
    }
    path = tmp_path / "manifest.csv"
    manifests.write(manifests.from_columns(columns, path), path)
    return path


def read(manifest, **options):
    return probe_command.read_task(Probe(data=(manifest,), **options), lambda _: None)


def test_classes_that_were_described_in_train_stand_apart(manifest):
    task = read(manifest, label="object")
    named = task.subsets["classes with a photograph or caption"]
    assert set(task.labels[named]) == {"object 0", "object 1"}
    np.testing.assert_array_equal(task.subsets["classes without"], ~named)
    assert len(np.unique(task.groups)) == COUNT // 2  # recordings


def test_of_things_left_out_it_is_the_thing_that_was_described(manifest):
    task = read(manifest, label="slip", leave_out="object", where=("score", 3))
    assert len(task.rows) == COUNT - 4 and len(np.unique(task.groups)) == 5
    named = task.subsets["objects with a photograph or caption"]
    assert set(task.groups[named]) == {"object 1"}
    np.testing.assert_array_equal(task.subsets["objects without"], ~named)


def test_where_nothing_or_all_was_described_nothing_stands_apart(manifest):
    assert read(manifest, label="object", where=("score", 7)).subsets == {}
    assert read(manifest, label="slip").subsets == {}  # both classes were


def test_recordings_of_joined_files_are_never_one_group(manifest, tmp_path):
    other = tmp_path / "other" / "manifest.csv"
    other.parent.mkdir()
    other.write_bytes(manifest.read_bytes())
    options = Probe(data=(manifest, other), label="object")
    task = probe_command.read_task(options, lambda _: None)
    assert len(np.unique(task.groups)) == COUNT and not set(task.groups[:COUNT]) & set(task.groups[COUNT:])


def test_no_row_is_left(manifest):
    with pytest.raises(UserError, match="no row is of sensor 'gelslim'; the manifest has digit"):
        read(manifest, label="slip", sensor="gelslim")
    with pytest.raises(UserError, match="no row has a label in 'slip' after the filters"):
        read(manifest, label="slip", where=("score", 1e9))


def test_groups_are_found_with_or_without_label(manifest):
    by_slip = [read(manifest, label="object", group=name).groups for name in ("slip", "label.slip")]
    assert set(by_slip[0]) == {"yes", "no"}
    np.testing.assert_array_equal(*by_slip)
    assert set(read(manifest, label="slip", group="object").groups) == {f"object {n}" for n in range(6)}


def test_groups_are_objects_then_touches_then_recordings_unless_they_are_the_label(manifest):
    assert set(read(manifest, label="slip").groups) == {f"object {n}" for n in range(6)}
    assert set(read(manifest, label="label.slip").groups) == set(read(manifest, label="slip").groups)
    assert set(read(manifest, label="object").groups) == {f"s{n}" for n in range(COUNT // 2)}
    table = manifests.read(manifest).table.to_pydict()
    for name, values in (("touch", 3), ("grasp_group", 2)):
        table[name] = [None if n % 5 == 4 else str(n % values) for n in range(COUNT)]
        manifests.write(manifests.from_columns(table, manifest), manifest)
        found = set(read(manifest, label="object").groups)
        assert {str(n) for n in range(values)} < found and any(one.startswith("sequence s") for one in found - {"0"})


def test_a_group_that_is_not_there_is_no_recording(manifest):
    with pytest.raises(UserError, match=r"no column 'taste' or 'label\.taste'; it has path"):
        read(manifest, label="object", group="taste")


def test_labels_never_stand_for_the_columns_of_a_manifest(manifest):
    table = manifests.read(manifest)
    odd = table.table.to_pydict() | {"label.sensor": ["gelslim"] * COUNT, "label.split": ["train"] * COUNT}
    manifests.write(manifests.from_columns(odd | {"label.sequence": ["one"] * COUNT}, manifest), manifest)
    task = read(manifest, label="object", sensor="digit")
    assert set(task.split) == {"train", "test"} and len(np.unique(task.groups)) == COUNT // 2


def test_a_label_of_lists_is_refused(manifest, tmp_path):
    columns = manifests.read(manifest).table.to_pydict() | {"label.pose": [[1.0, 2.0]] * COUNT}
    path = tmp_path / "lists.parquet"
    manifests.write(manifests.from_columns(columns, path), path)
    with pytest.raises(UserError, match=r"'label\.pose' holds lists; a probe wants one value a row"):
        read(path, label="pose")


def test_raw_pixels_name_the_row_and_the_column_of_a_bad_picture(tmp_path):
    picture = np.zeros((24, 32, 3), np.uint8)
    for name in ("a.png", "gel.png"):
        cv2.imwrite(str(tmp_path / name), picture)
    (tmp_path / "bad.png").write_bytes(b"no picture")
    columns = {
        "path": ["a.png", "a.png"], "sensor": ["digit"] * 2, "sequence": ["s"] * 2, "frame_index": [0, 1],
        "split": ["train", "test"], "object": ["a", "b"], "background_path": ["gel.png", "bad.png"],
    }  # fmt: skip
    for change, said in (({}, "'background_path'"), ({"path": ["a.png", "bad.png"]}, "'path'")):
        path = tmp_path / "manifest.csv"
        manifests.write(manifests.from_columns(columns | change, path), path)
        with pytest.raises(UserError, match=rf"row 1 of .*manifest\.csv, column {said}: .*bad\.png"):
            probe_command.raw_features(read(path, label="object"))
