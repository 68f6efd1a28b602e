import numpy as np
import pytest

from experiments.real import scores
from experiments.real.recordings import Recordings

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
