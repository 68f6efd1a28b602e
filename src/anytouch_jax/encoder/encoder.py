"""Encoders of touch, loaded by name, from a run folder, or from a weights file of any family.

>>> encoder = load_encoder("runs/stage2")
>>> touch = encoder.encode_touch(encoder.preprocess(frame), "digit")
>>> encoder.similarity(touch, ["a soft sponge", "a hard metal edge"], probabilities=True)
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from anytouch_jax.data.images import decode
from anytouch_jax.encoder.base import Encoder, check_frames, random_encoder, touch_features, touch_only
from anytouch_jax.encoder.family import family_encoder
from anytouch_jax.errors import UserError
from anytouch_jax.files import read_arrays
from anytouch_jax.weights import load, registry
from anytouch_jax.weights.families import Size, load_family

__all__ = [
    "Encoder", "ExampleTouch", "check_frames", "example_touches", "find_tokenizer", "load_encoder", "random_encoder",
    "touch_features",
]  # fmt: skip
FOLDER = Path(__file__).parent / "examples"  # PRESS-SENSOR.jpg, and PRESS-SENSOR-background.jpg of the untouched gel


def load_encoder(
    path: str | Path, *, step: int | None = None, heads: int | None = None, image_size: int | Size | None = None
) -> Encoder:
    """Load an encoder: by name, or of a run folder, a checkpoint folder or a weights file.

    Files of other families are read too (Sparsh, T3, AnyTouch 2, SITR, DINOv2, ViT-MAE, ViT and DeiT). `heads` is
    their number of attention heads, where neither the file nor a config.json next to it has it. `image_size` (a side,
    or height and width) changes the size of their images. Then the result is a `FamilyEncoder`.

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


class ExampleTouch(NamedTuple):
    """A touch by one sensor: `frame` and `background` are RGB u8 (h, w, 3), `press` names the touched place."""

    press: str
    sensor: str
    frame: np.ndarray
    background: np.ndarray


def example_touches() -> list[ExampleTouch]:
    """Return simulated touches: each of a few presses by several sensors. They are in the public domain (CC0)."""
    files = sorted(file for file in FOLDER.glob("*.jpg") if not file.stem.endswith("-background"))
    touches = []
    for file in files:
        press, sensor = file.stem.split("-")
        touches.append(ExampleTouch(press, sensor, decode(file), decode(file.with_stem(f"{file.stem}-background"))))
    return touches
