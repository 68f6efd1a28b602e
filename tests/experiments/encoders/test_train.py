"""The recipes of the encoders in the package: every option is understood, and each part starts as the card says."""

from __future__ import annotations

import pytest

from anytouch_jax.cli import train
from anytouch_jax.weights.registry import list_encoders, read_card
from experiments.encoders.train import RECIPES


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_is_understood_and_ends_as_its_card(name):
    for folder, stage, steps, _, recipe, share in RECIPES[name]:
        words = ["--stage", str(stage), "--data", "a.parquet", "--run", folder, "--steps", str(steps), *recipe, *share]
        config = train.parse(train.TrainOptions, "train", words).config
        assert config.model.patch_encoder == ("convolutional" if name.endswith("conv") else "shared")
        assert config.data.background == "subtract" and config.data.weights
    card = read_card(name)
    assert (config.stage, config.run.steps, config.model.image_size) == (2, card["steps"], card["image_size"])


def test_every_encoder_in_the_package_has_a_recipe():
    assert list_encoders() == sorted(RECIPES)
