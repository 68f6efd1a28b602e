import json
import shutil
import zlib

import cv2
import numpy as np
import pytest
from runs import run_config, train
from videos import write_video

import anytouch_jax as at
from anytouch_jax.cli.arguments import DEFAULT
from anytouch_jax.encoder.linear_head import load_head
from anytouch_jax.weights import load, registry


@pytest.fixture
def embed(anytouch, tiny_run, tmp_path):
    """embed(data, *words): the arrays of the features file, which must be written."""

    def run(data, *words):
        out = tmp_path / "features.npz"
        data = data if isinstance(data, list) else [data]
        batch = [] if "--batch" in words else ["--batch", 4]
        done = anytouch("embed", "--model", tiny_run, "--data", *data, "--out", out, *batch, *words)
        assert done.status == 0, done.err
        with np.load(out) as file:
            return dict(file) | {"done": done}

    return run


def test_a_manifest_and_a_folder_of_its_frames_have_the_same_features(embed, tmp_path, world):
    of_manifest = embed(world, "--split", "test")
    assert of_manifest["features"].shape == (2, 12) and of_manifest["rows"].tolist() == [10, 11]
    assert of_manifest["key/path"].tolist() == ["c2.png", "c3.png"] and set(
        of_manifest["key/split"]
    ) == {"test"}
    assert (
        of_manifest["key/object"].tolist()
        == of_manifest["key/label.object"].tolist()
        == ["ball", "cube"]
    )
    assert len(str(of_manifest["about/weights"])) == 8 and "about/sensor" not in of_manifest

    folder = tmp_path / "frames"
    folder.mkdir()
    for frame in (2, 3):
        shutil.copy(world.parent / f"c{frame}.png", folder)
    of_folder = embed(folder, "--sensor", "digit")
    np.testing.assert_allclose(of_folder["features"], of_manifest["features"], atol=1e-6)
    assert of_folder["key/frame_index"].tolist() == [0, 1] and str(of_folder["about/input"]) == str(
        folder
    )
    assert (
        of_folder["key/path"].tolist() == ["c2.png", "c3.png"]
        and str(of_folder["about/sensor"]) == "digit"
    )
    of_image = embed(folder / "c3.png", "--sensor", "digit")
    np.testing.assert_allclose(
        of_image["features"], of_folder["features"][1:], rtol=1e-5, atol=1e-6
    )
    other = embed(folder, "--sensor", "new_sensor")
    assert "'new_sensor'" in other["done"].err and "universal" in other["done"].err
    assert np.abs(other["features"] - of_folder["features"]).max() > 1e-4
    half = embed(folder, "--sensor", "digit", "--dtype", "bfloat16")
    error = (
        np.abs(half["features"] - of_folder["features"]).max() / np.abs(of_folder["features"]).max()
    )
    assert str(half["about/dtype"]) == "bfloat16" and 1e-5 < error < 0.05


def test_clips_of_a_manifest_and_of_a_video(embed, tmp_path, world):
    shutil.copytree(world.parent, tmp_path / "other")
    # several are read together
    of_manifest = embed([world, tmp_path / "other" / world.name], "--frames", 3)
    assert (
        of_manifest["rows"].tolist() == [2, 3, 6, 7, 14, 15, 18, 19]
        and "16 of 24" in of_manifest["done"].err
    )
    np.testing.assert_allclose(of_manifest["features"][:4], of_manifest["features"][4:], atol=1e-6)
    video = write_video(
        tmp_path / "touch.avi", [np.full((32, 32, 3), 40 * frame, np.uint8) for frame in range(5)]
    )
    # a large batch costs nothing
    of_video = embed(video, "--frames", 3, "--batch", 10**7)
    assert of_video["features"].shape == (3, 12) and of_video["key/frame_index"].tolist() == [
        2,
        3,
        4,
    ]


def test_a_stack_is_embedded_frame_by_frame(embed, tmp_path, mistake, tiny_run):
    frames = np.random.default_rng(0).integers(0, 256, (5, 32, 32, 3), np.uint8)
    (tmp_path / "folder").mkdir()
    for number, frame in enumerate(frames):
        cv2.imwrite(str(tmp_path / "folder" / f"{number}.png"), frame[..., ::-1])
    np.save(tmp_path / "stack.npy", frames)
    np.savez(tmp_path / "stack.npz", rgb=frames)
    for length in (1, 3):
        words = ("--sensor", "digit", "--frames", length)
        wanted = embed(tmp_path / "folder", *words)
        for name in ("stack.npy", "stack.npz"):
            found = embed(tmp_path / name, *words)
            np.testing.assert_allclose(found["features"], wanted["features"], atol=1e-6)
            assert found["key/frame_index"].tolist() == list(range(length - 1, 5))
    np.savez(tmp_path / "two.npz", left=frames, right=frames)
    out = ("--out", tmp_path / "f.npz")
    assert "left" in mistake("embed", "--model", tiny_run, "--data", tmp_path / "two.npz", *out)


def test_a_bad_image_of_a_folder_is_named_or_left_out(embed, mistake, tmp_path, world, tiny_run):
    folder = tmp_path / "frames"
    folder.mkdir()
    for place, name in enumerate(("a0", "a1", "a2", "a3", "b0", "b1", "b2")):
        shutil.copy(world.parent / f"{name}.png", folder / f"{place}.png")
    (folder / "2.png").write_bytes((folder / "2.png").read_bytes()[:-20])
    words = ("embed", "--model", tiny_run, "--data", folder, "--out", tmp_path / "features.npz")
    assert "2.png" in mistake(*words) and not (tmp_path / "features.npz").exists()
    # no clip spans a missing frame
    for frames, ends in ((1, [0, 1, 3, 4, 5, 6]), (3, [5, 6])):
        lenient = embed(
            folder, "--sensor", "gelsight_mini", "--on-bad-sample", "skip", "--frames", frames
        )
        assert lenient["rows"].tolist() == lenient["key/frame_index"].tolist() == ends
        assert lenient["key/path"].tolist() == [f"{end}.png" for end in ends]
        assert (
            f"{8 - frames - len(ends)} skipped" in lenient["done"].out
            and "2.png" in lenient["done"].err
        )
    of_manifest = embed(world, "--frames", 3)
    same = of_manifest["features"][of_manifest["rows"] == 6]
    np.testing.assert_allclose(same, lenient["features"][-1:], atol=1e-6)


def test_a_bad_row_of_a_manifest_is_named_however_the_run_was_trained(
    anytouch, mistake, tmp_path, world, tiny_run
):
    shutil.copytree(world.parent, tmp_path / "w")
    (tmp_path / "w" / "c2.png").write_bytes(b"no picture")
    shutil.copytree(tiny_run, tmp_path / "r")
    record = next((tmp_path / "r" / "checkpoints").glob("*/checkpoint.json"))
    content = json.loads(record.read_text())["record"]
    content["config"] = content["config"].replace(
        '"on_bad_sample": "error"', '"on_bad_sample": "skip"'
    )
    assert '"skip"' in content["config"]
    body = json.dumps(content, sort_keys=True)
    record.write_text(json.dumps({"checksum": zlib.crc32(body.encode()), "record": content}))
    shared = ("--model", tmp_path / "r", "--data", tmp_path / "w" / world.name)
    words = ("embed", *shared, "--out", tmp_path / "f.npz", "--batch", 4)
    assert "line 12 of" in mistake(*words)
    done = anytouch(*words, "--on-bad-sample", "skip")
    assert done.status == 0 and "1 skipped" in done.out and "line 12 of" in done.err
    done = anytouch("probe", "label", *shared)
    assert done.status == 2 and "line 12 of" in done.err


def test_no_clip_spans_two_fingers_or_a_missing_number(embed, tmp_path, world):
    fingers = [f"{finger}_{number}" for finger in ("left", "right") for number in range(3)]
    gap = [f"img{number:03d}" for number in (0, 1, 2, 5, 6, 7, 8)]
    for names, ends in ((fingers, ["left_2", "right_2"]), (gap, ["img002", "img007", "img008"])):
        folder = tmp_path / names[0]
        folder.mkdir()
        for name in names:
            shutil.copy(world.parent / "a0.png", folder / f"{name}.png")
        paths = embed(folder, "--sensor", "digit", "--frames", 3)["key/path"].tolist()
        assert paths == [f"{end}.png" for end in ends]


def test_a_folder_names_what_it_lacks(embed, tmp_path, world, tiny_run, mistake):
    """A missing sensor is noted once, a misspelled one refused, and so is a folder without
    images.
    """
    assert embed(world.parent)["done"].err.count("--sensor") == 1
    assert "--sensor" not in embed(world.parent, "--sensor", "universal")["done"].err
    folder = tmp_path / "mine"
    words = ("embed", "--model", tiny_run, "--out", tmp_path / "f.npz", "--data")
    assert "digit" in mistake(*words, world.parent, "--sensor", "DIGIT")
    (folder / "mug").mkdir(parents=True)
    assert str(folder) in mistake(*words, folder)
    shutil.copy(world.parent / "a0.png", folder / "mug" / "0.png")
    assert "anytouch data index recordings" in mistake(*words, folder)
    (folder / "labels.csv").write_text("object,material\nmug,clay\n")
    (folder / "mine.csv").write_text(
        "path,sensor,sequence,frame_index,split\nmug/0.png,digit,mug,0,train\n"
    )
    assert str(folder / "mine.csv") in mistake(*words, folder)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["m.csv", "--sensor", "digit"], ["--sensor"]),
        (["m.csv", "--rotate", "90", "--flip", "across"], ["--rotate", "--flip"]),
        (["m.parquet", "--background", "g.png"], ["--background"]),
        (["m.csv", "frames"], ["--data"]),
        (["m.csv", "--batch", "0"], ["--batch"]),
        (["m.csv", "--out", "f.csv"], ["--out", ".npz"]),
        (["m.csv", "--out", "afile/f.npz"], ["--out", "afile"]),
        (["m.csv"], ["nowhere"]),
        (["m.csv", "--split", "test", "--frames", "3", "--batch", "8"], ["nowhere"]),
        (["frames", "--split", "test"], ["--split"]),
        (
            ["frames", "--sensor", "digit", "--batch", "8", "--rotate", "270", "--flip", "down"],
            ["nowhere"],
        ),
        (["video.mp4", "--on-bad-sample", "skip"], ["--on-bad-sample"]),
        (["gone"], ["gone"]),
    ],
)
def test_mistakes_are_named_before_the_encoder_is_loaded(
    mistake, tmp_path, monkeypatch, words, named
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "frames").mkdir()
    for name in ("m.csv", "video.mp4", "afile"):
        (tmp_path / name).write_text("")
    out = [] if "--out" in words else ["--out", "f.npz"]
    sentence = mistake("embed", "--model", "nowhere", "--data", *words, *out)
    assert all(name in sentence for name in named), sentence


@pytest.mark.parametrize("command", ["embed", "measure", "stream"])
@pytest.mark.parametrize("stored", ["run", "package"])
def test_a_misspelt_sensor_is_named_before_the_encoder_is_loaded(
    mistake, tmp_path, tiny_run, monkeypatch, command, stored
):
    def loaded(*_, **__):
        raise AssertionError("loading takes seconds")

    monkeypatch.setattr(load, "load_model", loaded)
    video = write_video(tmp_path / "video.avi", [np.zeros((32, 32, 3), np.uint8)])
    model = ["--model", tiny_run] if stored == "run" else []
    words = (command, *model, "--data", video, "--out", tmp_path / "f.npz", "--sensor")
    assert "did you mean digit" in mistake(*words, "DIGIT")
    assert "sensor.json" in mistake(*words, "gone.sensor")


@pytest.fixture(scope="module")
def head(tmp_path_factory, world, tiny_run):
    from anytouch_jax.cli.app import main

    path = tmp_path_factory.mktemp("head") / "head.npz"
    words = [
        "probe",
        "label",
        "--model",
        tiny_run,
        "--data",
        world,
        "--label",
        "object",
        "--group",
        "sequence",
    ]
    words += ["--seeds", "0", "--pooling", "both", "--no-controls", "--save", path]
    assert main([str(word) for word in words]) == 0
    return path


def test_the_head_of_a_probe_names_the_rows_of_a_manifest(embed, anytouch, world, head):
    arrays = embed(world, "--head", head, "--split", "train")
    truth = [("ball", "cube")[number % 2] for number in arrays["key/frame_index"]]
    assert (
        arrays["label"].tolist() == truth and (arrays["p"] > 0.5).all() and (arrays["p"] <= 1).all()
    )
    labels, p = load_head(head)(arrays["features"])
    np.testing.assert_array_equal(labels, arrays["label"])
    np.testing.assert_array_equal(p.max(1), arrays["p"])
    np.testing.assert_allclose(p.sum(1), 1, atol=1e-6)
    about = anytouch("info", head).out
    assert "object" in about and "ball, cube" in about and "--pooling both --frames 1" in about
    saved = load_head(head)
    assert (saved.classes.tolist(), saved.label, saved.pooling, saved.frames) == (
        ["ball", "cube"],
        "object",
        "both",
        1,
    )
    assessed = saved.assess(arrays["features"])
    np.testing.assert_array_equal(arrays["set"], assessed.in_set)
    np.testing.assert_array_equal(arrays["novel"], assessed.novel)
    assert (
        arrays["classes"].tolist() == ["ball", "cube"]
        and arrays["contact"].shape == arrays["p"].shape
    )


def test_a_stream_names_each_frame(anytouch, mistake, tmp_path, tiny_run, head):
    video = write_video(
        tmp_path / "touch.avi", [np.full((32, 32, 3), value, np.uint8) for value in (40, 180)]
    )
    # whose pooling is taken
    words = ("stream", "--model", tiny_run, "--data", video, "--head", head)
    lines = [json.loads(line) for line in anytouch(*words, "--out", "-").out.splitlines()]
    labels, p = load_head(head)(np.array([line["features"] for line in lines], np.float32))
    assert [line["label"] for line in lines] == labels.tolist()
    np.testing.assert_allclose([line["p"] for line in lines], p.max(1), atol=1e-6)
    assert {tuple(line["set"]) for line in lines} <= {(), ("ball",), ("cube",), ("ball", "cube")}
    assert {line["novel"] for line in lines} <= {True, False}
    # no image of the untouched gel
    assert [line["contact"] for line in lines] == [None, None]
    gel = np.full((32, 32, 3), 40, np.uint8)
    gel[8:24, 8:24] = 200  # of which neither frame is a tint
    cv2.imwrite(str(tmp_path / "gel.png"), gel)
    touched = anytouch(*words, "--background", tmp_path / "gel.png", "--out", "-").out.splitlines()
    assert [json.loads(line)["contact"] for line in touched] == [True, True]
    assert anytouch(*words, "--out", tmp_path / "f.npz").status == 0
    with np.load(tmp_path / "f.npz") as file:
        assert (
            np.isnan(file["contact"]).all()
            and file["novel"].dtype == bool
            and file["set"].shape == (2, 2)
        )
        assert file["label"].tolist() == labels.tolist() and file["about/pooling"] == "both"
    assert "--pooling both" in mistake(*words, "--pooling", "class", "--out", "-")


def test_a_head_of_other_features_is_refused(mistake, tmp_path, world, tiny_run, head):
    words = ("embed", "--data", world, "--out", tmp_path / "f.npz", "--head")
    train(run_config(world, seed=5, steps=1), tmp_path / "other")
    (tmp_path / "odd.npz").write_bytes(b"odd")
    for file, model, more, named in (
        (head, tiny_run, ["--pooling", "mean"], "--pooling both"),
        (head, tmp_path / "other", [], "other"),
        (head, tiny_run, ["--pooling", "mean", "--frames", 3], "--pooling both --frames 1"),
        (tmp_path / "odd.npz", tiny_run, [], "odd.npz"),
        (tmp_path / "gone.npz", tiny_run, [], "gone.npz"),
    ):
        assert named in mistake(*words, file, "--model", model, *more)


@pytest.fixture
def packaged(anytouch, tiny_run, tmp_path, monkeypatch):
    """A package whose only encoder is that of `tiny_run`, exported with a card."""
    notes = tmp_path / "notes.md"
    notes.write_text("## Limits\n\nIt is for a test.\n")
    folder = tmp_path / "package" / DEFAULT
    done = anytouch("export", "--card", folder, "--model", tiny_run, "--notes", notes)
    assert done.status == 0 and str(folder) in done.out, done.err
    assert "It is for a test." in (folder / "README.md").read_text()
    monkeypatch.setattr(registry, "FOLDER", folder.parent)
    registry._packaged.cache_clear()
    yield folder
    registry._packaged.cache_clear()


def test_embed_uses_it_and_reports_it(packaged, anytouch, tiny_run, tmp_path):
    frames = tmp_path / "frames"
    frames.mkdir()
    for i in range(3):
        cv2.imwrite(str(frames / f"{i}.png"), np.full((30, 40, 3), 60 * i, np.uint8))
    outs = {}
    for name, words in (("named", ("--model", tiny_run)), ("default", ())):
        outs[name] = tmp_path / f"{name}.npz"
        done = anytouch("embed", *words, "--data", frames, "--sensor", "digit", "--out", outs[name])
        assert done.status == 0 and (f"encoder: {DEFAULT}" in done.err) == (name == "default"), (
            done.err
        )
    named, default = (np.load(out)["features"] for out in outs.values())
    # float16 in the package
    np.testing.assert_allclose(default, named, atol=2e-2 * np.abs(named).max())


def test_the_named_encoder_is_used_listed_and_described(packaged, anytouch, world):
    done = anytouch(
        "probe", "label", "--data", world, "--label", "object", "--no-controls", "--seeds", "0"
    )
    assert f"encoder: {DEFAULT}" in done.err and f"{DEFAULT}: linear" in done.out
    listed = anytouch("info", "encoders")
    assert (
        listed.status == 0 and listed.out.startswith(f"{DEFAULT}: ") and "28 pixels" in listed.out
    )
    assert "touch encoder: width 16" in anytouch("info", DEFAULT).out
    assert at.list_encoders() == [DEFAULT]


def test_a_folder_with_files_is_not_overwritten(anytouch, tiny_run, tmp_path):
    (tmp_path / "mine").write_text("precious")
    for folder in (tmp_path, tmp_path / "mine"):
        done = anytouch("export", "--card", folder, "--model", tiny_run)
        assert done.status == 2 and "not an empty folder" in done.err
    done = anytouch("export", "--card", tmp_path / "new", "--model", tiny_run, "--out", "x.bin")
    assert done.status == 2 and "--out has no effect with --card" in done.err
    assert anytouch("export", "--model", tiny_run).status == 2
