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
    ("dots", "digit"): (0.5089, 0.1598, 0.0019, 0.0056, -0.0045, 0.0090, 2.0992),
    ("dots", "gelsight_mini"): (1.0857, 0.5877, 0.0103, 0.0035, -0.0096, 0.0242, 5.9254),
    ("dots", "gelslim"): (0.2828, 0.0736, 0.0003, 0.0008, 0.0082, -0.0082, 1.1155),
    ("ring", "digit"): (0.7526, 0.4946, 0.0090, 0.0007, 0.0011, -0.0071, 4.4783),
    ("ring", "gelsight_mini"): (1.0756, 0.6783, 0.0192, 0.0088, 0.0031, -0.0005, 5.4975),
    ("ring", "gelslim"): (0.4324, 0.2193, 0.0045, -0.0005, -0.0001, -0.0175, 3.4941),
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
