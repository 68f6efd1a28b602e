"""Golden values of what `anytouch-tiny` measures on the example touches.

The other tests compare one way of measuring with another. A fault that is common to all, such as
one of the live decoder and its ONNX twin, would pass them, and changes these. Weights that are
trained again change them too: then run this file as a program (with the path of this repository in
PYTHONPATH), look at the new values, and write them here.
"""

import numpy as np
import pytest

import anytouch_jax as at

# mm and mm2. `along` and `down` are the mean shear in contact, `spread` is the root mean square of
# the shear everywhere. `drag_along` and `drag_down` are the mean shear in contact where the image
# moves to the right and down by 3 % of its width.
LENGTHS = """
touch                     depth mean_depth      along       down     spread       area drag_along  drag_down
dots-digit               0.4659     0.1542    0.00204    0.00241    0.04089      111.7    0.00770    0.00241
dots-gelsight_mini        1.062     0.5801    0.00881    0.00155    0.06957      139.4    0.01514    0.00533
dots-gelslim             0.2818    0.07348   -0.00189   -0.00182    0.01332      62.54    0.00245    0.00091
ring-digit               0.8331     0.5128    0.00727    0.01697    0.06472      91.35    0.01202    0.01407
ring-gelsight_mini        1.119     0.6892    0.00063   -0.00229    0.07639      89.17    0.01357    0.00951
ring-gelslim              0.416     0.2128   -0.00095   -0.00323    0.02863      76.29    0.00584    0.00349
"""  # noqa: E501 - a table
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
RELATIVE, ABSOLUTE = 0.01, 0.0015


def golden():
    """Return the values of each touch by name."""
    rows = {}
    for table in (LENGTHS, FORCES):
        (_, *names), *lines = map(str.split, table.strip().splitlines())
        for touch, *values in lines:
            rows.setdefault(touch, {}).update(zip(names, map(float, values), strict=True))
    return rows


GOLDEN = golden()


def name_of(touch):
    return f"{touch.press}-{touch.sensor}"


def measured(encoder, touch):
    """Return the values of an example touch by name, in the order of the tables."""

    def measure(frames):
        return encoder.measure(frames, touch.background, touch.sensor, log=lambda _: None)

    still = measure(touch.frame)
    inside = still.contact[0] > 0.5
    along, down = still.shear[0][inside].mean(0)
    step = round(0.015 * touch.frame.shape[1])
    moved = [np.roll(touch.frame, (step * n, step * n), (0, 1)) for n in range(3)]
    drag = measure(np.stack(moved)[None])
    drag_along, drag_down = drag.shear[0][drag.contact[0] > 0.5].mean(0)
    return {
        "depth": still.depth[0].max(),
        "mean_depth": still.depth[0][inside].mean(),
        "along": along,
        "down": down,
        "spread": np.sqrt(np.square(still.shear[0]).mean()),
        "area": still.area[0],
        "drag_along": drag_along,
        "drag_down": drag_down,
        "centre_x": still.centre[0, 0],
        "centre_y": still.centre[0, 1],
        "force_x": still.force[0, 0],
        "force_y": still.force[0, 1],
        "force_z": still.force[0, 2],
        "torque": still.torque[0],
    }


@pytest.mark.parametrize("engine", ["xla", "auto"])
def test_depth_shear_and_force_of_the_example_touches_are_known(engine):
    encoder = at.load_encoder("anytouch-tiny", engine=engine)
    touches = {name_of(touch): touch for touch in at.example_touches()}
    assert touches.keys() == GOLDEN.keys()
    for name, touch in touches.items():
        found = measured(encoder, touch)
        assert found.keys() == GOLDEN[name].keys()
        for number, wanted in GOLDEN[name].items():
            known = pytest.approx(wanted, rel=RELATIVE, abs=ABSOLUTE)
            assert found[number] == known, f"{number} of {name}"


if __name__ == "__main__":
    packaged = at.load_encoder("anytouch-tiny", engine="xla")
    for example in at.example_touches():
        values = measured(packaged, example)
        print(name_of(example), *(f"{name} {value:.4g}" for name, value in values.items()))
