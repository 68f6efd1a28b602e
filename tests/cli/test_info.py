import hashlib
import json
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
    done = anytouch("info", tiny_run, world, features)
    assert done.status == 0, done.err
    run, manifest, lines = done.out.strip().split("\n\n")
    for words in (
        str(tiny_run),
        "stage 1",
        "step 2 of 4",
        "checkpoints at 2",
        "digit, gelsight_mini",
        str(world),
        "loss ",
    ):
        assert words in run
    recordings = (
        "12 rows",
        "3 recordings",
        "4 clips",
        "test 2, train 8, val 2",
        "digit 8, gelsight_mini 4",
    )
    for words in (
        str(world),
        *recordings,
        "image_path 1, text 4, touch 12, object 12",
        "labels: object",
    ):
        assert words in manifest
    assert (
        f"{features}: 12 features of 12" in lines and "frame_index, object, label.object" in lines
    )
    assert "spread: the mean cosine of two features is" in lines
    assert f"encoder: {tiny_run}" in lines and anytouch("info", world.parent).out.startswith(
        str(world)
    )


def test_a_damaged_checkpoint_is_reported(anytouch, tiny_run, tmp_path):
    shutil.copytree(tiny_run, tmp_path / "run")
    assert "is damaged" not in anytouch("info", tmp_path / "run").out
    largest = max(
        (tmp_path / "run" / "checkpoints").rglob("*"),
        key=lambda file: file.stat().st_size * file.is_file(),
    )
    with open(largest, "r+b") as file:
        file.seek(largest.stat().st_size // 2)
        file.write(b"not what was here")
    done = anytouch("info", tmp_path / "run")
    assert done.status == 0 and "a run of stage 1" in done.out
    assert "is damaged" in done.out


def test_weights_report_whose_names_they_have(anytouch, tmp_path):
    import jax

    model = touch_model()
    params = build(model).init(jax.random.key(0))
    ours = tmp_path / "ours.safetensors"
    theirs = tmp_path / "theirs.safetensors"
    export_safetensors(
        ours, params, {safetensors.MODEL_KEY: to_json(model), safetensors.SEEN_KEY: "digit"}
    )
    safetensors.write_safetensors(
        theirs, convert.to_release(params, model), {safetensors.MODEL_KEY: to_json(model)}
    )
    assert (
        "this package's names" in (done := anytouch("info", ours)).out
        and "trained sensors: digit." in done.out
    )
    assert (
        "authors' (stage1) names" in (done := anytouch("info", theirs)).out
        and "unknown" in done.out
    )
    for kind in ("sensor", "shared"):
        other = touch_model(patch_encoder=kind)
        export_safetensors(
            theirs, build(other).init(jax.random.key(0)), {safetensors.MODEL_KEY: to_json(other)}
        )
        assert f"{kind} patches of 7" in anytouch("info", theirs).out
    export_safetensors(
        ours, params, {safetensors.MODEL_KEY: to_json(model), safetensors.BACKGROUND_KEY: "either"}
    )
    assert "background: either" in anytouch("info", ours).out


def test_a_folder_is_the_run_in_it_else_its_manifest(mistake, tmp_path, anytouch, tiny_run, world):
    (tmp_path / "notes.txt").write_text("x")
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    assert "gone" in mistake("info", tmp_path / "gone")
    assert "notes.txt" in mistake("info", tmp_path / "notes.txt")
    assert "weights" in mistake("info", tmp_path / "other.npz")
    assert str(tmp_path) in mistake("info", tmp_path)
    assert mistake("info")
    shutil.copytree(tiny_run, tmp_path / "run")
    shutil.copy(world, tmp_path / "run" / "manifest.csv")
    assert "a run of stage 1" in anytouch("info", tmp_path / "run").out
    (tmp_path / "mine").mkdir()
    for name in ("mine.csv", "mine_contact.csv"):
        shutil.copy(world, tmp_path / "mine" / name)
    (tmp_path / "mine" / "labels.csv").write_text("name,hardness\n")
    done = anytouch("info", tmp_path / "mine").out
    assert "mine.csv: a manifest of 12 rows" in done and "mine_contact.csv" in done


def test_an_adapted_run_and_an_export(anytouch, tiny_run, world, tmp_path):
    words = (
        "--model",
        tiny_run,
        "--data",
        world,
        "--sensor",
        "my_gel",
        "--frames",
        0,
        "--out",
        tmp_path / "new",
    )
    assert anytouch("adapt", *words).status == 0
    done = anytouch("info", tmp_path / "new").out
    assert (
        f"the run {tiny_run}, with tokens of my_gel fitted to 0 frames" in done
        and "step" not in done
    )
    (tmp_path / "encoder.bin").write_bytes(b"x")
    about = {
        "format": "anytouch_jax.export.1",
        "bytes": 1,
        "sha256": hashlib.sha256(b"x").hexdigest(),
        "frames": 3,
    }
    about |= {"image_size": 28, "features": 12, "platforms": ["cpu"], "sensors": {"universal": 0}}
    about |= dict.fromkeys(("jax", "background", "pooling", "join", "dtype"), "x")
    (tmp_path / "encoder.bin.json").write_text(json.dumps(about))
    assert "an exported encoder" in anytouch("info", tmp_path / "encoder.bin").out
    (tmp_path / "encoder.bin").write_bytes(b"y")  # flipped
    assert "is damaged" in anytouch("info", tmp_path / "encoder.bin").err


def test_the_health_of_each_unit_is_a_table_a_image_and_a_status(
    anytouch, mistake, tmp_path, world, tiny_run
):
    done = anytouch("info", world, "--health", "--image", tmp_path / "h.png", "--model", tiny_run)
    assert done.status in (0, 1) and "digit" in done.out and "orientation and colours" in done.out
    assert "contact visible to the encoder" in done.out and "units are good" in done.out
    assert (done.status == 1) == ("FAULT" in done.out)
    assert (tmp_path / "h.png").read_bytes()[:4] == b"\x89PNG"
    assert "--health" in mistake("info", world, "--image", tmp_path / "h.png")
