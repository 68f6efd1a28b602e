"""`anytouch embed` of a folder of pictures: what its frames are, and what is told of a folder that has none."""

from __future__ import annotations

import shutil

import numpy as np


def test_no_clip_reaches_from_one_finger_to_the_next(tmp_path, world, tiny_run, anytouch):
    folder, out = tmp_path / "frames", tmp_path / "features.npz"
    folder.mkdir()
    for finger in ("left", "right"):
        for number in range(4):
            shutil.copy(world.parent / f"a{number}.png", folder / f"{finger}_{number}.png")
    words = ("--run", tiny_run, "--input", folder, "--sensor", "digit", "--out", out, "--frames", 3, "--batch", 4)
    assert anytouch("embed", *words).status == 0
    with np.load(out) as file:
        assert file["key/path"].tolist() == ["left_2.png", "left_3.png", "right_2.png", "right_3.png"]
