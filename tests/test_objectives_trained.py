from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
from tiny_models import tiny_config
from used_parameters import used_parameters

from anytouch_jax import objectives
from anytouch_jax.batch import AlignBatch, MatchBatch, Stage2Batch, TouchBatch
from anytouch_jax.config import Config, presets
from anytouch_jax.nn.functional import build
from anytouch_jax.train.optim import match_rules
from anytouch_jax.weights.tree import flatten

ROWS = 2


def touches(frames: int) -> TouchBatch:
    return TouchBatch(np.zeros((ROWS, frames, 28, 28, 3), np.uint8), np.zeros(ROWS, np.int32))


def aligned(frames: int, images: int, texts: int) -> AlignBatch:
    text = np.ones((texts, 8), np.int32)
    image = np.zeros((images, 28, 28, 3), np.uint8)
    return AlignBatch(
        *touches(frames)[:2], image, np.arange(images), text, text > 0, np.arange(texts)
    )


def matched(frames: int, head: str) -> MatchBatch:
    one = touches(frames)[:2]
    if head == "cosine":
        return MatchBatch(*one, *one, place=np.arange(ROWS))
    return MatchBatch(*one, *one, *one)


def batches(config: Config, every: bool) -> list:
    """Every kind of batch that the loader makes for a configuration, with and without RGB images
    and captions.

    Not `every`: the fullest and the emptiest alone, where the configuration changes no path of a
    kind.
    """
    if config.stage == 1:
        return [touches(1), touches(4)]
    frames = 4 if config.recipe == "release" else 3
    head = config.model.match_head
    images, texts = (2 if tower else 0 for tower in (config.model.image, config.model.text))
    slots = {(1, 0, 0): 0, (1, images, 0): 0, (frames, 0, texts): 0, (frames, images, texts): 0}
    aligns = [aligned(*counts) for counts in slots]
    matches = [matched(count, head) for count in (1, 3)] if head != "none" else [None, None]
    pairs = [(align, None) for align in aligns] + [
        (aligns[0], matches[1]),
        (aligns[-1], matches[0]),
    ]
    pairs += [(None, matches[0])]
    return [Stage2Batch(*pair) for pair in (pairs if every else [pairs[-2], pairs[0]])]


def check(config: Config, every: bool = True) -> None:
    """Compare the table with the walk through the program of the loss, for every parameter and kind
    of batch.
    """
    net = build(config.model)
    params = net.abstract()
    sizes = {name: leaf.size for name, leaf in flatten(params).items()}
    loss = objectives.stage1_loss if config.stage == 1 else objectives.stage2_loss
    for batch in batches(config, every):
        used = used_parameters(
            partial(loss, net=net, config=config), params, batch, jax.random.key(0), 0.5
        )
        trained = match_rules(objectives.trained_by(batch, config=config), flatten(params))
        # A model without sensor tokens has an empty parameter for them, which the program reads.
        wrong = {
            name for name, value in flatten(used).items() if value != trained[name] and sizes[name]
        }
        assert not wrong, jax.tree.map(np.shape, batch)


PARTS = [{}, {"decoder_sensor_tokens": True}, {"patch_encoder": "sensor"}]
HEADS = [
    ("paper", "mlp"),
    ("paper", "cosine"),
    ("paper", "none"),
    ("release", "linear"),
    ("release", "cosine"),
]
BASELINES = [
    (name, stage) for name, baseline in presets.BASELINES.items() for stage in baseline.stages
]


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("next_frame", [True, False])
def test_stage_1(part, next_frame):
    config = tiny_config(1, **part)
    check(
        replace(
            config, objective=replace(config.objective, next_frame=next_frame, norm_pix_loss=True)
        )
    )


@pytest.mark.parametrize("towers", ["scratch", "pretrained"])
@pytest.mark.parametrize(("recipe", "head"), HEADS)
def test_stage_2(recipe, head, towers):
    config = tiny_config(2, recipe, towers, match_head=head)
    check(
        replace(
            config,
            objective=replace(config.objective, match_keep=0.5 if towers == "pretrained" else 1.0),
        )
    )


@pytest.mark.parametrize(
    "part", [*PARTS[1:], {"remat": True}, {"attention": "mapped"}, {"dtype": "bfloat16"}]
)
def test_parts_of_the_network(part):
    check(tiny_config(2, "release", **part), every=False)


@pytest.mark.parametrize(("name", "stage"), BASELINES)
def test_baselines(name, stage):
    config = presets.apply_baseline(name, tiny_config(stage))
    if name == "anytouch" or config != tiny_config(stage):  # equal configurations are checked once
        check(config, every=False)
