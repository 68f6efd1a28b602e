import io

import cv2
import numpy as np
import pytest
from chat_server import GOOD, KEY, serve
from checked_world import columns
from gel_images import press

from anytouch_jax.data.manifest import manifest as manifests


@pytest.fixture(autouse=True)
def _environment(monkeypatch):
    monkeypatch.setenv("OPENAI_API_KEY", KEY)
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture
def touches(tmp_path):
    """Three touches of two frames, with RGB images, without captions."""
    rng = np.random.default_rng(0)
    for i in range(6):
        cv2.imwrite(str(tmp_path / f"{i}.png"), press(10 * i))
        cv2.imwrite(str(tmp_path / f"see{i}.png"), rng.integers(0, 256, (24, 24, 3), np.uint8))
    more = {"dataset": ["tacquad"] * 6, "image_path": [f"see{i}.png" for i in range(6)]}
    more |= {"sequence": [f"s{i // 2}" for i in range(6)], "frame_index": [i % 2 for i in range(6)]}
    file = tmp_path / "touch.parquet"
    manifests.write(manifests.from_columns(columns(6, **more), file), file)
    return file


def test_captions_come_after_an_estimate_and_are_never_paid_twice(anytouch, touches, tmp_path):
    with serve() as server:
        words = [
            "data",
            "annotate",
            touches,
            "--url",
            server.url,
            "--yes",
            "--price-in",
            "2.5",
            "--price-out",
            "10",
        ]
        done = anytouch(*words, "--sheet", tmp_path / "look.html")
        assert done.status == 0, done
        assert f"gpt-4o at {server.url}: 3 questions (0 answered before), about " in done.out
        assert ": about 0.0" in done.out
        assert "300 tokens in, 60 tokens out" in done.out
        captions = tmp_path / "touch_captions.parquet"
        before = captions.read_bytes()
        # writes nothing, though all is answered
        estimate = anytouch(*words, "--estimate")
        assert estimate.status == 0 and "0 questions (3 answered before)" in estimate.out
        captions.write_bytes(b"corrected by hand")
        assert (
            anytouch(*words, "--estimate").status == 0
            and captions.read_bytes() == b"corrected by hand"
        )
        captions.write_bytes(before)
        again = anytouch(*words)
        assert again.status == 0 and len(server.heads) == 3 and again.out.count("0 questions") > 0
    assert (
        manifests.read(tmp_path / "touch_captions.parquet").column("text").to_pylist()
        == [GOOD["caption"]] * 6
    )
    assert "wool scarf" in (tmp_path / "look.html").read_text()
    assert server.heads[0][1]["Authorization"] == f"Bearer {KEY}"


def test_nothing_is_asked_without_consent(anytouch, mistake, touches, tmp_path, monkeypatch):
    with serve() as server:
        words = ["data", "annotate", touches, "--url", server.url]
        estimate = anytouch(*words, "--estimate")
        assert (
            estimate.status == 0
            and "3 questions" in estimate.out
            and "no prices given" in estimate.out
        )
        monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
        assert "--yes" in mistake(*words)  # no terminal: nobody answers
        monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
        monkeypatch.setattr("builtins.input", lambda _: "no")
        assert "not confirmed" in mistake(*words)
        # Ctrl-D
        monkeypatch.setattr("builtins.input", lambda _: (_ for _ in ()).throw(EOFError))
        assert "not confirmed" in mistake(*words)
        for wrong, named in (
            (["--price-in", "2.5"], "--price-out"),
            (["--url", "http://127.0.0.1:9/\u00e9/v1"], "http"),
            (["--sheet", str(touches)], "--sheet"),
            (["--out", "captions.txt"], "captions.txt"),
            (["--second-image", "image_2_path"], "image_2_path"),
        ):
            assert named in mistake(*words, *wrong)
        assert server.heads == [] and not (tmp_path / "touch_captions.parquet").exists()
        monkeypatch.setattr("builtins.input", lambda _: "y")
        assert anytouch(*words).status == 0 and len(server.heads) == 3


def test_an_estimate_needs_no_key(anytouch, mistake, touches, monkeypatch):
    monkeypatch.delenv("OPENAI_API_KEY")
    words = ("data", "annotate", touches, "--url", "https://api.example.org/v1")
    done = anytouch(*words, "--estimate")
    assert done.status == 0 and "3 questions" in done.out and "OPENAI_API_KEY" not in done.err
    assert "http" in mistake(*words[:3], "--url", "example", "--estimate")
    assert "OPENAI_API_KEY" in mistake(*words, "--yes")
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr(
        "builtins.input", lambda _: pytest.fail("asked before the key was looked for")
    )
    assert "OPENAI_API_KEY" in mistake(*words)


def test_failures_are_reported_counted_and_the_rest_is_kept(anytouch, touches, tmp_path):
    with serve() as server:
        words = ("data", "annotate", touches, "--url", server.url)
        assert anytouch(*words, "--yes", "--limit", "1").status == 0 and len(server.heads) == 1
        assert anytouch(*words, "--estimate", "--family", "tacquad", "object").status == 0
        (tmp_path / "see1.png").write_bytes(b"no picture")
        done = anytouch(*words, "--yes", "--out", tmp_path / "c.csv")
    assert (
        done.status == 1
        and "2 captions" in done.out
        and f"no caption for row 0 of {touches}" in done.err
    )
    assert (
        manifests.read(tmp_path / "c.csv").column("text").to_pylist()
        == [None] * 2 + [GOOD["caption"]] * 4
    )


def test_captions_of_a_table_are_attached_and_nobody_is_asked(anytouch, mistake, tmp_path):
    cv2.imwrite(str(tmp_path / "0.png"), np.zeros((32, 32, 3), np.uint8))
    path = tmp_path / "m.csv"
    manifests.write(manifests.from_columns(columns(caption_id=["octopi_3"]), path), path)
    (tmp_path / "captions.csv").write_text("caption_id,text\noctopi_3,rough and hard\n")
    done = anytouch(
        "data", "annotate", path, "--captions", tmp_path / "captions.csv", "--key", "caption_id"
    )
    assert done.status == 0, done.err
    assert manifests.read(tmp_path / "m_captions.csv").column("text").to_pylist() == [
        "rough and hard"
    ]
    assert "1 of 1 rows have a caption" in done.out
    for words, named in (
        (
            ["--captions", tmp_path / "captions.csv", "--limit", 1, "--split", "train"],
            ["--split", "--limit"],
        ),
        (
            ["--captions", tmp_path / "captions.csv", "--price-in", 1, "--yes"],
            ["--yes", "--price-in"],
        ),
        (["--key", "caption_id", "--yes"], ["--key"]),
    ):
        sentence = mistake("data", "annotate", path, *words)
        assert all(name in sentence for name in named)
