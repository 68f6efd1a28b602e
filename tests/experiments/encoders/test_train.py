import pytest

from anytouch_jax.config import from_json, to_json
from anytouch_jax.nn.functional import build
from anytouch_jax.simulated import SIMULATED
from anytouch_jax.weights.tree import flatten
from experiments.encoders.train import configure


@pytest.mark.parametrize("stage", [1, 2])
def test_a_stage_is_understood(stage):
    config = configure(stage, ["a.csv"], 3, {"data.batch_size": 16})
    assert config.stage == stage and config.run.seed == 3 and config.data.batch_size == 16
    assert config.data.manifests == (SIMULATED, "a.csv") and dict(config.data.weights)[SIMULATED] > 1
    assert config.data.background == "either" and config.model.image_size == 112 and config.model.fields
    assert from_json(to_json(config)) == config
    assert (config.model.match_head == "cosine") == (stage == 2)


def test_the_encoder_and_its_decoder_of_fields_keep_their_size():
    params = build(configure(1, [], 0, {}).model).abstract()
    millions = {name: sum(leaf.size for leaf in flatten(part).values()) / 1e6 for name, part in params.items()}
    assert millions["touch"] < 4 and millions["fields"] < 2
