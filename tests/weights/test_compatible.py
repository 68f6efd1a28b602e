import numpy as np
import pytest
from tiny_models import tiny_config

from anytouch_jax.config import UNIVERSAL
from anytouch_jax.weights.compatible import match_sensors, resize_position, serve_unseen

# torch.nn.functional.interpolate(mode="bicubic", align_corners=False) of arange(9)**2 % 7 as a 3 x 3 image
UP = [
    [-0.220484018, 0.204530478, 2.152891397, 4.220484257],
    [1.355409384, 1.418546438, 2.801180124, 4.506895065],
    [1.893125772, 1.390535593, 1.888761282, 3.028749228],
    [1.005151987, 0.140684366, 0.073182821, 0.851293325],
]
DOWN = [[0.572738647, 3.497573853], [1.071792603, 1.381332397]]


@pytest.mark.parametrize("expected", [UP, DOWN])
def test_equal_to_torch(expected):
    table = np.concatenate([[[100.0, -100.0]], np.stack([np.arange(9) ** 2 % 7, -(np.arange(9) ** 2 % 7)], 1)])
    flat = np.ravel(expected)
    resized = resize_position(table.astype("f4"), 1 + len(flat))
    assert resized.dtype == np.float32
    np.testing.assert_array_equal(resized[0], table[0])  # the class token's row
    np.testing.assert_allclose(resized[1:], np.stack([flat, -flat], 1), atol=1e-6)


def test_rows_of_sensors_go_by_name():
    table = np.arange(6.0).reshape(3, 2)
    stored, wanted = ("digit", "gelsight", UNIVERSAL), ("gelsight", "my_gel", UNIVERSAL, "digit")
    np.testing.assert_array_equal(match_sensors(table, stored, wanted), table[[1, 2, 2, 0]])


@pytest.mark.parametrize("drawn", [True, False])
def test_sensors_outside_training_get_the_universal_row_or_the_mean(drawn):
    model = tiny_config().model
    table = np.random.default_rng(0).normal(size=(len(model.sensors), 2, 3))
    served = serve_unseen({"sensor_tokens": table}, model, ["digit", "gelsight"], universal_drawn=drawn)
    rows = [model.sensors.index(name) for name in ("gelsight", "digit")]
    expected = np.broadcast_to(table[model.universal_row] if drawn else table[rows].mean(0), table.shape).copy()
    expected[rows] = table[rows]
    np.testing.assert_allclose(served["sensor_tokens"], expected, atol=1e-12)
