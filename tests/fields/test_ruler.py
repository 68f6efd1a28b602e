"""A ruler from presses of a ball: what it reads of others, and what it refuses."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from ball_presses import DIAMETER, POSES, WIDTH, presses

from anytouch_jax.errors import UserError
from anytouch_jax.fields import ruler as rulers
from anytouch_jax.fields.ruler import fit_ruler, integrated, read_ruler, ruler_of_today

OTHERS = np.array([[1.5, 1.0, 1.4], [-1.0, -2.0, 1.7]])


def fitted(made=None, network=None, ball_mm=DIAMETER, **more):
    made = presses() if made is None else made
    network = np.zeros_like(made.depth) if network is None else network
    return fit_ruler(
        list(made.frames), network, made.background, width_mm=WIDTH, ball_mm=ball_mm, **more
    )


@pytest.fixture(scope="module")
def ruler():
    return fitted(family="gelsight")


def test_other_presses_are_read_with_depth_contact_and_centre(ruler):
    made = presses(OTHERS, seed=1)
    touched = np.ones_like(made.depth)
    depth, deviation, contact = ruler.read(list(made.frames), np.zeros_like(made.depth), touched)
    height, width = depth.shape[1:]
    y, x = (np.mgrid[:height, :width] + 0.5) * WIDTH / width
    for own, p, true, (px, py, radius) in zip(depth, contact, made.depth, OTHERS, strict=True):
        away = np.hypot(x - px - WIDTH / 2, y - py - 6.0)
        rim = np.abs(away - radius) < 0.15
        above = own[away < 0.2].mean() - own[rim].mean()
        assert abs(above / (true[away < 0.2].mean() - true[rim].mean()) - 1) < 0.15
        inside = p > 0.5
        assert abs(np.sqrt(inside.sum() / np.pi) * WIDTH / width / radius - 1) < 0.15
        assert np.hypot(x[inside].mean() - px - 8, y[inside].mean() - py - 6) < 0.15
    assert (deviation > 0).all() and not ruler.by_network and ruler.is_usual


def test_nothing_is_read_of_an_untouched_gel_and_none_where_the_network_sees_no_touch(ruler):
    made = presses(OTHERS)
    free = np.repeat(made.background[None], 2, 0)
    zeros = np.zeros_like(made.depth)
    depth, _, contact = ruler.read(list(free), zeros, np.ones_like(zeros))
    assert np.abs(depth).max() < 0.05 and (contact < 0.5).all()
    assert (ruler.read(list(made.frames), zeros, zeros)[2] == 0).all()


def test_a_network_that_reads_this_device_is_kept_and_scaled():
    made = presses()
    rough = replace_light(made)
    kept = fitted(rough, made.depth / 1.3, weights="abc")
    assert kept.by_network and kept.gain == pytest.approx(1.3, rel=0.1)
    kept.check_network("abc")
    with pytest.raises(UserError, match="another encoder"):
        kept.check_network("abd")


def replace_light(made):
    """Colours that depend on the place, so that a few presses do not show them."""
    height, width = made.background.shape[:2]
    v, u = np.mgrid[:height, :width] / np.array([height, width])[:, None, None] - 0.5
    factor = (1 + 1.2 * np.sin(7 * u) * np.cos(9 * v))[..., None]
    change = made.frames.astype(float) - made.background
    return made._replace(frames=np.clip(made.background + factor * change, 0, 255).astype(np.uint8))


def test_half_and_twice_the_diameter_are_noticed(ruler):
    assert "unusual" not in " ".join(ruler.describe().values())
    twice = fitted(ball_mm=2 * DIAMETER, family="gelsight")
    assert not twice.is_usual and "Check its diameter" in twice.describe()["strength of colours"]
    deep = POSES * [1, 1, 1.35]
    with pytest.raises(UserError, match=r"wider|no ruler|explains"):
        fitted(presses(deep), ball_mm=DIAMETER / 2)


def test_a_ruler_is_stored_and_a_damaged_one_is_named(ruler, tmp_path):
    assert read_ruler(tmp_path) is None
    rulers.write_ruler(tmp_path, ruler)
    again = read_ruler(tmp_path)
    made = presses(OTHERS)
    zeros = np.zeros_like(made.depth)
    for one, other in zip(
        ruler.read(list(made.frames), zeros, zeros + 1),
        again.read(list(made.frames), zeros, zeros + 1),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)
    assert again.describe() == ruler.describe()
    (tmp_path / rulers.FILE).write_bytes(b"none")
    with pytest.raises(UserError, match="Calibrate the sensor again"):
        read_ruler(tmp_path)


def test_the_background_of_today_counts_and_a_pressed_one_is_refused(ruler):
    said = []
    noise = np.random.default_rng(3).integers(-1, 2, ruler.background.shape)
    today = np.clip(ruler.background + noise, 0, 255).astype(np.uint8)
    new, holds = ruler_of_today(ruler, today, said.append)
    assert holds and not said and (new.background == today).all()
    with pytest.raises(UserError, match="presses on the gel"):
        ruler_of_today(ruler, presses(POSES[2:3]).frames[0], said.append)


def test_exact_slopes_give_a_cone_a_stud_and_stairs_back():
    y, x = np.mgrid[:64, :80].astype(float)
    away = np.hypot(x - 40, y - 32)
    cone = cv2.GaussianBlur(np.maximum(12 - away, 0), (0, 0), 1.5)
    stud = 8 / (1 + np.exp((away - 14) / 1.5))
    stairs = 3 / (1 + np.exp(-(x - 25))) + 3 / (1 + np.exp(-(x - 55)))
    for surface in (cone, stud, stairs):
        steps = np.gradient(surface, axis=(1, 0))
        got = integrated(*steps)
        got += (surface - got).mean()
        assert np.ptp(got) == pytest.approx(np.ptp(surface), rel=0.05)
        assert np.abs(got - surface).max() < 0.06 * np.ptp(surface)


def test_too_few_presses_and_another_size_are_named():
    made = presses()
    with pytest.raises(UserError, match="2 of 3 images show a press"):
        rulers.pressed_frames([*made.frames[:2], made.background], made.background)
    with pytest.raises(UserError, match="another size"):
        rulers.pressed_frames(list(made.frames), made.background[:100])
    assert replace(fitted(), presses=3).presses == 3
