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
    ("dots", "digit"): (0.5204, 0.1554, 0.0011, 0.0159, -0.0048, 0.0067, 2.0998),
    ("dots", "gelsight_mini"): (1.0562, 0.5648, 0.0059, 0.0086, -0.0103, 0.0255, 5.7781),
    ("dots", "gelslim"): (0.2885, 0.0851, 0.0029, 0.0187, 0.0070, -0.0145, 1.1413),
    ("ring", "digit"): (0.7046, 0.4498, 0.0077, 0.0036, 0.0023, -0.0046, 4.2310),
    ("ring", "gelsight_mini"): (1.0684, 0.6856, 0.0222, 0.0140, 0.0012, 0.0014, 5.2832),
    ("ring", "gelslim"): (0.4331, 0.2284, 0.0055, 0.0101, 0.0004, -0.0083, 3.6110),
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
