"""Real presses and the model fitted to them."""

from __future__ import annotations

from importlib.resources import files

import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.sim.sensing import optics, sensors
from anytouch_jax.sim.sensing.sensors import SENSORS
from experiments.benchmarks import looks, photometry, presses
from experiments.benchmarks.presses import INDENTERS, PITCH, Indenter


@pytest.fixture(scope="module")
def gelsight():
    return presses.read_presses("gelsight")


def test_the_package_carries_the_presses_in_red_green_blue(gelsight):
    assert gelsight.frames.shape == (48, 480, 640, 3)
    assert gelsight.frames.dtype == gelsight.background.dtype == np.uint8
    # The red lamp of this unit stands on the right: that flank of the first ball turns red, the other one loses red.
    x, y = gelsight.centre[0].astype(int)
    change = gelsight.frames[0].astype(int) - gelsight.background
    right, left = change[y - 10 : y + 10, x + 35 : x + 55], change[y - 10 : y + 10, x - 55 : x - 35]
    assert right[..., 0].mean() > 15 > -10 > left[..., 0].mean()
    np.testing.assert_array_equal(gelsight.recorded[:, :2], gelsight.centre)
    assert tuple(presses.read_background("gelsight_mini").mean((0, 1)).round()) == (83, 99, 113)


def test_the_mini_circles_are_drawn_again_and_agree_with_each_other():
    mini = presses.read_presses("gelsight_mini")
    assert len(mini.radius) == 24
    moved = np.hypot(*(mini.centre - mini.recorded[:, :2]).T)
    assert 20 < moved.max() < 30
    # Two series were pressed, each at one place: the new centres say so, the recorded ones scatter.
    for series in (slice(0, 13), slice(13, 24)):
        assert mini.centre[series].std(0).max() < 3 < mini.recorded[series, :2].std(0).max()
    assert mini.radius.min() > 30 and mini.radius.max() < 60


def test_the_balls_size_agrees_with_taxims_table(gelsight):
    # The table was filled from the tilts of the presses and holds its last value beyond the largest of them, which is
    # asin(circle / ball): at 4.00 mm bin 112 of 124, at 4.70 mm it would be bin 79.
    table = np.load(str(files("taxim") / "calib" / "gelsight" / "polycalib.npz"))["grad_g"]
    still = [np.isclose(table[i], table[i + 1]).all(-1).mean() > 0.6 for i in range(60, 124)]
    last = 60 + still.index(True)
    ball = INDENTERS["gelsight"].radius
    tilt = np.arcsin(gelsight.radius.max() * PITCH / ball) / (np.pi / 2) * 124
    assert abs(last - tilt) < 3


def test_halves_are_disjoint_and_complete():
    train, test = presses.halves(7)
    assert sorted([*train, *test]) == list(range(7))
    assert not set(train) & set(test)


@pytest.mark.parametrize("read", [presses.read_background, presses.read_presses])
def test_a_sensor_without_calibration_is_named(read):
    with pytest.raises(UserError, match=r"'digit'.*gelsight, gelsight_mini"):
        read("digit")


def test_a_missing_package_says_what_to_install(monkeypatch):
    def absent(name: str) -> None:
        raise ModuleNotFoundError(name)

    monkeypatch.setattr(presses, "files", absent)
    with pytest.raises(UserError, match="pip install taxim"):
        presses.read_background("gelsight")


def synthetic(centre, size=(120, 160), width=12.0):
    """A frame whose change is odd about `centre`, on a grey background."""
    y, x = np.mgrid[: size[0], : size[1]]
    dx, dy = x - centre[0], y - centre[1]
    bump = np.exp(-(dx**2 + dy**2) / (2 * width**2))
    change = np.stack([dx * bump, dy * bump, -dx * bump], -1) * 6
    return np.clip(128 + change, 0, 255).round().astype(np.uint8), np.full((*size, 3), 128, np.uint8)


@pytest.mark.parametrize("centre", [(80, 60), (91, 47), (62, 66)])
def test_the_odd_centre_is_found_from_afar(centre):
    frame, plain = synthetic(centre)
    result = presses.odd_centre(frame, plain, np.array([78.0, 58.0]), 30)
    np.testing.assert_allclose(result, centre, atol=1)


def test_the_circle_grows_with_the_dent_and_an_untouched_frame_has_none():
    radii = [presses.circle(*synthetic((80, 60), width=w), np.array([80.0, 60.0]), 30)[2] for w in (6, 9, 12)]
    assert radii == sorted(radii) and radii[0] < radii[2]
    plain = synthetic((80, 60))[1]
    assert presses.circle(plain, plain, np.array([80.0, 60.0]), 30)[2] == 1


def test_a_ball_meets_the_flat_gel_on_its_circle():
    ball = Indenter(radius=2.0, share=1.0, sink=1.0)
    cut = np.asarray(presses.ball_cut((2.0, 1.5), 1.0, ball, (61, 81), 0.05))
    np.testing.assert_allclose(cut[30, 40], 2 - np.sqrt(3), rtol=1e-5)  # the depth: height of the cap
    np.testing.assert_allclose(cut[30, 60], 0, atol=1e-6)  # 1 mm to the right
    np.testing.assert_allclose(cut[30, 30], np.sqrt(2**2 - 0.5**2) - np.sqrt(3), rtol=1e-5)
    assert cut.min() == -1  # far away it is only "nothing here"
    half = np.asarray(presses.ball_cut((2.0, 1.5), 2.0, Indenter(radius=2.0, share=0.5, sink=1.0), (61, 81), 0.05))
    np.testing.assert_array_equal(half, cut)


def test_the_gel_settles_round_the_object():
    ball = Indenter(radius=2.0, sink=1.5)
    cut = presses.ball_cut((1.5, 1.5), 0.8, ball, (31, 31), 0.1)
    dent = np.asarray(presses.settle(cut, 0.1, 1.0))
    assert (dent >= np.asarray(cut)).all() and (dent >= 0).all()
    np.testing.assert_allclose(dent, dent.T, atol=1e-6)
    np.testing.assert_allclose(dent, dent[::-1], atol=1e-6)
    row = dent[15, 15:]
    assert (np.diff(row) <= 1e-6).all() and row[0] == np.asarray(cut).max()
    assert (row[np.asarray(cut)[15, 15:] < 0][:3] > 0).all()  # a skirt outside of the contact
    assert not np.asarray(presses.settle(jnp.full((31, 31), -0.5), 0.1, 1.0)).any()
    deeper = np.asarray(presses.settle(cut + 0.1, 0.1, 1.0))
    assert (deeper >= dent).all()


def test_the_fit_is_finite_small_where_unseen_and_zero_at_rest():
    model, plain = presses.fit_photometry("gelsight_mini")
    assert np.isfinite(model.normal).all() and np.isfinite(model.halo).all()
    assert not plain.halo.any() and model.halo.any()
    assert 0.3 < model.steepest < 0.7
    # All Mini presses lie near the middle: the drift over the image is the stated fading, nothing fitted.
    linear, square = (photometry.PLACES.index(p) for p in ((1, 0), (2, 0)))
    assert not model.normal[:, linear].any()
    np.testing.assert_allclose(model.normal[:, square], -0.5 * model.normal[:, 0])
    flat = jnp.zeros((3, 4))
    for c in range(3):
        change = optics.colour_change(jnp.asarray(model.normal[..., c]), flat, flat, jnp.zeros(4), jnp.zeros(3))
        assert not np.asarray(change).any()


def test_the_stored_looks_are_those_of_the_fits():
    for name, model in looks.models().items():
        stored = sensors.look(SENSORS[name])
        for part, value in model._asdict().items():
            np.testing.assert_allclose(getattr(stored, part), value, rtol=1e-3, atol=1e-4, err_msg=f"{name}.{part}")
    for name, indenter in INDENTERS.items():
        assert SENSORS[name].halo == indenter.halo, "the renderer blurs as the fit did"
        assert SENSORS[name].field == (480 * PITCH, 640 * PITCH)
    for name, lights in photometry.LIGHTS.items():
        base = photometry.untouched(lights, SENSORS[name].field)
        np.testing.assert_allclose(sensors.bases(SENSORS[name]), base, atol=1e-6)
        assert not SENSORS[name].real
