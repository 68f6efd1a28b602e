"""Touches of your sensor next to known ones: the real world, touches, scorer and clock."""

import jax
import numpy as np
import pytest

from anytouch_jax.sim.endless import SimulatedTouches
from anytouch_jax.sim.fitting import comparison, touches
from anytouch_jax.sim.fitting.touches import COUNT, own_touches, own_world
from anytouch_jax.sim.sensing.own import OwnSensor, write_sensor
from anytouch_jax.sim.sensing.sensors import SENSORS, look

WIDTH, HEIGHT = 30.0, 22.5  # mm: wider than every known sensor
KNOWN = ("digit", "gelsight_mini")


@pytest.fixture(scope="module")
def mine(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own") / "mine.sensor"
    numbers = OwnSensor("mine", WIDTH, HEIGHT, (24, 32), 0.7, sure={})
    gel = np.zeros((1, 30, 40, 3), np.uint8)
    gel[..., 2] = 120  # blue, as no known gel is
    return write_sensor(folder, numbers, gel, look(SENSORS["digit"]))


@pytest.fixture(scope="module")
def worlds(mine):
    """A world of a few objects of each split."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(touches, "OBJECTS", 12)
        return {split: own_world(mine, split, KNOWN) for split in ("train", "test")}


@pytest.fixture(scope="module")
def felt(worlds):
    return jax.device_get(own_touches(jax.random.key(0), worlds["train"], size=28))


def test_the_first_family_is_your_sensor_and_the_splits_fraction_no_object(worlds):
    train, test = worlds["train"], worlds["test"]
    fields = [(HEIGHT, WIDTH), *(SENSORS[name].field for name in KNOWN)]
    for world in (train, test):
        np.testing.assert_allclose(world.families.field, fields, rtol=1e-6)
        blue = np.asarray(world.backgrounds[0, 0]).mean((0, 1))
        assert blue[2] > 0.4 > 0.1 > blue[0]
    reliefs = [{relief.tobytes() for relief in np.asarray(world.relief)} for world in (train, test)]
    assert all(reliefs) and not reliefs[0] & reliefs[1]


def test_each_touch_is_felt_by_a_known_sensor_and_by_yours(felt):
    assert felt.clip.shape == (COUNT, 2, 1, 28, 28, 3)
    assert set(felt.sensor[:, 0]) == {0, 1, 2}, "the first take is by any of them"
    assert not felt.sensor[:, 1].any(), "the second is by yours"
    colour = felt.background.mean((2, 3))
    is_blue = colour[..., 2] > 2 * colour[..., 0]
    np.testing.assert_array_equal(is_blue, felt.sensor == 0)
    assert (felt.width[:, 1] > 0.7 * WIDTH).all() and (felt.width[:, 1] <= WIDTH).all()
    assert (felt.labels["depth"] > 0).all(), "every take shows a press"


def batch_of(by_known):
    """Touches of which the first take is by a known sensor or by yours."""
    sensor = np.stack([by_known, 0 * by_known], 1)
    touched = np.arange(len(by_known))
    return SimulatedTouches(None, None, sensor, touched, None, None, None, None, None, {})


def test_the_score_is_the_fraction_of_touches_whose_nearest_is_the_same_touch():
    """The rivals are those of all batches by a known sensor. Twice by yours does not count."""
    held = [batch_of(np.array([1, 0, 2, 1])), batch_of(np.array([2, 2, 0, 0]))]
    other = np.eye(8, dtype=np.float32).reshape(2, 4, 8)
    own = other.copy()
    own[0, 2] = other[1, 0]  # of another batch: wrong
    own[0, 1] = own[1, 2] = other[0, 0]  # by yours twice: they do not count
    own[1, 1] = 0.9 * other[1, 1] + other[1, 3]  # nearer to a touch that is no rival
    parts = iter(zip(own, other, strict=True))
    found = comparison.found_touches(held, lambda train, one: next(parts), {}).found
    assert found.mean() == pytest.approx(4 / 5)
