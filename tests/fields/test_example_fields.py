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
dots-digit               0.5089     0.1598   -0.00367    0.00688    0.04209      104.2
dots-gelsight_mini        1.086     0.5877    0.00517    0.00544    0.06947      141.7
dots-gelslim             0.2828    0.07358   -0.00149   -0.00087    0.01331      57.86
ring-digit               0.7526     0.4946    0.00749    0.00786    0.06181      91.95
ring-gelsight_mini        1.076     0.6783    0.00603   -0.00545    0.07439      88.91
ring-gelslim             0.4324     0.2193   -0.00181   -0.00871    0.02961      73.52
"""
# mm, N and N mm.
FORCES = """
touch                  centre_x   centre_y    force_x    force_y    force_z     torque
dots-digit             -0.09372    -0.9144   -0.00449    0.00897      2.099    0.03425
dots-gelsight_mini      -0.2454     0.3549   -0.00965    0.02421      5.925   -0.01395
dots-gelslim              1.439     -2.664    0.00821   -0.00819      1.116   -0.01122
ring-digit              -0.2987     -2.229    0.00109   -0.00707      4.478    0.03121
ring-gelsight_mini     -0.05057     -1.451    0.00312   -0.00048      5.497    0.01245
ring-gelslim            0.04805     -1.642   -0.00013   -0.01754      3.494    0.01715
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
