from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.sim import recorder as record
from anytouch_jax.sim import scene
from anytouch_jax.sim.recorder import SPACING, ClipInput, Recorder
from anytouch_jax.sim.scene import Scenes
from anytouch_jax.sim.sensing.sensors import SENSORS, identity_unit

SURFACES = jax.jit(record.surfaces)
DIGIT = SENSORS["digit"]
SCENES = Scenes(
    touches=6,
    objects=6,
    seed=2,
    sensors=("digit", "tac3d"),
    size=32,
    frames=5,
    fields=("pressure", "shear"),
)
RNG = np.random.default_rng(0)
AXIS = (np.arange(160) - 79.5) * SPACING
BUMPY = sum(
    np.cos(
        AXIS[:, None] * RNG.uniform(-2, 2) + AXIS[None, :] * RNG.uniform(-2, 2) + RNG.uniform(0, 6)
    )
    for _ in range(12)
).astype(np.float32)


def clip(**change):
    unit = identity_unit(DIGIT)
    values = {
        "relief": BUMPY * 0.1,
        "place": np.zeros(2, np.float32),
        "start": np.zeros(3, np.float32),
        "motion": np.zeros((2, 3), np.float32),
        "depth": np.full(2, 0.5, np.float32),
        "tilt": np.zeros(2, np.float32),
        "modulus": np.float32(1e5),
        "friction": np.float32(0.6),
        "unit": unit._replace(**change.pop("unit", {})),
        "seed": np.uint32(1),
    }
    values |= change
    return ClipInput(**values, drift=np.zeros((len(values["depth"]), 3, 3), np.float32))


def grid(n=30, pitch=0.2):
    line = (jnp.arange(n) - (n - 1) / 2) * pitch
    return jnp.meshgrid(line, line)  # x, y


def heights(**change):
    """Surface under the gel, not shifted to its first contact."""
    z = np.asarray(SURFACES(clip(**change), *grid()))
    return z - z[0, 0, 0]


def test_sliding_moves_the_imprint_with_the_object():
    # three columns right, two rows up
    z = heights(motion=np.asarray([[0, 0, 0], [0.6, -0.4, 0]], np.float32))
    np.testing.assert_allclose(z[1][:-2, 3:] - z[1][0, 3], z[0][2:, :-3] - z[0][2, 0], atol=2e-5)


def test_a_quarter_turn_turns_the_imprint_from_x_to_y():
    z = heights(motion=np.asarray([[0, 0, 0], [0, 0, np.pi / 2]], np.float32))
    np.testing.assert_allclose(z[1] - z[1].mean(), np.rot90(z[0] - z[0].mean(), -1), atol=2e-4)


def test_the_place_lies_under_the_middle_and_the_start_moves_it():
    plain = heights()
    moved = heights(
        place=np.asarray([1.0, 0.4], np.float32), start=np.asarray([1.0, 0.4, 0], np.float32)
    )
    np.testing.assert_allclose(moved, plain, atol=2e-5)
    place = heights(place=np.asarray([0.6, 0.0], np.float32))[0]
    np.testing.assert_allclose(
        place[:, :-3] - place[0, 0], plain[0][:, 3:] - plain[0][0, 3], atol=2e-5
    )


def test_depth_is_that_of_the_highest_point_under_the_gel():
    peak = np.zeros((160, 160), np.float32)
    peak[80, 80] = 0.4
    low = clip(relief=np.zeros((160, 160), np.float32), tilt=np.asarray([0.1, 0], np.float32))
    x, y = grid(60, 0.1)
    away = clip(relief=peak, motion=np.asarray([[0, 0, 0], [20.0, 0, 0]], np.float32))
    # the peak slid off
    np.testing.assert_allclose(record._depth(away, SURFACES(away, x, y)), [0.5, 0.1], atol=0.05)
    np.testing.assert_allclose(record._depth(low, SURFACES(low, x, y)), [0.5, 0.5], atol=1e-5)
    free = clip(relief=peak, motion=away.motion, depth=np.full(2, 0.2, np.float32))
    # nothing is touched
    np.testing.assert_allclose(record._depth(free, SURFACES(free, x, y)), [0.2, 0], atol=1e-5)


def test_the_mounting_turns_surface_and_motion_alike():
    motion = np.asarray([[0, 0, 0], [0.6, 0, 0]], np.float32)
    turned = clip(motion=motion, unit={"rotation": np.float32(np.pi / 2)})
    np.testing.assert_allclose(record.gel_motion(turned), [[0, 0, 0], [0, 0.6, 0]], atol=1e-6)
    z = np.asarray(SURFACES(turned, *grid()))
    # three rows down
    np.testing.assert_allclose(z[1][3:] - z[1][3, 0], z[0][:-3] - z[0][0, 0], atol=2e-4)
    plain = np.asarray(SURFACES(clip(motion=motion), *grid()))
    np.testing.assert_allclose(z[0], np.rot90(plain[0], -1), atol=2e-4)


@pytest.fixture(scope="module", autouse=True)
def _small_grid():
    """The laws hold on any grid: half of the usual one is solved in a quarter of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(record, "GRID", 48)
        yield


@pytest.fixture(scope="module")
def takes(_small_grid):
    """Six touches by a camera and by a sensor of fields: [(recording, take)] by sensor."""
    scenes = SCENES
    things, splits = scene.objects_and_splits(scenes)
    recorder = Recorder(scenes, things, batch=6)
    touches = [scene.draw_touch(scenes, number, splits) for number in range(6)]
    found = {}
    for sensor in scenes.sensors:
        recordings = [scene.draw_recording(scenes, touch, sensor) for touch in touches]
        found[sensor] = list(zip(recordings, recorder.record(recordings), strict=True))
    # a short group reuses the program
    assert len(recorder.record(recordings[:2])) == 2
    return found


def test_a_camera_gives_images_and_the_fields_asked_for(takes):
    for recording, take in takes["digit"]:
        # portrait, square pixels
        assert take.image.shape == (5, 43, 32, 3) and take.image.dtype == np.uint8
        assert take.background.shape == (43, 32, 3)
        # at the pixels of the image
        assert take.field.shape == (5, 43, 32, 3)
        changed = np.abs(take.image.astype(float) - take.background).mean((1, 2, 3))
        assert changed[recording.depth > 0.3].min() > 1.2 * changed[recording.depth <= 0].max(
            initial=0
        )


def test_a_field_is_felt_where_the_load_is_and_its_points_give_way_to_the_sides():
    pressed = partial(record.simulate_clip, sensor=SENSORS["tac3d"], fidelity="fast", size=0)
    ball = -(AXIS[:, None] ** 2 + AXIS[None, :] ** 2) / 16
    still = clip(
        relief=ball.astype(np.float32),
        motion=np.zeros((1, 3), np.float32),
        depth=np.full(1, 0.8, np.float32),
    )
    felt = jax.jit(pressed)
    seen = np.asarray(felt(still).field)[0]
    away = np.mgrid[:20, :20][::-1].transpose(1, 2, 0) - 9.5
    # just outside the contact
    ring = (np.linalg.norm(away, axis=-1) > 3) & (np.linalg.norm(away, axis=-1) < 4)
    slippery = np.asarray(felt(still._replace(friction=np.float32(0))).field)[0]
    held, free = (
        ((one[..., :2] * away).sum(-1) / np.linalg.norm(away, axis=-1))[ring].mean()
        for one in (seen, slippery)
    )
    # of the dent
    assert 0.02 * seen[..., 2].max() < held < 0.7 * free < 0.2 * seen[..., 2].max()
    np.testing.assert_allclose(seen[..., :2], -seen[::-1, ::-1, :2], atol=2e-4)
    # a unit's own
    noisy = still._replace(unit=still.unit._replace(noise=np.float32(0.03)))
    spread = np.asarray(felt(noisy).field)[0, ..., :3] - seen[..., :3]
    assert 0.02 < spread.std() < 0.04
    aside = felt(still._replace(start=np.asarray([1.3, -0.4, 0], np.float32)))
    (force,) = np.asarray(aside.field)[..., 5]
    x = (np.arange(20) - 9.5) / 20 * SENSORS["tac3d"].field[1]
    middle = (force.sum(0) * x).sum() / force.sum(), (force.sum(1) * x).sum() / force.sum()
    np.testing.assert_allclose((aside.labels["x"][0], aside.labels["y"][0]), middle, atol=0.05)
    np.testing.assert_allclose(middle, (1.3, -0.4), atol=0.1)


def test_labels_agree_with_the_pressure(takes):
    for recording, take in takes["digit"]:
        pressure = take.field[..., 0]
        unit = recording.unit
        total = np.maximum(pressure.sum((1, 2)), 1e-9)
        np.testing.assert_allclose(take.labels["depth"][0], max(recording.depth[0], 0), rtol=1e-5)
        pitch = float(unit.zoom) * DIGIT.field[1] / 32  # mm of a pixel
        edge = pressure[:, [0, -1]].sum((1, 2)) + pressure[:, :, [0, -1]].sum((1, 2))
        touching = recording.depth > 0
        # the image shows all of the contact
        whole = touching & (edge < 1e-2 * pressure.sum((1, 2)))
        force = pressure.sum((1, 2)) * pitch**2 * 1e-3
        np.testing.assert_allclose(take.labels["force"][whole], force[whole], rtol=0.1)
        shown = (np.arange(32) + 0.5 - 16) * pitch
        middle = (pressure.sum(1) * shown).sum(1) / total
        np.testing.assert_allclose(take.labels["x"][whole], middle[whole], atol=0.3 * pitch)
        np.testing.assert_array_equal(take.labels["force"] > 0, touching)
        assert not take.field[~touching].any()
        assert ((take.labels["slip"] >= 0) & (take.labels["slip"] <= 1)).all()
        if scene.MOTIONS[recording.gesture.motion] == "hold":
            # only squeezed to the sides
            assert np.abs(take.field[..., 1:]).max() < 0.4 * recording.depth.max()


def test_an_object_that_turns_about_itself_does_not_slide():
    """A ball under the gel's middle, mounted 0.6 mm aside: its twist gives a torque and no
    force.
    """
    motion = np.zeros((5, 3), np.float32)
    motion[:, 2] = np.linspace(0, 0.2, 5)
    round_ = -(AXIS[:, None] ** 2 + AXIS[None, :] ** 2) / 16
    turning = clip(
        relief=round_.astype(np.float32),
        unit={"offset": np.array([0.6, 0.6], np.float32)},
        motion=motion,
        depth=np.full(5, 0.6, np.float32),
    )
    simulate = partial(
        record.simulate_clip, sensor=DIGIT, fidelity="fast", size=48, fields=("shear",)
    )
    take = jax.jit(simulate)(turning)
    shear = np.asarray(take.field[-1])
    assert np.abs(shear).max() > 0.02
    assert np.abs(shear.mean((0, 1))).max() < 0.005 * np.abs(shear).max()


def test_another_batch_gives_the_same_recording(takes, monkeypatch):
    scenes = replace(SCENES, sensors=("digit",))
    things, _ = scene.objects_and_splits(scenes)
    recording, take = takes["digit"][4]
    lock = Recorder(scenes, things, batch=6).record([recording])[0]
    np.testing.assert_array_equal(lock.image, take.image)
    jax.tree.map(np.testing.assert_array_equal, lock.labels, take.labels)
    monkeypatch.setattr(record, "MAX_PIXELS", 4 * 2 * scenes.frames * scenes.size**2)
    recordings = [one for one, _ in takes["digit"]]
    assert len(recordings) == 6  # so a program of four runs twice
    for other, (_, take) in zip(
        Recorder(scenes, things, batch=6).record(recordings), takes["digit"], strict=True
    ):
        # another program rounds otherwise
        apart = np.abs(other.image.astype(int) - take.image)
        assert apart.max() <= 1 and (apart > 0).mean() < 1e-3
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-3, atol=1e-4),
            other.labels,
            take.labels,
        )
    with pytest.raises(ValueError, match="1 to 6 recordings of one sensor"):
        Recorder(scenes, things, batch=6).record([])
