import os

import cv2
import numpy as np
import pytest
from reader_world import fill
from videos import write_video

from anytouch_jax.data.images import decode
from anytouch_jax.datasets.readers.common import EXPORT_RECORD


def video(path, grey, count=5):
    write_video(path, (np.full((32, 32, 3), grey, np.uint8) for _ in range(count)))


def greys(table, root):
    """The greys of the images of every sequence, rounded."""
    found = {}
    for row in table.rows.values():
        found.setdefault(row["sequence"], []).append(
            round(int(decode(root / row["path"])[0, 0, 0]), -1)
        )
    return found


@pytest.mark.parametrize("count", [5, 3, 8])  # of the new take: as long, shorter, longer
def test_a_video_recorded_again_replaces_its_images_and_keeps_what_else_lies_there(
    tmp_path, read, count
):
    root = tmp_path / "mine"
    video(root / "mug/pour.avi", 60)
    assert greys(read("recordings", root, sensor="digit", export=True), root) == {
        "mug/pour": [60] * 5
    }
    (root / "mug/pour/caption.txt").write_text("mine")
    before = os.stat(root / "mug/pour/000000.png").st_ino
    read("recordings", root, sensor="digit", export=True)
    # not written again
    assert os.stat(root / "mug/pour/000000.png").st_ino == before
    # a copy of the data has other times
    os.utime(root / "mug/pour.avi", (1e9, 1e9))
    read("recordings", root, sensor="digit", export=True)
    assert os.stat(root / "mug/pour/000000.png").st_ino == before
    video(root / "mug/pour.avi", 200, count)
    reasons = read("recordings", root, sensor="digit").reasons
    assert any("changed after its images in mug/pour" in one for one in reasons)
    table = read("recordings", root, sensor="digit", export=True)
    assert greys(table, root) == {"mug/pour": [200] * count} and set(table["text"]) == {"mine"}
    assert not [one for one in (root / "mug").iterdir() if one.name.startswith(".")]


def test_two_sources_never_fraction_a_folder_and_folders_of_the_user_stay(tmp_path, read):
    root = tmp_path / "mine"
    fill(root, [f"cup/left/{n:06d}.png" for n in range(3)])
    own = {path: path.read_bytes() for path in root.rglob("*.png")}
    for name, grey in (
        ("left.mp4", 60),
        ("left.avi", 120),
        ("left.1.avi", 180),
        ("left.1.mp4", 240),
    ):
        video(root / "cup" / name, grey)
    video(root / "left.avi", 90)
    seen = greys(read("recordings", root, sensor="digit", export=True), root)
    assert sorted(tuple(one) for one in seen.values() if len(one) == 5) == [
        (g,) * 5 for g in (60, 90, 120, 180, 240)
    ]
    assert {path: path.read_bytes() for path in own} == own and len(seen["cup/left"]) == 3
    assert greys(read("recordings", root, sensor="digit", export=True), root) == seen


def test_images_of_an_older_version_are_adopted_and_a_failure_leaves_nothing(
    tmp_path, read, monkeypatch
):
    root = tmp_path / "mine"
    video(root / "cup/one.avi", 60)
    read("recordings", root, sensor="digit", export=True)
    (root / "cup/one" / EXPORT_RECORD).unlink()
    assert set(greys(read("recordings", root, sensor="digit", export=True), root)) == {"cup/one"}
    video(root / "cup/one.avi", 90)
    encode = cv2.imencode
    count = []
    monkeypatch.setattr(
        cv2, "imencode", lambda *of: (count.append(of), encode(*of))[1] if len(count) < 3 else 1 / 0
    )
    with pytest.raises(ZeroDivisionError):
        read("recordings", root, sensor="digit", export=True)
    monkeypatch.undo()
    assert sorted(path.name for path in (root / "cup").iterdir()) == ["one", "one.avi"]
    assert greys(read("recordings", root, sensor="digit"), root) == {"cup/one": [60] * 5}
