"""The tables of sensors are read from one record each, and hold the published numbers."""

from anytouch_jax import config, sensors
from anytouch_jax.config.model import OTHER_SENSORS
from anytouch_jax.data.background.contact import THRESHOLDS
from anytouch_jax.fields.measure import GELS
from anytouch_jax.sim.fitting.fit import NOT_FLAT
from anytouch_jax.sim.sensing.sensors import SENSORS


def test_stored_weights_find_their_rows():
    assert config.SENSORS == (
        "gelsight",
        "digit",
        "gelslim",
        "gelsight_mini",
        "duragel",
        "9dtact",
        "allsight",
        "tacto",
        "taxim",
        "universal",
    )
    assert config.FIELD_SENSORS == ("tac3d",)
    assert {"dtact", "tactip"} <= set(OTHER_SENSORS)


def test_tables_of_other_rooms_have_the_measured_numbers():
    assert GELS == {
        "gelsight": (18.88, 0.75, 150),
        "gelsight_mini": (18.88, 0.75, 180),
        "gelslim": (20.0, 0.75, 220),
        "digit": (14.25, 4 / 3, 120),
        "9dtact": (24.0, 0.75, 120),
        "duragel": (18.7, 0.75, 350),
    }
    assert THRESHOLDS == {"gelsight_mini": 6.5, "gelslim": 6.5, "gelsight": 6.5, "9dtact": 4.0}
    assert set(NOT_FLAT) == {
        "allsight",
        "tactip",
        "taclink",
        "digit360",
        "digit_360",
        "omnitact",
        "insight",
    }


def test_a_simulated_sensor_has_the_size_the_gel_and_the_dots_of_its_record():
    # The order numbers the random streams: another one would change every simulated data set.
    assert list(SENSORS) == [
        "gelsight",
        "gelsight_mini",
        "gelslim",
        "digit",
        "9dtact",
        "duragel",
        "tac3d",
    ]
    for name, sensor in SENSORS.items():
        record = sensors.RECORDS[name]
        assert sensor.field == record.size_mm and sensor.resolution == record.pixels
        assert sensor.gel.modulus == record.modulus_kpa
        assert sensor.gel.thickness == record.thickness_mm
        assert sensor.markers == record.dots and sensor.kind == record.measures
    moduli = {name: sensor.gel.modulus for name, sensor in SENSORS.items()}
    assert moduli == {
        "gelsight": 150.0,
        "gelsight_mini": 180.0,
        "gelslim": 220.0,
        "digit": 120.0,
        "9dtact": 120.0,
        "duragel": 350.0,
        "tac3d": 200.0,
    }
    assert {name: sensor.gel.thickness for name, sensor in SENSORS.items()} == {
        "gelsight": 4.0,
        "gelsight_mini": 4.25,
        "gelslim": 2.0,
        "digit": 2.5,
        "9dtact": 3.0,
        "duragel": 3.0,
        "tac3d": 3.0,
    }
