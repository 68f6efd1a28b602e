from dataclasses import replace

import jax
import numpy as np
import pytest
from pair_world import arrays
from tiny_models import tiny_config

from anytouch_jax.config import Stack
from anytouch_jax.encoder.encoder import random_encoder
from anytouch_jax.weights.tree import flatten
from experiments.translation import training
from experiments.translation.generator import GENERATOR, Fit, Generator, load, save
from experiments.translation.networks import Translation

pytestmark = pytest.mark.slow

X, Y, FIELDS = arrays(24)
ENCODER = random_encoder(tiny_config())
MODEL = ENCODER.config.model
IMAGE = Translation(MODEL, decoder=Stack(16, 1, 2, 32), hidden=16, channels=(4, 8, 8))
FIELD = replace(IMAGE, field=(20, 20, 6))
SENSORS = {"source": "gelsight_mini", "target": "duragel"}


@pytest.fixture(scope="module")
def made() -> Generator:
    return training.fit(ENCODER, X, Y, **SENSORS, options=Fit(steps=2, batch=8), shape=IMAGE)[0]


@pytest.fixture(scope="module")
def regressed() -> Generator:
    options = Fit(steps=2, batch=8)
    return training.fit(ENCODER, X, FIELDS, source="digit", target="tac3d", options=options, shape=FIELD)[0]


def test_frozen_encoders_stay_bit_for_bit(made):
    for name, value in flatten(ENCODER.params).items():
        np.testing.assert_array_equal(flatten(made.params["encoder"])[name], value)


def test_the_state_that_does_best_on_other_objects_is_kept():
    """What is right for the training pairs is wrong for these: the first state is the best, and it is the one kept."""
    options = Fit(steps=40, batch=8, learning_rate=1e-2)
    val = X[:8], FIELDS[:8]
    result, losses = training.fit(None, X[:8], -FIELDS[:8], **SENSORS, val=val, options=options, shape=FIELD)
    reported = [line["val"] for line in losses]
    assert reported[-1] > 1.02 * min(reported) and len(reported) == 20
    np.testing.assert_allclose(training.errors(result, *val).mean(), min(reported), rtol=1e-5)
    empty = X[:0], FIELDS[:0]
    assert "val" not in training.fit(None, X, FIELDS, **SENSORS, val=empty, options=options, shape=FIELD)[1][-1]


def test_a_saved_generator_comes_back_bit_for_bit(made, regressed, tmp_path):
    for one, images in ((made, X), (regressed, X)):
        folder = tmp_path / one.design.target
        save(one, folder)
        assert [file.name for file in folder.iterdir()] == [GENERATOR]
        back = load(folder)
        assert back.design == one.design
        jax.tree.map(np.testing.assert_array_equal, back.params, jax.tree.map(np.asarray, one.params))
        np.testing.assert_array_equal(back(images), one(images))
        assert load(folder / GENERATOR).design == one.design
