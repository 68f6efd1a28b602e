import json
import signal
import threading
import time

import cv2
import numpy as np
import pytest
from faulty_camera import FaultyCamera, write_uneven_video
from measuring import measuring_weights
from videos import write_video

from anytouch_jax.live import stream as streams


@pytest.fixture(scope="module")
def video(tmp_path_factory):
    path = tmp_path_factory.mktemp("video") / "touch.avi"
    write_video(path, (np.full((32, 32, 3), 40 * frame, np.uint8) for frame in range(6)))
    return path


def test_a_streamed_video_gives_the_features_of_embed(anytouch, tmp_path, video, tiny_run):
    streamed = tmp_path / "streamed.npz"
    plain = tmp_path / "plain.npz"
    args = ("--model", tiny_run, "--data", video, "--frames", 3, "--sensor", "digit")
    done = anytouch("stream", *args, "--out", streamed)
    assert done.status == 0 and "4 features of 12 values" in done.out
    words = " ".join(done.err.split())
    assert "p50 ms p99 ms decode" in words and "4 frames embedded, 0 dropped" in words
    assert anytouch("embed", *args, "--batch", 4, "--out", plain).status == 0
    with np.load(streamed) as a, np.load(plain) as b:
        np.testing.assert_allclose(a["features"], b["features"], atol=1e-5)
        assert a["key/frame_index"].tolist() == b["key/frame_index"].tolist() == [2, 3, 4, 5]
        # in the video of ten frames a second
        np.testing.assert_allclose(a["key/time"], [0.2, 0.3, 0.4, 0.5])
        assert (
            str(a["about/stride"]) == "1" and "about/started" not in a and not a["key/reused"].any()
        )

    done = anytouch("stream", *args, "--out", "-")
    lines = [json.loads(line) for line in done.out.splitlines()]
    assert done.status == 0 and [line["frame"] for line in lines] == [2, 3, 4, 5]
    assert [line["time"] for line in lines] == [0.2, 0.3, 0.4, 0.5]
    assert [line["reused"] for line in lines] == [False] * 4
    with np.load(streamed) as a:
        np.testing.assert_array_equal(
            np.asarray([line["features"] for line in lines], np.float32), a["features"]
        )
    assert "4 frames embedded" in done.err


def test_fields_are_those_of_measure(anytouch, mistake, tmp_path, video, tiny_run):
    weights = measuring_weights(tmp_path / "weights.safetensors")
    args = ("--model", weights, "--data", video, "--sensor", "tacto", "--width-mm", 10)
    done = anytouch("stream", *args, "--frames", 3, "--fields", "--out", "-")
    lines = [json.loads(line) for line in done.out.splitlines()]
    assert done.status == 0 and len(lines) == 4
    assert (
        anytouch("stream", *args, "--frames", 3, "--fields", "--out", tmp_path / "s.npz").status
        == 0
    )
    assert anytouch("measure", *args, "--out", tmp_path / "m.npz").status == 0
    with np.load(tmp_path / "s.npz") as streamed, np.load(tmp_path / "m.npz") as measured:
        force = [[line["fields"][f"force_{axis}"] for axis in "xyz"] for line in lines]
        np.testing.assert_allclose(force, measured["force"][2:], atol=2e-4)
        np.testing.assert_allclose(streamed["force_z"], measured["force"][2:, 2], atol=2e-4)
        np.testing.assert_allclose(streamed["slip_std"], measured["slip_std"][2:], atol=2e-4)
    assert "--model.fields 32" in mistake(
        "stream", "--model", tiny_run, "--data", video, "--fields", "--out", "-"
    )
    assert "without --fields" in mistake("stream", *args, "--out", "-")
    assert "clips of 3" in mistake("stream", *args, "--frames", 4, "--fields", "--out", "-")


def test_what_cannot_be_streamed(mistake, tmp_path, video, tiny_run):
    for words, named in (
        (["--frames", 3, "--stride", 4], "stride 4"),
        (["--frames", 2], "3 frames"),
        (["--stride", 4], "--stride"),
        (["--reuse", -1], "0 or more, not -1"),
        (["--out", tmp_path / "f.csv"], ".npz"),
        (["--data", tmp_path / "gone.avi"], "gone.avi"),
    ):
        given = {"--data": video, "--out": tmp_path / "f.npz"} | dict(
            zip(words[::2], words[1::2], strict=True)
        )
        assert named in mistake(
            "stream", "--model", tiny_run, *(word for pair in given.items() for word in pair)
        )
    assert list(tmp_path.iterdir()) == []


def test_ctrl_c_saves_what_there_is(anytouch, tmp_path, tiny_run, monkeypatch):
    """The signal comes while the camera shows nothing new and the program waits."""
    over = threading.Event()

    class Camera(FaultyCamera):
        def grab(self):
            if self.count < 2:
                return super().grab()
            # as a terminal does
            signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
            assert over.wait(60)
            return False

    monkeypatch.setattr(streams, "open_source", lambda *_: (Camera(), True))
    monkeypatch.setattr(streams, "_PATIENCE", 0.01)
    # a shell may have set it to be ignored
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        done = anytouch(
            "stream", "--model", tiny_run, "--data", 0, "--frames", 3, "--out", tmp_path / "f.npz"
        )
    finally:
        signal.signal(signal.SIGINT, before)
        over.set()
    assert done.status == 0, done
    with np.load(tmp_path / "f.npz") as file:
        # the encoder may not be done yet
        assert file["features"].ndim == 2 and len(file["features"]) <= 1


def test_a_image_on_its_side_is_turned(anytouch, tmp_path, tiny_run):
    """A folder, and a video frame by frame: as if the camera had been held upright."""
    rng = np.random.default_rng(0)
    upright = [cv2.resize(rng.integers(0, 256, (4, 3, 3), np.uint8), (24, 32)) for _ in range(3)]
    lying = [cv2.rotate(one[:, ::-1], cv2.ROTATE_90_COUNTERCLOCKWISE) for one in upright]
    result = {}
    for name, frames in (("upright", upright), ("lying", lying)):
        (tmp_path / name).mkdir()
        for number, frame in enumerate(frames):
            cv2.imwrite(str(tmp_path / name / f"{number}.png"), frame)
        write_video(tmp_path / f"{name}.avi", frames, code="FFV1")
        turn = ("--rotate", 90, "--flip", "across") if name == "lying" else ()
        for form, command in ((name, "embed"), (f"{name}.avi", "stream")):
            out = tmp_path / "f.npz"
            done = anytouch(
                command, "--model", tiny_run, "--data", tmp_path / form, "--out", out, *turn
            )
            assert done.status == 0, done
            with np.load(out) as file:
                result[form] = file["features"]
    np.testing.assert_array_equal(result["lying"], result["upright"])
    np.testing.assert_allclose(
        result["lying.avi"], result["upright.avi"], atol=1e-2 * np.abs(result["upright"]).max()
    )


@pytest.mark.parametrize("out", ["f.npz", "-"])
def test_a_camera_that_is_lost_keeps_the_features_and_fails(
    anytouch, mistake, tmp_path, tiny_run, monkeypatch, out
):
    cameras = [FaultyCamera(frames=0), FaultyCamera("grab", frames=30)]
    monkeypatch.setattr(streams, "open_source", lambda *_: (cameras.pop(), True))
    monkeypatch.setattr(streams, "RETRY", 0.05)
    before = time.time()
    target = out if out == "-" else tmp_path / out
    done = anytouch("stream", "--model", tiny_run, "--data", 0, "--out", target)
    assert (
        done.status == 2
        and "after 29 frames" in done.err.splitlines()[-1]
        and "Traceback" not in done.err
    )
    assert "1 missed reads" in done.err
    if out == "-":
        lines = [json.loads(line) for line in done.out.splitlines()]
        assert lines[-1]["missed"] == 1 and {line["picture"] for line in lines} == {"ok"}
        return
    with np.load(target) as file:
        assert file["key/frame_index"][-1] == 28 and str(file["about/missed"]) == "1"
        clock = float(str(file["about/started"])) + file["key/time"]
    assert (before <= clock).all() and (clock <= time.time()).all()
    words = (
        "stream",
        "--model",
        tiny_run,
        "--data",
        0,
        "--sensor",
        "digit",
        "--out",
        tmp_path / "g.npz",
    )
    # one that never shows a frame
    assert "camera" in mistake(*words) and not (tmp_path / "g.npz").exists()


@pytest.mark.parametrize("command", ["stream", "embed"])
def test_times_and_the_cut_of_a_video(anytouch, tmp_path, tiny_run, command):
    """Both commands use each frame's time stamp, and both report a video that is cut short."""
    stamps = [0, 30, 60, 500, 510, 1500]
    video = write_uneven_video(tmp_path / "uneven.mkv", stamps)
    out = tmp_path / "f.npz"
    assert anytouch(command, "--model", tiny_run, "--data", video, "--out", out).status == 0
    with np.load(out) as file:
        np.testing.assert_allclose(file["key/time"], np.array(stamps) / 1000, atol=1e-6)
    cut = write_uneven_video(tmp_path / "cut.mkv", [100 * i for i in range(30)])
    cut.write_bytes(cut.read_bytes()[: cut.stat().st_size // 2])
    done = anytouch(command, "--model", tiny_run, "--data", cut, "--out", out)
    assert done.status == 0 and "cut.mkv reports 30 frames and" in done.err
