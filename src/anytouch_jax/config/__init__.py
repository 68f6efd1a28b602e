"""Configuration records, presets and strict JSON. Nothing here imports jax."""

from anytouch_jax.config.model import (
    FIELD_SENSORS,
    SENSORS,
    STEM,
    UNIVERSAL,
    ModelConfig,
    SpellingError,
    Stack,
    TextTower,
    check_spelling,
)
from anytouch_jax.config.presets import preset
from anytouch_jax.config.serialise import from_json, to_json
from anytouch_jax.config.train import (
    CLIP_MEAN,
    CLIP_STD,
    IMAGENET_MEAN,
    IMAGENET_STD,
    RELEASE_WEIGHTS,
    Config,
    DataConfig,
    LossConfig,
    OptimConfig,
    PresetName,
    Recipe,
    RunConfig,
    Towers,
)

__all__ = [
    "CLIP_MEAN",
    "CLIP_STD",
    "FIELD_SENSORS",
    "IMAGENET_MEAN",
    "IMAGENET_STD",
    "RELEASE_WEIGHTS",
    "SENSORS",
    "STEM",
    "UNIVERSAL",
    "Config",
    "DataConfig",
    "LossConfig",
    "ModelConfig",
    "OptimConfig",
    "PresetName",
    "Recipe",
    "RunConfig",
    "SpellingError",
    "Stack",
    "TextTower",
    "Towers",
    "check_spelling",
    "from_json",
    "preset",
    "to_json",
]
