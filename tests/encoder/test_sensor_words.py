"""A fitted sensor, a folder NAME.sensor, is a sensor wherever its name would be."""

import json
from dataclasses import asdict

import cv2
import numpy as np
import pytest
from measuring import gel, measuring_weights

from anytouch_jax.cli.app import main
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder import sensor_words
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.fields import measure as fields
from anytouch_jax.sim.sensing.own import OwnSensor


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return measuring_weights(tmp_path_factory.mktemp("words") / "weights.safetensors")


@pytest.fixture
def mine(tmp_path):
    """A sensor of 20 x 15 mm whose gel has 60 kPa, as `anytouch sensor fit` writes it."""
    folder = tmp_path / "mine.sensor"
    folder.mkdir()
    numbers = OwnSensor("tripod", 20.0, 15.0, (48, 64), 1.0, modulus_kpa=60.0)
    (folder / "sensor.json").write_text(json.dumps(asdict(numbers)))
    return folder


def test_it_is_measured_in_its_own_mm_and_newtons(weights, mine):
    encoder = load_encoder(weights)
    lines = []
    own = encoder.measure(gel(), None, str(mine), log=lines.append)
    named = encoder.measure(gel(), None, "tripod", width_mm=20.0, log=lambda _: None)
    assert own.width_mm == 20 and not own.faults
    np.testing.assert_allclose(own.depth, named.depth, atol=1e-6)
    # the other gel is a guess of 170 kPa
    np.testing.assert_allclose(own.force / named.force, 60 / fields.OTHER_MODULUS, rtol=1e-5)
    assert not any("not in this model's table" in line for line in lines)
    assert any("tripod" in line and "universal" in line for line in lines)
    # a cropped image
    assert encoder.measure(gel(), None, str(mine), width_mm=10.0, log=lines.append).width_mm == 10
    turned = np.ascontiguousarray(np.rot90(gel()))
    assert encoder.measure(turned, None, str(mine), log=lines.append).faults


def test_weights_that_know_its_gel_are_believed(mine):
    known = fields.scale_of({"fields": {"modulus": {"tripod": 80.0}}}, str(mine))
    assert (known.width, known.modulus, known.spread, known.shape) == (20.0, 80.0, 0.0, 0.75)
    assert fields.scale_of({}, str(mine)).spread == fields.OTHER_SPREAD


def test_it_has_the_row_of_its_name(weights, mine):
    encoder = load_encoder(weights)
    frames = np.stack([encoder.preprocess(gel())] * 2)
    row = encoder.config.model.universal_row
    assert encoder.sensor_row(str(mine), lambda _: None) == row
    with pytest.warns(UserWarning, match="tripod"):
        words = encoder.encode_touch(frames, [str(mine), "digit"])
    np.testing.assert_allclose(words, encoder.encode_touch(frames, np.array([row, 1])), atol=1e-6)


def test_commands_take_it(weights, mine, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    import cv2

    (tmp_path / "frames").mkdir()
    for number in range(3):
        cv2.imwrite(f"frames/{number}.png", gel()[..., ::-1])
    shared = ["--model", str(weights), "--data", "frames", "--sensor", "mine.sensor"]
    assert main(["measure", *shared, "--out", "m.npz"]) == 0
    assert main(["embed", *shared, "--out", "f.npz"]) == 0
    with np.load("m.npz") as arrays:
        assert (arrays["width_mm"] == 20).all() and np.isfinite(arrays["force"]).all()
    with np.load("f.npz") as arrays:
        assert str(arrays["about/sensor"]) == "tripod"
    assert "not in this model's table" not in capsys.readouterr().err
    assert main(["embed", *shared[:-1], "gone.sensor", "--out", "f.npz"]) == 2
    assert "sensor.json" in capsys.readouterr().err


def test_a_missing_or_damaged_folder_is_one_sentence(weights, mine):
    encoder = load_encoder(weights)
    (mine / "sensor.json").write_text("{")
    for call in (
        lambda: encoder.measure(gel(), None, str(mine)),
        lambda: encoder.sensor_row(str(mine)),
    ):
        with pytest.raises(UserError, match=r"sensor\.json"):
            call()


@pytest.mark.parametrize("word", ["mine.senso", "at/mine.sensors", "mine.Sensor"])
def test_a_slip_in_the_ending_of_a_folder_is_no_new_name(word):
    with pytest.raises(UserError, match=r"did you mean (at/)?mine\.sensor\?"):
        sensor_words.resolve_sensor(word)
    assert sensor_words.resolve_sensor("gel.v2").name == "gel.v2"


def test_a_manifest_of_its_recordings_has_its_name(mine, tmp_path):
    place = tmp_path / "all/mug"
    place.mkdir(parents=True)
    for number in range(3):
        (place / f"{number}.png").write_bytes(cv2.imencode(".png", gel())[1].tobytes())
    words = ["data", "index", "recordings", str(place.parent), "--sensor"]
    assert main([*words, str(mine)]) == 0
    table = manifests.read(place.parent / "recordings.parquet")
    assert set(table.column("sensor").to_pylist()) == {"tripod"}
    assert main([*words, str(mine.with_suffix(".senso"))]) == 2
