"""Several pages that record into one folder."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.live.page.recorder import LiveRecorder
from anytouch_jax.live.page.teach import Teacher

# image, contact score and features
FRAME = (np.zeros((8, 8, 3), np.uint8), 1.0, np.zeros(4, np.float32))


def record(recorder: LiveRecorder, name: str) -> None:
    recorder.start(name, None)
    recorder.add(*FRAME)
    recorder.stop()


def names_of(folder) -> list[str]:
    return manifests.read(folder / "manifest.parquet").text_column("object").tolist()


def test_a_page_leaves_out_no_recording_of_another(tiny_run, tmp_path, monkeypatch):
    monkeypatch.setattr("anytouch_jax.live.page.teach._LOOK", 0.0)
    encoder = load_encoder(tiny_run)
    recorders = [LiveRecorder(tmp_path, "digit") for _ in range(2)]
    record(recorders[0], "cup by A")
    record(recorders[0], "slip of A")
    mine, other = (Teacher(encoder, one, log=lambda _: None) for one in recorders)
    before = mine.version
    record(recorders[1], "ball by B")
    other.reload()
    # live touch notices it, and the page reads it then
    mine.look()
    assert mine.version > before
    noticed = mine.version
    mine.look()
    assert mine.version == noticed
    record(recorders[1], "key by B")
    mine.leave_out(next(tmp_path.glob("*_slip_of_a")).name)
    assert names_of(tmp_path) == ["cup by A", "slip of A", "ball by B", "key by B"]
    for page in (mine, other):
        assert set(page.about()["names"]) == {"cup by A", "ball by B", "key by B"}
    other.leave_out(next(tmp_path.glob("*_key_by_b")).name)
    assert set(mine.about()["names"]) == {"cup by A", "ball by B"}
    with pytest.raises(UserError, match="no such recording"):
        mine.leave_out("no")


def test_recordings_that_end_at_once_are_all_kept(tmp_path):
    """Their folders have one name in one second, and their rows go into one file."""
    recorders = [LiveRecorder(tmp_path, "digit") for _ in range(4)]
    faults = []

    def several(recorder: LiveRecorder) -> None:
        for _ in range(5):
            try:
                record(recorder, "cup")
            except UserError as error:
                faults.append(error)
            if not recorder.state()["done"].startswith("1 frames"):
                faults.append(recorder.state()["done"])

    threads = [threading.Thread(target=several, args=(one,)) for one in recorders]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert faults == []
    table = manifests.read(tmp_path / "manifest.parquet")
    assert len(table) == 20 and len(set(table.text_column("sequence"))) == 20
    assert all(table.file(row).is_file() for row in range(20))
