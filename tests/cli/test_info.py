"""`anytouch info`: what lies there, told from the thing itself."""

from __future__ import annotations

import shutil

import numpy as np
from tiny_models import touch_model

from anytouch_jax.config import to_json
from anytouch_jax.nn.functional import build
from anytouch_jax.weights import convert, safetensors
from anytouch_jax.weights.safetensors import export_safetensors


def test_a_run_a_manifest_and_features(anytouch, tiny_run, world, tmp_path):
    features = tmp_path / "f.npz"
    assert anytouch("embed", "--model", tiny_run, "--data", world, "--out", features).status == 0
    said = anytouch("info", tiny_run, world, features)
    assert said.status == 0, said.err
    run, manifest, found = said.out.strip().split("\n\n")
    assert run.startswith(f"{tiny_run}: a run of stage 1, step 2 of 4; checkpoints at 2\n")
    assert "every other one counts as never seen" in run
    assert "began from nothing trained" in run and f"data: {world} (content " in run and "loss " in run
    assert f"{world}: a manifest of 12 rows in 3 recordings, 4 clips of three frames" in manifest
    assert "splits: test 2, train 8, val 2" in manifest and "sensors: digit 8, gelsight_mini 4" in manifest
    assert "rows with image_path 1, text 4, touch 12, object 12" in manifest and "labels: object" in manifest
    assert (
        f"{features}: 12 features of 12, with path, sensor, sequence, split, frame_index, object, label.object" in found
    )
    assert f"encoder: {tiny_run}" in found and anytouch("info", world.parent).out.startswith(str(world))


def test_a_damaged_checkpoint_is_told_of(anytouch, tiny_run, tmp_path):
    shutil.copytree(tiny_run, tmp_path / "run")
    assert "is damaged: its file" not in anytouch("info", tmp_path / "run").out
    largest = max((tmp_path / "run" / "checkpoints").rglob("*"), key=lambda file: file.stat().st_size * file.is_file())
    with open(largest, "r+b") as file:
        file.seek(largest.stat().st_size // 2)
        file.write(b"not what was here")
    said = anytouch("info", tmp_path / "run")
    assert said.status == 0 and "a run of stage 1" in said.out
    assert "is damaged: its file" in said.out and "no older checkpoint is intact" in said.out


def test_weights_tell_whose_names_they_have(anytouch, tmp_path):
    import jax

    model = touch_model()
    params = build(model).init(jax.random.key(0))
    ours, theirs = tmp_path / "ours.safetensors", tmp_path / "theirs.safetensors"
    export_safetensors(ours, params, {safetensors.MODEL_KEY: to_json(model), safetensors.SEEN_KEY: "digit"})
    safetensors.write_safetensors(theirs, convert.to_release(params, model), {safetensors.MODEL_KEY: to_json(model)})
    assert "by our own names" in (said := anytouch("info", ours)).out and "trained on: digit;" in said.out
    assert "by the authors (stage1) names" in (said := anytouch("info", theirs)).out and "is not told" in said.out
    for kind, told in (("sensor", "patches of 7, each sensor by its own;"), ("convolutional", "read by convolutions;")):
        other = touch_model(patch_encoder=kind)
        export_safetensors(theirs, build(other).init(jax.random.key(0)), {safetensors.MODEL_KEY: to_json(other)})
        assert told in anytouch("info", theirs).out
    params["touch"]["class_token"] = params["touch"]["class_token"] * np.nan
    export_safetensors(ours, params, {safetensors.MODEL_KEY: to_json(model)})
    assert "not finite: nothing can be embedded" in anytouch("info", ours).out


def test_what_is_none_of_these_is_one_sentence(mistake, tmp_path):
    (tmp_path / "notes.txt").write_text("x")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    assert "gone" in mistake("info", tmp_path / "gone")
    assert "notes.txt" in mistake("info", tmp_path / "notes.txt")
    assert "weights" in mistake("info", tmp_path / "other.npz")
    assert str(tmp_path) in mistake("info", tmp_path)
    assert mistake("info")


def test_a_folder_is_the_run_in_it_else_its_manifest(anytouch, tiny_run, world, tmp_path):
    shutil.copytree(tiny_run, tmp_path / "run")
    shutil.copy(world, tmp_path / "run" / "manifest.csv")
    assert "a run of stage 1" in anytouch("info", tmp_path / "run").out
    (tmp_path / "mine").mkdir()
    for name in ("mine.csv", "mine_contact.csv"):
        shutil.copy(world, tmp_path / "mine" / name)
    (tmp_path / "mine" / "labels.csv").write_text("name,hardness\n")
    said = anytouch("info", tmp_path / "mine").out
    assert "mine.csv: a manifest of 12 rows" in said and "also in this folder: mine_contact.csv" in said


def test_an_adapted_run_and_an_export(anytouch, tiny_run, world, tmp_path):
    words = ("--model", tiny_run, "--data", world, "--sensor", "my_gel", "--frames", 0, "--out", tmp_path / "new")
    assert anytouch("adapt", *words).status == 0
    said = anytouch("info", tmp_path / "new").out
    assert f"the run {tiny_run}, with tokens of my_gel fitted to 0 frames" in said and "step" not in said
    (tmp_path / "encoder.bin").write_bytes(b"x")
    (tmp_path / "encoder.bin.json").write_text('{"frames": 3}')
    assert "an exported encoder; how to call it\n" in anytouch("info", tmp_path / "encoder.bin").out
