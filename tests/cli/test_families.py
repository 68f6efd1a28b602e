import json
import shutil

import cv2
import numpy as np
import pytest
from places import ROOT
from safetensors.numpy import save_file
from touch_world import make_touches
from videos import write_video

from anytouch_jax import load_encoder
from anytouch_jax.export import export
from tests.weights.test_start import mae
from tests.zoo import test_families as forms

OTHERS = ROOT / "tests" / "parity" / "golden_others"
# small files of the other families: title, (width, depth, heads, mlp), patch, what else differs,
# pixels
MADE = {
    "sparsh_video": (
        forms.VIDEO,
        (20, 1, 5, 30),
        8,
        {"tubelet": 2, "frames": 4, "grid": (2, 5, 5)},
        (40, 40),
    ),
    "sitr": (
        forms.SITR,
        (18, 1, 3, 20),
        8,
        {"grid": (1, 4, 4), "calibration": 9, "outputs": 11},
        (32, 32),
    ),
    "t3": (forms.T3, (24, 1, 4, 48), 8, {"grid": (1, 5, 5), "trunk": 1}, (40, 40)),
}


@pytest.fixture(scope="module")
def touches(tmp_path_factory):
    return make_touches(
        tmp_path_factory.mktemp("touches"),
        touches={"train": 4, "val": 4, "test": 6},
        each=2,
        frames=4,
    )


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A file of each family.

    AnyTouch 2 takes clips of 4 frames, needs a background and knows sensors.
    """
    folder = tmp_path_factory.mktemp("files")
    made = {}
    for name, (title, stack, *more) in MADE.items():
        *_, arrays = forms.made(title, stack, *more)
        file = folder / name / "model.safetensors"
        if title == forms.T3:
            file = forms.write_t3(folder / name, arrays)
        else:
            file.parent.mkdir()
            save_file(arrays, file)
        (folder / name / "config.json").write_text(json.dumps({"num_attention_heads": stack[2]}))
        made[name] = file
    (folder / "sitr" / "calibration").mkdir()
    for number in range(10):
        cv2.imwrite(
            str(folder / "sitr" / "calibration" / f"{number:04d}.png"),
            np.full((32, 32, 3), 80, np.uint8),
        )
    (folder / "anytouch2").mkdir()
    shutil.copy(OTHERS / "anytouch2_checkpoint-4frames.pth", folder / "anytouch2" / "model.pth")
    (folder / "anytouch2" / "config.json").write_text(json.dumps({"num_attention_heads": 4}))
    return made | {"vit_mae": mae(folder / "mae"), "anytouch2": folder / "anytouch2" / "model.pth"}


FAMILIES = ("vit_mae", "anytouch2", *(pytest.param(name, marks=pytest.mark.slow) for name in MADE))


@pytest.mark.parametrize("family", FAMILIES)
def test_probes_retrieval_and_regression_of_a_family(anytouch, family, files, touches, tmp_path):
    words = ("--model", files[family], "--data", touches)
    out = tmp_path / "probe.json"
    done = anytouch(
        "probe", "label", *words, "--label", "hardness", "--no-controls", "--seeds", 1, "--out", out
    )
    assert done.status == 0, done.err
    assert f"{files[family]}: linear" in done.out and json.loads(out.read_text())
    out = tmp_path / "retrieve.json"
    done = anytouch("retrieve", *words, "--gallery", 6, "--out", out)
    assert done.status == 0, done.err
    names = {one["name"] for one in json.loads(out.read_text())["results"]}
    assert {str(files[family]), "random encoder"} <= names
    done = anytouch("probe", "tasks", *words, "--tasks", "force", "--frames", 4)
    assert done.status == 0 and "force" in done.out, done.err


@pytest.mark.parametrize("family", FAMILIES)
def test_a_streamed_video_gives_the_features_of_embed(anytouch, family, files, tmp_path):
    video = tmp_path / "video.avi"
    gel = tmp_path / "gel.png"
    write_video(video, (np.full((40, 48, 3), 25 * frame, np.uint8) for frame in range(9)))
    cv2.imwrite(str(gel), np.full((40, 48, 3), 90, np.uint8))
    words = ["--model", files[family], "--data", video, "--sensor", "digit", "--background", gel]
    words += ["--frames", load_encoder(files[family]).form.model.frames]
    outs = [tmp_path / f"{name}.npz" for name in ("stream", "embed")]
    for name, out in zip(("stream", "embed"), outs, strict=True):
        done = anytouch(name, *words, "--out", out)
        assert done.status == 0, done.err
    with np.load(outs[0]) as a, np.load(outs[1]) as b:
        assert len(a["features"]) > 3
        np.testing.assert_allclose(
            a["features"], b["features"], atol=2e-5 * np.abs(b["features"]).max()
        )


def test_a_run_starts_from_a_family_whose_form_and_export_are_known(
    files, anytouch, touches, tmp_path
):
    encoder = load_encoder(files["vit_mae"])
    logged = list[str]()
    assert [encoder.sensor_row("digit", logged.append) for _ in range(3)] == [0, 0, 0]
    (sentence,) = logged
    assert "the sensor 'digit' is ignored" in sentence
    exported = tmp_path / "encoder.bin"
    frames = np.zeros((2, 1, 28, 28, 3), np.float32)
    done = anytouch("export", "--model", files["vit_mae"], "--out", exported, "--platforms", "cpu")
    assert done.status == 0, done.err
    np.testing.assert_allclose(
        export.load(exported)(frames), encoder.encode_touch(frames), atol=1e-5
    )
    assert "non-commercial" in anytouch("info", files["vit_mae"]).out
    size = (
        "--model.image-size 28 --model.patch 7 --model.touch.width 16 --model.touch.depth 2 "
        "--model.touch.heads 2"
    )
    size += " --model.touch.mlp 32 --model.norm-eps 1e-12"
    size += " --model.decoder.width 8 --model.decoder.depth 1"
    words = [
        "--run",
        tmp_path / "run",
        "--init",
        files["vit_mae"],
        "--batch",
        4,
        "--steps",
        2,
        "--stop-after",
        1,
    ]
    words += [*size.split(), "--model.decoder.heads", "2", "--data.clip-fraction", "0"]
    done = anytouch("train", "--data", touches, *words)
    assert done.status == 2 and "--model.no-pre-norm" in done.err, done.err
    done = anytouch("train", "--data", touches, *words, "--model.no-pre-norm")
    assert done.status == 0 and "gives the touch encoder" in done.err, done.err
    assert "pre_norm" not in load_encoder(tmp_path / "run").params["touch"]
