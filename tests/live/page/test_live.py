"""Live touch on the page, with a video in the place of a camera."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import io
import json
import socket
import struct
import threading
import time
import zipfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import uvicorn
from starlette.testclient import TestClient
from videos import write_video
from view_world import SCRIPT, PressCamera

from anytouch_jax.cli.app import main
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.live.page import live as live_module
from anytouch_jax.live.page import packet as packet_module
from anytouch_jax.live.page import server
from anytouch_jax.live.page.feature_map import FeatureMap
from anytouch_jax.live.page.live import Live
from anytouch_jax.live.page.recorder import SCORE, LiveRecorder
from anytouch_jax.live.page.setup import make_setup

PAGE = {"X-Anytouch": "1"}
# image, contact score and features
FRAME = (np.zeros((8, 8, 3), np.uint8), 1.0, np.zeros(4, np.float32))


@pytest.fixture(scope="module")
def encoder(tiny_run):
    return load_encoder(tiny_run)


def opened(packet: bytes) -> tuple[dict, bytes]:
    (length,) = struct.unpack_from("<I", packet)
    (image,) = struct.unpack_from("<I", packet, 4 + length)
    assert len(packet) == 8 + length + image
    return json.loads(packet[4 : 4 + length]), packet[8 + length :]


def test_a_video_in_the_place_of_a_camera(encoder, video, tmp_path):
    live = Live(str(video), encoder, sensor="digit", out=tmp_path / "recorded", log=lambda _: None)
    page = TestClient(server.app([live]), "http://127.0.0.1", raise_server_exceptions=False)
    live.start()
    runner = asyncio.Runner()
    try:
        packets = live.packets("contact")

        def until(wanted) -> dict:
            return next(
                about
                for about in (opened(runner.run(anext(packets)))[0] for _ in range(500))
                if wanted(about)
            )

        first, jpeg = opened(runner.run(anext(packets)))
        assert (
            first["gel"] == "estimated" and first["layer"] == "contact" and jpeg[:2] == b"\xff\xd8"
        )
        # the video begins again
        assert until(lambda about: about["frame"] > 15)["picture"] == "ok"
        # another site
        assert page.post("/api/0/control", json={"do": "background"}).status_code == 403
        for order in (
            {"do": "x"},
            {},
            [],
            {"do": "orient", "rotate": 45, "flip": "none"},
            {"do": ["record"]},
        ):
            assert page.post("/api/0/control", json=order, headers=PAGE).status_code == 400
        assert page.post("/api/0/control", content=b"x" * 20_000, headers=PAGE).status_code == 413
        assert page.post("/api/0/control", json={"do": "background"}, headers=PAGE).json() == {
            "done": True
        }
        assert until(lambda about: about["gel"] == "captured")
        for name in ("cup", "../../cup"):
            order = {"do": "record", "object": name}
            assert page.post("/api/0/control", json=order, headers=PAGE).status_code == 200
            turn = {"do": "orient", "rotate": 90, "flip": "none"}
            for again in (order, turn):
                # it is on
                assert page.post("/api/0/control", json=again, headers=PAGE).status_code == 400
            until(lambda about: about["recording"]["on"] and about["recording"]["written"] >= 3)
            assert page.post("/api/0/control", json={"do": "stop"}, headers=PAGE).status_code == 200
            # packets under way are of the recording before
            until(lambda about: not about["recording"]["on"])
        orient = {"do": "orient", "rotate": 90, "flip": "across"}
        assert page.post("/api/0/control", json=orient, headers=PAGE).status_code == 200
        # another orientation, another background
        assert until(lambda about: about["gel"] == "estimated")
    finally:
        live.stop()
        runner.close()
    table = manifests.read(tmp_path / "recorded" / "manifest.parquet")
    assert set(table.text_column("object")) == {"cup", "../../cup"} and set(
        table.text_column("sensor")
    ) == {"digit"}
    assert (
        len({file.parent for file in map(table.file, range(len(table)))}) == 2 and len(table) >= 6
    )
    for row in range(len(table)):
        assert (
            decode(table.file(row)).shape
            == decode(table.file(row, "background_path")).shape
            == (48, 48, 3)
        )
    # nothing hidden but the lock
    names = sorted(path.name for path in (tmp_path / "recorded").iterdir())
    assert names[0] == ".manifest.lock" and [name[0] for name in names[1:]] == ["2", "2", "m"]


def test_live_touch_is_measured(encoder, tmp_path, monkeypatch):
    camera = PressCamera()
    monkeypatch.setattr(live_module, "open_source", lambda *_: (camera, True))
    assert not {"depth", "surface"} & set(
        Live("0", encoder, sensor=None, out=tmp_path).about()["layers"]
    )
    live = Live(
        "0", load_encoder("anytouch-tiny"), sensor="gelsight_mini", out=tmp_path, log=lambda _: None
    )
    assert live.about()["layers"][-2:] == ["depth", "surface"]
    live.start()
    runner = asyncio.Runner()
    packets = {layer: live.packets(layer) for layer in ("depth", "surface")}

    def until(layer: str, wanted) -> tuple[dict, np.ndarray]:
        for _ in range(500):
            about, jpeg = opened(runner.run(anext(packets[layer])))
            if about["layer"] == layer and wanted(about):
                return about, cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        raise AssertionError(layer)

    try:
        free, _ = until("depth", lambda about: about["frame"] > 3)
        # a page that shows fewer pixels gets no more
        _, small = opened(runner.run(anext(live.packets("depth", 90))))
        assert max(cv2.imdecode(np.frombuffer(small, np.uint8), cv2.IMREAD_COLOR).shape) == 90
        live.frames.capture_background()
        camera.shape = "ball"
        for layer, shape in (("depth", (360, 480, 3)), ("surface", (54, 72, 3))):
            pressed, image = until(layer, lambda about: about["fields"]["area"] > 0)
            assert (
                image.shape == shape
                and pressed["fields"]["force"][2] > 0.1 > free["fields"]["force"][2]
            )
            assert {"contact", "force, N", "depth, mm", "slip, %"} == set(pressed["curves"])
            # The frame was compared with its background before.
            with monkeypatch.context() as patch:
                patch.delattr(packet_module, "touch_layer")
                assert opened(packet_module.packet(live._newest, layer))[0]["layer"] == layer
        # no frame is read in one way and measured in another
        for rotate in (90, 0) * 40:
            live.frames.orient(rotate, "none")
            live.frames.capture_background()
            time.sleep(0.003)
        live.frames.orient(90, "none")  # another shape than the sensor's: it is said
        until("depth", lambda about: any("height" in fault for fault in about["fields"]["faults"]))
    finally:
        live.stop()
        runner.close()


def test_a_background_that_does_not_fit_the_calibration_is_said(encoder):
    """Of another gel deviations are wider, of another device nothing is measured."""
    gel = np.full((48, 64, 3), 128, np.uint8)

    class Measuring:
        """The encoder, with a calibrated sensor."""

        measures = True

        def __getattr__(self, name: str):
            return getattr(encoder, name)

        def measure_of(self, sensor, background, log):
            if sensor == "other":
                raise UserError("another device.")
            if sensor == "worn":
                log("another gel: deviations are wider.")
            return log

    notes = {}
    logged = []
    for sensor in ("same", "worn", "other"):
        setup = make_setup(Measuring(), sensor, 0, "none", gel, log=logged.append)
        if setup.measure is not None:
            setup.measure("do not trust this frame")
        notes[sensor] = (setup.note, setup.measure is not None)
    assert notes == {
        "same": ("", True),
        "worn": ("another gel: deviations are wider.", True),
        "other": ("another device.", False),
    }
    assert logged == ["another gel: deviations are wider.", "another device."]


def test_a_stopped_camera_does_not_stop_the_page(encoder, video, tmp_path):
    live = Live(str(video), encoder, sensor="digit", out=tmp_path)
    open_streams = set()
    plain = live.packets

    async def counted(layer, side):
        open_streams.add(me := object())
        try:
            async for packet in plain(layer, side):
                yield packet
        finally:
            open_streams.discard(me)

    live.packets = counted
    listener = socket.create_server(("127.0.0.1", 0))
    port = listener.getsockname()[1]
    running = uvicorn.Server(uvicorn.Config(server.app([live]), log_level="error", lifespan="off"))
    thread = threading.Thread(target=running.run, args=([listener],), daemon=True)
    thread.start()

    def wait_for(count: int) -> None:
        end = time.monotonic() + 10
        while len(open_streams) != count and time.monotonic() < end:
            time.sleep(0.02)
        assert len(open_streams) == count

    request = f"GET /api/0/stream HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode()
    try:
        # before the first frame, and after the last
        for number in (0, 1):
            live._newest = live._newest._replace(number=number)
            with contextlib.ExitStack() as pages:
                # the server has 40 threads
                for _ in range(60):
                    pages.enter_context(socket.create_connection(("127.0.0.1", port))).sendall(
                        request
                    )
                wait_for(60)
                page = http.client.HTTPConnection("127.0.0.1", port, timeout=5)
                page.request("GET", "/")
                assert page.getresponse().status == 200
                page.close()
            wait_for(0)  # streams end when their pages leave
    finally:
        running.should_exit = True
        thread.join(10)


def test_frames_before_a_full_disk_are_kept(tmp_path, monkeypatch):
    saved = []

    def full(path, content):
        if len(saved) == 2:
            raise OSError(28, "No space left on device")
        saved.append(path)
        with open(path, "wb") as file:
            return file.write(content)

    monkeypatch.setattr(Path, "write_bytes", full)
    recorder = LiveRecorder(tmp_path, "digit")
    recorder.start("cup", None)
    for _ in range(60):
        recorder.add(*FRAME)
    recorder.stop()
    assert (
        "No space left" in recorder.state()["done"] and "first 2 frames" in recorder.state()["done"]
    )
    assert len(list(tmp_path.glob("*_cup/*.png"))) == 2 and not list(tmp_path.glob(".*_cup"))


def test_a_recording_that_fails_keeps_what_there_was(tmp_path):
    (tmp_path / "manifest.parquet").write_bytes(b"not a table")
    recorder = LiveRecorder(tmp_path, "digit")
    recorder.start("cup", None)
    recorder.add(*FRAME)
    recorder.stop()
    assert (
        "failed" in recorder.state()["done"]
        and (tmp_path / "manifest.parquet").read_bytes() == b"not a table"
    )
    # its frames are not lost
    assert len(list(tmp_path.glob("*_cup/000000.png"))) == 1


def test_a_source_that_ends_and_touches_of_another_encoder(encoder, features, tmp_path, video):
    with pytest.raises(UserError, match="another encoder"):
        Live(str(video), encoder, sensor="digit", space=FeatureMap(features, []), out=tmp_path)
    with pytest.raises(UserError, match="no video"):
        Live(str(tmp_path / "no.avi"), encoder, sensor="digit", out=tmp_path).start()


NAMES = {
    "": 400,
    "  \u200b ": 400,
    "None": 400,
    "n/a": 400,
    SCRIPT: 200,
    "../../cup": 200,
    "x" * 300: 200,
    "cup": 200,
}


@pytest.mark.parametrize("name", NAMES)
def test_a_hostile_name_is_text(name, encoder, video, tmp_path):
    live = Live(str(video), encoder, sensor=None, out=tmp_path / "out", log=lambda _: None)
    page = TestClient(server.app([live]), "http://127.0.0.1", raise_server_exceptions=False)

    def order(**body) -> int:
        return page.post("/api/0/control", json=body, headers=PAGE).status_code

    # the second recording has an existing name
    for _ in range(2):
        assert order(do="record", object=name) == NAMES[name]
        live.recorder.add(*FRAME)
        assert order(do="stop") == 200
    names = page.get("/api/0/taught").json()["names"]
    if NAMES[name] == 400:
        assert names == {} and not (tmp_path / "out").exists()
        return
    assert list(names) == [name[:100]] and names[name[:100]]["recordings"] == 2
    table = manifests.read(tmp_path / "out" / "manifest.parquet")
    assert set(table.text_column("sensor")) == {"universal"} and sorted(tmp_path.iterdir()) == [
        tmp_path / "out"
    ]
    assert page.get("/api/0/recorded/0").status_code == 200
    assert order(do="leave out", sequence="no") == 400
    assert order(do="leave out", sequence=names[name[:100]]["last"]) == 200
    assert page.get("/api/0/taught").json()["names"][name[:100]]["recordings"] == 1
    # its frames stay
    assert len(manifests.read(tmp_path / "out" / "manifest.parquet")) == 2


def test_a_classifier_taught_by_touching(encoder, tmp_path, monkeypatch, capsys):
    camera = PressCamera()
    out = tmp_path / "touches"
    monkeypatch.setattr(live_module, "open_source", lambda *_: (camera, True))

    def opened_live() -> Live:
        return Live("0", encoder, sensor="gelsight_mini", out=out, log=lambda _: None)

    live = opened_live()
    page = TestClient(server.app([live]), "http://127.0.0.1", raise_server_exceptions=False)
    live.start()
    runner = asyncio.Runner()
    packets = live.packets("frame")

    def until(wanted) -> dict:
        return next(
            about
            for about in (opened(runner.run(anext(packets)))[0] for _ in range(900))
            if wanted(about)
        )

    def order(**body) -> None:
        assert page.post("/api/0/control", json=body, headers=PAGE).status_code == 200, body

    try:
        until(lambda about: about["frame"] > 3)
        order(do="background")
        refused = page.post("/api/0/control", json={"do": "train"}, headers=PAGE)
        assert refused.status_code == 400 and "two names" in refused.json()["error"]
        for name in ("ball", "bar", "pins", "ball", "bar", "pins"):
            camera.shape = name
            until(lambda about: about["contact"])
            order(do="record", object=name)
            # the camera's round
            until(lambda about: about["recording"]["on"] and about["recording"]["written"] > 12)
            order(do="stop")
            camera.shape = ""
            until(lambda about: about["contact"] is False)
        order(do="train")
        end = time.monotonic() + 300
        while (after := page.get("/api/0/taught").json())["training"] or not after["trained"]:
            assert time.monotonic() < end and not after["fault"], after
            time.sleep(0.05)
        for name in ("pins", "ball", "bar"):
            camera.shape = name
            seen = until(lambda about, name=name: about["contact"] and about.get("label") == name)
            assert seen["p"] > 0.5 and seen["set"] and "novelty" in seen
            assert until(lambda about, name=name: about["recorded"][0]["about"]["object"] == name)
        assert after["result"]["right"] > 0.7 and 0 <= after["result"]["pixels"] <= 1
        head = page.get("/api/0/taught/head.npz")
        packed = page.get("/api/0/taught/recordings.zip")
        with zipfile.ZipFile(io.BytesIO(packed.content)) as archive:
            archive.extractall(tmp_path / "downloaded")
        (tmp_path / "head.npz").write_bytes(head.content)
        order(do="record", object="last")
        until(
            lambda about: about["recording"]["name"] == "last" and about["recording"]["written"] > 2
        )
    finally:
        live.stop()  # as Ctrl-C does
        runner.close()
    table = manifests.read(out / "manifest.parquet")
    # that was not stopped is not lost
    assert set(table.text_column("object")) == {"ball", "bar", "pins", "last"}
    assert (table.number_column(SCORE)[table.text_column("object") == "pins"] > 6.5).all()
    again = opened_live().teacher.about()  # a new start continues
    assert again["trained"] and set(again["names"]) == {"ball", "bar", "pins", "last"}
    assert again["result"] == after["result"]
    camera.shape = "bar"
    video = write_video(tmp_path / "bar.avi", [camera.retrieve()[1] for _ in range(3)], 30)
    gel = table.file(0, "background_path")
    options = [
        "--model",
        encoder.source,
        "--head",
        tmp_path / "head.npz",
        "--sensor",
        "gelsight_mini",
        "--out",
        "-",
    ]
    capsys.readouterr()
    assert main(list(map(str, ["stream", "--data", video, "--background", gel, *options]))) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [json.loads(line)["label"] for line in lines if line.startswith("{")] == ["bar"] * 3
    copy = manifests.read(tmp_path / "downloaded" / "touches" / "manifest.parquet")
    assert len(copy) and all(copy.file(row).is_file() for row in range(len(copy)))
