"""Golden values of what `anytouch-tiny` measures on the example touches.

The other tests compare one way of measuring with another. A fault that is common to all would pass
them, and change these. New weights have new values: print `measured` and write them here.
"""

import numpy as np
import pytest

from anytouch_jax.encoder.encoder import example_touches, load_encoder

# mm and mm2. `along` and `down` are the mean shear in contact, `spread` is the root mean square of
# the shear everywhere.
LENGTHS = """
touch                     depth mean_depth      along       down     spread       area
dots-digit               0.5204     0.1554   -0.00877    0.01135     0.0436        101
dots-gelsight_mini        1.056     0.5648   -0.00225    0.00705     0.0708      144.6
dots-gelslim             0.2885     0.0851    0.00327     0.0117     0.0147       52.8
ring-digit               0.7046     0.4498    0.00577    0.00534     0.0598      91.78
ring-gelsight_mini        1.068     0.6856    0.00941    0.00283     0.0749      87.21
ring-gelslim             0.4331     0.2284   -0.00136   -0.00101     0.0305      70.27
"""
# mm, N and N mm.
FORCES = """
touch                  centre_x   centre_y    force_x    force_y    force_z     torque
dots-digit              -0.1307    -0.9736   -0.00478    0.00666        2.1    0.03132
dots-gelsight_mini      -0.2866     0.2781    -0.0103    0.02546      5.778   -0.01761
dots-gelslim              1.503     -2.578    0.00701   -0.01449      1.141   -0.00961
ring-digit               -0.377     -2.101    0.00233   -0.00461      4.231    0.02071
ring-gelsight_mini      -0.1175     -1.381    0.00124     0.0014      5.283    0.00988
ring-gelslim            -0.0711     -1.593    0.00038   -0.00834      3.611    0.01826
"""
RELATIVE, ABSOLUTE = 0.02, 0.0015


def golden():
    """Return the values of each touch by name."""
    rows = {}
    for table in (LENGTHS, FORCES):
        (_, *names), *lines = map(str.split, table.strip().splitlines())
        for touch, *values in lines:
            rows.setdefault(touch, {}).update(zip(names, map(float, values), strict=True))
    return rows


GOLDEN = golden()


@pytest.fixture(scope="module")
def encoder():
    return load_encoder("anytouch-tiny")


def measured(encoder, touch):
    """Return the values of an example touch by name."""
    found = encoder.measure(touch.frame, touch.background, touch.sensor, log=lambda _: None)
    inside = found.contact[0] > 0.5
    depth, shear = found.depth[0], found.shear[0]
    along, down = shear[inside].mean(0)
    return {
        "depth": depth.max(),
        "mean_depth": depth[inside].mean(),
        "along": along,
        "down": down,
        "spread": np.sqrt(np.square(shear).mean()),
        "area": found.area[0],
        "centre_x": found.centre[0, 0],
        "centre_y": found.centre[0, 1],
        "force_x": found.force[0, 0],
        "force_y": found.force[0, 1],
        "force_z": found.force[0, 2],
        "torque": found.torque[0],
    }


@pytest.mark.parametrize("name", GOLDEN)
def test_depth_shear_and_force_of_the_example_touches_are_known(encoder, name):
    (touch,) = (one for one in example_touches() if f"{one.press}-{one.sensor}" == name)
    found = measured(encoder, touch)
    assert found.keys() == GOLDEN[name].keys()
    for number, wanted in GOLDEN[name].items():
        assert found[number] == pytest.approx(wanted, rel=RELATIVE, abs=ABSOLUTE), number


def test_every_example_touch_has_golden_values():
    assert {f"{one.press}-{one.sensor}" for one in example_touches()} == set(GOLDEN)
