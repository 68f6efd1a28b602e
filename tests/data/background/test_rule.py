import pickle
import threading
import time
from functools import partial

import cv2
import numpy as np
import pytest
from press_videos import LOOKS, SENSORS, gel_frame, press_video
from refused import refused

from anytouch_jax.data.background import rule as backgrounds
from anytouch_jax.data.background.contact import THRESHOLDS
from anytouch_jax.data.background.estimate import UntouchedBackground
from anytouch_jax.data.manifest import manifest as manifests


def presses(count, look="coloured", tint=0, seed=0):
    """Frames of single touches at changing places, all pressed."""
    frames = [
        gel_frame(look, 1, shift=float(shift), seed=seed + number)
        for number, shift in enumerate(np.linspace(-70, 70, count))
    ]
    return [np.clip(frame.astype(int) + tint, 0, 255).astype(np.uint8) for frame in frames]


def distance(image, look="coloured", tint=0):
    return float(np.abs(image.astype(int) - gel_frame(look, 0).astype(int) - tint).mean())


@pytest.mark.parametrize("look", ["coloured", "darkening"])
def test_the_median_of_pressed_frames_is_the_untouched_gel(look):
    frames = presses(30, look)
    free = UntouchedBackground(gel_frame(look, 0))
    assert (
        free.score(backgrounds.estimate_background(frames))
        < 3
        < 6
        < min(map(free.score, frames[5:25]))
    )
    assert np.array_equal(
        backgrounds.estimate_background(iter(frames)),
        backgrounds.estimate_background(np.stack(frames)),
    )
    refused("too few", backgrounds.estimate_background, frames[:2])
    refused("2 sizes", backgrounds.estimate_background, [*frames, frames[0][:50]])


@pytest.fixture
def world(tmp_path):
    """world([(frames, cells)]): frames with equal cells; "gel.png" is a stored image, grey."""

    def build(*groups):
        cv2.imwrite(str(tmp_path / "gel.png"), np.full((120, 160, 3), 90, np.uint8))
        rows = []
        for frames, cells in groups:
            for frame in frames:
                path = f"{len(rows)}.png"
                cv2.imwrite(str(tmp_path / path), frame[..., ::-1])
                usual = {"sensor": "digit", "unit": None, "split": "train", "background_path": None}
                rows.append({"path": path, "sequence": path, "frame_index": 0} | usual | cells)
        return manifests.from_columns(
            {name: [row[name] for row in rows] for name in rows[0]}, tmp_path / "m.parquet"
        )

    return build


def test_a_stored_image_comes_first_and_the_median_of_training_frames_of_the_unit_next(world):
    table = world(
        (presses(12), {"unit": "a"}),
        (presses(12, tint=40), {"unit": "a", "split": "test"}),
        (presses(6, tint=20), {"unit": "b"}),
        (presses(2), {"unit": "b", "background_path": "gel.png"}),
        ([gel_frame("coloured", 0)], {"unit": "c", "split": "background"}),
        (presses(2), {"unit": "c"}),
        (presses(2, tint=60), {"unit": "d"}),
        (presses(3), {"sensor": "taxim", "unit": "e"}),
        (presses(2), {"unit": "f"}),
        (presses(8, tint=20), {"unit": "f", "split": "test"}),
    )
    rule = backgrounds.Backgrounds(table)
    rows = table.text_column("unit")
    first = {unit: int(np.flatnonzero(rows == unit)[0]) for unit in set(rows)}
    assert distance(rule.read(first["a"])) < 3 and rule.read(first["a"] + 20) is rule.read(
        first["a"]
    )
    # its other rows have a stored image
    assert distance(rule.read(first["b"]), tint=20) < 4
    stored = int(np.flatnonzero(table.present("background_path"))[0])
    assert rule(stored) is None and (rule.read(stored) == 90).all()
    # the image of split background, not the median
    assert distance(rule.read(first["c"] + 1)) < 2
    # too few frames: the median of the sensor, not of its own tint
    assert distance(rule.read(first["d"])) < 25
    # two training frames are too few: all of the unit count
    assert distance(rule.read(first["f"]), tint=16) < 8
    everything = np.arange(len(table))
    assert rows[~rule.has(everything)].tolist() == ["e"] * 3
    report = rule.report(everything)
    assert "a stored image for 2 rows" in report and "none for 3 rows" in report
    assert set(rule.images(everything)) == {"digit a", "digit b", "digit c", "digit d", "digit f"}
    assert rule.digest() == backgrounds.Backgrounds(table).digest()


def test_a_unit_of_few_sequences_does_not_subtract_its_own_press(world):
    """Such as a column `unit` that names the object.

    A unit of another look has only its own frames.
    """

    def press(number, tint=0):
        frames = [
            gel_frame("coloured", 1, shift=40.0 * number - 60, seed=10 * number + seed)
            for seed in range(8)
        ]
        frames = [np.clip(frame.astype(int) + tint, 0, 255).astype(np.uint8) for frame in frames]
        return frames, {"unit": f"object {number}", "sequence": f"video {number}"}

    rule = backgrounds.Backgrounds(world(*map(press, range(4)), press(9, tint=60)))
    assert (
        all(distance(rule.read(8 * number)) < 2 for number in range(4))
        and distance(rule.read(32), tint=60) < 12
    )
    assert rule.report(np.arange(40)) == (
        "untouched gel: the median of its sensor of 40 frames for 32 rows; the median of 8 frames "
        "for 8 rows"
    )


def test_the_same_unit_gets_the_image_of_a_head_and_another_one_warning(world):
    known = {"digit a": gel_frame("coloured", 0, seed=9)}
    table = world(
        (presses(8, seed=20), {"unit": "a"}),
        (presses(8, tint=40), {"unit": "b"}),
        (presses(8, tint=60), {"unit": "c"}),
    )
    said: list[str] = []
    rule = backgrounds.Backgrounds(table, known, said.append)
    rows = table.text_column("unit")
    assert all(rule(int(row)) is known["digit a"] for row in np.flatnonzero(rows == "a"))
    assert distance(rule.read(8), tint=40) < 4 and distance(rule.read(16), tint=60) < 4
    assert len(said) == 1 and "in tint" in said[0]
    assert backgrounds.same_unit(known, np.zeros((160, 120, 3), np.uint8)) == (None, "in size")
    assert backgrounds.same_unit({}, known["digit a"]) == (None, "")
    # a press covers the smaller part of an image
    for frame in presses(5):
        assert backgrounds.same_unit(known, frame)[1] == ""


def other_pattern(gel: np.ndarray) -> np.ndarray:
    """A gel of the same tint with a stain that covers a twentieth of it."""
    stained = gel.copy()
    stained[20:50, 30:60] = np.minimum(stained[20:50, 30:60].astype(int) + 45, 255)
    return stained


def test_the_untouched_gel_of_another_unit_of_one_tint_is_not_taken_for_a_press(world):
    """Two GelSight Minis of two labs differ by a contact score of 8, and hardly in tint."""
    known = {"digit a": gel_frame("coloured", 0)}
    own = other_pattern(known["digit a"])
    assert UntouchedBackground(known["digit a"]).score(own) > 6.5
    assert backgrounds.same_unit(known, own)[1] == ""  # it may be a press
    assert "by a contact score of" in backgrounds.same_unit(known, own, untouched=True)[1]
    assert backgrounds.same_unit(known, gel_frame("coloured", 0, seed=3), untouched=True)[1] == ""
    table = world(
        ([own], {"unit": "b", "split": "background"}),
        ([other_pattern(frame) for frame in presses(6)], {"unit": "b"}),
        (presses(6), {"unit": "a"}),
    )
    said: list[str] = []
    rule = backgrounds.Backgrounds(table, known, said.append)
    assert (rule(1) == own).all()
    assert len(said) == 1 and "from every unit that the head or index was fitted with" in said[0]
    # the median of another one may hold a press, so its tint alone counts
    assert rule(7) is known["digit a"] and len(said) == 1


def test_few_frames_get_the_nearest_image_and_one_true_line(world):
    """A deep press alone changes the tint as much as another unit does."""
    gel = gel_frame("coloured", 0)
    known = {"digit a": gel, "digit b": np.full_like(gel, 30)}
    pressed = np.clip(gel.astype(int) + 9, 0, 255).astype(np.uint8)
    same = backgrounds.recognise(known, gel, is_background=False, of="the index was made with")
    assert same == (gel, "the image that the index was made with", "")
    found = backgrounds.recognise(known, pressed, is_background=False, of="the index was made with")
    assert found.image is gel and not found.warning
    assert found.what.startswith("the nearest image that the index was made with. So few frames")
    sure = backgrounds.recognise(known, pressed, is_background=True)
    assert sure.image is None and "in tint, by 9 grey levels" in sure.warning
    small = np.zeros((160, 120, 3), np.uint8)
    assert backgrounds.recognise(known, small, is_background=False) == (None, "", "")
    # rows that had no untouched gel, and so were left out
    said: list[str] = []
    rule = backgrounds.Backgrounds(
        world(([pressed] * 2, {"unit": "a"})), {"digit a": gel}, said.append
    )
    assert rule(0) is gel and said == []
    assert "the nearest image that the head was fitted with" in rule.report(np.arange(2))


@pytest.mark.parametrize(("look", "fraction"), list(zip(LOOKS, (0.0, 0.4, 0.6), strict=True)))
def test_a_live_source_that_begins_with_a_press_settles_on_the_free_gel(look, fraction):
    frames, contact = press_video(look, fraction, frames=60)
    begin = int(np.argmax(contact))  # the first frame is pressed, if any is
    running = backgrounds.RunningBackground()
    seen = []
    for frame in [*frames[begin:], *frames[:begin]] * 9:
        # while a thread is at work
        running = pickle.loads(pickle.dumps(running)) if len(seen) == 13 else running
        running.add(frame)
        seen.append((running.settled, running.image))
    assert not seen[0][0] and running.settled and len({id(image) for _, image in seen}) > 6
    gel = UntouchedBackground(gel_frame(look, 0))
    assert gel.score(running.image) < THRESHOLDS[SENSORS[look]] / 2


def test_no_frame_waits_for_an_estimate_and_equal_frames_have_equal_images(monkeypatch):
    estimate = backgrounds.estimate
    images = list[list[np.ndarray]]()
    begun = time.perf_counter()
    for _ in range(2):
        running = backgrounds.RunningBackground()
        seen = []
        is_due = threading.Semaphore(0)
        held = partial(
            lambda is_due, frames: is_due.acquire(timeout=60) and estimate(frames), is_due
        )
        monkeypatch.setattr(backgrounds, "estimate", held)
        for number, frame in enumerate(presses(24), 1):
            if number in (2, 4, 8, 16):  # twice as many frames as when the estimate was begun
                is_due.release()
            running.add(frame)
            seen.append(running.image)
        is_due.release()
        images.append(seen)
    assert time.perf_counter() - begun < 60 and len({id(one) for one in seen}) == 5
    assert all(map(np.array_equal, *images))


def test_images_by_unit_are_read_from_the_arrays_that_were_written():
    known = {"a/b": gel_frame("coloured", 0), "ü": gel_frame("darkening", 0)[:50]}
    read = backgrounds.backgrounds_of_arrays(backgrounds.background_arrays(known))
    assert list(read) == list(known) and all(
        np.array_equal(read[name], known[name]) for name in known
    )
    assert backgrounds.backgrounds_of_arrays({}) == {} == backgrounds.background_arrays({})
    with pytest.raises((KeyError, ValueError)):
        backgrounds.backgrounds_of_arrays({"gels": np.array(["a"])})
    with pytest.raises((KeyError, ValueError)):
        backgrounds.backgrounds_of_arrays({"gels": np.array(["a"]), "gel/0": np.zeros((4, 4))})


@pytest.mark.parametrize(
    ("rotate", "flip"), [(0, "none"), (90, "across"), (270, "down"), (180, "none")]
)
def test_a_image_as_the_camera_takes_it_is_turned_upright_again(rotate, flip):
    from anytouch_jax.data.transforms import orient_frame

    image = gel_frame("dotted", 1, shift=20)[:100]
    np.testing.assert_array_equal(
        orient_frame(backgrounds.as_taken(image, rotate, flip), rotate, flip), image
    )
