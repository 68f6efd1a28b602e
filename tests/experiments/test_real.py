import cv2
import numpy as np
import pytest
from checked_world import columns

from anytouch_jax.data.manifest import manifest as manifests
from experiments.real import balls, recordings, scores
from experiments.real.recordings import Recordings

MM = 0.06
BALL = 3.0
PRESS = balls.Press("one", np.zeros((120, 160, 3), np.uint8), BALL, 85.3, 62.6, 30.0)


def cap() -> np.ndarray:
    """The depth (h, w) in mm of a ball, 0 outside of its contact."""
    return np.nan_to_num(balls.true_depth(PRESS, MM))


def test_a_perfect_depth_has_no_error_and_a_wrong_one_has_its_own():
    # where the gel rests is not known
    exact = balls.error_of(cap() + 0.2, PRESS, MM)
    assert exact.radius == pytest.approx(0, abs=0.01) and exact.centre == pytest.approx(0, abs=0.02)
    assert exact.profile < 0.02 and exact.true_centre == pytest.approx(
        3 - np.sqrt(9 - 1.8**2), abs=2e-3
    )
    steep = balls.error_of(1.3 * cap(), PRESS, MM)
    assert steep.centre == pytest.approx(0.3 * exact.true_centre, rel=0.25) and steep.radius < -0.1


@pytest.mark.parametrize("radii", [(20, 48), None])
def test_the_circle_of_a_press_is_found(radii):
    x, y, r = balls.distance(PRESS)
    colours = (
        np.stack([x, y, -x], -1) / PRESS.radius * 40 if radii else np.full((120, 160, 3), 40.0)
    )
    change = colours * (r < PRESS.radius)[..., None] + np.random.default_rng(0).normal(
        0, 1, (120, 160, 3)
    )
    found = balls.find_circle(np.asarray(change, np.float32), radii)
    assert np.abs(np.array(found) - (PRESS.x, PRESS.y, PRESS.radius)).max() < (2 if radii else 4)


RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def data() -> Recordings:
    """Sixty recordings of six objects by two fingers, two frames a finger; slip goes with the
    object's number.
    """
    rows = [(r, f, t) for r in range(60) for f in (0, 2) for t in range(2)]
    recording = np.array([r for r, _, _ in rows])
    objects = recording % 6
    split = np.array(["train", "train", "val", "test"])[recording // 6 % 4]
    finger = np.array([f"cam{f}" for _, f, _ in rows])
    names = np.array([f"o{o}" for o in objects])
    takes = np.array([f"r{r:02d}" for r in recording])
    return Recordings(None, takes, finger, split, objects % 5, names, (objects > 2).astype(int))


def planted(data: Recordings, noise: float) -> np.ndarray:
    y = np.searchsorted(data.names, data.object)
    return (np.eye(6)[y] + noise * RNG.standard_normal((len(y), 6))).astype(np.float32)


@pytest.mark.parametrize("head", scores.HEADS)
def test_features_that_name_the_object_are_right_and_noise_is_not(data, head):
    clear, noise = (
        scores.object_score(x, data, scores.HEADS[head])
        for x in (planted(data, 0.1), planted(data, 50.0))
    )
    assert clear.fraction == 1.0 and noise.fraction < 0.6
    assert len(clear.groups) == len(np.unique(data.recording[data.split == "test"]))
    mean, low, _ = clear.minus(noise)
    assert mean > 0.4 and low > 0.1
    assert clear.minus(clear) == (0.0, 0.0, 0.0)


def test_the_other_finger_is_scored_on_the_camera_that_the_head_never_saw(data):
    """A feature that shows the object on one camera, and another object on the other, is always
    wrong there.
    """
    x = planted(data, 0.01)
    x[data.finger == "cam2"] = np.roll(x[data.finger == "cam2"], 1, axis=1)
    assert scores.object_score(x, data).fraction > 0.4
    assert scores.other_finger_score(x, data).fraction == 0.0


def test_slip_is_scored_on_objects_that_the_head_never_saw(data):
    """A feature that is the object's number says nothing of an unseen object."""
    assert scores.slip_score(planted(data, 0.01), data).fraction < 0.7
    slipping = data.slip[:, None] + 0.01 * RNG.standard_normal((len(data.slip), 3))
    assert scores.slip_score(slipping.astype(np.float32), data).fraction == 1.0


def test_the_untouched_gel_is_the_units_image_a_median_or_the_first_frame(tmp_path):
    rng = np.random.default_rng(0)
    names = ("gel", *(f"{take}{number}" for take in "ab" for number in range(3)))
    images = {name: rng.integers(0, 256, (48, 64, 3), np.uint8) for name in names}
    for name, image in images.items():
        cv2.imwrite(str(tmp_path / f"{name}.png"), image[..., ::-1])
    order = ("b1", "a0", "b2", "b0", "a1", "a2")
    given = columns(
        6, path=[f"{name}.png" for name in order], frame_index=[int(name[1]) for name in order]
    )
    given |= {name: [one[0] for one in order] for name in ("sequence", "recording")}
    given |= {
        "background_path": [{"a": "gel.png"}.get(one[0]) for one in order],
        "dataset": [recordings.SET] * 6,
    }
    given |= {
        "unit": ["cam0_a"] * 6,
        "object_fold": [0] * 6,
        "label.object": ["o"] * 6,
        "label.slip": [0] * 6,
    }
    path = tmp_path / "m.parquet"
    manifests.write(manifests.from_columns(given, path), path)
    middle = np.partition(np.stack([images[name] for name in order]), 2, axis=0)[2]
    for word, wanted in (
        ("rule", (images["gel"], middle)),
        ("median", (middle, middle)),
        ("first frame", (images["a0"], images["b0"])),
    ):
        data = recordings.read(path, word)
        for name, take, (frame, gel) in zip(order, data.recording, data.pairs(), strict=True):
            np.testing.assert_array_equal(frame, images[name])
            np.testing.assert_array_equal(gel, wanted["ab".index(take)])
