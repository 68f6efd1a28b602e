"""Presets: named sizes of the network, for each stage and recipe."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from anytouch_jax.config.model import ModelConfig, Stack, TextTower
from anytouch_jax.config.parsing import read_value
from anytouch_jax.config.train import Config, DataConfig, PresetName, Recipe, Towers
from anytouch_jax.errors import ConfigError


def _stack(width: int, depth: int, heads: int) -> Stack:
    return Stack(width, depth, heads, 4 * width)


_PRESETS: dict[str, tuple[ModelConfig, Stack, int]] = {
    "tiny": (
        ModelConfig(112, 14, 128, _stack(192, 6, 6), _stack(128, 2, 4), text=TextTower(_stack(128, 4, 4))),
        _stack(192, 6, 6),
        64,
    ),
    "small": (
        ModelConfig(224, 14, 512, _stack(384, 6, 6), _stack(512, 8, 16), text=TextTower(_stack(384, 6, 6))),
        _stack(384, 6, 6),
        64,
    ),
    "base": (
        ModelConfig(224, 16, 512, _stack(768, 12, 12), _stack(512, 8, 16), text=TextTower(_stack(512, 12, 8))),
        _stack(768, 12, 12),
        256,
    ),
    "large": (
        ModelConfig(224, 14, 768, _stack(1024, 24, 16), _stack(512, 8, 16), text=TextTower(_stack(768, 12, 12))),
        _stack(1024, 24, 16),
        256,
    ),
}


def preset(
    name: PresetName | str,
    *,
    stage: Literal[1, 2] = 1,
    recipe: Recipe = "paper",
    towers: Towers = "scratch",
) -> Config:
    """Return the configuration called `name` (tiny, small, base, large) for a stage and a recipe.

    `large` is the paper's. `towers` matters in stage 2 only: "scratch" trains small image and text towers whole,
    "pretrained" expects CLIP weights, freezes the text tower and adapts the image tower by LoRA. One point of the
    release depends on the machine and is set by hand: negatives stay within a device's 64 rows, so
    `objective.groups` is 4 for a batch of 256. Raises ConfigError for an unknown name or choice.
    """
    if name not in _PRESETS:
        raise ConfigError(f"unknown preset {name!r}. Choose one of {', '.join(_PRESETS)}")
    read_value(Towers, towers, "towers")  # stage 1 has no towers, but a wrong choice is an error there too
    full, image, batch = _PRESETS[name]
    config = Config(
        model=replace(full, text=None),
        stage=stage,
        recipe=recipe,
        preset=name,
        data=DataConfig(batch_size=batch),
    )
    if stage == 2:
        if towers == "none":
            raise ConfigError("stage 2 needs towers. Choose --towers scratch or --towers pretrained.")
        model = replace(
            full,
            image=image,
            match_head="linear" if recipe == "release" else "mlp",
            lora_rank=16 if towers == "pretrained" else 0,
        )
        objective = replace(config.objective, center_embeddings=towers == "scratch" and recipe == "paper")
        config = replace(config, model=model, towers=towers, objective=objective)
    if recipe == "release":
        config = replace(config, optim=replace(config.optim, decay="cosine"), data=replace(config.data, order="random"))
    return config
