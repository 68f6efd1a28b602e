import fcntl
import http.server
import os
import re
import struct
import threading
import time

import cv2
import numpy as np
import pytest
from refused import refused
from videos import write_video

from anytouch_jax.live import cameras
from anytouch_jax.live.cameras import CameraSettings, camera_of, list_cameras, open_source

YUYV, MJPG = (int.from_bytes(name, "little") for name in (b"YUYV", b"MJPG"))
# format -> size -> intervals, of a camera that lists its sizes and of one with a range of sizes
DRIVERS = {
    "video0": {
        YUYV: {(640, 480): [(1, 30), (1, 15)]},
        MJPG: {(640, 480): [(1, 60)], (320, 240): [(1, 120)]},
    },
    "video2": {YUYV: {(3280, 2464): [(1001, 30000)]}},
}


class Driver:
    """Answers of V4L2 drivers, by the layout of linux/videodev2.h."""

    def ioctl(self, handle, code, words):
        name = os.path.basename(os.readlink(f"/proc/self/fd/{handle}"))
        forms = DRIVERS.get(name, {})
        index, second, width, height = struct.unpack("=4I", words[:16])
        if code & 0xFF == 2:
            answers = [
                struct.pack("=3I32sI", i, 1, 0, b"", form).ljust(64, b"\0")
                for i, form in enumerate(forms)
            ]
        elif code & 0xFF == 74:
            is_range = name == "video2"
            answers = [
                struct.pack("=3I6I", i, second, 3, 16, w, 2, 16, h, 2)
                if is_range
                else struct.pack("=3I2I", i, second, 1, w, h)
                for i, (w, h) in enumerate(forms[second])
            ]
        else:
            assert code & 0xFF == 75
            answers = [
                struct.pack("=5I2I", i, second, width, height, 1, *interval)
                for i, interval in enumerate(forms[second][width, height])
            ]
        if index >= len(answers):
            raise OSError(22, "Invalid argument")
        words[: len(answers[index])] = answers[index]
        return 0


@pytest.fixture
def system(monkeypatch, tmp_path):
    """A DIGIT (0, with a node of metadata 1) and a GelSight Mini (2)."""
    devices = tmp_path / "dev"
    listed = tmp_path / "video4linux"
    devices.mkdir()
    about = {
        "video0": ("DIGIT: DIGIT", 0, "D20345"),
        "video1": ("DIGIT: DIGIT", 1, "D20345"),
        "video2": ("GelSight Mini R0B 2BXX", 0, ""),
    }
    for name, (title, index, serial) in about.items():
        (devices / name).write_bytes(b"")
        (tmp_path / "usb" / name / "interface").mkdir(parents=True)
        (listed / name).mkdir(parents=True)
        (listed / name / "name").write_text(f"{title}\n")
        (listed / name / "index").write_text(f"{index}\n")
        (listed / name / "device").symlink_to(tmp_path / "usb" / name / "interface")
        if serial:
            (tmp_path / "usb" / name / "serial").write_text(f"{serial}\n")
    monkeypatch.setattr(cameras, "SYSTEM", listed)
    monkeypatch.setattr(cameras, "DEVICES", devices)
    monkeypatch.setattr(fcntl, "ioctl", Driver().ioctl)
    return listed


def test_cameras_are_listed_with_names_serials_sizes_and_rates(system):
    digit, mini = list_cameras()
    assert (digit.number, digit.serial) == (0, "D20345") and str(
        mini
    ) == "2 (GelSight Mini R0B 2BXX)"
    assert digit.lines() == [
        "camera 0 (DIGIT: DIGIT, serial D20345)",
        "  YUYV: 640 x 480 at 30, 15 frames/s",
        "  MJPG: 640 x 480 at 60 frames/s; 320 x 240 at 120 frames/s",
    ]
    assert mini.lines()[1] == "  YUYV: 3280 x 2464 at 29.97 frames/s"


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("0", 0),
        ("7", 7),
        ("/dev/video7", 7),
        ("DIGIT", 0),
        ("digit", 0),
        ("d20345", 0),
        ("gelsight mini", 2),
        ("video.mp4", None),
        ("videos/digit", None),
        ("http://host/a", "http://host/a"),
        ("rtsp://host", "rtsp://host"),
        ("", None),
    ],
)
def test_what_a_user_may_call_a_camera(system, name, number):
    assert camera_of(name) == number


def test_a_name_of_several_cameras_and_of_none(system):
    refused(r"the name of 2 cameras, 0 \(DIGIT.*2 \(GelSight", camera_of, "g")
    refused(r"no video and no camera digits; connected are 0 \(DIGIT", open_source, "digits")


class Played:
    """A cv2.VideoCapture of a camera that has 640 x 480 and 320 x 240 only, and 30 frames a
    second.
    """

    def __init__(self, *_):
        self.values = {
            cv2.CAP_PROP_FRAME_WIDTH: 640,
            cv2.CAP_PROP_FRAME_HEIGHT: 480,
            cv2.CAP_PROP_FPS: 30.0,
        }
        self.values[cv2.CAP_PROP_FOURCC] = YUYV
        self.order = []

    def isOpened(self):
        return True

    def set(self, name, value):
        self.order.append(name)
        if name in (cv2.CAP_PROP_FOURCC, cv2.CAP_PROP_FPS) or value in (640, 480, 320, 240):
            self.values[name] = min(value, 30.0) if name == cv2.CAP_PROP_FPS else value
        return True

    def get(self, name):
        return self.values.get(name, 0)


@pytest.mark.parametrize(
    ("asked", "given"),
    [
        (CameraSettings(), "640 x 480 pixels, 30 frames/s, YUYV. With format MJPG it gives 60"),
        (CameraSettings((320, 240), 30, "mjpg"), "320 x 240 pixels, 30 frames/s, MJPG"),
        (
            CameraSettings((640, 480), 60, None),
            "640 x 480 pixels, 30 frames/s, YUYV, not 60 frames/s as asked for",
        ),
        (
            CameraSettings((1000, 1000)),
            "640 x 480 pixels, 30 frames/s, YUYV, not 1000 x 1000 pixels as asked for",
        ),
    ],
)
def test_a_camera_is_asked_and_what_it_gives_is_reported(system, monkeypatch, asked, given):
    monkeypatch.setattr(cv2, "VideoCapture", Played)
    said = []
    source, live = open_source("digit", asked, said.append)
    assert live and len(said) == 1 and said[0].startswith(f"camera digit: {given}")
    if asked.format and asked.size:
        assert source.order.index(cv2.CAP_PROP_FOURCC) < source.order.index(
            cv2.CAP_PROP_FRAME_WIDTH
        )


def test_an_address_is_a_camera_and_a_video_at_an_address_is_a_video(tmp_path):
    video = tmp_path / "video.avi"
    write_video(video, (np.full((48, 64, 3), 40 * number, np.uint8) for number in range(5)))
    image = cv2.imencode(".jpg", np.full((48, 64, 3), 90, np.uint8))[1].tobytes()

    class Answer(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            is_video = self.path == "/video.avi"
            self.send_header(
                "Content-Type", "video/avi" if is_video else "multipart/x-mixed-replace; boundary=b"
            )
            self.end_headers()
            part = b"--b\r\nContent-Type: image/jpeg\r\n"
            part += f"Content-Length: {len(image)}\r\n\r\n".encode()
            self.wfile.write(video.read_bytes() if is_video else (part + image + b"\r\n") * 200)

        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Answer)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    address = f"http://127.0.0.1:{server.server_port}"
    try:
        said = []
        source, live = open_source(f"{address}/stream.mjpg", None, said.append)
        assert live and source.read()[1].shape == (48, 64, 3) and "64 x 48 pixels" in said[0]
        source.release()
        source, live = open_source(f"{address}/video.avi")
        assert not live and source.read()[0]
        source.release()
    finally:
        server.shutdown()
        server.server_close()
    refused("cannot be opened; check the address", open_source, f"{address}/gone.mjpg")


class Slow:
    """A camera that says it gives 200 frames/s, and repeats each of its images."""

    def __init__(self, number: int) -> None:
        self.is_there = number == 0
        self.count = 0

    def isOpened(self) -> bool:
        return self.is_there

    def grab(self) -> bool:
        time.sleep(0.005)
        self.count += 1
        return True

    def retrieve(self):
        return True, np.full((8, 8, 3), self.count // 2, np.uint8)

    def get(self, name: int) -> float:
        return 200.0 if name == cv2.CAP_PROP_FPS else 1e3 * time.monotonic() - 30.0

    def release(self) -> None:
        pass


def test_what_a_camera_gives_is_measured(system, monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", Slow)
    lines = cameras.describe_cameras()
    measured = next(line for line in lines if "gives" in line)
    assert "fresh frames/s of 200" in measured and "30 ms old" in measured
    assert 45 <= int(re.search(r"(\d+)% of frames repeat", measured)[1]) <= 55
    assert any("and not 200 as it says" in line for line in lines)
    assert "it cannot be opened now" in lines[-1]
