"""The command line: help, mistakes and their answers, and each subcommand on a small run."""

import itertools
import json
import os
import pkgutil
import shutil
import signal
import subprocess
import sys
import warnings
import zlib
from pathlib import Path

import cv2
import jax
import numpy as np
import pytest
from runs import read_rows, write_manifest
from tiny_models import touch_model

from anytouch_jax.cli.app import _COMMANDS, _at_home, main
from anytouch_jax.config import SENSORS, to_json
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.nn.functional import build
from anytouch_jax.train import mesh
from anytouch_jax.weights import load, safetensors
from anytouch_jax.weights.safetensors import export_safetensors

SIZES = [
    "--model.image-size",
    "28",
    "--model.patch",
    "7",
    "--model.embed",
    "12",
    "--model.touch.width",
    "16",
    "--model.touch.depth",
    "2",
    "--model.touch.heads",
    "2",
    "--model.touch.mlp",
    "32",
    "--model.decoder.width",
    "8",
    "--model.decoder.depth",
    "1",
    "--model.decoder.heads",
    "2",
    "--model.decoder.mlp",
    "16",
]


@pytest.fixture(autouse=True)
def _own_cache(compiled_once):
    """`anytouch train` keeps compiled programs, also those that took no time."""


def run(*args) -> int:
    """The exit status of `anytouch ARGS`, also where the parser exits by itself."""
    try:
        return main([str(arg) for arg in args])
    except SystemExit as stop:
        return int(stop.code or 0)


def mistake(capsys, *args) -> str:
    """The one line that a user's mistake is answered with."""
    capsys.readouterr()
    assert run(*args) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"anytouch {args[0]}: ") and "Traceback" not in error
    assert len(error.strip().splitlines()) == 1, error
    return error


# Help and usage -----------------------------------------------------------------------------------------------------


def test_help_lists_every_command(capsys):
    for args in (["--help"], ["-h"]):
        assert run(*args) == 0
        out = capsys.readouterr().out
        assert all(f"\n  {name} " in out for name in _COMMANDS)
        texts = {out.index(text) - out.rindex("\n", 0, out.index(text)) for _, text in _COMMANDS.values()}
        assert len(texts) == 1  # one column
    assert run() == 2
    capsys.readouterr()
    assert run("--version") == 0 and capsys.readouterr().out.strip()[0].isdigit()


@pytest.mark.parametrize("name", list(_COMMANDS))
def test_every_command_has_help_with_an_example(name, capsys):
    assert run(name, "--help") == 0
    out = capsys.readouterr().out
    example = next(line for line in out.splitlines() if line.startswith("Example: "))
    assert example.startswith(f"Example: anytouch {name} ")
    assert "--help" in out


def test_the_help_shows_what_is_given_by_place(capsys):
    for name, places in (("parity", 1), ("convert", 2)):
        run(name, "--help")
        assert f"anytouch {name} [-h]" + " PATH" * places in capsys.readouterr().out


def test_help_all_lists_the_configuration_with_the_defaults_of_the_preset(capsys):
    assert run("train", "--help-all", "--preset", "small") == 0
    out = capsys.readouterr().out
    told = " ".join(out.replace("│", " ").split())
    for meaning in ("share of the patches that a touch keeps in matching", "decay of an average of the parameters"):
        assert meaning in told  # of the comments of the configuration
    for option in ("--model.touch.width", "--objective.mask-ratio", "--optim.clip-norm", "--loader.threads"):
        assert option in out
    assert "(default: 384)" in out
    lines = [line.strip("│ ") for line in out.splitlines()]
    fields = [(line, after) for line, after in itertools.pairwise(lines) if line.startswith("--")]
    assert len(fields) > 70 and not [
        line for line, after in fields if after.startswith("(default")
    ]  # all are explained


def test_the_home_folder_is_meant_behind_an_equals_sign_too(monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    assert main(["probe", "--data=~/none.csv", "--run", "x", "--label", "object"]) == 1
    assert f"{tmp_path}/none.csv" in capsys.readouterr().err.replace("\n", "")
    assert _at_home("a=~/x") == "a=~/x" and _at_home("--note") == "--note"


def test_help_needs_no_heavy_imports():
    code = (
        "import sys; from anytouch_jax.cli.app import main; assert main(['--help']) == 0\n"
        "heavy = {'jax', 'tyro', 'numpy', 'flax', 'cv2', 'rich'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, env={**os.environ}, timeout=60)


def test_what_features_are_is_told_without_heavy_imports(tmp_path):
    np.savez(tmp_path / "f.npz", features=np.zeros((2, 3), np.float32), rows=np.arange(2))
    code = (
        f"import sys; from anytouch_jax.cli.app import main; assert main(['info', {str(tmp_path / 'f.npz')!r}]) == 0\n"
        "heavy = {'jax', 'flax', 'optax', 'orbax', 'scipy', 'cv2', 'pyarrow'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, env={**os.environ}, timeout=60)


def test_an_unknown_command_is_answered_with_the_nearest(capsys):
    assert run("trin") == 2
    assert "did you mean train?" in capsys.readouterr().err
    assert run("xyzzy") == 2
    error = capsys.readouterr().err
    assert "no command 'xyzzy'" in error and "did you mean" not in error


@pytest.mark.parametrize(
    ("typo", "meant"),
    [("--stps", "--steps"), ("--optim.clip-nrm", "--optim.clip-norm"), ("--objective.mask-ration", "mask-ratio")],
)
def test_a_mistyped_option_is_answered_with_the_nearest(typo, meant, capsys):
    assert run("train", "--data", "m.csv", "--run", "r", typo, "5") == 2
    error = capsys.readouterr().err
    assert typo in error and "Perhaps you meant" in error and meant in error.split("Perhaps", 1)[1]
    more = "--help-all" if "." in typo else "--help"  # where the option that was meant is explained
    assert f"run anytouch train {more}" in error and "[the options" not in error


def test_wrong_values_are_usage_errors(capsys):
    train = ("train", "--data", "m.csv", "--run", "r")
    for args in (("--stage", "3"), ("--steps", "many"), ("--objective.mask-ratio",), ("--model.patch", "13")):
        assert run(*train, *args) == 2
        assert "Traceback" not in capsys.readouterr().err
    assert run("train", "--run", "r") == 2
    assert "--data" in capsys.readouterr().err


# Mistakes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (("--model.patch", 0), "--model.patch must be 1 or more, not 0"),
        (("--model.decoder.heads", 0), "heads must be 1 or more, not 0"),
        (("--model.decoder.width", 18, "--model.decoder.heads", 2), "--model.decoder.width must be a multiple of 4"),
        (("--optim.clip-norm", -1), "--optim.clip-norm must be above 0, not -1.0"),
        (("--steps", 0), "--loop.steps must be 1 or more, not 0"),
        (("--loader.flip", 7), "--loader.flip must be 0 to 1, not 7.0"),
        (("--stop-after", -1), "--stop-after must be 0 or more, not -1"),
    ],
)
def test_numbers_out_of_range_are_one_sentence(args, said, capsys, tmp_path, world):
    assert run("train", "--data", world, "--run", tmp_path / "r", *args) in (1, 2)
    told = capsys.readouterr().err
    assert said in " ".join(told.replace("│", " ").split()) and "Traceback" not in told
    assert not (tmp_path / "r").exists()


@pytest.mark.parametrize(
    "error", [RuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 bytes."), MemoryError()]
)
def test_too_little_memory_is_a_sentence(capsys, monkeypatch, error):
    def run(name, args):
        raise error

    monkeypatch.setattr("anytouch_jax.cli.app._run", run)
    assert "there is not enough memory for this; ask for less at once" in mistake(capsys, "train", "--data", "m.csv")
    error.args = ("a bug",)
    if isinstance(error, RuntimeError):
        with pytest.raises(RuntimeError, match="a bug"):
            main(["train"])


def test_missing_files(capsys, tmp_path, tiny_run, world):
    missing = tmp_path / "none.csv"
    assert str(missing) in mistake(capsys, "train", "--data", missing, "--run", tmp_path / "r")
    assert not (tmp_path / "r").exists()
    assert "nowhere" in mistake(capsys, "embed", "--run", tmp_path / "nowhere", "--input", world, "--out", "f.npz")
    assert "none.csv" in mistake(capsys, "embed", "--run", tiny_run, "--input", missing, "--out", tmp_path / "f.npz")
    assert "none.csv" in mistake(capsys, "probe", "--data", missing)
    assert "nowhere" in mistake(capsys, "parity", tmp_path / "nowhere")
    assert "nowhere" in mistake(capsys, "convert", tmp_path / "nowhere.pth", tmp_path / "w.safetensors")
    assert "--init" in mistake(capsys, "train", "--data", world, "--run", tmp_path / "r", "--init", tmp_path / "gone")


def changed(world: Path, tmp_path: Path, change) -> Path:
    """The world's manifest with its rows (dicts) changed, its pictures beside it."""
    rows = read_rows(world)
    change(rows)
    shutil.copytree(world.parent, tmp_path, dirs_exist_ok=True)
    columns = tuple(rows[0])
    return write_manifest(tmp_path / "manifest.csv", [[row.get(c, "") for c in columns] for row in rows], columns)


def drop_sensor(rows):
    for row in rows:
        del row["sensor"]


def test_bad_manifests(capsys, tmp_path, world):
    def told(change):
        folder = tmp_path / change.__name__
        manifest = changed(world, folder, change)
        return mistake(capsys, "train", "--data", manifest, "--run", tmp_path / "r", "--stop-after", 1, *SIZES)

    def unknown_sensor(rows):
        rows[2]["sensor"] = "gelsightt"

    def no_train_rows(rows):
        for row in rows:
            row["split"] = "test"

    def way_out(rows):
        rows[1]["path"] = "../a1.png"

    assert "sensor" in told(drop_sensor)
    assert "gelsightt" in told(unknown_sensor) and "row 2" in told(unknown_sensor)
    assert "'train'" in told(no_train_rows)
    assert "../a1.png" in told(way_out)


def test_a_corrupt_picture_is_named_or_skipped_and_counted(capsys, tmp_path, world):
    manifest = changed(world, tmp_path / "world", lambda rows: None)
    (manifest.parent / "a1.png").write_bytes(b"not a picture")
    args = ("train", "--data", manifest, "--batch", 8, "--steps", 4, "--save-every", 4, *SIZES)
    error = mistake(capsys, *args, "--run", tmp_path / "strict", "--stop-after", 1)
    assert "a1.png" in error and "row 1" in error
    assert run(*args, "--run", tmp_path / "lenient", "--on-bad-sample", "skip", "--stop-after", 1) == 0
    line = json.loads((tmp_path / "lenient" / "metrics.jsonl").read_text())
    assert line["skipped"] == 0 and line["skipped_batches"] == 0
    assert line["skipped_samples"] >= 1 and line["loss"] > 0


def test_no_clip_weights_for_pretrained_towers(capsys, tmp_path, world):
    told = mistake(capsys, "train", "--data", world, "--run", tmp_path / "r", "--stage", 2, "--towers", "pretrained")
    assert "--clip" in told


# What the commands do -----------------------------------------------------------------------------------------------


def test_train_takes_the_configuration_from_preset_recipe_and_options(tmp_path, world, capsys):
    args = ["train", "--data", world, "--run", tmp_path / "r", "--recipe", "release", "--steps", 40, "--batch", 8]
    args += ["--objective.mask-ratio", "0.5", "--optim.clip-norm", "1.0", "--seed", 3, "--loader.threads=1"]
    assert run(*args, "--stop-after", 0, *SIZES) == 0
    config = json.loads((tmp_path / "r" / "config.json").read_text())
    assert config["objective"]["mask_ratio"] == 0.5 and config["optim"]["clip_norm"] == 1.0
    assert config["recipe"] == "release" and config["optim"]["decay"] == "cosine"
    assert config["data"]["manifests"] == [str(world)] and config["data"]["threads"] == 1
    assert (config["data"]["batch_size"], config["run"]["steps"], config["run"]["seed"]) == (8, 40, 3)
    assert config["model"]["touch"] == {"width": 16, "depth": 2, "heads": 2, "mlp": 32}
    assert "0 of 40 steps" in capsys.readouterr().err


def test_train_goes_on_and_refuses_other_settings(tmp_path, world, tiny_run, capsys):
    shutil.copytree(tiny_run, tmp_path / "r")
    args = ["train", "--data", world, "--run", tmp_path / "r", "--steps", 4, "--save-every", 4, "--batch", 8, *SIZES]
    assert "run.steps" in mistake(capsys, *args, "--steps", 5)
    # the run was started from Python with a configuration that no preset has: only its name differs
    config = json.loads((tmp_path / "r" / "config.json").read_text())
    assert config["preset"] == "tiny"
    assert run(*args, "--stop-after", 3) == 0
    error = capsys.readouterr().err
    assert "going on from the checkpoint of step 2" in error and "3 of 4 steps" in error


@pytest.mark.parametrize(
    "place", ["anytouch_jax.data.manifest.manifest.read", "anytouch_jax.weights.checkpoint.Checkpoints.latest"]
)
def test_a_termination_before_the_first_step_is_polite(tmp_path, world, capsys, monkeypatch, place):
    module, _, name = place.rpartition(".")
    owner = pkgutil.resolve_name(module)
    before, real = signal.getsignal(signal.SIGTERM), getattr(owner, name)

    def terminated(*args, **options):
        signal.raise_signal(signal.SIGTERM)
        return real(*args, **options)

    args = ["train", "--data", world, "--run", tmp_path / "r", "--steps", 4, "--batch", 8, *SIZES]
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, terminated)
        assert run(*args) == 0
    told = capsys.readouterr().err.strip()
    assert told.splitlines()[-1].startswith("stopped by SIGTERM before a step of") and "Traceback" not in told
    assert signal.getsignal(signal.SIGTERM) is before
    assert {path.name for path in tmp_path.rglob("*") if path.is_file()} <= {"config.json", ".lock"}
    assert run(*args, "--stop-after", 0) == 0


def test_embed_a_manifest_and_a_folder(tmp_path, world, tiny_run, capsys):
    out = tmp_path / "features.npz"
    assert run("embed", "--run", tiny_run, "--input", world, "--split", "test", "--out", out, "--batch", 4) == 0
    assert "2 features of 12 values" in capsys.readouterr().out
    with np.load(out) as file:
        assert file["features"].shape == (2, 12)
        assert file["rows"].tolist() == [10, 11]
        assert file["key/path"].tolist() == ["c2.png", "c3.png"] and set(file["key/split"]) == {"test"}
        assert file["key/object"].tolist() == file["key/label.object"].tolist() == ["ball", "cube"]
        assert len(str(file["about/weights"])) == 8 and "about/sensor" not in file
        from_manifest = file["features"]

    folder = tmp_path / "frames"
    folder.mkdir()
    for frame in (2, 3):
        shutil.copy(world.parent / f"c{frame}.png", folder)
    args = ("embed", "--run", tiny_run, "--input", folder, "--out", out, "--batch", 4)
    assert run(*args, "--sensor", "digit") == 0
    with np.load(out) as file:
        np.testing.assert_allclose(file["features"], from_manifest, atol=1e-6)
        assert file["key/frame_index"].tolist() == [0, 1] and str(file["about/input"]) == str(folder)
        assert file["key/path"].tolist() == ["c2.png", "c3.png"]
        assert str(file["about/sensor"]) == "digit" and str(file["about/background"]) == "not taken off"
    capsys.readouterr()
    assert run(*args, "--sensor", "new_sensor") == 0
    assert "'new_sensor'" in (error := capsys.readouterr().err) and "universal tokens" in error
    with np.load(out) as file:
        assert np.abs(file["features"] - from_manifest).max() > 1e-4
    assert run(*args, "--sensor", "digit", "--dtype", "bfloat16") == 0
    with np.load(out) as file:
        assert str(file["about/dtype"]) == "bfloat16"
        assert 1e-5 < np.abs(file["features"] - from_manifest).max() / np.abs(from_manifest).max() < 0.05


def test_embed_leaves_a_bad_picture_of_a_folder_out(tmp_path, world, tiny_run, capsys):
    folder, out = tmp_path / "frames", tmp_path / "features.npz"
    folder.mkdir()
    for place, name in enumerate(("a0", "a1", "a2", "a3", "b0", "b1", "b2")):
        shutil.copy(world.parent / f"{name}.png", folder / f"{place}.png")
    (folder / "2.png").write_bytes((folder / "2.png").read_bytes()[:-20])
    args = ("embed", "--run", tiny_run, "--input", folder, "--out", out, "--batch", 4, "--sensor", "gelsight_mini")
    assert "2.png" in mistake(capsys, *args) and not out.exists()
    for frames, ends in ((1, [0, 1, 3, 4, 5, 6]), (3, [5, 6])):  # no clip reaches over what is missing
        assert run(*args, "--on-bad-sample", "skip", "--frames", frames) == 0
        told = f"{len(ends)} features of 12 values, {8 - frames - len(ends)} skipped"
        assert told in capsys.readouterr().out
        with np.load(out) as file:
            assert file["rows"].tolist() == file["key/frame_index"].tolist() == ends
            assert file["key/path"].tolist() == [f"{end}.png" for end in ends]
    with np.load(out) as file:
        last = file["features"][-1]
    assert run("embed", "--run", tiny_run, "--input", world, "--frames", 3, "--out", out, "--batch", 4) == 0
    with np.load(out) as file:
        np.testing.assert_allclose(file["features"][file["rows"] == 6], last[None], atol=1e-6)


@pytest.mark.parametrize("command", ["embed", "probe", "retrieve", "export"])
def test_compiled_programs_are_kept_on_disk(tmp_path, world, tiny_run, capsys, monkeypatch, command):
    kept = []
    monkeypatch.setattr(mesh, "enable_compilation_cache", lambda: kept.append(command))
    words = {
        "embed": ("--input", world, "--out", tmp_path / "f.npz"),
        "probe": ("--data", world, "--label", "no_such_label"),
        "retrieve": ("--data", tmp_path / "no.csv"),
        "export": ("--out", tmp_path / "f.jaxexport", "--platforms", "no_such"),
    }
    run(command, "--run", tiny_run, *words[command])
    assert kept == [command]


def test_embed_finds_first_that_it_cannot_write(tmp_path, world, capsys):
    told = mistake(capsys, "embed", "--run", tmp_path / "gone", "--input", world, "--out", world / "features.npz")
    assert f"{world} is a file, not a folder" in told


def test_embed_and_probe_name_a_bad_picture_however_the_run_was_trained(tmp_path, world, tiny_run, capsys):
    shutil.copytree(world.parent, tmp_path / "w")
    (tmp_path / "w" / "c2.png").write_bytes(b"no picture")
    shutil.copytree(tiny_run, tmp_path / "r")
    record = next((tmp_path / "r" / "checkpoints").glob("*/checkpoint.json"))
    content = json.loads(record.read_text())["record"]
    content["config"] = content["config"].replace('"on_bad_sample": "error"', '"on_bad_sample": "skip"')
    assert '"skip"' in content["config"]
    body = json.dumps(content, sort_keys=True)
    record.write_text(json.dumps({"checksum": zlib.crc32(body.encode()), "record": content}))
    args = ("embed", "--run", tmp_path / "r", "--input", tmp_path / "w" / world.name, "--out", tmp_path / "f.npz")
    told = mistake(capsys, *args, "--batch", 4)
    assert "row 10 of" in told and "'path'" in told
    assert run(*args, "--batch", 4, "--on-bad-sample", "skip") == 0
    assert "11 features of 12 values, 1 skipped" in capsys.readouterr().out
    assert run("probe", "--run", tmp_path / "r", "--data", tmp_path / "w" / world.name) == 1
    told = capsys.readouterr().err
    assert "row 10 of" in told and "'path'" in told


def test_embed_clips_of_a_manifest_and_of_a_video(tmp_path, world, tiny_run, capsys):
    out = tmp_path / "features.npz"
    assert run("embed", "--run", tiny_run, "--input", world, "--frames", 3, "--out", out, "--batch", 4) == 0
    assert "8 of 12 rows end no clip of 3 frames" in " ".join(capsys.readouterr().err.split())
    with np.load(out) as file:
        assert file["rows"].tolist() == [2, 3, 6, 7]

    video = tmp_path / "touch.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 10, (32, 32))
    for frame in range(5):
        writer.write(np.full((32, 32, 3), 40 * frame, np.uint8))
    writer.release()
    assert run("embed", "--run", tiny_run, "--input", video, "--frames", 3, "--out", out, "--batch", 4) == 0
    with np.load(out) as file:
        assert file["features"].shape == (3, 12) and file["key/frame_index"].tolist() == [2, 3, 4]
    assert "too few" in mistake(capsys, "embed", "--run", tiny_run, "--input", video, "--frames", 6, "--out", out)


def test_probe_reports_on_test_and_writes_json(tmp_path, world, tiny_run, capsys):
    out = tmp_path / "probe.json"
    args = ("probe", "--data", world, "--run", tiny_run, "--label", "object", "--seeds", 2)
    assert run(*args, "--no-controls", "--out", out) == 0
    table = capsys.readouterr().out
    assert f"{tiny_run}: linear" in table and f"{tiny_run}: kNN" in table
    assert "raw pixels" not in table and "random" not in table
    assert json.loads(out.read_text())
    assert "'taste'" in mistake(capsys, *args[:-4], "--label", "taste")
    assert run("probe", "--data", world, "--no-controls") == 1
    assert "nothing to probe" in capsys.readouterr().err


def test_convert_to_the_authors_names_and_back(tmp_path, tiny_run, capsys):
    theirs, ours, again = (tmp_path / name for name in ("release.safetensors", "own.safetensors", "again.safetensors"))
    assert run("convert", tiny_run, theirs) == 0
    assert run("convert", theirs, ours, "--names", "own") == 0
    assert run("convert", ours, again) == 0
    assert theirs.read_bytes()[-4096:] == again.read_bytes()[-4096:]
    clip = np.random.default_rng(0).integers(0, 256, (2, 3, 28, 28, 3), np.uint8)
    expected = load_encoder(tiny_run).encode_touch(clip, "digit")
    for path in (theirs, ours, again):  # two heads of width 8: the shapes alone would tell one head
        np.testing.assert_array_equal(load_encoder(path).encode_touch(clip, "digit"), expected)


def test_what_the_authors_files_cannot_hold_is_one_sentence(tmp_path, capsys):
    model = touch_model()
    params = build(model).init(jax.random.key(0))
    export_safetensors(
        tmp_path / "own.safetensors", {"touch": params["touch"]}, {safetensors.MODEL_KEY: to_json(model)}
    )
    told = mistake(capsys, "convert", tmp_path / "own.safetensors", tmp_path / "theirs.safetensors")
    assert "lacks a touch encoder or a decoder" in told and "--names own" in told
    assert not (tmp_path / "theirs.safetensors").exists()


def test_convert_brings_the_universal_tokens_to_the_last_row(tmp_path):
    # A sensor added at the end of the table stands behind them; the authors' code reads the last row.
    model = touch_model(sensors=(*SENSORS, "mine"))
    params = build(model).init(jax.random.key(0))
    export_safetensors(tmp_path / "own.safetensors", params, {safetensors.MODEL_KEY: to_json(model)})
    assert run("convert", tmp_path / "own.safetensors", tmp_path / "theirs.safetensors") == 0
    table = load.read_weights(tmp_path / "theirs.safetensors")["sensor_token"]
    np.testing.assert_array_equal(table[-1], params["touch"]["sensor_tokens"][SENSORS.index("universal")])
    np.testing.assert_array_equal(table[-2], params["touch"]["sensor_tokens"][-1])
    assert load_encoder(tmp_path / "theirs.safetensors").sensor_row("mine") == len(SENSORS) - 1


def test_a_reader_that_goes_away_is_no_traceback():
    ended = subprocess.run(
        f"{sys.executable} -m anytouch_jax --help | true", shell=True, capture_output=True, text=True, check=False
    )
    assert "Traceback" not in ended.stderr


def test_a_warning_of_the_library_is_a_sentence(monkeypatch, capsys, tmp_path):
    def warn(_):
        warnings.warn("sensor 'x' is not known", stacklevel=2)
        warnings.warn("jax will change", FutureWarning, stacklevel=2)
        return 0

    monkeypatch.setattr("anytouch_jax.cli.info.run", warn)
    with warnings.catch_warnings(record=True) as others:
        warnings.simplefilter("always")
        assert main(["info", str(tmp_path)]) == 0
    assert capsys.readouterr().err == "sensor 'x' is not known\n"
    assert [one.category for one in others] == [FutureWarning]  # somebody else's, as Python shows it


def test_an_interrupt_ends_a_simulation_while_a_thread_compiles(tmp_path):
    code = (
        "import signal, sys, time; from anytouch_jax import cli; from anytouch_jax.sim.recorder import Recorder\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # workers of pytest-xdist ignore it\n"
        "def compile(*_): print('compiling', flush=True); time.sleep(60)\n"
        "Recorder.record = compile; sys.exit(cli.main(sys.argv[1:]))"
    )
    words = ["simulate", "--touches", "2", "--sensors", "digit", "--out", str(tmp_path / "scenes")]
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", code, *words], stdout=pipe, stderr=pipe, text=True) as child:
        assert child.stdout.readline() == "compiling\n"
        child.send_signal(signal.SIGINT)
        try:
            said = child.communicate(timeout=20)[1].splitlines()
        finally:
            child.kill()
    assert child.returncode == 130 and "Traceback" not in str(said)
    assert said[-1] == "interrupted: what is finished is kept, the same command goes on"


def test_an_interrupt_is_no_traceback(monkeypatch, capsys, tmp_path):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("tests.parity.cases.run", interrupted)
    assert run("parity", tmp_path) == 130
    assert capsys.readouterr().err.strip() == "interrupted"
