"""The server of `anytouch view`: what it shows of files, and what it refuses."""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
from importlib.resources import files
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from checked_world import columns
from starlette.testclient import TestClient
from view_world import SCRIPT

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.errors import UserError
from anytouch_jax.live.cameras import Camera
from anytouch_jax.live.page import server
from anytouch_jax.live.page.runs import Run
from anytouch_jax.live.page.tables import Table

KINDS = (".html", ".js", ".css")
LIVE = {"kind": "live", "source": "", "start": lambda: None}


def client(*paths, **options) -> TestClient:
    application = server.app(server.open_sources(paths), **options)
    return TestClient(application, "http://127.0.0.1", raise_server_exceptions=False)


@pytest.fixture(scope="module")
def page(touches, features):
    return client(touches, features)


def image(response) -> np.ndarray:
    assert response.status_code == 200 and response.headers["content-type"] == "image/jpeg", (
        response.text
    )
    return cv2.imdecode(np.frombuffer(response.content, np.uint8), cv2.IMREAD_COLOR)


def test_a_touch_is_its_recordings_by_all_sensors(page):
    about = page.get("/api/sources").json()[0]["about"]
    assert (
        about["rows"] == 12
        and about["touches"] == 2
        and about["filters"]["sensor"] == ["digit", "gelsight_mini"]
    )
    first = page.get("/api/0/touch?place=0").json()
    assert first["count"] == 2 and [clip["sensor"] for clip in first["clips"]] == [
        "digit",
        "gelsight_mini",
    ]
    assert [clip["rows"] for clip in first["clips"]] == [[0, 1, 2], [3, 4, 5]]
    assert first["clips"][0]["curves"]["label.force"] == [0, 6, 9] and first["clips"][0]["photo"]
    # the last one
    assert page.get("/api/0/touch?place=7").json()["place"] == 1
    assert page.get("/api/0/touch?row=10").json()["place"] == 1


def test_touches_are_listed_with_a_image_each(page):
    found = page.get("/api/0/touches").json()
    assert found["count"] == 2 and [one["place"] for one in found["touches"]] == [0, 1]
    # the middle of the first recording
    assert [one["row"] for one in found["touches"]] == [1, 7]
    assert found["touches"][1]["name"] == SCRIPT
    assert found["touches"][0]["sensors"] == ["digit", "gelsight_mini"]
    some = page.get("/api/0/touches", params={"filters": '{"split": "test"}'}).json()
    assert some["count"] == 1 and [one["row"] for one in some["touches"]] == [7]
    assert page.get("/api/0/touches?start=2").json()["touches"] == []
    for path in ("touches?start=-1", 'touches?filters={"path": "x"}'):
        assert page.get(f"/api/0/{path}").status_code == 400


@pytest.mark.parametrize(
    "filters, count, clips",
    [
        ({"sensor": "digit"}, 2, 1),
        ({"split": "test"}, 1, 2),
        ({"object": SCRIPT}, 1, 2),
        ({"object": "no"}, 0, 0),
    ],
)
def test_filters(page, filters, count, clips):
    found = page.get("/api/0/touch", params={"filters": json.dumps(filters)}).json()
    assert (found["count"], len(found["clips"])) == (count, clips)


@pytest.mark.parametrize("filters", ['{"path": "x"}', '{"sensor": 3}', "[]", "{", '{"sensor'])
def test_filters_that_are_none(page, filters):
    assert page.get("/api/0/touch", params={"filters": filters}).status_code == 400


def test_rows_in_any_order_make_the_same_touches(touches):
    table = manifests.read(touches)
    mixed = Table(
        manifests.select_rows(table, np.random.default_rng(0).permutation(len(table))), "mixed"
    )
    clips = mixed.touch(0, {})["clips"] + mixed.touch(1, {})["clips"]
    paths = [[mixed.manifest.value(row, "path") for row in clip["rows"]] for clip in clips]
    recordings = [f"{touch}_{sensor}" for touch in "01" for sensor in ("digit", "gelsight_mini")]
    assert sorted(paths) == [
        [f"{recording}_{frame}.png" for frame in range(3)] for recording in recordings
    ]


def test_a_frame_shows_its_difference_and_contact(page):
    free = page.get("/api/0/frame/0?layer=difference")
    pressed = page.get("/api/0/frame/2?layer=contact")
    assert image(page.get("/api/0/frame/2")).shape == image(pressed).shape == (48, 48, 3)
    assert float(free.headers["x-score"]) < 1 < 20 < float(pressed.headers["x-score"])
    # an untouched gel is grey
    assert abs(image(free).astype(int) - 128).max() < 6
    blue, _, red = image(pressed)[24, 24].astype(int)
    assert red > blue + 60  # the middle of the press is marked
    assert image(page.get("/api/0/photo/0")).shape == (48, 48, 3)
    for path in ("photo/1", "frame/12", "frame/99999999999999999999", "frame/0?layer=x"):
        assert page.get(f"/api/0/{path}").status_code == 400


def test_depth_is_measured_where_the_untouched_gel_is_known(page, tmp_path):
    free, pressed = (page.get(f"/api/0/frame/{row}?layer=depth") for row in (0, 2))
    nothing, values = (json.loads(answer.headers["x-fields"]) for answer in (free, pressed))
    assert image(pressed).shape == (480, 480, 3) and values["unit"] == "mm"
    assert (
        nothing["force"][2]
        < 0.05
        < 0.3
        < values["force"][2]
        == pytest.approx(values["curves"]["force, N"], abs=1e-3)
    )
    assert (
        nothing["area"] == 0 < values["area"]
        and values["depth_std"] > 0
        and "slip, %" not in nothing["curves"]
    )
    surface = image(page.get("/api/0/frame/2?layer=surface")).astype(int)
    # grey
    assert np.ptp(surface.max(2) - surface.min(2)) <= 2 and surface.max() > 60
    assert "x-fields" not in page.get("/api/0/frame/2?layer=contact").headers
    cv2.imwrite(str(tmp_path / "0.png"), np.full((32, 48, 3), 90, np.uint8))
    manifests.write(
        manifests.from_columns(columns(sensor=["mine"]), tmp_path / "m.csv"), tmp_path / "m.csv"
    )
    # one frame shows no untouched gel
    unknown = client(tmp_path / "m.csv").get("/api/0/frame/0?layer=depth")
    assert image(unknown).shape == (32, 48, 3) and "x-fields" not in unknown.headers


def test_a_video_by_its_name_with_its_own_untouched_gel(video, tmp_path):
    shutil.copy(video, tmp_path / "video.avi")
    page = client(tmp_path / "video.avi")
    assert all(page.get(f"/api/0/frame/{row}").headers["x-score"] for row in (0, 11))
    grey = {row: image(page.get(f"/api/0/frame/{row}")).mean() for row in (11, 3, 4, 0, 7)}
    # frames in any order
    for row, value in grey.items():
        assert abs(value - 20 - 15 * row) < 4
    touch = page.get("/api/0/touch").json()
    assert touch["clips"][0]["rows"] == list(range(12)) and touch["name"] == "video"
    # nothing is known of them
    assert not {"sensor", "split", "sequence"} & set(touch["clips"][0])


def test_a_folder_of_images(tmp_path):
    for name, value in (("background", 40), ("2", 60), ("10", 80)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((32, 32, 3), value, np.uint8))
    page = client(tmp_path)
    assert page.get("/api/0/touch").json()["clips"][0]["rows"] == [0, 1]
    # 2 before 10
    assert abs(image(page.get("/api/0/frame/0")).mean() - 60) < 2
    assert (
        page.get("/api/0/frame/0").headers["x-score"]
        and page.get("/api/sources").json()[0]["name"] == tmp_path.name
    )


def test_examples_of_the_package(tmp_path):
    page = client(Path("examples"))
    touches = [page.get(f"/api/0/touch?place={place}").json() for place in (0, 1)]
    assert [(touch["name"], len(touch["clips"])) for touch in touches] == [("dots", 3), ("ring", 3)]
    for row in range(6):
        assert float(page.get(f"/api/0/frame/{row}?layer=contact").headers["x-score"]) > 6.5


def test_the_first_page_opens_a_camera(monkeypatch):
    class Fake:
        kind = "live"
        name = "camera 2"
        source = "2"

        def about(self):
            return {}

        def start(self):
            started.append(self.source)

    started = []
    sources = []
    cameras = [Camera(2, "GelSight Mini", "28H7", ()), Camera(4, "webcam", "", ())]
    monkeypatch.setattr(server, "list_cameras", lambda: cameras)
    sources.append(server.StartPage(lambda camera: Fake()))
    page = TestClient(server.app(sources), "http://127.0.0.1", raise_server_exceptions=False)
    assert page.get("/api/sources").json()[0]["about"]["cameras"] == {
        "2": "GelSight Mini 28H7",
        "4": "webcam",
    }
    answers = [
        page.post("/api/0/control", json={"camera": one}, headers={"X-Anytouch": "1"})
        for one in "2324"
    ]
    assert [answer.status_code for answer in answers] == [200, 400, 200, 400] and started == ["2"]
    assert answers[0].json() == answers[2].json() == {"source": 1}
    assert page.post("/api/0/control", json={"camera": "2"}).status_code == 403


def test_nothing_outside_is_served(tmp_path, touches):
    inside = tmp_path / "inside"
    inside.mkdir()
    secret = tmp_path / "secret.png"
    shutil.copy(touches.with_name("0_digit_0.png"), secret)
    os.symlink(secret, inside / "link.png")
    os.symlink(tmp_path, inside / "up")
    paths = ["../secret.png", str(secret), "link.png", "up/secret.png"]
    table = columns(4, path=paths, sequence=list("abcd"), image_path=paths, background_path=paths)
    manifests.write(manifests.from_columns(table, inside / "m.csv"), inside / "m.csv")
    page = client(inside / "m.csv")
    for row in range(4):
        for kind in ("frame", "photo"):
            answer = page.get(f"/api/0/{kind}/{row}")
            assert answer.status_code == 400 and "folder" in answer.json()["error"]
    folder = tmp_path / "folder"
    folder.mkdir()
    os.symlink(secret, folder / "0.png")
    assert client(folder).get("/api/0/frame/0").status_code == 400
    for path in (
        "/../secret.png",
        "/%2e%2e/secret.png",
        "/server.py",
        "//etc/passwd",
        "/__init__.py",
    ):
        assert page.get(path).status_code == 404


def test_the_map_and_neighbours_across_sensors(page):
    points = page.get("/api/1/map?method=pca").json()
    assert points["rows"] == list(range(12)) and max(map(abs, points["x"] + points["y"])) <= 1
    assert np.ptp(np.array(points["x"])[:6]) < 0.5 < abs(points["x"][0] - points["x"][6])
    assert len(page.get("/api/1/map?method=tsne").json()["x"]) == 12
    coloured = page.get("/api/1/colours?method=pca&column=sensor").json()
    assert (
        coloured["names"] == ["digit", "gelsight_mini"]
        and coloured["codes"] == [0, 0, 0, 1, 1, 1] * 2
    )
    found = page.get("/api/1/neighbours?row=1&others=1").json()
    # a hit for each recording
    assert [hit["row"] for hit in found["hits"]] == [4, found["hits"][1]["row"]]
    assert {hit["about"]["sensor"] for hit in found["hits"]} == {"gelsight_mini"}
    anywhere = page.get("/api/1/neighbours?row=1").json()["hits"]
    assert [hit["about"]["sequence"] for hit in anywhere][:1] == ["0-gelsight_mini"] and len(
        anywhere
    ) == 3
    for path in ("map?method=x", "colours?column=x", "neighbours?row=12", "neighbours?row=-1"):
        assert page.get(f"/api/1/{path}").status_code == 400


def test_features_show_images_of_given_files_only(page, features, touches, tmp_path):
    assert page.get("/api/sources").json()[1]["about"]["table"] == 0
    alone = client(features).get("/api/sources").json()
    # its manifest lies in its folder
    assert [one["kind"] for one in alone] == ["table", "space"]
    moved = Path(shutil.copy(features, tmp_path))  # its manifest does not
    assert [one["kind"] for one in client(moved).get("/api/sources").json()] == ["space"]
    assert client(moved, touches).get("/api/sources").json()[1]["about"]["table"] == 0
    other = tmp_path / "other.csv"
    manifests.write(manifests.from_columns(columns(12, path=["a.png"] * 12), other), other)
    assert client(moved, other).get("/api/sources").json()[1]["about"]["table"] is None


def test_text_of_files_stays_text(page):
    answer = page.get("/api/0/touch?place=1")
    assert (
        answer.headers["content-type"] == "application/json"
        and answer.headers["x-content-type-options"] == "nosniff"
    )
    assert answer.json()["clips"][0]["object"] == SCRIPT
    policy = page.get("/").headers["content-security-policy"]
    assert (
        "default-src 'none'" in policy and "script-src 'self';" in policy and "unsafe" not in policy
    )
    assets = {
        file.name: file.read_text()
        for file in map(Path, map(str, files("anytouch_jax.live.page").iterdir()))
        if file.suffix in KINDS
    }
    script = "".join(text for name, text in assets.items() if name.endswith(".js"))
    assert not re.search(
        r"innerHTML|outerHTML|insertAdjacentHTML|document\.write|\beval\(|new Function|srcdoc",
        script,
    )
    # nothing from the network
    for name, text in assets.items():
        assert not re.search(r"https?:|//cdn|@import|url\(", text)
        assert name == "page.html" or page.get(f"/{name}").text == text


def test_a_token_and_the_name_of_the_host(touches):
    page = client(touches, token="secret")
    assert page.get("/").status_code == 200 and page.get("/page.js").status_code == 200
    for headers in ({}, {"Authorization": "Bearer no"}, {"Authorization": "secret"}):
        assert page.get("/api/sources", headers=headers).status_code == 401
        assert page.get("/api/0/frame/0", headers=headers).status_code == 401
    assert page.get("/api/sources", headers={"Authorization": "Bearer secret"}).status_code == 200
    assert client(touches).get("/api/sources", headers={"Host": "evil.example"}).status_code == 400
    assert "access-control-allow-origin" not in client(touches).get("/api/sources").headers


def test_a_run_while_it_trains(tmp_path):
    run = tmp_path / "run"
    (run / "figures").mkdir(parents=True)
    log = run / "metrics.jsonl"
    log.write_text('{"step": 1, "loss": 2.0}\nnot json\n{"step": 2, "loss": NaN}\n{"step": 3, "lo')
    cv2.imwrite(str(run / "figures" / "reconstruction_000001.png"), np.zeros((8, 8, 3), np.uint8))
    cv2.imwrite(str(tmp_path / "secret.png"), np.zeros((8, 8, 3), np.uint8))
    os.symlink(tmp_path / "secret.png", run / "figures" / "secret.png")
    page = client(run)
    assert isinstance(server.open_sources([run])[0], Run)
    first = page.get("/api/0/losses").json()
    assert first["lines"][0] == {"step": 1, "loss": 2.0} and first["figures"] == [
        "reconstruction_000001.png"
    ]
    with log.open("a") as file:
        file.write('ss": 1.0}\n')
    rest = page.get(f"/api/0/losses?after={first['next']}").json()
    assert rest["lines"] == [{"step": 3, "loss": 1.0}]
    assert page.get(f"/api/0/losses?after={rest['next']}").json()["lines"] == []
    # a file that was replaced
    assert page.get("/api/0/losses?after=999").json()["lines"][0]["step"] == 1
    assert image(page.get("/api/0/figure/reconstruction_000001.png")).shape == (8, 8, 3)
    for name in ("secret.png", "..%2f..%2fsecret.png", "no.png"):
        assert page.get(f"/api/0/figure/{name}").status_code in (400, 404)


def test_a_port_that_is_taken():
    with socket.create_server(("127.0.0.1", 0)) as taken, pytest.raises(UserError, match="--port"):
        server.serve([], "127.0.0.1", taken.getsockname()[1], print)


def test_the_built_in_recording_is_opened_like_a_camera(monkeypatch):
    opened = []
    monkeypatch.setattr(server, "list_cameras", list)
    start = server.StartPage(lambda camera: opened.append(camera) or SimpleNamespace(**LIVE))
    page = TestClient(server.app([start]), "http://127.0.0.1", raise_server_exceptions=False)
    name = page.get("/api/sources").json()[0]["about"]["example"]
    answer = page.post("/api/0/control", json={"camera": name}, headers={"X-Anytouch": "1"})
    assert answer.json() == {"source": 1} and opened == [name]
