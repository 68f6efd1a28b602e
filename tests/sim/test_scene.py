"""Drawn scenes: seeds, splits, grades and motions. Nothing is simulated here."""

import math
from dataclasses import replace

import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.sim import scene
from anytouch_jax.sim.scene import Gesture, Scenes

SCENES = Scenes(touches=60, objects=60, seed=3)
THINGS, SPLITS = scene.objects_and_splits(SCENES)


def recordings(scenes, number=0):
    touch = scene.draw_touch(scenes, number, SPLITS)
    return {sensor: scene.draw_recording(scenes, touch, sensor) for sensor in scenes.sensors}


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"sensors": ("digit", "nose")}, "no simulated sensor 'nose'"),
        ({"sensors": ()}, "at least one"),
        ({"sensors": ("digit", "digit")}, "once"),
        ({"depth": (-0.1, 0.5)}, "depth is a range of mm from 0 on, lowest first, not -0.1 to 0.5"),
        ({"depth": (0.5, 0.1)}, "lowest first"),
        ({"fields": ("heat",)}, "no simulated field 'heat'"),
        ({"touches": 0}, "touches must be 1 or more"),
        ({"vision": 1.5}, "vision must be"),
        ({"grade": "rough"}, "grade must be"),
        ({"units": "two"}, "units must be"),
        ({"seed": -1}, "seed must be 0 or more, not -1"),
        ({"depth": (0.5, 3.0)}, "depth 3 mm may go through the gel of"),
        ({"fields": ("shear", "shear")}, "each field once"),
        ({"held_out": -0.3}, "held_out must be"),
        ({"first": -1}, "first must be 0 or more, not -1"),
    ],
)
def test_what_cannot_be_simulated_is_refused(change, sentence):
    with pytest.raises(UserError, match=sentence):
        replace(SCENES, **change)


def test_splits_share_no_pair_of_primitive_and_texture():
    kinds = {split: {t.kind for t, s in zip(THINGS, SPLITS, strict=True) if s == split} for split in set(SPLITS)}
    assert set(kinds) == {"train", "val", "test"}
    assert not kinds["train"] & kinds["test"] and not kinds["train"] & kinds["val"] and not kinds["val"] & kinds["test"]
    assert 0.25 <= SPLITS.count("test") / len(SPLITS) < 0.4
    for part in range(2):  # every primitive and every texture of the test objects is seen in training, apart
        assert {kind[part] for kind in kinds["test"]} <= {kind[part] for kind in kinds["train"]}


@pytest.mark.parametrize("objects", range(12, 19))
def test_few_objects_have_a_test_set_or_say_why_not(objects):
    try:
        splits = scene.objects_and_splits(replace(SCENES, objects=objects))[1]
    except UserError as error:
        assert f"--objects {objects} and --held-out 0.25: of {objects} objects only" in str(error)
    else:
        assert "test" in splits and splits.count("train") > splits.count("test")


def test_objects_take_turns_and_a_seed_decides():
    touches = [scene.draw_touch(SCENES, number, SPLITS) for number in range(120)]
    counts = np.bincount([touch.object for touch in touches], minlength=60)
    assert (counts == 2).all()
    again = scene.draw_touch(SCENES, 7, SPLITS)
    assert again.object == touches[7].object and np.array_equal(again.place, touches[7].place)
    other = scene.draw_touch(replace(SCENES, seed=4), 7, SPLITS)
    assert not np.array_equal(other.place, again.place)


def test_places_lie_evenly_within_three_millimetres():
    """Of a disc of radius r a share of (r / 3)^2 lies within r: they do not crowd in its middle."""
    within = np.array([np.sum(scene.draw_touch(SCENES, number, SPLITS).place ** 2) / 9 for number in range(600)])
    assert within.max() <= 1
    for share in (0.1, 0.25, 0.5, 0.75):
        assert abs((within < share).mean() - share) < 0.06


def test_one_device_of_each_sensor_mounted_straight():
    one = replace(SCENES, units="one")
    several = [recordings(one, number) for number in range(4)]
    plain = [recordings(SCENES, number) for number in range(4)]
    for sensor in SCENES.sensors:
        first = several[0][sensor].unit
        for later in several[1:]:
            assert all(np.array_equal(a, b) for a, b in zip(first, later[sensor].unit, strict=True))
        assert (first.mirror == 1).all() and first.rotation == 0 and not first.offset.any()
        assert not np.array_equal(first.tint, plain[0][sensor].unit.tint)
        # nothing else of a recording knows of it
        for a, b in zip(several, plain, strict=True):
            for name in ("start", "motion", "depth", "tilt", "has_photo", "has_text", "seed"):
                np.testing.assert_array_equal(getattr(a[sensor], name), getattr(b[sensor], name))
    assert not np.array_equal(several[0]["digit"].unit.tint, several[0]["duragel"].unit.tint)


def test_another_sensor_in_the_list_changes_nothing():
    few = recordings(replace(SCENES, sensors=("digit",)))["digit"]
    many = recordings(replace(SCENES, sensors=("gelslim", "tac3d", "digit")))["digit"]
    for one, two in zip(few.unit, many.unit, strict=True):
        np.testing.assert_array_equal(one, two)
    assert (few.has_photo, few.has_text, few.seed) == (many.has_photo, many.has_text, many.seed)


def test_fine_recordings_move_alike_and_coarse_ones_share_only_the_place():
    fine = list(recordings(SCENES, 5).values())
    assert all(np.array_equal(fine[0].motion, r.motion) and np.array_equal(fine[0].depth, r.depth) for r in fine)
    assert all(np.array_equal(fine[0].start, r.start) and not r.tilt.any() for r in fine)
    assert len({float(r.unit.rotation) for r in fine}) == len(fine)  # but no two units are alike
    coarse = list(recordings(replace(SCENES, grade="coarse"), 5).values())
    assert len({r.depth.max() for r in coarse}) == len({tuple(r.start) for r in coarse}) == len(coarse)
    assert all(r.tilt.any() for r in coarse)
    assert all(np.array_equal(r.touch.place, coarse[0].touch.place) for r in coarse)
    offsets = np.asarray(
        [r.start[:2] for n in range(60) for r in recordings(replace(SCENES, grade="coarse"), n).values()]
    )
    assert 0.6 < offsets.std() < 1.0 and np.abs(offsets.mean()) < 0.15


def test_units_and_noise_are_never_shared_between_recordings():
    found = [r for n in range(20) for r in recordings(SCENES, n).values()]
    assert len({tuple(np.concatenate([np.ravel(v) for v in r.unit])) for r in found}) == len(found)
    assert len({r.seed for r in found}) == len(found)


def test_shares_of_photographs_and_captions():
    found = [r for n in range(60) for r in recordings(replace(SCENES, vision=0.25, text=0.75), n).values()]
    assert 0.15 < np.mean([r.has_photo for r in found]) < 0.35
    assert 0.65 < np.mean([r.has_text for r in found]) < 0.85
    none = [r for n in range(20) for r in recordings(replace(SCENES, vision=0, text=1), n).values()]
    assert not any(r.has_photo for r in none) and all(r.has_text for r in none)


def gesture(motion, slide=(0.0, 0.0), twist=0.0, shown=1.0, middle=0.5, lift=-1.0):
    """A gesture whose phases lift 10 %, press 20 %, pause 10 %, move 30 %, pause 10 %, release 10 % and lift 10 %."""
    phases = np.array([1, 2, 1, 3, 1, 1, 1]) / 10
    return Gesture(
        0.8,
        scene.MOTIONS.index(motion),
        np.asarray(slide),
        twist,
        phases,
        shown,
        middle,
        lift,
        np.array([1.0, 0.0, 0.1]),
    )


@pytest.mark.parametrize("motion", ["hold", "slide", "twist"])
def test_a_gesture_presses_then_moves_then_lets_go(motion):
    slide, twist = np.array([1.5, -0.5]) * (motion == "slide"), 0.2 * (motion == "twist")
    moved, depth = scene.trajectory(101, gesture(motion, slide, twist))
    assert moved.shape == (101, 3) and depth.shape == (101,)
    touching = depth > 0
    assert 0.75 < touching.mean() < 0.85 and not touching[:10].any() and not touching[-10:].any()
    assert depth.max() == pytest.approx(0.8) and (depth[31:80] == depth.max()).all()
    assert (np.diff(depth[touching][:20]) >= 0).all() and np.abs(np.diff(depth[touching])).max() < 0.15
    assert not moved[:40].any()
    np.testing.assert_allclose(moved[-1], [*slide, twist], atol=1e-9)
    assert (np.diff(moved @ np.sign([1.5, -0.5, 0.2])) >= -1e-12).all()  # never backwards


def test_a_clip_shows_a_part_of_a_gesture():
    whole, depth = scene.trajectory(101, gesture("slide", (1, 0)))
    part, shallow = scene.trajectory(11, gesture("slide", (1, 0), shown=0.1, middle=0.55))
    np.testing.assert_allclose(part, whole[50:61], atol=1e-9)
    np.testing.assert_allclose(shallow, depth[50:61], atol=1e-9)


def test_a_regrasp_leaves_the_object_and_comes_back_elsewhere():
    for frames in (4, 40):
        moved, depth = scene.trajectory(frames, gesture("hold", shown=0.5, lift=0.5))
        off = np.flatnonzero(depth <= 0)
        assert len(off) >= 1 and depth[0] > 0 and depth[-1] > 0
        assert not moved[0].any()
        np.testing.assert_allclose(moved[-1], [1.0, 0, 0.1])


def test_gestures_differ_in_length_and_some_frames_are_without_contact():
    depths = np.stack([recordings(SCENES, number)["digit"].depth for number in range(400)])
    assert 0.03 < (depths <= 0).mean() < 0.2
    assert ((depths > 0).sum(1) > 0).mean() > 0.97
    lengths = [scene.draw_touch(SCENES, number, SPLITS).gesture.shown for number in range(400)]
    assert min(lengths) < 0.4 and max(lengths) > 1.1


def test_a_still_is_the_deepest_press():
    moved, depth = scene.trajectory(1, gesture("slide", (1, 1)))
    assert not moved.any() and depth.tolist() == [0.8]


def test_a_still_has_no_motion_to_tell():
    still = replace(SCENES, frames=1)
    found = [scene.directions(recordings(still, number)["digit"]) for number in range(12)]
    assert all(one == {"label.motion": "hold", "label.twist": "none", "label.slide": "none"} for one in found)


def test_a_sensor_of_fields_has_no_camera_that_mirrors_or_crops():
    for number in range(8):
        unit = recordings(replace(SCENES, sensors=("tac3d",)), number)["tac3d"].unit
        assert (unit.mirror == 1).all() and not unit.window.any() and unit.zoom == 1


def test_directions_are_those_of_the_picture():
    recording = recordings(SCENES, 0)["digit"]
    assert (
        scene.directions(recording._replace(gesture=gesture("slide", (2, 0)), depth=-np.ones(10)))["label.motion"]
        == "hold"
    )

    def seen(motion, slide=(0.0, 0.0), twist=0.0, mirror=(1, 1), rotation=0.0):
        unit = recording.unit._replace(mirror=np.asarray(mirror, np.float32), rotation=np.float32(rotation))
        return scene.directions(recording._replace(unit=unit, gesture=gesture(motion, slide, twist), depth=np.ones(10)))

    assert seen("hold") == {"label.motion": "hold", "label.twist": "none", "label.slide": "none"}
    assert seen("slide", (2, 0.3)) == {"label.motion": "slide", "label.twist": "none", "label.slide": "right"}
    assert seen("slide", (2, 0.3), mirror=(-1, 1))["label.slide"] == "left"
    assert seen("slide", (0.1, 1))["label.slide"] == "down"
    assert seen("slide", (1, 0), rotation=math.pi / 2)["label.slide"] == "down"
    assert seen("twist", twist=0.2)["label.twist"] == "clockwise"  # from x (right) to y (down)
    assert seen("twist", twist=0.2, mirror=(-1, 1))["label.twist"] == "counterclockwise"
    assert seen("twist", twist=0.2, mirror=(-1, -1))["label.twist"] == "clockwise"
