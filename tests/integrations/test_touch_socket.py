import importlib.util
import json
import socket
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from places import ROOT

FOLDER = ROOT / "integrations"


def example():
    spec = importlib.util.spec_from_file_location(
        "touch_socket", FOLDER / "unix_socket" / "touch_socket.py"
    )
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_client_gets_whole_lines_and_a_lost_one_stops_nothing(tmp_path):
    path = str(tmp_path / "touch.sock")
    stop = threading.Event()

    def frames():
        number = 0
        while not stop.is_set():
            contact = (1.0, 0.0, float("nan"))[number % 3]
            fields = (
                SimpleNamespace(summary=lambda: {"force_z": 1.5, "centre_x": None})
                if number
                else None
            )
            about = {"contact": contact, "estimated": False, "fields": fields}
            yield SimpleNamespace(number=number, time=0.1 * number, values=np.arange(3.0), **about)
            number += 1
            time.sleep(0.002)

    server = threading.Thread(target=example().serve, args=(frames(), path), daemon=True)
    server.start()
    try:
        clients = [socket.socket(socket.AF_UNIX) for _ in range(2)]
        for client in clients:
            client.settimeout(20)
            while client.connect_ex(path):
                time.sleep(0.01)
        for client in clients:
            lines = client.makefile()
            several = [json.loads(lines.readline()) for _ in range(3)]
            assert {line["contact"] for line in several} == {True, False, None}
            assert several[0]["features"] == [0, 1, 2]
            assert several[1]["fields"] == {"force_z": 1.5, "centre_x": None}
            first = several[0]["frame"]
            assert [line["frame"] for line in several] == [first, first + 1, first + 2]
            lines.close()
            client.close()  # the other goes on
    finally:
        stop.set()
        server.join(20)
    assert not server.is_alive() and not (tmp_path / "touch.sock").exists()


def test_a_dead_socket_is_replaced_and_nothing_else_is(tmp_path):
    serve = example().serve
    path = tmp_path / "touch.sock"
    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(str(path))  # closed without unlink, as by kill -9
    serve([], str(path))
    assert not path.exists()
    with socket.socket(socket.AF_UNIX) as other:
        other.bind(str(path))
        other.listen()
        with pytest.raises(SystemExit, match=r"touch\.sock is in use"):
            serve([], str(path))
        assert path.is_socket()
    path.unlink()
    path.write_text("of the user")
    with pytest.raises(SystemExit, match="in use"):
        serve([], str(path))
    assert path.read_text() == "of the user"
