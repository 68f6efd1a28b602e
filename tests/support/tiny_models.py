"""The smallest models that have every part, for the tests of all rooms."""

from __future__ import annotations

from dataclasses import replace

from anytouch_jax.config import Config, ModelConfig, Stack, TextTower, preset

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
