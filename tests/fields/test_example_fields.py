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
dots-digit               0.4957     0.1639    0.00204    0.00241    0.04089      111.7
dots-gelsight_mini         1.13     0.6172    0.00881    0.00155    0.06957      139.4
dots-gelslim             0.2997    0.07828   -0.00189   -0.00182    0.01332      62.54
ring-digit               0.8859     0.5453    0.00727    0.01697    0.06472      91.35
ring-gelsight_mini         1.19     0.7331    0.00063   -0.00229    0.07639      89.17
ring-gelslim             0.4431     0.2262   -0.00095   -0.00323    0.02863      76.29
"""
# mm, N and N mm.
FORCES = """
touch                  centre_x   centre_y    force_x    force_y    force_z     torque
dots-digit             -0.07352     -0.968   -0.00176    0.00478      2.197    0.04523
dots-gelsight_mini      -0.2977      0.232   -0.00508    0.01839       6.13   -0.01951
dots-gelslim              1.322     -2.831    0.01483   -0.00931      1.202   -0.00176
ring-digit              -0.2424     -2.374    0.00436   -0.01583      4.751    0.04572
ring-gelsight_mini     -0.05747     -1.493   -0.00117   -0.00201      5.808    0.01058
ring-gelslim            0.07856     -1.626    0.00191   -0.02036      3.492    0.00191
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
