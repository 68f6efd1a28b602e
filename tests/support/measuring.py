"""Weights that measure: a tiny network with random parameters."""

import json
from pathlib import Path

import jax
import numpy as np
from tiny_models import touch_model

from anytouch_jax.config import to_json
from anytouch_jax.nn.functional import build
from anytouch_jax.weights import safetensors


def measuring_weights(path: Path, calibration: dict | None = None, *, fields: int = 8) -> Path:
    """Write the weights of a network with `fields` channels, and the calibration of its
    deviations.
    """
    model = touch_model(fields=fields)
    params = build(model).init(jax.random.key(0))
    metadata = {safetensors.MODEL_KEY: to_json(model)}
    metadata |= {safetensors.FIELDS_KEY: json.dumps(calibration)} if calibration else {}
    safetensors.export_safetensors(path, params, metadata)
    return path


def gel(height: int = 48, width: int = 64) -> np.ndarray:
    """Return an even image u8 (height, width, 3) in three colours, with noise."""
    noise = np.random.default_rng(0).integers(0, 6, (height, width, 3))
    return (np.array([90, 110, 140]) + noise).astype(np.uint8)
