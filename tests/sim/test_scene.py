import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from anytouch_jax.cli.data import SimulateOptions
from anytouch_jax.config import SimulatedConfig
from anytouch_jax.config.scenes import SceneOptions
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
        ({"seed": -1}, "seed must be 0 to 4294967295, not -1"),
        ({"depth": (0.5, 3.0)}, "depth 3 mm may go through the gel of"),
        ({"fields": ("shear", "shear")}, "each field once"),
        ({"held_out": -0.3}, "held_out must be"),
        ({"first": -1}, "first must be 0 or more, not -1"),
    ],
)
def test_what_cannot_be_simulated_is_refused(change, sentence):
    with pytest.raises(UserError, match=sentence):
        replace(SCENES, **change)


def test_splits_fraction_no_pair_of_primitive_and_texture():
    kinds = {
        split: {t.kind for t, s in zip(THINGS, SPLITS, strict=True) if s == split}
        for split in set(SPLITS)
    }
    assert set(kinds) == {"train", "val", "test"}
    assert (
        not kinds["train"] & kinds["test"]
        and not kinds["train"] & kinds["val"]
        and not kinds["val"] & kinds["test"]
    )
    assert 0.25 <= SPLITS.count("test") / len(SPLITS) < 0.4
    # every primitive and every texture of the test objects is seen in training, apart
    for part in range(2):
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


def test_fine_recordings_move_alike_and_coarse_ones_fraction_only_the_place():
    fine = list(recordings(SCENES, 5).values())
    assert all(
        np.array_equal(fine[0].motion, r.motion) and np.array_equal(fine[0].depth, r.depth)
        for r in fine
    )
    assert all(np.array_equal(fine[0].start, r.start) and not r.tilt.any() for r in fine)
    # but no two units are alike
    assert len({float(r.unit.rotation) for r in fine}) == len(fine)
    coarse = list(recordings(replace(SCENES, grade="coarse"), 5).values())
    assert (
        len({r.depth.max() for r in coarse}) == len({tuple(r.start) for r in coarse}) == len(coarse)
    )
    assert all(r.tilt.any() for r in coarse)
    assert all(np.array_equal(r.touch.place, coarse[0].touch.place) for r in coarse)
    offsets = np.asarray(
        [
            r.start[:2]
            for n in range(60)
            for r in recordings(replace(SCENES, grade="coarse"), n).values()
        ]
    )
    assert 0.6 < offsets.std() < 1.0 and np.abs(offsets.mean()) < 0.15


def gesture(motion, slide=(0.0, 0.0), twist=0.0, shown=1.0, middle=0.5, lift=-1.0):
    """A gesture whose phases lift 10 %, press 20 %, pause 10 %, move 30 %, pause 10 %, release 10 %
    and lift 10 %.
    """
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
    slide = np.array([1.5, -0.5]) * (motion == "slide")
    twist = 0.2 * (motion == "twist")
    moved, depth = scene.trajectory(101, gesture(motion, slide, twist))
    assert moved.shape == (101, 3) and depth.shape == (101,)
    touching = depth > 0
    assert 0.75 < touching.mean() < 0.85 and not touching[:10].any() and not touching[-10:].any()
    assert depth.max() == pytest.approx(0.8) and (depth[31:80] == depth.max()).all()
    assert (np.diff(depth[touching][:20]) >= 0).all() and np.abs(
        np.diff(depth[touching])
    ).max() < 0.15
    assert not moved[:40].any()
    np.testing.assert_allclose(moved[-1], [*slide, twist], atol=1e-9)
    # never backwards
    assert (np.diff(moved @ np.sign([1.5, -0.5, 0.2])) >= -1e-12).all()


def test_directions_are_those_of_the_image():
    recording = recordings(SCENES, 0)["digit"]
    assert (
        scene.directions(recording._replace(gesture=gesture("slide", (2, 0)), depth=-np.ones(10)))[
            "label.motion"
        ]
        == "hold"
    )

    def seen(motion, slide=(0.0, 0.0), twist=0.0, mirror=(1, 1), rotation=0.0):
        unit = recording.unit._replace(
            mirror=np.asarray(mirror, np.float32), rotation=np.float32(rotation)
        )
        return scene.directions(
            recording._replace(unit=unit, gesture=gesture(motion, slide, twist), depth=np.ones(10))
        )

    assert seen("hold") == {"label.motion": "hold", "label.twist": "none", "label.slide": "none"}
    assert seen("slide", (2, 0.3)) == {
        "label.motion": "slide",
        "label.twist": "none",
        "label.slide": "right",
    }
    assert seen("slide", (2, 0.3), mirror=(-1, 1))["label.slide"] == "left"
    assert seen("slide", (0.1, 1))["label.slide"] == "down"
    assert seen("slide", (1, 0), rotation=math.pi / 2)["label.slide"] == "down"
    # from x (right) to y (down)
    assert seen("twist", twist=0.2)["label.twist"] == "clockwise"
    assert seen("twist", twist=0.2, mirror=(-1, 1))["label.twist"] == "counterclockwise"
    assert seen("twist", twist=0.2, mirror=(-1, -1))["label.twist"] == "clockwise"


def test_settings_of_training_and_of_data_sets_differ_only_where_that_is_meant():
    """The same setting has one default, but for those that `SimulatedConfig` gives a reason for."""
    training = {field.name: field.default for field in fields(SimulatedConfig)}
    data_set = {field.name: field.default for field in fields(SceneOptions)}
    shared = training.keys() & data_set.keys()
    different = {name for name in shared if training[name] != data_set[name]}
    assert different == {"objects", "seed", "sensors", "depth", "vision"}
    assert shared - different == {"text"}


def test_a_data_set_is_what_the_command_line_says():
    options = SimulateOptions(
        Path("out"), touches=3, sensors=("digit",), held_out=0.0, size=64, units="one", first=5
    )
    made = Scenes(**{field.name: getattr(options, field.name) for field in fields(SceneOptions)})
    assert made == Scenes(
        touches=3, sensors=("digit",), held_out=0.0, size=64, units="one", first=5
    )
