import json
import shutil
import subprocess
import sys
from dataclasses import replace

import jax
import numpy as np
import pytest

from anytouch_jax.encoder.encoder import random_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.export import export as exports
from anytouch_jax.export.export import describes, export, load

RNG = np.random.default_rng(0)
CLIPS = RNG.integers(0, 256, (5, 3, 28, 28, 3), np.uint8)
ROWS = np.asarray([1, 0, 9, 3, 1], np.int32)


@pytest.fixture(scope="module")
def artefact(tmp_path_factory, encoder):
    """(path, what `export` gave back) of clips of three frames for two platforms."""
    path = tmp_path_factory.mktemp("export") / "model.bin"
    return path, export(encoder, path, frames=3, platforms=("cpu", "cuda"))


@pytest.fixture
def copied(artefact, tmp_path):
    """The artefact where a test may damage it."""
    for path in (artefact[0], describes(artefact[0])):
        shutil.copy(path, tmp_path)
    return tmp_path / "model.bin"


def test_any_number_of_touches_gives_the_features_of_the_live_model(artefact, encoder):
    path, about = artefact
    run = load(path)
    for count in (1, 2, 5):
        live = encoder.encode_touch(CLIPS[:count], ROWS[:count])
        result = run(CLIPS[:count], ROWS[:count])
        assert result.shape == (count, 12) and result.dtype == np.float32
        np.testing.assert_allclose(result, live, atol=1e-5)
    np.testing.assert_allclose(run(CLIPS, "digit"), encoder.encode_touch(CLIPS, "digit"), atol=1e-5)
    # the universal tokens
    np.testing.assert_allclose(run(CLIPS), encoder.encode_touch(CLIPS), atol=1e-5)
    assert np.abs(run(CLIPS) - run(CLIPS, "digit")).max() > 1e-4
    names = list(encoder.config.model.sensors)
    # as `Encoder.embed` takes them
    for each in ([names[row] for row in ROWS], np.array(names, object)[ROWS]):
        np.testing.assert_array_equal(run(CLIPS, each), run(CLIPS, ROWS))
    assert 0 <= about["worst_difference"] < 1e-4


def test_the_description_tells_how_to_call_it(artefact, encoder, monkeypatch):
    path, about = artefact
    assert json.loads(describes(path).read_text()) == about
    assert (
        about["platforms"] == ["cpu", "cuda"] and about["frames"] == 3 and about["image_size"] == 28
    )
    assert (
        about["features"] == 12
        and about["sensors"]["digit"] == 1
        and about["sensors"]["universal"] == 9
    )
    assert about["bytes"] == path.stat().st_size
    assert (
        "to 28 x 28, its shape not kept: OpenCV's INTER_AREA" in about["resize"]
        and "gel" not in about["resize"]
    )
    monkeypatch.chdir(path.parent)
    space = {"frames": CLIPS, "sensor": ROWS}
    exec(about["example"], space)  # what a reader would copy
    np.testing.assert_allclose(space["features"], encoder.encode_touch(CLIPS, ROWS), atol=1e-5)


@pytest.mark.parametrize("attention", ["cudnn", "mapped"])
def test_attention_of_one_platform_is_exported_for_all(tmp_path, encoder, attention):
    model = replace(encoder.config.model, attention=attention)
    export(
        replace(encoder, config=replace(encoder.config, model=model)), tmp_path / "m.bin", frames=3
    )
    np.testing.assert_allclose(
        load(tmp_path / "m.bin")(CLIPS, ROWS), encoder.encode_touch(CLIPS, ROWS), atol=1e-5
    )


def test_an_artefact_needs_no_code_of_the_network(artefact):
    code = (
        "import sys, numpy as np; from anytouch_jax.export.export import load\n"
        f"z = load({str(artefact[0])!r})(np.zeros((2, 3, 28, 28, 3), np.uint8), 'digit')\n"
        "assert z.shape == (2, 12)\n"
        "ours = {m for m in sys.modules if m.startswith(('anytouch_jax.nn', "
        "'anytouch_jax.objectives', 'flax'))}\n"
        "assert not ours, ours"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=120)


def test_wrong_touches_and_sensors_are_one_sentence(artefact):
    run = load(artefact[0])
    for clips, sensor, word in (
        (CLIPS.astype(np.float32), ROWS, "float32"),
        (CLIPS[:, :2], ROWS, r"\(B, 3, 28, 28, 3\)"),
        (CLIPS[:, :, :27], ROWS, r"\(B, 3, 28, 28, 3\)"),
        (CLIPS[:0], ROWS[:0], "at least one"),
        (CLIPS, ROWS.astype(float), r"one integer for each of the 5 touches, not float64 \(5,\)"),
        (CLIPS, ["digit"] * 4, "one integer for each of the 5 touches"),
        (
            CLIPS,
            ["digit"] * 4 + ["nobody"],
            "sensor 'nobody' is not one of .*; universal serves any other",
        ),
        (CLIPS, ROWS - 1, "0 to 9"),
        (CLIPS, ROWS + 1, "0 to 9"),
        (CLIPS, "nobody", "universal serves any other"),
    ):
        with pytest.raises(UserError, match=word):
            run(clips, sensor)


def test_a_damaged_artefact_is_refused(copied):
    whole = copied.read_bytes()
    middle = len(whole) // 2
    for data in (
        whole[:-1],
        whole[:middle] + bytes([whole[middle] ^ 1]) + whole[middle + 1 :],
        b"",
    ):
        copied.write_bytes(data)
        with pytest.raises(UserError, match=r"model\.bin is damaged: its checksum"):
            load(copied)


def test_a_wrong_or_missing_description_is_refused(copied):
    about = json.loads(describes(copied).read_text())
    for change in ({"format": "other.2"}, {"frames": -1}, {"sensors": {}}, {"platforms": []}):
        describes(copied).write_text(json.dumps(about | change))
        with pytest.raises(UserError, match=r"model\.bin\.json"):
            load(copied)
    describes(copied).unlink()
    with pytest.raises(UserError, match=r"model\.bin\.json cannot be read: No such file"):
        load(copied)
    copied.unlink()
    with pytest.raises(UserError, match=r"model\.bin cannot be read: No such file"):
        load(copied)


def test_an_artefact_that_differs_from_the_live_model_is_not_written(
    encoder, tmp_path, monkeypatch
):
    other = random_encoder(encoder.config, seed=5)
    grouped = exports._artefact
    monkeypatch.setattr(exports, "_artefact", lambda _, *rest: grouped(other, *rest))
    with pytest.raises(UserError, match="differs from the live model"):
        export(encoder, tmp_path / "m.bin", platforms=("cpu",))
    assert list(tmp_path.iterdir()) == []


def test_an_artefact_does_not_depend_on_the_precision_of_jax(artefact, encoder, tmp_path):
    path, about = artefact
    plain = load(path)(CLIPS, ROWS)
    with jax.enable_x64(True):
        again = export(encoder, tmp_path / "model.bin", frames=3, platforms=("cpu", "cuda"))
        np.testing.assert_array_equal(load(tmp_path / "model.bin")(CLIPS, ROWS), plain)
        np.testing.assert_array_equal(load(path)(CLIPS, ROWS), plain)
    assert again["worst_difference"] == about["worst_difference"]
