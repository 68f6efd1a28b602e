"""A user's own sensor: a folder that is taken like the name of a known one, and what is wrong with
a damaged one.
"""

import json

import numpy as np
import pytest

from anytouch_jax.cli.app import main
from anytouch_jax.errors import UserError
from anytouch_jax.sim import endless
from anytouch_jax.sim.scene import Scenes, draw_recording, draw_touch
from anytouch_jax.sim.sensing import own
from anytouch_jax.sim.sensing.own import OwnSensor, find_sensor, write_sensor
from anytouch_jax.sim.sensing.sensors import SENSORS, Markers, bases, draw_unit, look

DOTS = Markers(1.5, 0.3, ink=(0.9, 0.8, 0.7))


@pytest.fixture
def folder(tmp_path):
    gel = np.full((1, 30, 40, 3), 90, np.uint8)
    numbers = OwnSensor("mine", 18.0, 13.5, (240, 320), 0.7, DOTS, sure={"noise": "2 %"})
    return write_sensor(tmp_path / "mine.sensor", numbers, gel, look(SENSORS["digit"]))


def test_it_is_read_as_it_was_written_and_again_when_it_changes(folder):
    sensor = find_sensor(str(folder))
    assert (sensor.name, sensor.field, sensor.noise, sensor.markers) == (
        "mine",
        (13.5, 18.0),
        0.7,
        DOTS,
    )
    np.testing.assert_array_equal(look(sensor).normal, look(SENSORS["digit"]).normal)
    assert (
        bases(sensor)[0, 0, 0, 0] == np.float32(90 / 255)
        and find_sensor("digit") is SENSORS["digit"]
    )
    write_sensor(
        folder,
        own.read_numbers(folder),
        np.full((1, 30, 40, 3), 50, np.uint8),
        look(SENSORS["9dtact"]),
    )
    assert (
        bases(find_sensor(str(folder)))[0, 0, 0, 0] == np.float32(50 / 255)
        and "mine" not in SENSORS
    )


def test_a_fit_goes_over_its_own_numbers_in_any_layout(folder):
    own.check_unedited(folder)
    own.check_unedited(folder.with_name("new.sensor"))
    file = folder / own.NUMBERS
    file.write_text(json.dumps(dict(reversed(json.loads(file.read_text()).items())), indent=8))
    own.check_unedited(folder)


@pytest.mark.parametrize("change", [{"thickness_mm": 2.5}, {"written": None}, "by hand", "more"])
def test_a_fit_loses_no_edit(folder, capsys, change):
    file = folder / own.NUMBERS
    numbers = json.loads(file.read_text())
    if change == "by hand":
        file.write_text(file.read_text() + "}")  # a slip of the editor
    elif change == "more":
        del numbers["written"]  # as an earlier version wrote it
        file.write_text(json.dumps(numbers))
    else:
        file.write_text(json.dumps(numbers | change))
    before = file.read_bytes()
    command = ["sensor", "fit", str(folder), "--name", "mine", "--width-mm", "18", "--out"]
    assert main([*command, str(folder)]) == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "was edited or calibrated" in said and "another --out" in said
    assert file.read_bytes() == before


def test_a_calibration_keeps_the_numbers_that_are_there(folder, capsys):
    before = (folder / own.NUMBERS).read_bytes()
    command = ["sensor", "calibrate", str(folder), "--ball-mm", "6", "--out", str(folder)]
    assert main([*command, "--sensor", "digit"]) == 2
    assert f"further with --sensor {folder}" in capsys.readouterr().err
    assert (folder / own.NUMBERS).read_bytes() == before


def test_one_device_varies_less_than_a_product(folder):
    units = [draw_unit(find_sensor(str(folder)), np.random.default_rng(n)) for n in range(40)]
    family = [draw_unit(SENSORS["digit"], np.random.default_rng(n)) for n in range(40)]
    assert all((unit.mirror == 1).all() and unit.zoom > 0.9 and unit.marked for unit in units)
    assert np.std([unit.gain for unit in units]) < 0.5 * np.std(
        [unit.gain / 1.4 for unit in family]
    )


def test_data_sets_and_worlds_take_it(folder):
    scenes = Scenes(touches=1, sensors=(str(folder), "digit"), objects=4)
    recording = draw_recording(scenes, draw_touch(scenes, 0, ["train"] * 4), str(folder))
    assert recording.unit.base.shape == (30, 40, 3)
    world = endless.make_world(endless.objects_of(scenes)[:1], (str(folder), "digit"))
    np.testing.assert_allclose(world.families.field[0], (13.5, 18.0))
    with pytest.raises(UserError, match="name each sensor once"):
        Scenes(sensors=(str(folder), str(folder) + "/"))


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"width_mm": 400}, "width_mm must be 4 to 40 mm"),
        ({"noise": "much"}, "sensor.noise must be float"),
        ({"name": "digit"}, "digit is a sensor of the table"),
        ({"colour": 1}, "no setting called colour"),
        (None, "is not JSON"),
        ("no arrays", "look.npz"),
        ("other arrays", "the array normal is missing"),
    ],
)
def test_a_damaged_folder_gets_a_sentence(folder, change, named):
    file = folder / own.NUMBERS
    if isinstance(change, dict):
        file.write_text(json.dumps(json.loads(file.read_text()) | change))
    elif change is None:
        file.write_text("{")
    else:
        (folder / own.ARRAYS).unlink()
        if change == "other arrays":
            np.savez(folder / own.ARRAYS, bases=np.zeros((1, 2, 2, 3), np.uint8))
    with pytest.raises(UserError, match=named) as error:
        find_sensor(str(folder))
    assert str(folder) in str(error.value)
    with pytest.raises(UserError, match=r"nothing\.sensor"):
        find_sensor("nothing.sensor")
