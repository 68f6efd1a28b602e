"""Touches of two sensors on disk, their features, and a video."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from gel_images import press
from videos import write_video
from view_world import DEPTHS, SCRIPT

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.embed import Features, save_npz


@pytest.fixture(scope="session")
def touches(tmp_path_factory) -> Path:
    """A manifest of 2 touches, each by 2 sensors, 3 frames a recording.

    The second touch has an odd name.
    """
    folder = tmp_path_factory.mktemp("touches")
    rows = []
    for touch, name in enumerate(("cup", SCRIPT)):
        for sensor in ("digit", "gelsight_mini"):
            for frame, depth in enumerate(DEPTHS):
                path = f"{touch}_{sensor}_{frame}.png"
                cv2.imwrite(str(folder / path), press(depth + 5 * touch))
                split = ("train", "test")[touch]
                rows.append(
                    (
                        path,
                        sensor,
                        f"{touch}-{sensor}",
                        frame,
                        split,
                        str(touch),
                        name,
                        depth / 10,
                        "0_digit_0.png",
                    )
                )
    names = (
        "path",
        "sensor",
        "sequence",
        "frame_index",
        "split",
        "touch",
        "object",
        "label.force",
        "background_path",
    )
    columns = dict(zip(names, map(list, zip(*rows, strict=True)), strict=True))
    columns["text"] = [SCRIPT] * len(rows)
    columns["image_path"] = ["0_digit_2.png"] + [None] * (len(rows) - 1)
    manifests.write(
        manifests.from_columns(columns, folder / "manifest.parquet"), folder / "manifest.parquet"
    )
    return folder / "manifest.parquet"


@pytest.fixture(scope="session")
def features(touches) -> Path:
    """Features of the rows of `touches`: rows of one touch and frame are near, whatever the
    sensor.
    """
    table = manifests.read(touches)
    touch, frame = (
        np.asarray(table.column(name).to_pylist(), float) for name in ("touch", "frame_index")
    )
    angle = 2 * touch + 0.1 * frame
    values = np.stack([np.cos(angle), np.sin(angle), 0.01 * np.arange(len(angle))], 1).astype(
        np.float32
    )
    keys = {
        name: table.text_column(name) for name in ("path", "sensor", "sequence", "split", "object")
    }
    keys["frame_index"] = frame.astype(np.int64)
    path = touches.with_name("features.npz")
    about = {"weights": "none", "encoder": SCRIPT, "input": str(touches)}
    save_npz(path, Features(values, np.arange(len(values)), keys), about)
    return path


@pytest.fixture(scope="session")
def video(tmp_path_factory) -> Path:
    """A video of 12 frames at 30 frames/s that grow brighter."""
    frames = [np.full((48, 48, 3), 20 + 15 * frame, np.uint8) for frame in range(12)]
    return write_video(tmp_path_factory.mktemp("video") / "press.avi", frames, 30)
