"""No tactile pre-training: an image tower used as a touch encoder (the paper's rows CLIP, Tables 1 to 4)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.errors import UserError
from anytouch_jax.nn.attention import usable
from anytouch_jax.nn.functional import build
from anytouch_jax.nn.lora import merge_lora
from anytouch_jax.weights import load


def image_tower_encoder(path: str | Path) -> Encoder:
    """The image tower of a stage-2 run (LoRA merged) or of CLIP weights as an encoder of touches; nothing is trained.

    A still gives exactly the tower's embedding of that image; a clip that of its mean frame. There are no sensor
    tokens. Call it CLIP only where the weights are CLIP's. Raises UserError when there is no image tower.
    """
    loaded = load.load_model(path)
    params, config = loaded.params, loaded.config
    stack = config.model.image
    if stack is None or "image" not in params:
        raise UserError(f"{path} holds no image tower; give a stage-2 run with one, or CLIP weights")
    tower = merge_lora(params, config.model.lora_alpha)["image"]
    bare = replace(
        usable(config.model), touch=stack, sensor_tokens=0, patch_encoder="shared", image=None, text=None,
        match_head="none", lora_rank=0, force_head=False,
    )  # fmt: skip
    fresh = {"touch": build(bare).init(jax.random.key(0))["touch"]}
    touch = load.inflate(fresh, jax.tree.map(np.asarray, tower), divide=True)
    return Encoder(replace(config, model=bare), touch, f"{path} (image tower)")
