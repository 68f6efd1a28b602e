from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax.errors import UserError
from anytouch_jax.sim.sensing import optics, sensors
from anytouch_jax.sim.sensing.sensors import SENSORS, Markers

SIZE = (48, 64)
SLIM = SENSORS["gelslim"]
DIGIT = SENSORS["digit"]
PITCH = SLIM.field[0] / 36
GRID = (36, 48)
KEY = jax.random.key(0)
PLAIN = sensors.identity_unit(SLIM)
MARKED = PLAIN._replace(marked=np.float32(1))


@partial(jax.jit, static_argnames=("shadow",))
def draw(displacement, tangential, unit, key, shadow=True):
    model = None if shadow else sensors.look(SLIM)._replace(halo=np.zeros((3, 3, 3)))
    return optics.render(
        displacement, tangential, PITCH, SLIM, unit, key, resolution=SIZE, photometry=model
    )


def bump(x=0.0, y=0.0, height=0.8, width=1.5):
    down, across = ((np.arange(n) - (n - 1) / 2) * PITCH for n in GRID)
    away = (across[None, :] - x) ** 2 + (down[:, None] - y) ** 2
    return jnp.asarray(height * np.exp(-away / (2 * width**2)), jnp.float32)


STILL = jnp.zeros((*GRID, 2))
FLAT = jnp.zeros(GRID)


def levels(image):
    return np.asarray(image).astype(int)


def test_no_displacement_is_the_background():
    drawn = sensors.draw_unit(SLIM, np.random.default_rng(0))._replace(marked=np.float32(1))
    for unit in (PLAIN, MARKED, drawn):
        behind = optics.background(SLIM, unit, KEY, resolution=SIZE)
        # another program rounds otherwise
        apart = np.abs(levels(draw(FLAT, STILL, unit, KEY)) - levels(behind))
        assert apart.max() <= 1 and apart.mean() < 1e-3
    assert behind.shape == (*SIZE, 3) and behind.dtype == jnp.uint8


def test_a_dent_changes_the_image_where_it_is():
    for x, y in ((0.0, 0.0), (5.0, -3.0), (-6.0, 4.0)):
        change = np.abs(
            levels(draw(bump(x, y), STILL, PLAIN, KEY)) - levels(draw(FLAT, STILL, PLAIN, KEY))
        ).sum(-1)
        rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
        weight = change * (change > 15)
        pitch = SLIM.field[0] / SIZE[0]
        seen = [(weight * axis).sum() / weight.sum() for axis in (columns - 31.5, rows - 23.5)]
        np.testing.assert_allclose(np.array(seen) * pitch, [x, y], atol=1.0)
        assert change.max() > 60
        assert (
            change[np.hypot((columns - 31.5) * pitch - x, (rows - 23.5) * pitch - y) > 7].max()
            <= 12
        )


def test_mirror_turns_the_image_over():
    for axis, mirror in ((1, [-1, 1]), (0, [1, -1])):
        unit = PLAIN._replace(mirror=np.array(mirror, np.float32))
        flipped = np.flip(levels(draw(bump(3.0, 2.0), STILL, PLAIN, KEY)), axis)
        np.testing.assert_allclose(levels(draw(bump(3.0, 2.0), STILL, unit, KEY)), flipped, atol=1)


def test_tint_gain_and_light_angle_act():
    base = levels(draw(FLAT, STILL, PLAIN, KEY))
    dent = levels(draw(bump(), STILL, PLAIN, KEY))
    red = PLAIN._replace(tint=np.array([0.5, 1, 1], np.float32))
    halved = levels(draw(FLAT, STILL, red, KEY))
    np.testing.assert_allclose(halved[..., 0], base[..., 0] / 2, atol=1)
    np.testing.assert_array_equal(halved[..., 1:], base[..., 1:])
    weak = PLAIN._replace(gain=np.full(3, 0.5, np.float32))
    inside = (dent > 5) & (dent < 250)
    np.testing.assert_allclose(
        (levels(draw(bump(), STILL, weak, KEY)) - base)[inside],
        ((dent - base) / 2)[inside],
        atol=1.5,
    )
    turned = PLAIN._replace(light_angle=np.float32(0.5))
    assert np.abs(levels(draw(bump(), STILL, turned, KEY)) - dent).max() > 10
    np.testing.assert_array_equal(draw(FLAT, STILL, turned, KEY), base)


def test_markers_follow_the_skin_and_come_back_after_one_step_of_the_lattice():
    unit = MARKED._replace(marker_phase=np.array([0.3, 0.1], np.float32))
    rest = optics.render(FLAT, STILL, PITCH, DIGIT, sensors.identity_unit(DIGIT), resolution=SIZE)
    assert rest.shape == (*SIZE, 3)  # a sensor without markers draws none
    ink = Markers(pitch=2.0, radius=0.4)
    x, y = (jnp.asarray(a) for a in np.meshgrid(np.linspace(-5, 5, 101), np.linspace(-5, 5, 101)))
    cover = partial(optics.ink_coverage, ink, phase=jnp.zeros(2), size=1.0, soft=0.05, half=10.0)
    spots = np.asarray(cover(x, y))
    # lattice points at 0 and 2 mm
    assert spots[50, 50] == 1 and spots[50, 60] == 0 and spots[50, 70] == 1
    assert abs(spots.mean() / (np.pi * 0.4**2 / 4) - 1) < 0.2
    # Material that has moved by +0.5 mm is seen 5 samples further right.
    np.testing.assert_allclose(np.asarray(cover(x - 0.5, y))[:, 5:], spots[:, :-5], atol=1e-4)
    dashes = np.asarray(
        optics.ink_coverage(Markers(2.0, 0.3, aspect=2.5), x, y, jnp.zeros(2), 1.0, 0.05, 10.0)
    )
    assert (dashes[50, 40:61] > 0.5).sum() > 2 * (dashes[40:61, 50] > 0.5).sum() - 3
    moved = STILL.at[..., 0].set(0.6)
    assert (
        levels(draw(FLAT, moved, unit, KEY)) != levels(draw(FLAT, STILL, unit, KEY))
    ).mean() > 0.02
    np.testing.assert_array_equal(draw(FLAT, moved, PLAIN, KEY), draw(FLAT, STILL, PLAIN, KEY))


def test_noise_has_the_stated_spread_and_is_a_function_of_the_key():
    unit = PLAIN._replace(noise=np.float32(4))
    clean = levels(draw(FLAT, STILL, PLAIN, KEY))
    noisy = levels(draw(FLAT, STILL, unit, KEY))
    error = (noisy - clean)[(clean > 20) & (clean < 235)]
    assert abs(error.mean()) < 0.2 and abs(error.std() - 4) < 0.2
    np.testing.assert_array_equal(noisy, draw(FLAT, STILL, unit, KEY))
    shown = jax.jit(partial(optics.background, SLIM, unit, resolution=(112, 149)))
    others = [levels(shown(jax.random.key(n)))[..., 0].ravel() for n in range(40)]
    others -= np.mean(others, 0)
    assert np.abs(np.corrcoef(others) - np.eye(40)).max() < 0.07
    planes = (noisy - clean).reshape(-1, 3)
    assert np.abs(np.corrcoef(planes.T) - np.eye(3)).max() < 0.06


def test_the_field_adds_up_to_the_load():
    rng = np.random.default_rng(5)
    pressure = rng.uniform(0, 50, (48, 48))
    traction = rng.normal(0, 9, (48, 48, 2))
    moved = rng.normal(0, 0.1, (48, 48, 2))
    sunk = np.full((48, 48), 0.25)
    pitch = 17.0 / 48
    measured = np.asarray(
        optics.measure_field(*map(jnp.asarray, (sunk, moved, pressure, traction)), pitch)
    )
    assert measured.shape == (20, 20, 6) and measured.dtype == np.float32
    np.testing.assert_allclose(measured[..., 5].sum(), pressure.sum() * pitch**2 * 1e-3, rtol=1e-4)
    np.testing.assert_allclose(
        measured[..., 3:5].sum((0, 1)), traction.sum((0, 1)) * pitch**2 * 1e-3, atol=1e-4
    )
    np.testing.assert_allclose(measured[..., 2], 0.25, rtol=1e-5)
    np.testing.assert_allclose(measured[..., 0].mean(), moved[..., 0].mean(), atol=1e-6)
    corner = np.zeros((48, 48))
    corner[1, 40] = 1.0
    spot = np.asarray(
        optics.measure_field(*map(jnp.asarray, (sunk, moved, corner, traction)), pitch)
    )[..., 5]
    # rows are y, columns x
    assert np.unravel_index(spot.argmax(), spot.shape) == (0, 16)
    with pytest.raises(UserError, match="one size"):
        optics.measure_field(
            jnp.zeros((4, 4)), jnp.zeros((4, 5, 2)), jnp.zeros((4, 4)), jnp.zeros((4, 4, 2)), pitch
        )


def test_the_noise_of_a_field_is_in_mm_and_in_what_the_gel_makes_of_it():
    still = [
        jnp.zeros((48, 48)),
        jnp.zeros((48, 48, 2)),
        jnp.zeros((48, 48)),
        jnp.zeros((48, 48, 2)),
    ]
    noisy = partial(optics.measure_field, *still, 17.0 / 48, noise=0.02, gel=SENSORS["tac3d"].gel)
    seen = np.asarray(noisy(key=jax.random.key(3)))
    newton = 0.02 * 200.0 * 17.0 / 20 * 1e-3
    np.testing.assert_allclose(seen.std((0, 1)), [0.02] * 3 + [newton] * 3, rtol=0.15)
    assert np.abs(seen.mean((0, 1)) / seen.std((0, 1))).max() < 0.2
    assert not np.asarray(noisy()).any() and np.array_equal(noisy(key=jax.random.key(3)), seen)


def test_a_gel_pressed_deeply_all_over_is_no_darker_than_the_deepest_dent_of_the_calibration():
    sensor = SENSORS["gelsight_mini"]
    unit = sensors.identity_unit(sensor)
    draw = jax.jit(lambda d: optics.render(d, None, 0.15, sensor, unit, resolution=(48, 64)))
    images = [
        np.asarray(draw(jnp.full((96, 128), depth))).astype(float) for depth in (0.0, 0.1, 3.0, 6.0)
    ]
    # the rounding of slopes that should be zero
    np.testing.assert_allclose(images[2], images[3], atol=1)
    assert images[3].mean() > 0.4 * images[0].mean() and images[1].mean() != images[0].mean()


def test_the_vignette_darkens_a_dent_as_it_darkens_the_untouched_gel():
    dark = replace(SLIM, vignette=0.8)
    place = optics.pixel_positions(dark, PLAIN, SIZE)

    def change(sensor):
        draw = partial(optics.render, pitch=PITCH, sensor=sensor, unit=PLAIN, resolution=SIZE)
        return levels(draw(bump(7.0, -5.0), None)) - levels(draw(FLAT, None))

    here = 1 - 0.8 * (np.asarray(place.u)[None] ** 2 + np.asarray(place.v)[:, None] ** 2) / 2
    clear = change(replace(SLIM, vignette=0.0))
    dim = change(dark)
    strong = (np.abs(clear) > 30) & (np.abs(clear) < 90)
    assert strong.sum() > 20
    expected = (clear * here[..., None])[strong]
    assert np.median(np.abs(dim[strong] - expected)) < 4 and np.abs(dim - clear)[strong].mean() > 5


def test_dirt_and_the_fixed_pattern_lie_on_every_image_of_a_unit():
    specks = PLAIN.specks.copy()
    specks[0] = [0.5, 0, 0.8, 0.5, 0.5, 0.5]
    dirty = PLAIN._replace(specks=specks, grain=np.array([2, 7], np.float32))
    dirt = levels(draw(FLAT, STILL, dirty, KEY)) - levels(draw(FLAT, STILL, PLAIN, KEY))
    assert (
        dirt[23:25, 47:49].mean() < -20
        and abs(dirt[:, :24].mean()) < 1
        and 1.5 < dirt[:, :24].std() < 2.6
    )
    behind = levels(optics.background(SLIM, dirty, KEY, resolution=SIZE))
    np.testing.assert_allclose(levels(draw(FLAT, STILL, dirty, KEY)), behind, atol=1)
