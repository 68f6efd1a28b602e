import jax
import numpy as np
import pytest
from tiny_models import compiled, full_model, touch_model

from anytouch_jax.config import preset
from anytouch_jax.nn.functional import build


def test_abstract_has_the_shapes_of_init_and_allocates_nothing():
    net = build(full_model(lora_rank=2))
    real, abstract = net.init(jax.random.key(0)), net.abstract()
    assert jax.tree.map(lambda x: (x.shape, x.dtype), real) == jax.tree.map(lambda x: (x.shape, x.dtype), abstract)
    large = build(preset("large", stage=2, recipe="release", towers="pretrained").model).abstract()
    assert sum(np.prod(leaf.shape) for leaf in jax.tree.leaves(large)) > 7.5e8


def test_parameters_have_the_floats_of_the_context_whatever_was_built_before():
    net = build(touch_model(embed=5))
    for wide, expected in ((True, "float64"), (False, "float32"), (True, "float64")):
        with jax.enable_x64(wide):
            params = net.init(jax.random.key(0))
        assert {str(leaf.dtype) for leaf in jax.tree.leaves(params)} == {expected}


def test_first_values():
    net = build(full_model(lora_rank=2))
    a, b, c = (net.init(jax.random.key(seed)) for seed in (0, 0, 1))
    jax.tree.map(np.testing.assert_array_equal, a, b)
    assert not np.array_equal(a["touch"]["patch"]["kernel"], c["touch"]["patch"]["kernel"])
    np.testing.assert_allclose(a["logit_scale"], np.log(1 / 0.07), rtol=1e-6)
    assert not np.asarray(a["lora"]["query"]["b"]).any() and np.asarray(a["lora"]["query"]["a"]).any()
    assert (np.asarray(a["touch"]["pre_norm"]["scale"]) == 1).all()
    assert abs(np.std(a["touch"]["sensor_tokens"]) - 0.02) < 0.002
    # blocks of a stack and equal layers of different names start apart
    kernel = np.asarray(a["touch"]["blocks"]["attention"]["query"]["kernel"])
    assert not np.array_equal(kernel[0], kernel[1])
    assert not np.array_equal(kernel, a["touch"]["blocks"]["attention"]["key"]["kernel"])


def test_parts_left_out_do_not_exist():
    assert set(build(touch_model()).abstract()) == {"touch", "decoder"}
    with pytest.raises(AttributeError):
        compiled(touch_model()).encode_image(compiled(touch_model()).params, np.zeros((1, 28, 28, 3)))
