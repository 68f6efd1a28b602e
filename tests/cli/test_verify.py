import json
import shutil

import cv2
import numpy as np
import pytest
from gel_pictures import press

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.prepare import verify


def edit(path, **columns):
    """The manifest with other columns."""
    table = manifests.read(path).table
    full = {name: table[name].to_pylist() for name in table.column_names} | columns
    manifests.write(manifests.from_columns(full, path), path)


@pytest.fixture
def distinct(pressed):
    """`pressed` with no two pictures alike."""
    rng = np.random.default_rng(0)
    for i in range(10):
        noise = rng.integers(0, 4, (48, 48, 3), np.uint8)
        cv2.imwrite(str(pressed.parent / f"{i}.png"), press(10 * i) + noise)
    return pressed


def test_a_sound_manifest_passes(anytouch, distinct):
    done = anytouch("data", "verify", distinct)
    assert done.status == 0, done.out
    assert "10 rows, 10 files" in done.out and "No fault was found" in done.out
    assert "| CC-BY-NC-4.0 | no | 3 | mine |" in done.out and "| - | unknown | 1 |" in done.out


def test_a_broken_file_is_an_error_until_it_is_repaired(anytouch, distinct, tmp_path):
    data = (tmp_path / "7.png").read_bytes()
    (tmp_path / "7.png").write_bytes(data[: len(data) // 2])
    (tmp_path / "8.png").unlink()
    done = anytouch("data", "verify", distinct, "--out", tmp_path / "report.json")
    assert done.status == 1
    assert f"row 7 of {distinct}" in done.out and f"row 8 of {distinct}" in done.out
    report = json.loads((tmp_path / "report.json").read_text())
    assert not report["ok"] and sorted(row for f in report["findings"] for row in f["rows"]) == [7, 8]
    assert anytouch("data", "verify", distinct, "--no-decode").out.count("row 7") == 0

    fixed = tmp_path / "fixed.parquet"
    done = anytouch("data", "verify", distinct, "--repair", fixed)
    assert done.status == 0 and f"{fixed}: 8 of 10 rows" in done.out and "dropped 2 rows" in done.out
    assert anytouch("data", "verify", fixed).status == 0
    assert len(manifests.read(distinct)) == 10


def test_what_no_repair_can_decide_stays_an_error(anytouch, distinct, tmp_path):
    edit(distinct, touch=["t"] * 10, split=["background"] * 2 + ["train"] * 4 + ["test"] * 4)
    (tmp_path / "4.png").unlink()
    done = anytouch("data", "verify", distinct, "--repair", tmp_path / "fixed.parquet")
    assert done.status == 1 and "left to you: 1 values of touch are in more than one of" in done.out
    assert "left to you: 1 rows whose path" not in done.out


def test_objects_and_files_on_both_sides_of_a_split_are_errors(anytouch, distinct, tmp_path):
    splits, other = ["background"] * 2 + ["train"] * 4 + ["test"] * 4, tmp_path / "other.parquet"
    shutil.copy(distinct, other)
    edit(other, split=["test"] * 10)
    assert anytouch("data", "verify", distinct).status == anytouch("data", "verify", other).status == 0
    done = anytouch("data", "verify", distinct, other)
    assert done.status == 1 and "leak_file" in done.out  # the same pictures in train and test
    edit(distinct, object=["mug"] * 10, split=splits, sequence=[f"{name} 1" for name in splits])
    assert anytouch("data", "verify", distinct).status == 0
    assert anytouch("data", "verify", distinct, "--objects").status == 1  # on request


def test_swapped_folders_are_exchanged_when_the_user_says_so(anytouch, distinct, tmp_path):
    for i in range(10):
        cv2.imwrite(str(tmp_path / f"photo{i}.png"), np.full((30, 30, 3), 20 * i, np.uint8))
    edit(distinct, image_path=[f"photo{i}.png" for i in range(10)])
    anytouch("data", "verify", distinct, "--repair", tmp_path / "back.csv", "--swap", "mine")
    back = manifests.read(tmp_path / "back.csv")
    assert back.value(3, "path") == "photo3.png" and back.value(3, "image_path") == "3.png"


def test_commercial_rows_only_also_of_the_repaired_copy(anytouch, distinct, tmp_path):
    (tmp_path / "5.png").unlink()
    words = ["--repair", tmp_path / "fixed.parquet", "--commercial-only", tmp_path / "free.parquet"]
    done = anytouch("data", "verify", distinct, *words)
    assert "free.parquet: 5 rows" in done.out and " 3 " in done.out and " 1 " in done.out
    assert manifests.read(tmp_path / "free.parquet").column("license").to_pylist() == ["MIT"] * 5


def test_mistakes_are_one_sentence(mistake, distinct, tmp_path, monkeypatch):
    assert "--repair" in mistake("data", "verify", distinct, "--swap", "mine")
    assert "'x'" in mistake("data", "verify", distinct, "--swap", "x", "--repair", tmp_path / "o.csv")
    assert str(distinct) in mistake("data", "verify", distinct, "--repair", distinct)
    assert "below" in mistake("data", "verify", distinct, "--repair", tmp_path / "below" / "o.csv")
    edit(distinct, license=[None] * 10)
    monkeypatch.setattr(verify, "verify", lambda *_, **__: pytest.fail("the work was begun"))
    assert mistake("data", "verify", distinct, "--commercial-only", tmp_path / "c.csv")
    assert not (tmp_path / "c.csv").exists()
