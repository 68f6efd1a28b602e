"""The depth of the decoder is the integral of the gradient that it predicts."""

import jax
import numpy as np
import pytest
from tiny_models import touch_model

from anytouch_jax.fields.older import with_gradient
from anytouch_jax.fields.outputs import LENGTH, STATES
from anytouch_jax.fields.poisson import differences, integrate
from anytouch_jax.nn.functional import build
from anytouch_jax.weights.tree import flatten, nest


@pytest.fixture(scope="module")
def decoded():
    """Return parameters of a decoder, and a function of them that gives fields and gradient."""
    model = touch_model(fields=8)
    net = build(model)
    rng = np.random.default_rng(0)
    side = model.image_size
    tokens = 1 + model.sensor_tokens + (side // model.patch) ** 2
    states = rng.normal(size=(2, tokens, STATES * model.touch.width)).astype(np.float32)
    clip = rng.normal(size=(2, 1, side, side, 3)).astype(np.float32)
    aspect = np.zeros(2, np.float32)

    @jax.jit
    def run(params):
        return net.bind({"fields": params}).fields.with_slope(states, clip, aspect)

    return net.init(jax.random.key(1))["fields"], run


def test_the_gradient_of_the_depth_is_the_nearest_to_what_is_predicted(decoded):
    params, run = decoded
    out, slope = run(params)
    own = np.asarray(differences(out.depth / LENGTH))
    nearest = np.asarray(differences(integrate(slope.values)))
    np.testing.assert_allclose(own, nearest, atol=1e-4)


def test_weights_of_depth_itself_give_the_same_depth(decoded):
    params, run = decoded
    flat = {f"fields/{name}": np.asarray(x) for name, x in flatten(params).items()}
    new = ("fields/slope/", "fields/press/")
    older = {name: x for name, x in flat.items() if not name.startswith(new)}
    assert older.keys() != flat.keys()
    completed = with_gradient(older)
    assert completed.keys() == flat.keys()
    out, slope = run(nest(completed)["fields"])
    # What was predicted had a surface, so nothing is lost by the integral.
    own = np.asarray(differences(out.depth / LENGTH))
    np.testing.assert_allclose(own[:, :, :-1, 0], slope.values[:, :, :-1, 0], atol=1e-4)
    np.testing.assert_allclose(own[:, :-1, :, 1], slope.values[:, :-1, :, 1], atol=1e-4)
    assert np.ptp(out.depth) > 0


def test_weights_that_have_a_gradient_are_left_alone(decoded):
    flat = {f"fields/{name}": np.asarray(x) for name, x in flatten(decoded[0]).items()}
    for name, values in with_gradient(flat).items():
        assert values is flat[name]
