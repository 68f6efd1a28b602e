import csv

import cv2
import numpy as np
import pytest

from experiments.real import balls, recordings, scores
from experiments.real.recordings import Recordings

MM, BALL = 0.06, 3.0
PRESS = balls.Press("one", np.zeros((120, 160, 3), np.uint8), BALL, 85.3, 62.6, 30.0)


def cap() -> np.ndarray:
    """The depth (h, w) in mm of a ball, 0 outside of its contact."""
    return np.nan_to_num(balls.true_depth(PRESS, MM))


def test_a_perfect_depth_has_no_error_and_a_wrong_one_has_its_own():
    exact = balls.error_of(cap() + 0.2, PRESS, MM)  # where the gel rests is not known
    assert exact.radius == pytest.approx(0, abs=0.01) and exact.centre == pytest.approx(0, abs=0.02)
    assert exact.profile < 0.02 and exact.true_centre == pytest.approx(3 - np.sqrt(9 - 1.8**2), abs=2e-3)
    steep = balls.error_of(1.3 * cap(), PRESS, MM)
    assert steep.centre == pytest.approx(0.3 * exact.true_centre, rel=0.25) and steep.radius < -0.1


@pytest.mark.parametrize("radii", [(20, 48), None])
def test_the_circle_of_a_press_is_found(radii):
    x, y, r = balls.distance(PRESS)
    colours = np.stack([x, y, -x], -1) / PRESS.radius * 40 if radii else np.full((120, 160, 3), 40.0)
    change = colours * (r < PRESS.radius)[..., None] + np.random.default_rng(0).normal(0, 1, (120, 160, 3))
    found = balls.find_circle(np.asarray(change, np.float32), radii)
    assert np.abs(np.array(found) - (PRESS.x, PRESS.y, PRESS.radius)).max() < (2 if radii else 4)


RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def data() -> Recordings:
    """Sixty recordings of six objects by two fingers, two frames a finger; slip goes with the object's number."""
    rows = [(r, f, t) for r in range(60) for f in (0, 2) for t in range(2)]
    recording = np.array([r for r, _, _ in rows])
    objects = recording % 6
    split = np.array(["train", "train", "val", "test"])[recording // 6 % 4]
    frames = RNG.integers(0, 256, (len(rows), 48, 64, 3), np.uint8)
    return Recordings(
        frames, frames[:2], np.zeros(len(rows), int), np.array([f"r{r:02d}" for r in recording]),
        np.array([f"cam{f}" for _, f, _ in rows]), split, objects % 5, np.array([f"o{o}" for o in objects]),
        (objects > 2).astype(int), "hash",
    )  # fmt: skip


def planted(data: Recordings, noise: float) -> np.ndarray:
    y = np.searchsorted(data.names, data.object)
    return (np.eye(6)[y] + noise * RNG.standard_normal((len(y), 6))).astype(np.float32)


@pytest.mark.parametrize("head", scores.HEADS)
def test_features_that_name_the_object_are_right_and_noise_is_not(data, head):
    clear, noise = (scores.object_score(x, data, scores.HEADS[head]) for x in (planted(data, 0.1), planted(data, 50.0)))
    assert clear.share == 1.0 and noise.share < 0.6
    assert len(clear.groups) == len(np.unique(data.recording[data.split == "test"]))
    mean, low, _ = clear.minus(noise)
    assert mean > 0.4 and low > 0.1
    assert clear.minus(clear) == (0.0, 0.0, 0.0)


def test_the_other_finger_is_scored_on_the_camera_that_the_head_never_saw(data):
    """A feature that shows the object on one camera, and another object on the other, is always wrong there."""
    x = planted(data, 0.01)
    x[data.finger == "cam2"] = np.roll(x[data.finger == "cam2"], 1, axis=1)
    assert scores.object_score(x, data).share > 0.4
    assert scores.other_finger_score(x, data).share == 0.0


def test_slip_is_scored_on_objects_that_the_head_never_saw(data):
    """A feature that is the object's number says nothing of an unseen object."""
    assert scores.slip_score(planted(data, 0.01), data).share < 0.7
    slipping = data.slip[:, None] + 0.01 * RNG.standard_normal((len(data.slip), 3))
    assert scores.slip_score(slipping.astype(np.float32), data).share == 1.0


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
