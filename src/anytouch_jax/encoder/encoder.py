"""Encoders of touch, loaded by name, from a run folder, or from a weights file of any family.

>>> encoder = load_encoder("runs/stage2")
>>> touch = encoder.encode_touch(encoder.preprocess(frame), "digit")
>>> encoder.similarity(touch, ["a soft sponge", "a hard metal edge"], probabilities=True)
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np

from anytouch_jax.encoder.base import (
    Encoder,
    bare_model,
    check_frames,
    precision,
    random_encoder,
    touch_features,
    touch_only,
)
from anytouch_jax.encoder.family import family_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.files import read_arrays
from anytouch_jax.nn.clip import merge_lora
from anytouch_jax.nn.functional import build
from anytouch_jax.weights import load, registry
from anytouch_jax.weights.families import Size, load_family

__all__ = [
    "Encoder", "check_frames", "find_tokenizer", "image_tower_encoder", "load_encoder", "random_encoder",
    "touch_features",
]  # fmt: skip


def load_encoder(
    path: str | Path, *, step: int | None = None, heads: int | None = None, image_size: int | Size | None = None
) -> Encoder:
    """Load an encoder: by name, or of a run folder, a checkpoint folder or a weights file.

    Files of other families are read too (Sparsh, T3, AnyTouch 2, SITR, DINOv2, ViT-MAE, ViT and DeiT). `heads` is
    their number of attention heads, where neither the file nor a config.json beside it has it. `image_size` (a side, or
    height and width) changes the size of their images. Then the result is a `FamilyEncoder`.

    Names are those of `list_encoders`, and addresses hf://user/repo[@revision] on the Hugging Face hub. Weights files
    are .pth, .bin, .safetensors or .npz. `step` chooses a checkpoint of a run, the latest by default. Image and text
    towers are loaded too, if there are any. Raises UserError for weights without a touch encoder, or with values that
    are not finite.
    """
    name, path, names = str(path), registry.locate(path), set[str]()
    if path.suffix == ".npz":
        with suppress(OSError, ValueError):  # the reader of weights reports a damaged file
            names = set(read_arrays(path, only=lambda _: False))
    if {"features", "rows"} <= names:
        raise UserError(f"{path} contains features, not an encoder; pass it to `anytouch probe label --features`")
    model, weights = load_family(path, heads=heads, image_size=image_size)
    if model is not None:
        return family_encoder(model, name, path)
    if heads is not None or image_size is not None:
        raise UserError(f"{name} stores its heads and image size; leave out heads and image_size")
    loaded = load.load_model(path, step=step, weights=weights)
    if "touch" not in loaded.params:
        raise UserError(f"{name} has no touch encoder; give a stage-1 or stage-2 run, or AnyTouch weights")
    others = {name: part for name, part in loaded.params.items() if name != "touch"}
    return Encoder(
        touch_only(loaded.config), {"touch": loaded.params["touch"]}, name, loaded.trained_sensors,
        loaded.universal_drawn, loaded.config.model, others, find_tokenizer(path), loaded.metadata,
    )  # fmt: skip


def find_tokenizer(path: Path) -> Path | None:
    """Return the tokenizer.json of a run, of the run of a checkpoint, or of the folder of a file."""
    is_checkpoint = path.is_dir() and not (path / "config.json").is_file()
    folders = [path, path.parent, path.parent.parent] if is_checkpoint else [path if path.is_dir() else path.parent]
    return next((folder / "tokenizer.json" for folder in folders if (folder / "tokenizer.json").is_file()), None)


def image_tower_encoder(path: str | Path) -> Encoder:
    """Load the image tower of a stage-2 run (LoRA merged) or of CLIP weights as a touch encoder: no tactile training.

    A still gives the tower's embedding of that image, a clip that of its mean frame (the rows CLIP of Tables 1 to 4).
    There are no sensor tokens. Raises UserError without an image tower.
    """
    loaded = load.load_model(path)
    model, params = loaded.config.model, loaded.params
    if model.image is None or "image" not in params:
        raise UserError(f"{path} has no image tower; give a stage-2 run with one, or CLIP weights")
    tower = merge_lora(params, model.lora_alpha)["image"]
    bare = replace(bare_model(model), touch=model.image, sensor_tokens=0, patch_encoder="shared", pre_norm=True)
    with precision(loaded.config):
        fresh = {"touch": build(bare).init(jax.random.key(0))["touch"]}
    touch = load.inflate(fresh, jax.tree.map(np.asarray, tower), divide=True)
    return Encoder(replace(loaded.config, model=bare), touch, f"{path} (image tower)")
