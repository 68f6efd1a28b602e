"""Live touch on the page, with a film in the place of a camera."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import socket
import struct
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import uvicorn
from starlette.testclient import TestClient
from view_world import DEPTHS

from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.view import server
from anytouch_jax.view.live import Live, LiveRecorder
from anytouch_jax.view.space import FeatureMap

PAGE = {"X-Anytouch": "1"}


@pytest.fixture(scope="module")
def encoder(tiny_run):
    return load_encoder(tiny_run)


def opened(packet: bytes) -> tuple[dict, bytes]:
    (length,) = struct.unpack_from("<I", packet)
    (picture,) = struct.unpack_from("<I", packet, 4 + length)
    assert len(packet) == 8 + length + picture
    return json.loads(packet[4 : 4 + length]), packet[8 + length :]


def test_a_film_in_the_place_of_a_camera(encoder, film, tmp_path):
    live = Live(str(film), encoder, sensor="digit", out=tmp_path / "recorded", log=lambda _: None)
    page = TestClient(server.app([live]), "http://127.0.0.1", raise_server_exceptions=False)
    live.start()
    runner = asyncio.Runner()
    try:
        packets = live.packets()

        def until(wanted) -> dict:
            return next(about for about in (opened(runner.run(anext(packets)))[0] for _ in range(500)) if wanted(about))

        first, jpeg = opened(runner.run(anext(packets)))
        assert first["contact"] is None and first["panels"] == 1 and jpeg[:2] == b"\xff\xd8"
        assert until(lambda about: about["frame"] > 15)["picture"] == "ok"  # the film begins again
        assert page.post("/api/0/control", json={"do": "background"}).status_code == 403  # another site
        for order in ({"do": "x"}, {}, [], {"do": "orient", "rotate": 45, "flip": "none"}, {"do": ["record"]}):
            assert page.post("/api/0/control", json=order, headers=PAGE).status_code == 400
        assert page.post("/api/0/control", content=b"x" * 20_000, headers=PAGE).status_code == 413
        assert page.post("/api/0/control", json={"do": "background"}, headers=PAGE).json() == {"done": True}
        assert until(lambda about: about["contact"] is not None)["panels"] == 3
        for name in ("cup", "../../cup"):
            order = {"do": "record", "object": name}
            assert page.post("/api/0/control", json=order, headers=PAGE).status_code == 200
            assert page.post("/api/0/control", json=order, headers=PAGE).status_code == 400  # it is on
            until(lambda about: about["recording"]["on"] and about["recording"]["written"] >= 3)
            assert page.post("/api/0/control", json={"do": "stop"}, headers=PAGE).status_code == 200
            until(lambda about: not about["recording"]["on"])  # packets under way are of the recording before
        orient = {"do": "orient", "rotate": 90, "flip": "across"}
        assert page.post("/api/0/control", json=orient, headers=PAGE).status_code == 200
        assert until(lambda about: about["contact"] is None)  # another orientation, another background
    finally:
        live.stop()
    table = manifests.read(tmp_path / "recorded" / "manifest.parquet")
    assert set(table.text_column("object")) == {"cup", "../../cup"} and set(table.text_column("sensor")) == {"digit"}
    assert len({file.parent for file in map(table.file, range(len(table)))}) == 2 and len(table) >= 6
    for row in range(len(table)):
        assert decode(table.file(row)).shape == decode(table.file(row, "background_path")).shape == (48, 48, 3)
    assert sorted(path.name[0] for path in (tmp_path / "recorded").iterdir()) == ["2", "2", "m"]  # nothing hidden


def test_a_stopped_camera_does_not_stop_the_page(encoder, film):
    live, open_streams = Live(str(film), encoder, sensor="digit"), set()
    plain = live.packets

    async def counted():
        open_streams.add(me := object())
        try:
            async for packet in plain():
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
        for packet in (b"", b"the last one"):  # before the first frame, and after the last
            live._newest = (len(packet), packet)
            with contextlib.ExitStack() as pages:
                for _ in range(60):  # the server has 40 threads
                    pages.enter_context(socket.create_connection(("127.0.0.1", port))).sendall(request)
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
    recorder.start("cup", "train", None)
    for _ in range(60):
        recorder.add(np.zeros((8, 8, 3), np.uint8))
    recorder.stop()
    assert "No space left" in recorder.state()["done"] and "first 2 frames" in recorder.state()["done"]
    assert len(list(tmp_path.glob("*_cup/*.png"))) == 2 and not list(tmp_path.glob(".*"))


def test_a_recording_that_fails_keeps_what_there_was(tmp_path):
    (tmp_path / "manifest.parquet").write_bytes(b"not a table")
    recorder = LiveRecorder(tmp_path, "digit")
    recorder.start("cup", "train", None)
    recorder.add(np.zeros((8, 8, 3), np.uint8))
    recorder.stop()
    assert "failed" in recorder.state()["done"] and (tmp_path / "manifest.parquet").read_bytes() == b"not a table"
    assert len(list(tmp_path.glob("*_cup/000000.png"))) == 1  # its frames are not lost
    with pytest.raises(UserError, match="--sensor"):
        LiveRecorder(tmp_path, None).start("cup", "train", None)


def test_a_source_that_ends_and_touches_of_another_encoder(encoder, features, tmp_path, film):
    with pytest.raises(UserError, match="another encoder"):
        Live(str(film), encoder, sensor="digit", space=FeatureMap(features, []))
    with pytest.raises(UserError, match="no video"):
        Live(str(tmp_path / "no.avi"), encoder, sensor="digit").start()
    assert len(DEPTHS) == 3
