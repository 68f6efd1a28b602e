"""The image tower as touch encoder: the rows CLIP of the paper's Tables 1 to 4."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from anytouch_jax.encoder.base import Encoder, bare_model, precision
from anytouch_jax.errors import UserError
from anytouch_jax.nn.clip import merge_lora
from anytouch_jax.nn.functional import build
from anytouch_jax.weights import load, start


def image_tower_encoder(path: str | Path) -> Encoder:
    """Load the image tower of a stage-2 run (LoRA merged) or of CLIP weights as a touch encoder: no
    tactile training.

    A still gives the tower's embedding of that image, a clip that of its mean frame (the rows CLIP
    of Tables 1 to 4). There are no sensor tokens. Raises UserError without an image tower.
    """
    loaded = load.load_model(path)
    model = loaded.config.model
    params = loaded.params
    if model.image is None or "image" not in params:
        raise UserError(f"{path} has no image tower; give a stage-2 run with one, or CLIP weights")
    tower = merge_lora(params, model.lora_alpha)["image"]
    bare = replace(
        bare_model(model), touch=model.image, sensor_tokens=0, patch_encoder="shared", pre_norm=True
    )
    with precision(loaded.config):
        fresh = {"touch": build(bare).init(jax.random.key(0))["touch"]}
    touch = start.inflate(fresh, jax.tree.map(np.asarray, tower), divide=True)
    return Encoder(replace(loaded.config, model=bare), touch, f"{path} (image tower)")
