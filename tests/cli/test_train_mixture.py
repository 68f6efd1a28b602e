"""One training run on a mixture of datasets, loose and packed, CSV and Parquet, as `make train-stage1` runs it."""

from __future__ import annotations

import json

import cv2
import pytest
from gel_pictures import press
from runs import SIZES

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.files import close_shards


@pytest.fixture
def mixture(tmp_path, anytouch):
    """Four manifests: two sensors, three loose and one packed, with different columns."""
    files = []
    for number, (name, ending) in enumerate({"a": "csv", "b": "parquet", "c": "csv", "d": "parquet"}.items()):
        folder = tmp_path / name
        folder.mkdir()
        for i in range(4):
            cv2.imwrite(str(folder / f"{i}.png"), press(20 * i))
        columns = {
            "path": [f"{i}.png" for i in range(4)], "sensor": [("digit", "gelsight")[number % 2]] * 4,
            "sequence": ["s"] * 4, "frame_index": list(range(4)), "split": ["train"] * 4,
            "dataset": [f"set {name}"] * 4,
            f"label.{name}": [1] * 4,
        }  # fmt: skip
        files.append(folder / f"touch.{ending}")
        manifests.write(manifests.from_columns(columns, files[-1]), files[-1])
    assert anytouch("pack", files[3]).status == 0
    yield [*files[:3], files[3].with_name("touch_packed") / "manifest.parquet"]
    close_shards()


@pytest.mark.slow
def test_four_datasets_in_one_run(anytouch, mixture, tmp_path, compiled_once):
    sizes = [word for name, value in SIZES.items() for word in (f"--{name}", value)]
    words = ["train", "--stage", 1, "--data", *mixture, "--run", tmp_path / "run", "--steps", 2, "--batch", 8, *sizes]
    said = anytouch(*words, "--loader.weights", "set a", 3)
    assert said.status == 0, said.err
    assert "an epoch draws set a 3 times, other datasets once" in said.err
    lines = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [0, 1] and all(line["loss"] > 0 for line in lines)
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert len(config["data"]["manifests"]) == 4 and config["data"]["weights"] == [["set a", 3.0]]
    again = anytouch(*words)
    assert again.status == 1 and "weights" in again.err  # another mixture is another run
