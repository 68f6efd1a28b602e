"""Configuration records, presets and strict JSON. Nothing here imports jax."""

from anytouch_jax.config.model import (
    FIELD_SENSORS,
    OWN_SENSOR,
    SENSORS,
    UNIVERSAL,
    ModelConfig,
    SpellingError,
    Stack,
    TextTower,
    check_spelling,
)
from anytouch_jax.config.parsing import parse_json, read_value
from anytouch_jax.config.presets import preset
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
    SimulatedConfig,
    Towers,
    from_json,
    to_json,
)
