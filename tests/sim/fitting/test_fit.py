"""The fit of a sensor: hidden parameters of simulated devices come back, and unfit images are
refused.
"""

import numpy as np
import pytest
from hidden_sensor import colours_of_dents, hidden_images, true_colours
from press_videos import gel_frame

from anytouch_jax.errors import UserError
from anytouch_jax.sim.fitting.fit import fit_sensor
from anytouch_jax.sim.fitting.touches import separable
from anytouch_jax.sim.sensing.own import find_sensor
from anytouch_jax.sim.sensing.sensors import SENSORS, look


def step_of(markers, half, away):
    """The distance of dots `away` mm from the middle of an image, whose corners are `half` mm
    away.
    """
    return markers.pitch / (1 - markers.bend + markers.bend * (away / half) ** 2)


@pytest.mark.parametrize(
    ("name", "ball_mm", "dots", "noise", "most"),
    [
        ("gelslim", 6.35, 1.0, 1.5, 0.15),
        ("9dtact", 6.35, 0.0, 0.5, 0.15),
        ("gelsight_mini", 6.35, 0.0, 0.6, 0.15),
        ("digit", None, 0.0, 0.5, 0.3),
        ("gelsight_mini", None, 1.0, 1.0, 0.3),
    ],
)
def test_hidden_parameters_of_a_device_are_found(tmp_path, name, ball_mm, dots, noise, most):
    hidden = hidden_images(name, 2, 16, ball_mm=ball_mm, marked=dots, noise=noise)
    fitted = fit_sensor(
        list(hidden.frames), "mine", hidden.width, tmp_path / "mine.sensor", ball_mm=ball_mm
    )
    sensor = find_sensor(str(fitted.folder))
    numbers = fitted.numbers
    assert abs(numbers.noise / noise - 1) < 0.2
    if dots:
        true = SENSORS[name].markers
        grown = float(hidden.unit.marker_pitch)
        own_half, half = (float(np.hypot(*one.field)) / 2 for one in (sensor, SENSORS[name]))
        for away in (0.0, 0.3 * hidden.width, 0.5 * hidden.width):
            wanted = grown * step_of(true, grown * half, away)
            assert abs(step_of(sensor.markers, own_half, away) / wanted - 1) < 0.03
        if name == "gelsight_mini":  # the others are as small as pixels
            assert (
                abs(sensor.markers.radius / (true.radius * float(hidden.unit.marker_size)) - 1)
                < 0.25
            )
    else:
        assert sensor.markers is None
    found = colours_of_dents(look(sensor), sensor.halo)
    true = true_colours(hidden)
    # it shows depth, and no slope
    part = np.s_[2:] if name == "9dtact" else np.s_[:2]
    assert np.linalg.norm((found - true)[part]) < most * np.linalg.norm(true[part])


def images(look="coloured", places=range(-40, 41, 10), depth=0.9, seed=0):
    return [gel_frame(look, depth, "ball", shift, seed + n) for n, shift in enumerate(places)]


GOOD = {"images": images(), "name": "mine", "width_mm": 18.6, "out": "mine.sensor"}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"images": images(depth=0.0)}, "no image shows a press"),
        (
            {"images": images(places=[0] * 6) + images(places=[1] * 3)},
            "no image shows a press|same place",
        ),
        ({"images": images()[:4]}, "4 images are too few"),
        (
            {"images": images() + [np.minimum(one, 225) + 30 for one in images(seed=50)]},
            "another unit",
        ),
        ({"images": [*images(), images()[0][:, :100]]}, "have 2 sizes"),
        ({"width_mm": 0.5}, "the sides of a gel are 4 to 40 mm"),
        ({"width_mm": 120.0}, "4 to 40 mm"),
        ({"ball_mm": 60.0}, "a ball of 60 mm"),
        ({"name": "allsight"}, "is not flat"),
        ({"name": "tac3d"}, "measures a field"),
        ({"name": "digit"}, "sensor of the table"),
        ({"name": "gelsigth"}, "did you mean gelsight"),
        ({"out": "mine"}, r"must end in \.sensor"),
        ({"background": np.zeros((50, 50, 3), np.uint8)}, "other proportions"),
    ],
)
def test_wrong_input_gets_a_sentence(tmp_path, change, named):
    options = GOOD | change
    options["out"] = tmp_path / options["out"]
    with pytest.raises(UserError, match=named) as error:
        fit_sensor(**options)
    assert "\n" not in str(error.value) and not options["out"].exists()


def test_a_round_image_is_of_a_sensor_that_is_not_flat(tmp_path):
    y, x = np.mgrid[:120, :160] - np.array([60, 80])[:, None, None]
    round_ones = [one * (np.hypot(x, y) < 62)[..., None].astype(np.uint8) for one in images()]
    with pytest.raises(UserError, match="not flat"):
        fit_sensor(**GOOD | {"images": round_ones, "out": tmp_path / "mine.sensor"})


def test_the_classifier_sees_a_difference_only_where_there_is_one():
    rng = np.random.default_rng(0)
    one, other, stronger = (
        [rng.normal(0, size, (32, 32, 3)).astype(np.float32) for _ in range(40)]
        for size in (3, 3, 4)
    )
    assert separable(one, other) < 0.7 and separable(one, stronger) > 0.95
