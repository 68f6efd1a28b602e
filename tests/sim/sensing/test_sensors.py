from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from anytouch_jax import config
from anytouch_jax.sim.sensing import optics, sensors
from anytouch_jax.sim.sensing.sensors import SENSORS

CAMERAS = [name for name, sensor in SENSORS.items() if sensor.kind == "image"]
DIGIT = SENSORS["digit"]


def test_the_records_are_whole_and_known_to_the_model():
    assert set(SENSORS) <= {*config.SENSORS, *config.FIELD_SENSORS}
    for name, sensor in SENSORS.items():
        assert sensor.name == name and hash(sensor) == hash(replace(sensor))
        aspect = sensor.field[0] / sensor.field[1] * sensor.resolution[1] / sensor.resolution[0]
        assert abs(aspect - 1) < 0.02, "square pixels"
        assert (
            sensor.gel.modulus > 0
            and 0 < sensor.gel.thickness < 10
            and 0 < sensor.gel.poisson < 0.5
        )
    assert [s.name for s in SENSORS.values() if s.kind == "field"] == ["tac3d"]


@pytest.mark.parametrize("name", CAMERAS)
def test_an_untouched_gel_is_neither_black_nor_burnt_and_has_colours(name):
    for base in sensors.bases(SENSORS[name]):
        height, width = SENSORS[name].field
        assert base.dtype == np.float32 and base.shape[2] == 3
        assert base.shape[0] / base.shape[1] == pytest.approx(height / width, rel=0.05)
        assert base.min() >= 0.0 and base.max() <= 1.0
        assert 0.2 < base.mean() < 0.7
        assert (base == 1).mean() < 0.01
        assert base.reshape(-1, 3).std(0).min() > 0.01, "every channel varies over the image"


def test_a_digit_shades_as_in_real_images():
    """Real DIGITs show the flank that faces up orange, the one that faces down blue, the right one
    green.
    """
    model = sensors.look(DIGIT)
    middle = jnp.zeros(1)

    def colour(nx, ny):
        tilts = jnp.full((1, 1), nx), jnp.full((1, 1), ny)
        return np.array(
            [
                optics.colour_change(model.normal[..., c], *tilts, middle, middle)[0, 0]
                for c in range(3)
            ]
        )

    up = colour(0, 0.5)
    down = colour(0, -0.5)
    right = colour(-0.5, 0)
    left = colour(0.5, 0)
    assert up[0] > 0.1 > up[1] > 0 > up[2] and up[0] > up[2] + 0.2
    assert down[2] > down[0] + 0.15 and right[1] > left[1] + 0.1
    assert not colour(0, 0).any()


def test_a_unit_follows_from_the_seed_alone():
    first, again, other = (sensors.draw_unit(DIGIT, np.random.default_rng(s)) for s in (3, 3, 4))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    differs = [
        name
        for name, a, b in zip(first._fields, first, other, strict=True)
        if not np.array_equal(a, b)
    ]
    assert set(differs) >= {
        "tint",
        "gain",
        "uneven",
        "thickness",
        "modulus",
        "zoom",
        "rotation",
        "offset",
        "noise",
        "base",
        "focus",
        "specks",
        "grain",
        "lights",
        "quality",
        "marker_pitch",
    }
    streams = [np.random.default_rng(5) for _ in SENSORS]
    for sensor, stream in zip(SENSORS.values(), streams, strict=True):
        sensors.draw_unit(sensor, stream)
    assert len({stream.uniform() for stream in streams}) == 1, "every sensor takes as many draws"


def test_units_stay_inside_the_field_and_carry_markers_by_fraction():
    sensor = SENSORS["gelsight_mini"]
    rng = np.random.default_rng(6)
    drawn = [sensors.draw_unit(sensor, rng) for _ in range(300)]
    for unit in drawn:
        reach = np.abs(unit.window) + unit.zoom * np.array(sensor.field[::-1]) / 2
        assert (reach <= np.array(sensor.field[::-1]) / 2 + 1e-4).all()
        assert set(np.abs(unit.mirror)) == {1}
        assert unit.tint.min() > 0 and unit.modulus > 0 and unit.thickness > 0 and unit.noise > 0
    assert abs(np.mean([u.marked for u in drawn]) - 0.5) < 0.1
    assert not any(sensors.draw_unit(DIGIT, rng).marked for _ in range(20)), (
        "a DIGIT has no markers"
    )
    assert all(a.dtype == np.float32 for a in drawn[0])
    assert np.std([u.base.mean() for u in drawn]) > 0.005, (
        "units are untouched gels of several real ones"
    )
