"""The smallest models that have every part, for the tests of all rooms."""

from dataclasses import replace
from functools import cache
from typing import Any

import jax

from anytouch_jax.config import Config, ModelConfig, Stack, TextTower, preset
from anytouch_jax.nn.functional import Net, build

STACK = Stack(16, 2, 2, 32)
TEXT = TextTower(Stack(16, 2, 2, 32), vocab=50, length=8)


def touch_model(**changes) -> ModelConfig:
    """Touch encoder and decoder: 28 pixels, 4 patches a side of 7, width 16."""
    return replace(ModelConfig(28, 7, 12, STACK, Stack(8, 1, 2, 16)), **changes)


def full_model(**changes) -> ModelConfig:
    """With both towers and an MLP matching head."""
    return replace(touch_model(), **({"image": STACK, "text": TEXT, "match_head": "mlp"} | changes))


def tiny_config(stage: int = 1, recipe: str = "paper", towers: str = "scratch", **model) -> Config:
    """A preset's recipe on a tiny model."""
    config = preset("tiny", stage=stage, recipe=recipe, towers=towers)
    if stage == 1:
        return replace(config, model=touch_model(**model))
    head = {"match_head": "linear" if recipe == "release" else "mlp"}
    rank = {"lora_rank": 2} if towers == "pretrained" else {}
    return replace(config, model=full_model(**(head | rank | model)))


class Compiled:
    """The methods of a network, each under one `jax.jit`: outside of it every operation is a
    program for itself.
    """

    def __init__(self, net: Net) -> None:
        self.net = net
        self.bind = net.bind
        self.abstract = net.abstract
        self.params = net.init(jax.random.key(0))

    @cache  # noqa: B019  of the few networks of a module
    def __getattr__(self, name: str) -> Any:
        static = {
            "encode_touch": "aggregation",
            "encode_poolings": "aggregation",
            "reconstruct": "frames",
        }.get(name)
        return jax.jit(getattr(self.net, name), static_argnames=static)


@cache
def compiled(model: ModelConfig) -> Compiled:
    """The network of a model, made once in a process, and its first parameters."""
    return Compiled(build(model))
