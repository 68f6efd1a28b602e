"""A LeRobot data set that is written is read by the reader of the library, pixel for pixel."""

import json

import numpy as np
import pyarrow.parquet
import pytest
from refused import refused

pytest.importorskip("mujoco")

from anytouch_jax.data.images import decode
from anytouch_jax.datasets.readers import IndexOptions, index
from anytouch_jax.sim.mujoco import LeRobotWriter

GEL = "observation.images.tactile_left"
RNG = np.random.default_rng(0)
IMAGES = RNG.integers(0, 256, (5, 24, 32, 3), dtype=np.uint8)


def write(root, fail=False):
    with LeRobotWriter(root, fps=20) as writer:
        for number, image in enumerate(IMAGES):
            writer.add({GEL: image, "action": [number, -1.0], "observation.state": [0.5]})
            if number == 1:
                writer.end_episode("press")
        if fail:
            raise RuntimeError("the robot fell")
        writer.end_episode("slide")
    return root


def test_what_is_written_is_read(tmp_path):
    root = write(tmp_path / "set")
    options = IndexOptions(sensor="digit", values=("action",))
    manifest = index("lerobot", root, options=options).manifest
    rows = manifest.table.to_pylist()
    assert [row["episode"] for row in rows] == [0, 0, 1, 1, 1]
    assert [row["label.action_0"] for row in rows] == [0, 1, 2, 3, 4]
    assert [row["label.task"] for row in rows] == ["press"] * 2 + ["slide"] * 3
    assert [row["timestamp"] for row in rows] == pytest.approx([0, 0.05, 0, 0.05, 0.1])
    for number, image in enumerate(IMAGES):
        np.testing.assert_array_equal(decode(manifest.file(number)), image)


def test_what_lerobot_asks_of_the_files(tmp_path):
    """Its loader wants fixed lists, statistics of each feature, and tasks as the index."""
    root = write(tmp_path / "set")
    info = json.loads((root / "meta/info.json").read_text())
    assert info["total_frames"] == 5 and info["total_episodes"] == 2
    assert info["features"][GEL]["dtype"] == "image" and info["features"]["action"]["shape"] == [2]
    stats = json.loads((root / "meta/stats.json").read_text())
    assert np.shape(stats[GEL]["mean"]) == (3, 1, 1) and stats["action"]["count"] == [5]
    np.testing.assert_allclose(
        np.ravel(stats[GEL]["mean"]), IMAGES.mean((0, 1, 2)) / 255, rtol=1e-6
    )
    np.testing.assert_allclose(stats["action"]["std"], [np.std(range(5)), 0], atol=1e-9)
    table = pyarrow.parquet.read_table(root / "data/chunk-000/file-001.parquet")
    assert str(table.schema.field("action").type).startswith("fixed_size_list")
    assert table["index"].to_pylist() == [2, 3, 4]
    tasks = pyarrow.parquet.read_table(root / "meta/tasks.parquet")
    about = json.loads(tasks.schema.metadata[b"pandas"])
    assert about["index_columns"] == ["__index_level_0__"]
    episodes = pyarrow.parquet.read_table(root / "meta/episodes").to_pylist()
    assert [one["dataset_to_index"] for one in episodes] == [2, 5]


def test_an_error_keeps_the_episodes_that_ended(tmp_path):
    with pytest.raises(RuntimeError, match="fell"):
        write(tmp_path / "set", fail=True)
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["total_episodes"] == 1 and info["total_frames"] == 2


def test_mistakes_are_told(tmp_path):
    root = write(tmp_path / "set")
    refused("not an empty folder", LeRobotWriter, root, fps=20)
    refused("fps is above 0", LeRobotWriter, tmp_path / "new", fps=0)
    writer = LeRobotWriter(tmp_path / "new", fps=20)
    refused("at least one frame", writer.end_episode, "press")
    refused("has no episode", writer.close)
    refused("may not be called index", writer.add, {"index": [1.0]})
    writer = LeRobotWriter(tmp_path / "new", fps=20)
    refused("an image u8", writer.add, {"fields": np.zeros((4, 4))})
    writer = LeRobotWriter(tmp_path / "new", fps=20)
    writer.add({"action": [0.0, 1.0]})
    refused(r"has action of \(1,\), and the first one \(2,\)", writer.add, {"action": [0.0]})
    refused("has more, which the first", writer.add, {"action": [0.0, 1.0], "more": [1.0]})
    refused("with NaN", writer.add, {"action": [np.nan, 1.0]})
