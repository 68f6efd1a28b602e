"""Presets: named sizes of the network, for each stage and recipe."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from anytouch_jax.config.model import ModelConfig, Stack, TextTower
from anytouch_jax.config.parsing import read_value
from anytouch_jax.config.train import Config, DataConfig, PresetName, Recipe, Towers
from anytouch_jax.errors import ConfigError

# name -> pixels, patch, embedding; (width, blocks, heads) of touch encoder and image tower, of decoder, of text tower;
# batch
_PRESETS = {
    "tiny": (112, 14, 128, (192, 6, 6), (128, 2, 4), (128, 4, 4), 64),
    "small": (224, 14, 512, (384, 6, 6), (512, 8, 16), (384, 6, 6), 64),
    "base": (224, 16, 512, (768, 12, 12), (512, 8, 16), (512, 12, 8), 256),
    "large": (224, 14, 768, (1024, 24, 16), (512, 8, 16), (768, 12, 12), 256),
}


def preset(
    name: PresetName | str, *, stage: Literal[1, 2] = 1, recipe: Recipe = "paper", towers: Towers = "scratch"
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
    pixels, patch, embed, *sizes, batch = _PRESETS[name]
    touch, decoder, text = (Stack(width, depth, heads, 4 * width) for width, depth, heads in sizes)
    model = ModelConfig(pixels, patch, embed, touch, decoder)
    config = Config(model, stage, recipe, preset=name, data=DataConfig(batch_size=batch))
    if stage == 2:
        if towers == "none":
            raise ConfigError("stage 2 needs towers. Choose --towers scratch or --towers pretrained.")
        model = replace(model, image=touch, text=TextTower(text), lora_rank=16 if towers == "pretrained" else 0)
        model = replace(model, match_head="linear" if recipe == "release" else "mlp")
        config = replace(config, model=model, towers=towers)
        config = config.with_settings({"objective.center_embeddings": towers == "scratch" and recipe == "paper"})
    if recipe == "release":
        config = config.with_settings({"optim.decay": "cosine", "data.order": "random"})
    return config
