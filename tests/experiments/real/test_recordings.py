import csv

import cv2
import numpy as np
import pytest

from experiments.real import recordings


@pytest.fixture(scope="module")
def pack(tmp_path_factory):
    """Two recordings of one finger: eight free frames, then a dent. The rows of the table are shuffled."""
    root, rng = tmp_path_factory.mktemp("pack"), np.random.default_rng(0)
    gel = rng.integers(80, 160, (96, 128, 3)).astype(np.uint8)
    gel = cv2.GaussianBlur(gel, (0, 0), 8)
    rows = []
    for take in ("a", "b"):
        for number in range(12):
            frame = gel.astype(int) + rng.integers(-1, 2, gel.shape)
            if number >= 8:
                cv2.circle(dent := np.zeros(gel.shape, np.uint8), (64, 48), 14, (60, 20, 40), -1)
                frame = frame + dent
            name = f"{take}{number}.png"
            cv2.imwrite(str(root / name), np.clip(frame, 0, 255).astype(np.uint8))
            rows.append((name, take, number))
    cv2.imwrite(str(root / "gel.png"), gel)
    fixed = {"sensor": "gelsight_mini", "unit": "cam0_a", "dataset": recordings.SET, "split": "train", "stride": 1,
             "object_fold": 0, "label.object": "o", "label.slip": 0}  # fmt: skip
    own = {"a": "gel.png", "b": ""}
    with (root / "manifest.csv").open("w", newline="") as file:
        names = ["path", "sequence", "recording", "frame_index", "background_path", *fixed]
        table = csv.DictWriter(file, names)
        table.writeheader()
        for place in rng.permutation(len(rows)):
            name, take, number = rows[place]
            line = {"path": name, "sequence": take, "recording": take, "frame_index": number} | fixed
            table.writerow(line | {"background_path": own[take]})
    return root


def subtracted(data, take):
    return [data.backgrounds[place] for place in data.background[data.recording == take]]


def test_a_recording_without_a_picture_gets_its_first_frame(pack):
    data = recordings.read(pack / "manifest.csv")
    gel, first = (cv2.imread(str(pack / name))[..., ::-1] for name in ("gel.png", "b0.png"))
    assert len(data.frames) == 24 and all((each == gel).all() for each in subtracted(data, "a"))
    assert all((each == first).all() for each in subtracted(data, "b"))
    data = recordings.read(pack / "manifest.csv", "first")
    first = cv2.imread(str(pack / "a0.png"))[..., ::-1]
    assert all((each == first).all() for each in subtracted(data, "a"))
