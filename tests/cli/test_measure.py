import csv

import cv2
import numpy as np
import pytest
from films import write_film
from measuring import gel, measuring_weights

from anytouch_jax.cli.app import main


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return str(measuring_weights(tmp_path_factory.mktemp("measure") / "weights.safetensors"))


@pytest.fixture
def frames(tmp_path):
    """A folder of five pictures of a DIGIT and of its untouched gel, and the same as a film and as
    a manifest.
    """
    folder = tmp_path / "frames"
    folder.mkdir()
    pictures = []
    lines = ["path,sensor,sequence,frame_index,split,background_path"]
    for number in range(5):
        picture = gel(64, 48)
        picture[10:30, 10 : 20 + 5 * number] += 60
        cv2.imwrite(str(folder / f"{number}.png"), picture[..., ::-1])
        pictures.append(picture[..., ::-1])
        lines.append(f"frames/{number}.png,digit,press,{number},train,frames/background.png")
    cv2.imwrite(str(folder / "background.png"), gel(64, 48)[..., ::-1])
    write_film(tmp_path / "film.avi", pictures, 30)
    lines.append("frames/background.png,gelsight_mini,other,0,train,")
    (tmp_path / "manifest.csv").write_text("\n".join(lines) + "\n")
    return tmp_path


def test_every_form_of_data_gives_maps_and_a_line_a_frame(frames, weights, capsys, monkeypatch):
    monkeypatch.chdir(frames)
    more = ("--film", "shown.avi", "--ply", "gel.ply")
    for data, count in (("frames", 5), ("film.avi", 5), ("frames/4.png", 1), ("manifest.csv", 6)):
        sensor = () if data == "manifest.csv" else ("--sensor", "digit")
        assert (
            main(
                ["measure", "--model", weights, "--data", data, "--out", "out.npz", *sensor, *more]
            )
            == 0
        )
        assert f"{count} frames" in capsys.readouterr().out
        lines = list(csv.DictReader((frames / "out.csv").read_text().splitlines()))
        with np.load("out.npz") as arrays:
            assert arrays["depth"].shape == (count, 14, 14) and arrays["force"].shape == (count, 3)
            assert len(lines) == count == len(arrays["name"])
            for row, line in enumerate(lines):
                assert float(line["force_z"]) == pytest.approx(arrays["force"][row, 2], abs=1e-4)
                assert float(line["depth"]) == pytest.approx(arrays["depth"][row].max(), abs=2e-3)
                assert {"slip_std", "area", "centre_x", "torque", "time"} <= line.keys()
            if data == "frames":
                by_folder = arrays["force"]
    # a manifest measures what the folder does
    with np.load("out.npz") as arrays:
        np.testing.assert_allclose(arrays["force"][:5], by_folder, atol=1e-4)
        assert arrays["width_mm"].tolist() == pytest.approx([14.25] * 5 + [18.88])
    shown = cv2.VideoCapture("shown.avi")
    assert sum(shown.grab() for _ in range(9)) == 6
    assert (frames / "gel.ply").read_bytes().startswith(b"ply\n")


@pytest.mark.parametrize(
    ("more", "word"),
    [
        (("--out", "out.csv"), ".npz"),
        (("--out", "frames.npz", "--film", "x.gif"), ".mp4"),
        (("--out", "manifest.npz", "--data", "manifest.csv"), "is a file that is read"),
        (("--out", "out.npz", "--width-mm", "0"), "above 0"),
        (("--out", "out.npz", "--data", "nothing"), "is no"),
        (("--out", "out.npz", "--model", "plain.safetensors"), "--model.fields 32"),
        (
            ("--out", "out.npz", "--data", "manifest.csv", "--sensor", "digit"),
            "--sensor has no effect",
        ),
    ],
)
def test_mistakes_are_one_sentence(frames, weights, capsys, monkeypatch, more, word):
    monkeypatch.chdir(frames)
    measuring_weights(frames / "plain.safetensors", fields=0)
    given = {"--model": weights, "--data": "frames/4.png"} | dict(
        zip(more[::2], more[1::2], strict=True)
    )
    assert main(["measure", *(part for pair in given.items() for part in pair)]) == 2
    assert word in capsys.readouterr().err.splitlines()[-1]


def test_a_fault_is_reported_once(frames, weights, capsys, monkeypatch):
    monkeypatch.chdir(frames)
    for number in range(40):
        cv2.imwrite(f"frames/{number}.png", np.full((64, 48, 3), 90 + number, np.uint8))
    assert (
        main(
            [
                "measure",
                "--model",
                weights,
                "--data",
                "frames",
                "--out",
                "o.npz",
                "--sensor",
                "digit",
            ]
        )
        == 0
    )
    assert capsys.readouterr().err.count("the picture is grey") == 1
