import csv
import os
import signal
from pathlib import Path

import cv2
import numpy as np
import pytest
from measuring import gel, measuring_weights
from videos import write_video

from anytouch_jax.cli.app import main
from anytouch_jax.encoder.base import Encoder
from anytouch_jax.fields.video import Video


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return str(measuring_weights(tmp_path_factory.mktemp("measure") / "weights.safetensors"))


@pytest.fixture
def frames(tmp_path):
    """A folder of five images of a DIGIT and of its untouched gel, and the same as a video and as
    a manifest.
    """
    folder = tmp_path / "frames"
    folder.mkdir()
    images = []
    lines = ["path,sensor,sequence,frame_index,split,background_path"]
    for number in range(5):
        image = gel(64, 48)
        image[10:30, 10 : 20 + 5 * number] += 60
        cv2.imwrite(str(folder / f"{number}.png"), image[..., ::-1])
        images.append(image[..., ::-1])
        lines.append(f"frames/{number}.png,digit,press,{number},train,frames/background.png")
    cv2.imwrite(str(folder / "background.png"), gel(64, 48)[..., ::-1])
    write_video(tmp_path / "video.avi", images, 30)
    np.save(tmp_path / "stack.npy", np.stack(images)[..., ::-1])
    np.savez(tmp_path / "stack.npz", frames=np.stack(images)[..., ::-1], force=np.zeros(5))
    lines.append("frames/background.png,gelsight_mini,other,0,train,")
    (tmp_path / "manifest.csv").write_text("\n".join(lines) + "\n")
    return tmp_path


def test_every_form_of_data_gives_maps_and_a_line_a_frame(frames, weights, capsys, monkeypatch):
    monkeypatch.chdir(frames)
    more = ("--video", "shown.avi", "--ply", "gel.ply")
    every = ("frames", "video.avi", "stack.npy", "stack.npz", "frames/4.png", "manifest.csv")
    for data, count in zip(every, (5, 5, 5, 5, 1, 6), strict=True):
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
        (("--out", "frames.npz", "--video", "x.gif"), ".mp4"),
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
    assert capsys.readouterr().err.count("the image is grey") == 1


def words(weights, *more: str) -> list[str]:
    return ["measure", "--model", weights, "--sensor", "digit", *more]


def test_a_video_has_the_rate_of_its_recording(frames, weights, monkeypatch):
    monkeypatch.chdir(frames)
    images = [cv2.imread(f"frames/{number}.png") for number in range(5)]
    write_video("slow.avi", images, 12)
    lines = Path("manifest.csv").read_text().splitlines()
    stamps = ["timestamp", *(f"{0.05 * number}" for number in range(5)), "0"]
    Path("timed.csv").write_text("\n".join(map(",".join, zip(lines, stamps, strict=True))))
    for data, rate in (("slow.avi", 12), ("frames", 30), ("manifest.csv", 30), ("timed.csv", 20)):
        sensor = [] if data.endswith(".csv") else ["--sensor", "digit"]
        more = ["--data", data, "--out", "out.npz", "--video", "shown.avi"]
        assert main(["measure", "--model", weights, *sensor, *more]) == 0
        assert cv2.VideoCapture("shown.avi").get(cv2.CAP_PROP_FPS) == pytest.approx(rate, rel=1e-3)


def test_a_video_that_cannot_be_written_is_an_error_and_costs_no_numbers(
    frames, weights, capsys, monkeypatch
):
    monkeypatch.chdir(frames)
    monkeypatch.setattr(Video, "_is_whole", lambda self: False)
    Path("shown.avi").write_bytes(b"an earlier film")
    more = ("--data", "frames", "--out", "out.npz", "--video", "shown.avi")
    assert main(words(weights, *more)) == 2
    assert "shown.avi" in capsys.readouterr().err
    assert Path("shown.avi").read_bytes() == b"an earlier film"
    with np.load("out.npz") as arrays:
        assert len(arrays["name"]) == 5


def test_ctrl_c_keeps_what_was_measured_and_replaces_nothing(frames, weights, capsys, monkeypatch):
    monkeypatch.chdir(frames)
    for number in range(40):
        cv2.imwrite(f"frames/{number}.png", gel(64, 48) + np.uint8(number))
    real = Encoder.measure
    calls = []

    def interrupted(self, *given, **more):
        calls.append(0)
        if len(calls) == 2:
            os.kill(os.getpid(), signal.SIGINT)
        return real(self, *given, **more)

    monkeypatch.setattr(Encoder, "measure", interrupted)
    more = ("--data", "frames", "--out", "out.npz", "--video", "shown.avi", "--ply", "gel.ply")
    names = ("out.npz", "out.csv", "shown.avi", "gel.ply")
    assert main(words(weights, *more)) == 130
    assert "out.npz and out.csv: 32 frames" in capsys.readouterr().out
    for part in (False, True):
        if part:  # these are there now, and stay
            calls.clear()
            for name in names:
                Path(name).write_bytes(b"earlier")
            assert main(words(weights, *more)) == 130
            assert all(Path(name).read_bytes() == b"earlier" for name in names)
        end = ".part" if part else ""
        with np.load(f"out{end}.npz") as arrays:
            assert arrays["depth"].shape[0] == len(arrays["name"]) == 32
        assert len(Path(f"out{end}.csv").read_text().splitlines()) == 33
        video = cv2.VideoCapture(f"shown{end}.avi")
        assert sum(video.grab() for _ in range(40)) == 32
        assert Path(f"gel{end}.ply").read_bytes().startswith(b"ply")
    assert not [file for file in frames.iterdir() if file.name.startswith(".")]
    capsys.readouterr()
    monkeypatch.setattr(Encoder, "measure", real)
    assert main(words(weights, *more)) == 0
    with np.load("out.npz") as arrays:
        assert len(arrays["name"]) == 40
