from dataclasses import replace

import cv2
import numpy as np
import pytest
from measuring import gel, measuring_weights

import anytouch_jax as at
from anytouch_jax.data.background.layout import known_backgrounds
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.fields import measure as fields
from anytouch_jax.fields.module import FORCE, LENGTH, TORQUE, FieldOutput
from anytouch_jax.sim.sensing.sensors import SENSORS
from anytouch_jax.weights import load, registry

SIDE = 20
ARRAYS = (
    "depth",
    "depth_std",
    "shear",
    "shear_std",
    "contact",
    "force",
    "force_std",
    "torque",
    "torque_std",
    "slip",
    "slip_std",
    "area",
    "area_std",
    "centre",
)


@pytest.fixture(scope="module")
def encoder(tmp_path_factory):
    return load_encoder(
        measuring_weights(tmp_path_factory.mktemp("fields") / "weights.safetensors")
    )


def output(**changes) -> FieldOutput:
    """A square of 10 x 10 pixels in contact, in the upper left quarter, at a tenth of the
    modulus.
    """
    inside = np.zeros((1, SIDE, SIDE), bool)
    inside[:, :10, :10] = True
    zeros = np.zeros((1, SIDE, SIDE))
    values = {
        "depth": np.where(inside, 0.05, 0),
        "shear": np.zeros((1, SIDE, SIDE, 2)),
        "contact": np.where(inside, 30.0, -30.0),
        "pressure": np.where(inside, 0.1, 0),
        "depth_log": zeros,
        "shear_log": zeros,
        "force": np.array([[0.002, -0.004, 0.02]]),
        "torque": np.array([0.001]),
        "slip": np.array([0.0]),
        "force_log": np.zeros((1, 2)),
        "torque_log": np.zeros(1),
        "slip_log": np.zeros(1),
    }
    return FieldOutput(**(values | changes))


def test_outputs_become_mm_and_newtons_with_the_deviations_of_laplace_errors():
    scale = fields.scale_of({}, "mine", 20.0)._replace(modulus=100.0, spread=0.0)
    one = fields.fields_of(output(), scale, shape=0.5)
    root = np.sqrt(2)
    np.testing.assert_allclose(
        [one.depth.max(), one.depth_std.max()], [1.0, 20 * LENGTH * root], rtol=1e-5
    )
    # 100 kPa, 400 mm2: 40 N
    np.testing.assert_allclose(one.force, 40 * np.array([[0.002, -0.004, 0.02]]), rtol=1e-5)
    np.testing.assert_allclose(
        one.force_std, 40 * root * np.array([[FORCE, FORCE, 0.021]]), rtol=1e-5
    )
    np.testing.assert_allclose(
        [one.torque[0], one.torque_std[0]], [0.8, 800 * TORQUE * root], rtol=1e-5
    )
    # a quarter of 20 x 10 mm
    np.testing.assert_allclose([one.area[0], *one.centre[0]], [50, -5, -2.5], rtol=1e-4)
    other = fields.scale_of(
        {"fields": '{"depth": 2, "normal": 3, "modulus": {"mine": 50}}'}, "mine", 20.0
    )
    two = fields.fields_of(output(depth_log=np.full((1, SIDE, SIDE), 100.0)), other, shape=0.5)
    # the logarithm is bent
    np.testing.assert_allclose(two.depth_std, 20 * LENGTH * root * 2 * np.exp(5), rtol=1e-5)
    np.testing.assert_allclose(two.force_std[0, 2], 3 * 20 * root * 0.021, rtol=1e-5)


@pytest.mark.parametrize("name", fields.GELS)
def test_known_sensors_are_those_of_the_simulator(name):
    sensor = SENSORS[name]
    height, width = sensor.field
    assert fields.GELS[name] == pytest.approx((width, height / width, sensor.gel.modulus), rel=2e-3)


def test_without_contact_and_without_a_width_nothing_is_invented():
    free = fields.fields_of(
        output(contact=np.full((1, SIDE, SIDE), -9.0)), fields.scale_of({}, "digit"), shape=4 / 3
    )
    assert free.area[0] == 0 and np.isnan(free.centre).all() and free.summary()["centre_x"] is None
    # nothing slips where nothing touches
    assert np.isnan(free.slip).all() and np.isnan(free.slip_std).all()
    assert free.summary()["slip"] is None and free.summary()["slip_std"] is None
    assert np.isnan(fields.stacked([free])["slip"]).all()
    faulty = fields.fields_of(
        output(contact=np.full((1, SIDE, SIDE), -9.0)),
        fields.scale_of({}, "digit"),
        shape=4 / 3,
        faults=("grey",),
    )
    assert faulty.summary()["slip"] is None
    touched = fields.fields_of(output(), fields.scale_of({}, "digit"), shape=4 / 3)
    assert touched.slip[0] == 0.5 and touched.summary()["slip_std"] is not None
    unknown = fields.fields_of(output(), fields.scale_of({}, "mine"), shape=0.75)
    assert unknown.force is None and unknown.torque is None and unknown.summary()["force_z"] is None
    assert unknown.depth.max() == pytest.approx(0.05) and unknown.area[0] == pytest.approx(
        0.75 / 4, rel=1e-4
    )
    # The modulus of an unknown gel is a guess, and the deviation says so.
    guessed = fields.fields_of(
        output(force_log=np.full((1, 2), -50.0)), fields.scale_of({}, "mine", 20.0), shape=0.75
    )
    assert (guessed.force_std >= 0.39 * np.abs(guessed.force)).all()


def test_the_interval_of_force_is_of_factors_and_as_wide_as_what_is_known():
    within = np.pad(np.full((1, 10, 10), 30.0), [(0, 0), *2 * [(5, SIDE - 15)]])
    sure = output(force_log=np.full((1, 2), -50.0), contact=within - 15)
    scales = [
        fields.scale_of({}, "digit"),
        fields.scale_of({}, "mine", 14.25),
        fields.scale_of({}, "digit")._replace(case="calibrated", spread=0.2),
    ]
    ratios = []
    for scale in scales:
        one = fields.fields_of(sure, scale, shape=4 / 3)
        about = one.summary()
        assert about["force_low"] < about["force_z"] < about["force_high"]
        ratios.append(
            [about["force_high"] / about["force_z"], about["force_z"] / about["force_low"]]
        )
    family, unknown, calibrated = np.log(ratios)
    assert (unknown > 1.5 * family).all() and (calibrated < family + 0.1).all()
    # Forces of unknown devices are read too small, so their interval reaches further up.
    assert unknown[0] > 1.2 * unknown[1]
    np.testing.assert_allclose(calibrated, fields.Z * 0.2, rtol=0.15)
    # The network's own deviation comes on top, and a fault says that nothing is known.
    wide = fields.fields_of(output(contact=sure.contact), scales[0], shape=4 / 3)
    faulty = fields.fields_of(sure, scales[0], shape=4 / 3, faults=("grey",))
    assert wide.force_high > one.force_high and faulty.force_low == 0
    # How deep the gel is at the border cannot be seen, so the force may be larger, not smaller.
    everywhere = output(force_log=sure.force_log, contact=np.full_like(sure.contact, 5.0))
    leaving, inside = (
        fields.fields_of(read, scales[0], shape=4 / 3) for read in (everywhere, sure)
    )
    assert leaving.force_high > 2 * inside.force_high and leaving.force_low == inside.force_low
    assert fields.fields_of(sure, fields.scale_of({}, "mine"), shape=1.0).force_low is None


def test_frames_of_every_form_are_measured_alike(encoder):
    frames = np.stack([gel(), gel()[::-1], gel()[:, ::-1]])
    several = encoder.measure(frames, None, "tacto", width_mm=10.0)
    assert (
        several.depth.shape == (3, 14, 14)
        and several.force.shape == (3, 3)
        and several.width_mm == 10
    )
    # a still is a clip of equal frames
    clip = np.repeat(frames[:, None], 3, axis=1)
    for form in (
        clip,
        np.concatenate([frames[::-1, None], clip], axis=1),
        frames / np.float32(255),
    ):
        again = encoder.measure(form, None, "tacto", width_mm=10.0)
        for name in ARRAYS:
            np.testing.assert_allclose(
                getattr(again, name), getattr(several, name), rtol=2e-3, atol=2e-5
            )
    np.testing.assert_allclose(
        encoder.measure(frames[1], None, "tacto", width_mm=10.0).depth, several[1].depth, atol=1e-5
    )
    assert several.at(48, 64).shear.shape == (3, 48, 64, 2) and len(several[1]) == 1
    # two batches
    many = encoder.measure(np.repeat(frames, 30, axis=0), None, "tacto", width_mm=10.0)
    np.testing.assert_allclose(many.force[::30], several.force, atol=1e-5)
    moving = np.stack([gel(), gel(), gel()[::-1]])[None]
    assert (
        np.abs(encoder.measure(moving, None, "tacto", width_mm=10.0).shear - several[1].shear).max()
        > 1e-4
    )


def test_features_and_fields_come_from_one_pass(encoder):
    clips = np.random.default_rng(0).integers(0, 256, (2, 3, 28, 28, 3), np.uint8)
    for pooling in ("class", "mean", "both"):
        values, _ = encoder.encode_and_measure(
            clips, np.ones(2, np.int32), np.zeros(2, np.float32), pooling
        )
        np.testing.assert_allclose(
            values, encoder.encode_touch(clips, "digit", pooling=pooling), atol=2e-5
        )


def test_what_cannot_be_measured_is_one_sentence(encoder, tiny_run):
    with pytest.raises(UserError, match=r"--model\.fields 32"):
        load_encoder(tiny_run).measure(gel())
    for frame, background, width, word in (
        (gel(), None, 0.0, "above 0"),
        (gel(), None, np.inf, "above 0"),
        (gel(), gel(48, 48), 1.0, "48 x 48"),
        (np.zeros(7, np.uint8), None, 1.0, "frames must be"),
        (gel()[None][:0], None, 1.0, "frames must be"),
    ):
        with pytest.raises(UserError, match=word):
            encoder.measure(frame, background, width_mm=width, log=lambda _: None)
    with pytest.raises(UserError, match="calibration of fields"):
        replace(encoder, metadata={"fields": "{"}).measure(gel())


def faulty(kind: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Return a frame of a real look of the GelSight Mini with a fault, and its background."""
    real = np.ascontiguousarray(
        np.repeat(np.repeat(known_backgrounds("gelsight_mini")[0], 4, 0), 4, 1)
    )
    grey = np.repeat(real.mean(2, keepdims=True).astype(np.uint8), 3, 2)
    return {
        "none": (real, real),
        "grey": (grey, None),
        "grey against a background": (grey, real),
        "wrong channel order": (real[..., ::-1], real[..., ::-1]),
        "wrong channel order of the frame alone": (real[..., ::-1], real),
        "upside down": (real[::-1, ::-1], None),
        "mirrored after the background was taken": (real[:, ::-1], real),
        "cut to a square": (real[:, :120], None),
        "turned": (np.rot90(real), None),
    }[kind]


def test_a_device_that_is_built_another_way_round_is_no_fault(encoder):
    """The simulated DIGIT of an example has its lights the other way round than three real ones."""
    for touch in at.example_touches():
        lines: list[str] = []
        seen = encoder.measure(touch.frame, touch.background, touch.sensor, log=lines.append)
        assert not seen.faults and not lines, (touch.press, touch.sensor)
    real, _ = faulty("none")
    for turned in (real[:, ::-1], real[::-1], real[::-1, ::-1]):
        both = np.ascontiguousarray(turned)
        assert not fields.faults_of(both, both, "gelsight_mini", 0.75)


@pytest.mark.parametrize(
    ("kind", "word"),
    [
        ("grey", "colour"),
        ("grey against a background", "colour"),
        ("wrong channel order", "red and blue exchanged"),
        ("wrong channel order of the frame alone", "red and blue exchanged"),
        ("upside down", "unlike other units"),
        ("mirrored after the background was taken", "mirrored"),
        ("cut to a square", "120 x 120"),
        ("turned", "120 x 160"),
    ],
)
def test_a_fault_is_logged_and_no_value_is_sure(encoder, kind, word):
    lines: list[str] = []
    good = encoder.measure(*faulty("none"), "gelsight_mini", log=lines.append)
    assert not lines and not good.faults
    frame, background = faulty(kind)
    bad = encoder.measure(frame, background, "gelsight_mini", log=lines.append)
    assert any(word in line for line in lines) and bad.faults
    for name in ("depth", "force", "torque", "area"):
        assert (getattr(bad, f"{name}_std") >= np.abs(getattr(bad, name))).all()
    assert bad.depth_std.min() >= LENGTH * 18.88 and bad.slip_std.min() >= 1


def test_a_wide_press_is_not_called_recoloured():
    real, _ = faulty("none")
    rng = np.random.default_rng(0)
    alarms = 0
    for _ in range(100):
        press = cv2.resize(
            rng.uniform(-90, 90, (3, 4, 3)), real.shape[1::-1], interpolation=cv2.INTER_CUBIC
        )
        alarms += bool(
            fields.faults_of(
                np.clip(real + press, 0, 255).astype(np.uint8), real, "gelsight_mini", 0.75
            )
        )
    assert alarms <= 5


def test_drift_of_the_light_on_a_symmetric_gel_is_no_turn():
    """A mirror image of such a gel changes less than the light of a correct device drifts."""
    ramp = np.linspace(-1, 1, 160)[None, :, None]
    dome = 60 - 20 * (ramp**2 + np.linspace(-1, 1, 120)[:, None, None] ** 2)
    gel = np.clip((dome + 2 * ramp) * (1, 0.62, 0.18), 0, 255).astype(np.uint8)
    drifted = np.clip((dome - 8 * ramp) * (1, 0.62, 0.18), 0, 255).astype(np.uint8)
    assert not fields.faults_of(drifted, gel, "ring_light", 0.75)
    real, _ = faulty("none")
    for turned in (real[:, ::-1], real[::-1], real[::-1, ::-1], real[..., ::-1]):
        assert fields.faults_of(np.ascontiguousarray(turned), real, "gelsight_mini", 0.75)


def test_the_part_is_kept_in_the_package_and_its_calibration_too(tmp_path):
    source = measuring_weights(
        tmp_path / "w.safetensors", {"depth": 1.5, "modulus": {"digit": 90.0}}
    )
    folder = registry.write_encoder(tmp_path / "card", load.load_model(source))
    before, after = (load_encoder(path) for path in (source, folder / registry.WEIGHTS))
    one, two = (encoder.measure(gel(64, 48), None, "digit") for encoder in (before, after))
    np.testing.assert_allclose(one.depth, two.depth, atol=5e-3)
    np.testing.assert_allclose(one.force, two.force, rtol=2e-2, atol=1e-2)
    plain = replace(after, metadata={}).measure(gel(64, 48), None, "digit")
    np.testing.assert_allclose(two.depth_std, 1.5 * plain.depth_std, rtol=1e-5)
    np.testing.assert_allclose(two.force, plain.force * 90 / 120, rtol=1e-5)


def test_the_surface_is_a_mesh_in_mm(tmp_path):
    one = fields.fields_of(output(), fields.scale_of({}, "digit"), shape=4 / 3)
    fields.write_surface(tmp_path / "gel.ply", gel(64, 48), one)
    head, _, body = (tmp_path / "gel.ply").read_bytes().partition(b"end_header\n")
    # 16 x 12 points
    assert b"element vertex 192" in head and b"element face 330" in head
    points = np.frombuffer(body[: 192 * 15], [("at", "<f4", 3), ("colour", "u1", 3)])
    at = points["at"].astype(float)
    assert len(body) == 192 * 15 + 330 * 13
    # x right, y down, z away from the camera: where the gel is pressed it is nearer
    np.testing.assert_allclose(at, one.at(16, 12).points()[0].reshape(-1, 3), atol=1e-6)
    assert np.ptp(at[:, 0]) == pytest.approx(14.25 * 11 / 12) and at[0, 0] < 0 and at[0, 1] < 0
    assert at[:, 2].min() == pytest.approx(-0.05 * 14.25) and at[:, 2].max() == 0
    assert at[at[:, 2] < -0.6][:, :2].max() < 0, "the upper left quarter is pressed"
    assert b"comment frame: right-handed, x right, y down, z away from the camera" in head
    # the front of every face is turned to the object
    faces = np.frombuffer(body[192 * 15 :], [("count", "u1"), ("corners", "<i4", 3)])
    corner, second, third = np.moveaxis(at[faces["corners"]], 1, 0)
    assert (np.cross(second - corner, third - corner)[:, 2] > 0).all()
    image = fields.overlay(gel(64, 48), one)
    assert (
        image.shape == (64, 48, 3) and np.abs(image[:28].astype(int) - gel(64, 48)[:28]).mean() > 20
    )


def test_shear_is_the_motion_of_dots_in_mm(encoder):
    y, x = np.mgrid[:120, :160]

    def image(by, sides=1):
        ink = np.hypot((x - by) % 16 - 8, y % 16 - 8) < 3
        return np.clip(
            np.where(ink, 30, 120 + x / 4)[..., None] + (0, 15 * sides, -20 * sides), 0, 255
        ).astype(np.uint8)

    moved = encoder.measure(np.stack([image(0), image(3)]), image(0), "tacto", width_mm=16.0)
    assert np.abs(np.median(moved.shear, (1, 2)) - [[0, 0], [0.3, 0]]).max() < 0.02
    assert (
        moved.shear.shape == (*moved.depth.shape, 2) and moved.shear_std.shape == moved.depth.shape
    )
    assert np.median(moved.shear_std) < 0.05
    fractions = encoder.measure(image(3), image(0), "tacto").shear
    np.testing.assert_allclose(16 * fractions[0], moved.shear[1], atol=1e-5)
    grey = encoder.measure(image(3, 0), image(0), "tacto", width_mm=16.0, log=lambda _: None)
    assert grey.faults and np.median(grey.shear_std) > 0.5

    scale = fields.Scale(16.0, 100.0, 0.0, None, dict.fromkeys(fields._NAMES, 1.0))
    measure = fields.Measure(scale, "mine", image(0), lambda _: None, 0, "none")
    # a quarter of 16 x 12 mm is in contact: 48 mm2
    dragged = measure(output(), [image(3)])
    wanted = fields.DRAG * 0.1 * 0.3 * np.sqrt(48)
    np.testing.assert_allclose(dragged.force[0, :2], [wanted, 0], atol=0.05 * wanted)
    assert dragged.force[0, 2] == pytest.approx(0.02 * 100 * 0.256, rel=1e-4)
    free = measure(output(contact=np.full((1, SIDE, SIDE), -9.0)), [image(3)])
    assert not free.force[0, :2].any(), "a gel that moved in its mount is not dragged"
