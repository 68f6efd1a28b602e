"""`anytouch sensor calibrate` and `sensor check`, and a calibrated sensor in `measure`."""

import csv
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from ball_presses import DIAMETER, POSES, WIDTH, presses
from measuring import measuring_weights
from videos import write_video

from anytouch_jax.cli.app import main
from anytouch_jax.encoder.encoder import load_encoder


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with weights, and the images of presses by known force."""
    folder = tmp_path_factory.mktemp("calibrate")
    measuring_weights(folder / "weights.safetensors")
    (folder / "balls").mkdir()
    made = presses()
    for number, frame in enumerate(made.frames):
        cv2.imwrite(str(folder / "balls" / f"{number}.png"), frame[..., ::-1])
    cv2.imwrite(str(folder / "balls" / "background.png"), made.background[..., ::-1])
    pressed = presses(POSES[2:3]).frames[0]
    cv2.imwrite(str(folder / "pressed.png"), pressed[..., ::-1])
    return folder


def calibrate(*more: str) -> int:
    return main(["sensor", "calibrate", "balls", "--model", "weights.safetensors", *more])


BALL = ("--ball-mm", str(DIAMETER), "--width-mm", str(WIDTH), "--sensor", "gelsight")


def test_a_ball_and_a_weight_make_a_sensor_that_measure_takes(place, capsys, monkeypatch):
    monkeypatch.chdir(place)
    assert calibrate(*BALL, "--out", "mine.sensor") == 0
    said = capsys.readouterr()
    assert "5 presses of 6 mm" in said.err and "mine.sensor" in said.out
    assert calibrate("--sensor", "mine.sensor", "--newton", "5") == 0
    assert "presses of 5 to 5 N" in capsys.readouterr().err
    numbers = json.loads(Path("mine.sensor/sensor.json").read_text())
    assert numbers["family"] == "gelsight" and numbers["force_spread"] > 0.3
    words = ["measure", "--model", "weights.safetensors", "--data", "balls", "--out", "o.npz"]
    assert main([*words, "--sensor", "mine.sensor"]) == 0
    lines = list(csv.DictReader(Path("o.csv").read_text().splitlines()))
    forces = [float(line["force_z"]) for line in lines]
    # the factor is the median one, of stills; these are frames of a clip
    assert np.median(forces) == pytest.approx(5, rel=0.2)
    for line in lines:
        assert float(line["force_low"]) < float(line["force_z"]) < float(line["force_high"])
    encoder = load_encoder("weights.safetensors")
    fields = encoder.measure(presses().frames[2], presses().background, "mine.sensor")
    assert fields.case == "calibrated" and fields.width_mm == WIDTH
    # Depth is by the colours: the weights are random, and know nothing of it.
    assert fields.depth.max() == pytest.approx(presses().depth[2].max(), rel=0.35)


def test_a_stream_takes_a_calibrated_sensor(place, capsys, monkeypatch):
    monkeypatch.chdir(place)
    assert calibrate(*BALL, "--out", "live.sensor") == 0
    assert calibrate("--sensor", "live.sensor", "--newton", "5") == 0
    capsys.readouterr()
    write_video("balls.avi", presses().frames[..., ::-1], code="FFV1")
    words = ["stream", "--model", "weights.safetensors", "--data", "balls.avi", "--out", "-"]
    words += ["--background", "balls/background.png", "--fields", "--sensor", "live.sensor"]
    assert main(words) == 0
    lines = [json.loads(line)["fields"] for line in capsys.readouterr().out.splitlines()]
    forces = [line["force_z"] for line in lines]
    assert np.median(forces) == pytest.approx(5, rel=0.3)
    for line in lines:
        assert line["force_low"] < line["force_z"] < line["force_high"]


def test_forces_come_from_a_column_too(place, capsys, monkeypatch):
    monkeypatch.chdir(place)
    Path("forces.csv").write_text("frame,newton\n0.png,2\n3.png,3.5\n")
    more = ("--sensor", "gelsight", "--width-mm", "16", "--out", "weighed.sensor")
    assert calibrate(*more, "--newton", "forces.csv") == 0
    assert "2 presses of 2 to 3.5 N" in capsys.readouterr().err
    Path("forces.csv").write_text("frame,newton\nother.png,2\n")
    assert calibrate("--sensor", "weighed.sensor", "--newton", "forces.csv") == 2
    assert "other.png of it is not among the images" in capsys.readouterr().err


def test_check_names_the_state_and_its_status_says_whether_all_is_well(place, capsys, monkeypatch):
    monkeypatch.chdir(place)
    assert calibrate(*BALL, "--out", "checked.sensor") == 0
    capsys.readouterr()
    check = ["sensor", "check", "--sensor", "checked.sensor"]
    assert main([*check, "balls/background.png"]) == 0
    assert capsys.readouterr().out.startswith("the same gel")
    assert main([*check, "pressed.png"]) == 1
    assert "something presses on the gel" in capsys.readouterr().out
    words = ["measure", "--model", "weights.safetensors", "--data", "balls", "--out", "p.npz"]
    assert main([*words, "--sensor", "checked.sensor", "--background", "pressed.png"]) == 2
    assert "something presses on the gel" in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("more", "word"),
    [
        (("--out", "x.sensor"), "--ball-mm, --newton, or both"),
        (("--ball-mm", "6"), "--out mine.sensor"),
        (("--ball-mm", "6", "--out", "x"), "must end in .sensor"),
        (("--ball-mm", "6", "--out", "x.sensor"), "--width-mm 16"),
        (("--ball-mm", "90", "--width-mm", "16", "--out", "x.sensor"), "a ball of 90 mm"),
        (("--newton", "-3", "--width-mm", "16", "--out", "x.sensor"), "above 0"),
        (("--newton", "none", "--width-mm", "16", "--out", "x.sensor"), "a CSV file"),
    ],
)
def test_mistakes_are_one_sentence(place, capsys, monkeypatch, more, word):
    monkeypatch.chdir(place)
    assert calibrate(*more) == 2
    assert word in capsys.readouterr().err.splitlines()[-1]
    assert not Path("x.sensor").exists()
