"""The linear head of a probe on disk: `probe --save`, `embed --head`, `load_head`."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from runs import run_config, train

from anytouch_jax.evaluate.heads import load_head


@pytest.fixture(scope="module")
def head(tmp_path_factory, world, tiny_run):
    from anytouch_jax.cli.app import main

    path = tmp_path_factory.mktemp("head") / "head.npz"
    words = ["probe", "--run", tiny_run, "--data", world, "--label", "object", "--group", "sequence", "--seeds", "0"]
    assert main([str(word) for word in [*words, "--no-controls", "--save", path]]) == 0
    return path


def test_the_head_that_was_probed_names_the_rows_of_a_manifest(anytouch, tmp_path, world, tiny_run, head):
    out = tmp_path / "f.npz"
    said = anytouch(
        "embed", "--run", tiny_run, "--input", world, "--pooling", "both", "--head", head, "--split", "train",
        "--out", out,
    )  # fmt: skip
    assert said.status == 0, said
    with np.load(out) as file:
        truth = [("ball", "cube")[number % 2] for number in file["key/frame_index"]]
        assert file["label"].tolist() == truth and (file["p"] > 0.5).all() and (file["p"] <= 1).all()
        labels, p = load_head(head)(file["features"])
        np.testing.assert_array_equal(labels, file["label"])
        np.testing.assert_array_equal(p.max(1), file["p"])
    np.testing.assert_allclose(p.sum(1), 1, atol=1e-6)
    told = anytouch("info", head).out
    assert "for object: ball, cube" in told and "--pooling both --frames 1" in told
    kept = load_head(head)
    assert (kept.classes.tolist(), kept.label, kept.pooling, kept.frames) == (["ball", "cube"], "object", "both", 1)


def test_a_stream_names_each_frame(anytouch, mistake, tmp_path, tiny_run, head):
    video = tmp_path / "touch.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 10, (32, 32))
    for value in (40, 180):
        writer.write(np.full((32, 32, 3), value, np.uint8))
    writer.release()
    args = ("embed", "--run", tiny_run, "--input", video, "--stream", "--head", head)  # which says the pooling
    lines = [json.loads(line) for line in anytouch(*args, "--out", "-").out.splitlines()]
    labels, p = load_head(head)(np.array([line["features"] for line in lines], np.float32))
    assert [line["label"] for line in lines] == labels.tolist()
    np.testing.assert_allclose([line["p"] for line in lines], p.max(1), atol=1e-6)
    assert anytouch(*args, "--out", tmp_path / "f.npz").status == 0
    with np.load(tmp_path / "f.npz") as file:
        assert file["label"].tolist() == labels.tolist() and file["about/pooling"] == "both"
    assert "--pooling both" in mistake(*args, "--pooling", "class", "--out", "-")


def test_a_head_of_other_features_is_refused(mistake, tmp_path, world, tiny_run, head):
    args = ("embed", "--input", world, "--out", tmp_path / "f.npz", "--head")
    other = ("--run", tiny_run, "--pooling", "mean")
    assert "--pooling both" in mistake(*args, head, *other)
    assert "--pooling both --frames 1" in mistake(*args, head, *other, "--frames", 3)
    other = tmp_path / "other"
    train(run_config(world, seed=5, steps=1), other)
    told = mistake(*args, head, "--run", other)
    assert "another encoder" in told and str(other) in told
    (tmp_path / "odd.npz").write_bytes(b"odd")
    assert "odd.npz is not the head" in mistake(*args, tmp_path / "odd.npz", "--run", tiny_run)
    assert "There is no head" in mistake(*args, tmp_path / "gone.npz", "--run", tiny_run)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ([], "--save keeps the linear head of one encoder: give one --run, not 0"),
        (["--run", "a", "b"], "give one --run, not 2"),
        (["--run", "a", "--tasks", "all"], "--save does nothing beside --tasks"),
        (["--run", "a", "--leave-out", "object"], "--save does nothing beside --leave-out"),
    ],
)
def test_what_keeps_no_head_is_refused(mistake, tmp_path, words, told):
    assert told in mistake("probe", "--data", "nowhere.csv", "--save", tmp_path / "h.npz", *words)
