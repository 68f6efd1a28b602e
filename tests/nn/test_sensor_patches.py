from dataclasses import replace

import jax
import numpy as np
import pytest
from tiny_models import compiled, full_model, touch_model

from anytouch_jax.nn.functional import build
from anytouch_jax.weights.convert import serve_unseen, to_release
from anytouch_jax.weights.keymaps import param_shapes
from anytouch_jax.weights.safetensors import WeightsError
from anytouch_jax.weights.tree import flatten

RNG = np.random.default_rng(0)
SHARED = touch_model()
OWN = touch_model(patch_encoder="sensor")
CLIP = RNG.standard_normal((3, 3, 28, 28, 3)).astype("f4")


def parameters(model):
    return compiled(model).params


def encode(model, params, clip, sensor):
    return np.asarray(compiled(model).encode_touch(params, clip, np.asarray(sensor, np.int32)))


def test_a_batch_of_one_sensor_trains_its_own_patch_encoder_alone():
    params = parameters(OWN)
    loss = jax.jit(
        jax.grad(
            lambda p, clip, sensor: (compiled(OWN).net.encode_touch(p, clip, sensor) ** 2).sum()
        )
    )
    for clip in (CLIP, CLIP[:, :1]):
        for sensor, used in (([3, 3, 3], [3]), ([0, 9, 0], [0, 9])):
            grad = loss(params, clip, np.asarray(sensor, np.int32))["touch"]["patch"]["kernel"]
            assert np.flatnonzero(np.abs(np.asarray(grad)).max(axis=(1, 2, 3))).tolist() == used


@pytest.mark.parametrize("frames", [1, 3])
def test_equal_kernels_are_a_shared_one(frames):
    params = parameters(SHARED)
    kernel = params["touch"]["patch"]["kernel"]
    each = np.broadcast_to(kernel, (10, *kernel.shape))
    own = params | {"touch": params["touch"] | {"patch": {"kernel": each}}}
    z = encode(OWN, own, CLIP[:, :frames], [0, 4, 9])
    np.testing.assert_allclose(z, encode(SHARED, params, CLIP[:, :frames], [0, 4, 9]), atol=1e-5)


def test_sensors_differ_by_their_patch_encoders_without_tokens():
    model = replace(OWN, sensor_tokens=0)
    z = encode(model, parameters(model), np.repeat(CLIP[:1], 3, axis=0), [0, 3, 3])
    assert np.abs(z[0] - z[1]).max() > 1e-3
    np.testing.assert_allclose(z[1], z[2], atol=1e-6)
    # neither: nothing tells them apart
    model = replace(SHARED, sensor_tokens=0)
    z = encode(model, parameters(model), np.repeat(CLIP[:1], 3, axis=0), [0, 3, 3])
    np.testing.assert_allclose(z[0], z[1], atol=1e-6)


def test_a_row_outside_the_table_is_nan_not_the_last_sensor():
    model = replace(OWN, sensor_tokens=0)
    for outside in (10, -1):
        z = np.asarray(encode(model, parameters(model), CLIP, [0, outside, 3]))
        assert np.isnan(z[1]).all() and np.isfinite(z[[0, 2]]).all()


@pytest.mark.parametrize(
    "model", [OWN, replace(OWN, sensor_tokens=0), full_model(image=None), full_model(text=None)]
)
def test_the_shapes_written_down_are_those_of_the_network(model):
    wanted = {name: tuple(leaf.shape) for name, leaf in flatten(build(model).abstract()).items()}
    assert {name: tuple(shape) for name, shape in param_shapes(model).items()} == wanted


def test_the_authors_files_have_no_place_for_several_patch_encoders():
    with pytest.raises(WeightsError, match="one patch projection for all sensors"):
        to_release(parameters(OWN), OWN)


def touch(model):
    return jax.tree.map(np.asarray, parameters(model)["touch"])


def test_sensors_never_seen_are_served_by_the_universal_row():
    before = touch(OWN)
    after = serve_unseen(before, OWN, ["gelsight", "digit"], universal_drawn=True)
    for a, b in (
        (after["sensor_tokens"], before["sensor_tokens"]),
        (after["patch"]["kernel"], before["patch"]["kernel"]),
    ):
        np.testing.assert_array_equal(a[[0, 1, 9]], b[[0, 1, 9]])
        for row in range(2, 9):
            np.testing.assert_array_equal(a[row], b[9])
    np.testing.assert_array_equal(after["position"], before["position"])
