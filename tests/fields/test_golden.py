"""Fields of the example touches as the packaged encoder measured them: a common error of the live
decoder and its ONNX twin would pass where both are only compared with each other.

Weights that are trained again change these numbers. Then run this file as a program, look at the
new ones, and replace them.
"""

import numpy as np
import pytest

import anytouch_jax as at

# (press, sensor): deepest and mean depth in contact in mm, mean shear in contact along x and y in
# mm where the image moves to the right and down by 3 % of its width, force in N
GOLDEN: dict[tuple[str, str], tuple[float, ...]] = {
    ("dots", "digit"): (0.4957, 0.1639, 0.0077, 0.0024, -0.0018, 0.0048, 2.1971),
    ("dots", "gelsight_mini"): (1.1301, 0.6172, 0.0151, 0.0053, -0.0051, 0.0184, 6.1305),
    ("dots", "gelslim"): (0.2997, 0.0783, 0.0024, 0.0009, 0.0148, -0.0093, 1.2016),
    ("ring", "digit"): (0.8859, 0.5453, 0.0120, 0.0141, 0.0044, -0.0158, 4.7514),
    ("ring", "gelsight_mini"): (1.1901, 0.7331, 0.0136, 0.0095, -0.0012, -0.0020, 5.8082),
    ("ring", "gelslim"): (0.4431, 0.2262, 0.0058, 0.0035, 0.0019, -0.0204, 3.4915),
}


def measured(encoder, touch) -> list[float]:
    still = encoder.measure(touch.frame, touch.background, touch.sensor, log=lambda _: None)
    step = round(0.015 * touch.frame.shape[1])
    moved = [np.roll(touch.frame, (step * n, step * n), (0, 1)) for n in range(3)]
    clip = np.stack(moved)[None]
    drag = encoder.measure(clip, touch.background, touch.sensor, log=lambda _: None)
    inside = still.contact[0] > 0.5
    shear = drag.shear[0][drag.contact[0] > 0.5].mean(0)
    depth = still.depth[0]
    return [float(depth.max()), float(depth[inside].mean()), *map(float, shear), *still.force[0]]


@pytest.mark.parametrize("engine", ["xla", "auto"])
def test_the_packaged_encoder_measures_what_it_measured(engine):
    encoder = at.load_encoder("anytouch-tiny", engine=engine)
    touches = at.example_touches()
    assert {(touch.press, touch.sensor) for touch in touches} == GOLDEN.keys()
    for touch in touches:
        wanted = GOLDEN[touch.press, touch.sensor]
        np.testing.assert_allclose(measured(encoder, touch), wanted, rtol=0.01, atol=0.003)


if __name__ == "__main__":
    packaged = at.load_encoder("anytouch-tiny", engine="xla")
    for touch in at.example_touches():
        numbers = ", ".join(f"{value:.4f}" for value in measured(packaged, touch))
        print(f'    ("{touch.press}", "{touch.sensor}"): ({numbers}),')
