import stat
from dataclasses import replace

import cv2
import jax
import numpy as np
import pytest
from tiny_models import touch_model
from videos import write_video

from anytouch_jax.config import SENSORS, to_json
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.errors import CheckError
from anytouch_jax.export import export
from anytouch_jax.nn.functional import build
from anytouch_jax.weights import load, safetensors
from anytouch_jax.weights.safetensors import export_safetensors
from anytouch_jax.weights.tree import flatten


@pytest.fixture
def weights(anytouch):
    """weights(to, model, out, *words): write weights, which must succeed; returns `out`."""

    def run(to, model, out, *words):
        done = anytouch("export", "--to", to, "--model", model, "--out", out, *words)
        assert done.status == 0 and str(out) in done.out, done.err
        return out

    return run


def write_rows(path, count):
    rows = "".join(f"{number}.png,digit,s,{number},train\n" for number in range(count))
    path.write_text(f"path,sensor,sequence,frame_index,split\n{rows}")


def write(path, model, params, **metadata):
    arrays = {name: np.asarray(array) for name, array in flatten(params).items()}
    safetensors.write_safetensors(path, arrays, {safetensors.MODEL_KEY: to_json(model)} | metadata)
    return path


def test_the_file_for_jax_gives_the_features_of_the_live_model(
    anytouch, tmp_path, tiny_run, monkeypatch
):
    out = tmp_path / "made" / "model.bin"
    done = anytouch(
        "export", "--model", tiny_run, "--out", out, "--frames", 1, "--platforms", "cpu", "cuda"
    )
    assert done.status == 0, done
    assert "cpu, cuda" in done.out and f"{out}.json" in done.out
    frames = np.random.default_rng(0).integers(0, 256, (2, 1, 28, 28, 3), np.uint8)
    live = load_encoder(tiny_run).encode_touch(frames, "digit")
    np.testing.assert_allclose(export.load(out)(frames, "digit"), live, atol=1e-5)
    assert anytouch("export", "--model", tiny_run, "--out", out, "--dtype", "bfloat16").status == 0
    assert 1e-5 < np.abs(export.load(out)(frames, "digit") - live).max() / np.abs(live).max() < 0.05

    def differs(*_, **__):
        raise CheckError("the artefact differs")

    monkeypatch.setattr(export, "export_with", differs)
    done = anytouch("export", "--model", tiny_run, "--out", tmp_path / "m.bin")
    assert done.status == 1 and "differs" in done.err


def test_a_file_for_engines_embeds_and_streams_like_the_run(anytouch, tmp_path, tiny_run):
    pytest.importorskip("onnxruntime")
    rng, out, small, table = (
        np.random.default_rng(0),
        *(tmp_path / f"{n}" for n in ("m.onnx", "int8.onnx", "t.csv")),
    )
    for number in range(200):
        cv2.imwrite(str(tmp_path / f"{number}.png"), rng.integers(0, 256, (28, 28, 3), np.uint8))
    write_rows(table, 200)

    def features(command, data, *words):
        made = tmp_path / f"{len(list(tmp_path.iterdir()))}.npz"
        done = anytouch(command, *words, "--data", data, "--out", made)
        assert done.status == 0, done
        with np.load(made) as file:
            return file["features"], str(file["about/weights"])

    done = anytouch("export", "--to", "onnx", "--model", tiny_run, "--out", out)
    assert done.status == 0 and f"{out}.json" in done.out, done
    done = anytouch(
        "export", "--to", "onnx", "--model", tiny_run, "--out", small, "--int8", "--data", table
    )
    assert done.status == 0 and "in int8" in done.out and "on 200 touches" in done.out, done
    live, fingerprint = features("embed", table, "--model", tiny_run)
    for model, tolerance in ((out, 1e-5), (small, 0.1)):
        found, weights = features("embed", table, "--model", model)
        assert (
            np.abs(found - live).max() < tolerance * np.abs(live).max() and weights == fingerprint
        )
    video = write_video(
        tmp_path / "video.avi", [cv2.imread(str(tmp_path / f"{number}.png")) for number in range(3)]
    )
    engines = (
        ["--model", tiny_run],
        ["--model", tiny_run, "--engine", "onnxruntime"],
        ["--model", out],
    )
    found = [features("stream", video, *words, "--sensor", "digit")[0] for words in engines]
    np.testing.assert_allclose(found[1:], [found[0]] * 2, atol=1e-5)
    done = anytouch(
        "stream", "--model", out, "--engine", "xla", "--data", video, "--out", tmp_path / "no.npz"
    )
    assert done.status == 2 and "not on xla" in done.err and not (tmp_path / "no.npz").exists()


def test_weights_go_to_the_authors_names_and_back(tmp_path, tiny_run, weights):
    theirs = weights("release", tiny_run, tmp_path / "release.safetensors")
    ours = weights("safetensors", theirs, tmp_path / "own.safetensors")
    again = weights("release", ours, tmp_path / "again.safetensors")
    assert theirs.read_bytes()[-4096:] == again.read_bytes()[-4096:]
    assert stat.S_IMODE(ours.stat().st_mode) == 0o644  # others may read it
    clip = np.random.default_rng(0).integers(0, 256, (2, 3, 28, 28, 3), np.uint8)
    expected = load_encoder(tiny_run).encode_touch(clip, "digit")
    # two heads of width 8: the shapes alone would suggest one head
    for path in (theirs, ours, again):
        np.testing.assert_array_equal(load_encoder(path).encode_touch(clip, "digit"), expected)


def test_the_universal_tokens_go_to_the_last_row(tmp_path, weights):
    # A sensor added at the end of the table is after them, and the authors' code reads the last
    # row.
    model = touch_model(sensors=(*SENSORS, "mine"))
    params = build(model).init(jax.random.key(0))
    export_safetensors(
        tmp_path / "own.safetensors", params, {safetensors.MODEL_KEY: to_json(model)}
    )
    theirs = weights("release", tmp_path / "own.safetensors", tmp_path / "theirs.safetensors")
    table = load.read_weights(theirs)["sensor_token"]
    np.testing.assert_array_equal(
        table[-1], params["touch"]["sensor_tokens"][SENSORS.index("universal")]
    )
    np.testing.assert_array_equal(table[-2], params["touch"]["sensor_tokens"][-1])
    assert load_encoder(theirs).sensor_row("mine") == len(SENSORS) - 1


@pytest.fixture
def two(tmp_path):
    """(first, second): files of two encoders of one network, and the parameters of both."""
    model = touch_model()
    params = [{"touch": build(model).init(jax.random.key(seed))["touch"]} for seed in (0, 1)]
    files = [
        write(tmp_path / f"{name}.safetensors", model, tree)
        for name, tree in zip("ab", params, strict=True)
    ]
    return files, params


def test_weights_between_two_runs_are_interpolated(two, tmp_path, weights):
    (first, second), params = two
    start, end = (flatten(tree) for tree in params)
    for fraction in (0, 0.25, 1):
        out = weights(
            "safetensors",
            second,
            tmp_path / "w.safetensors",
            "--between",
            first,
            "--fraction",
            fraction,
        )
        arrays = load.read_weights(out)
        assert arrays.keys() == end.keys()
        for name, array in arrays.items():
            expected = np.asarray(start[name]) * (1 - fraction) + np.asarray(end[name]) * fraction
            np.testing.assert_allclose(array, expected, rtol=1e-6, atol=1e-7)
    clip = np.random.default_rng(0).integers(0, 256, (2, 3, 28, 28, 3), np.uint8)
    np.testing.assert_array_equal(
        load_encoder(out).encode_touch(clip), load_encoder(second).encode_touch(clip)
    )
    source = safetensors.read_file_metadata(out)["source"]
    assert str(first) in source and str(second) in source


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ("--out m.bin --frames 2", "3 frames"),
        ("--out m.bin --model gone", "gone"),
        ("--out m.bin --aggregation sum", "--aggregation"),
        ("--out m.bin --fraction 0.3", "--fraction"),
        ("--out afile/m.bin", "--out"),
        ("--out m.onnx --int8", "--int8 has no effect with --to jax"),
        ("--out m.onnx --to onnx --data few.csv", "--int8 and --data"),
        ("--out m.onnx --to onnx --int8 --data few.csv", "needs 200 touches and --data has 3"),
        ("--out m.onnx --to onnx --dtype bfloat16", "--dtype"),
        ("--out m.bin --to onnx", ".onnx"),
        ("--out w.bin --to release", ".safetensors"),
        ("--out w.safetensors --to release", "--to safetensors"),  # it lacks a decoder
        ("--out b.safetensors --to safetensors", "--out"),
        ("--out w.safetensors --to safetensors --frames 3", "--frames"),
        ("--out w.safetensors --to safetensors --fraction 0.25", "--fraction"),
        ("--out w.safetensors --to safetensors --between eps.safetensors", "norm_eps"),
        ("--out w.safetensors --to safetensors --between gel.safetensors", "background"),
    ],
)
def test_mistakes_write_nothing(two, tmp_path, mistake, monkeypatch, words, named):
    monkeypatch.chdir(tmp_path)
    params = two[1][0]
    write(tmp_path / "eps.safetensors", replace(touch_model(), norm_eps=1e-3), params)
    write(
        tmp_path / "gel.safetensors",
        touch_model(),
        params,
        **{safetensors.BACKGROUND_KEY: "subtract"},
    )
    (tmp_path / "afile").write_text("")
    write_rows(tmp_path / "few.csv", 3)
    before = sorted(tmp_path.iterdir())
    model = [] if "--model" in words else ["--model", "b.safetensors"]
    assert named in mistake("export", *model, *words.split())
    assert sorted(tmp_path.iterdir()) == before
