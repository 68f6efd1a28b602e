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


def test_the_sensor_of_a_folder_is_asked_for_by_its_name(tmp_path, world, tiny_run, anytouch, mistake):
    words = ("--run", tiny_run, "--input", world.parent, "--out", tmp_path / "features.npz", "--batch", 4)
    said = anytouch("embed", *words)
    assert said.status == 0 and said.err.count("no --sensor was given: the universal tokens were used") == 1
    assert "--sensor" not in anytouch("embed", *words, "--sensor", "universal").err
    assert "sensor 'DIGIT': it is called digit" in mistake("embed", *words, "--sensor", "DIGIT")


def test_a_folder_without_pictures_says_what_to_give_instead(tmp_path, world, tiny_run, mistake):
    folder = tmp_path / "mine"
    (folder / "mug").mkdir(parents=True)
    words = ("embed", "--run", tiny_run, "--input", folder, "--out", tmp_path / "features.npz")
    assert mistake(*words).strip().endswith(".npy)")
    shutil.copy(world.parent / "a0.png", folder / "mug" / "0.png")
    assert "they lie in its sub-folders: anytouch index recordings" in mistake(*words)
    (folder / "labels.csv").write_text("object,material\nmug,clay\n")
    (folder / "mine.csv").write_text("path,sensor,sequence,frame_index,split\nmug/0.png,digit,mug,0,train\n")
    assert f"give its manifest {folder / 'mine.csv'}" in mistake(*words)
