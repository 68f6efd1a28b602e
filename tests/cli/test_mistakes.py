"""Mistakes at the command line that would lose something, or do nothing, without a word."""

from __future__ import annotations

import stat
from pathlib import Path

import cv2
import numpy as np
import pytest
from reader_world import fill


def test_values_given_in_two_parts_are_not_lost(mistake):
    said = mistake("probe", "--data", "a.csv", "--label", "object", "--data=b.csv", "--run", "r")
    assert "--data is given twice; write it once, with all its values behind it" in said
    words = ("probe", "--data", "a.csv", "--label", "object", "--where", "force", 1, "--where", "slip", 2)
    assert "--where is given twice" in mistake(*words)
    words = ("train", "--data", "a.csv", "--run", "r", "--model.sensors", "digit", "--model.sensors", "gelslim")
    assert "--model.sensors is given twice" in mistake(*words)
    assert "--run is given twice" in mistake("retrieve", "--data", "a.csv", "--run", "r", "--run", "s")


def test_a_manifest_is_not_written_over_another_table(anytouch, mistake, tmp_path):
    fill(tmp_path, [f"real/mug/dataset_{k}/frames/frame_{i:07d}.jpg" for k in range(2) for i in range(3)])
    table = tmp_path / "labels.csv"
    table.write_text("name,hardness\nmug,hard\n")
    assert "labels.csv is there and is no manifest; name another file" in mistake(
        "index", "ycb_slide", tmp_path, "--out", table
    )
    assert table.read_text().startswith("name,hardness")
    for _ in range(2):  # a manifest may be made anew
        assert anytouch("index", "ycb_slide", tmp_path, "--out", tmp_path / "m.csv").status == 0
    (tmp_path / "broken.parquet").write_bytes(b"no parquet")
    assert "is no manifest" in mistake("index", "ycb_slide", tmp_path, "--out", tmp_path / "broken.parquet")


def test_weights_that_are_written_may_be_read_by_others(anytouch, tiny_run, tmp_path):
    assert anytouch("convert", tiny_run, tmp_path / "w.safetensors", "--names", "own").status == 0
    assert stat.S_IMODE((tmp_path / "w.safetensors").stat().st_mode) == 0o644


def test_what_cannot_be_is_told_before_the_work(mistake, tiny_run, world, tmp_path):
    (tmp_path / "afile").write_text("")
    (tmp_path / "semi.csv").write_text("path;sensor;sequence;frame_index;split\na.png;digit;s;0;train\n")
    said = mistake("train", "--data", world, "--run", tmp_path / "afile")
    assert "afile is a file, not a folder; choose another --run" in said
    said = mistake("train", "--stage", 2, "--data", world, "--run", tiny_run)
    assert "holds a run of stage 1; choose another --run for stage 2" in said
    assert "has semicolons between its columns; save it with commas" in mistake("info", tmp_path / "semi.csv")
    out = tmp_path / "o.csv"
    assert "name the same file" in mistake("verify", world, "--repair", out, "--commercial-only", out)
    assert "--gallery must be 2 or more" in mistake("retrieve", "--data", world, "--run", tiny_run, "--gallery", 1)


def test_numbers_and_names_that_cannot_be_are_one_sentence(mistake, tiny_run, world, tmp_path):
    adapt = ("adapt", "--run", tiny_run, "--data", world, "--sensor", "new", "--out", tmp_path / "a")
    for seed in (-1, 10**20):
        assert "--seed must be" in mistake(*adapt, "--seed", seed)
    assert "--steps must be 1 or more" in mistake(*adapt, "--steps", 0)
    nothing = "--labels, --steps do nothing with --frames 0, which fits nothing"
    assert nothing in mistake(*adapt, "--frames", 0, "--labels", "material", "--steps", 5)
    towers = mistake("train", "--stage", 1, "--data", world, "--towers", "pretrained", "--run", tmp_path / "a")
    assert "--towers pretrained needs CLIP weights" in towers
    probe = ("probe", "--run", tiny_run, "--data", world, "--label", "object")
    assert "--seeds must be 0 or more" in mistake(*probe, "--seeds", -3)
    assert "'nothing'" in mistake(*probe, "--where", "nothing", 1)
    assert "no row is of sensor 'xyz'; the manifest has digit, gelsight_mini" in mistake(*probe, "--sensor", "xyz")
    tasks = ("probe", "--run", tiny_run, "--data", world, "--tasks", "object")
    for heads in ("gradien", ","):
        assert "choose among linear, knn, gradient, with commas between" in mistake(*tasks, "--heads", heads)
    assert "--join does nothing for clips of 3 frames" in mistake(*tasks, "--frames", 3, "--join", "concat")
    assert not (tmp_path / "a").exists()


def test_a_batch_larger_than_a_folder_costs_nothing(anytouch, tiny_run, world, tmp_path):
    (tmp_path / "frames").mkdir()
    for name in ("a0", "a1"):
        (tmp_path / "frames" / f"{name}.png").write_bytes((world.parent / f"{name}.png").read_bytes())
    words = ("--run", tiny_run, "--input", tmp_path / "frames", "--sensor", "digit", "--out", tmp_path / "f.npz")
    said = anytouch("embed", *words, "--batch", 10**7)
    assert said.status == 0 and "2 features of 12 values" in said.out, said.err


def test_an_absolute_path_is_called_so(mistake, tiny_run, tmp_path):
    picture, manifest = tmp_path / "a.png", tmp_path / "m.csv"
    cv2.imwrite(str(picture), np.zeros((32, 32, 3), np.uint8))
    manifest.write_text(f"path,sensor,sequence,frame_index,split\n{picture},digit,s,0,train\n")
    said = mistake("embed", "--run", tiny_run, "--input", manifest, "--out", tmp_path / "f.npz")
    assert "is absolute; write it relative to the manifest's folder" in said


@pytest.mark.parametrize("stream", [[], ["--stream"]])
def test_a_video_that_ends_early_is_told_of(anytouch, tiny_run, tmp_path, stream):
    film = tmp_path / "a.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 64))
    for shade in np.random.default_rng(0).integers(0, 255, (30, 64, 64, 3), np.uint8):
        writer.write(shade)
    writer.release()
    words = ("--run", tiny_run, "--input", film, "--sensor", "digit", "--out", tmp_path / "f.npz", *stream)
    said = anytouch("embed", *words)
    assert said.status == 0 and "is it whole" not in said.err
    film.write_bytes(film.read_bytes()[: film.stat().st_size // 2])
    said = anytouch("embed", *words)
    assert said.status == 0 and "could be read; is it whole?" in said.err


def test_no_clip_of_a_folder_reaches_over_a_missing_number(anytouch, tiny_run, tmp_path):
    folder, out = tmp_path / "frames", tmp_path / "f.npz"
    folder.mkdir()
    for number in (0, 1, 2, 5, 6, 7, 8):
        cv2.imwrite(str(folder / f"img{number:03d}.png"), np.full((32, 32, 3), number * 9, np.uint8))
    words = ("--run", tiny_run, "--sensor", "digit", "--out", out)
    assert anytouch("embed", *words, "--input", folder, "--frames", 3).status == 0
    with np.load(out) as found:
        assert [Path(name).stem for name in found["key/path"]] == ["img002", "img007", "img008"]
    assert anytouch("embed", *words, "--input", folder / "img005.png").status == 0
    with np.load(out) as one:
        lock = one["features"]
    assert anytouch("embed", *words, "--input", folder).status == 0
    with np.load(out) as every:
        np.testing.assert_allclose(lock, every["features"][3:4], rtol=1e-5, atol=1e-6)


def test_an_option_of_a_section_is_named_in_full(mistake):
    args = ("train", "--data", "nowhere.csv", "--run", "r")
    assert "no --learning-rate; use --optim.learning-rate" in mistake(*args, "--learning-rate", "1e-3")
    assert "use --optim.learning-rate" in mistake(*args, "--learning_rate=1e-3", "--model.patch", 16)
