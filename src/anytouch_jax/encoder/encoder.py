"""Encoders of touch, loaded by name, from a run folder, or from a weights file of any family.

>>> encoder = load_encoder("runs/stage2")
>>> touch = encoder.encode_touch(encoder.preprocess(frame), "digit")
>>> encoder.similarity(touch, ["a soft sponge", "a hard metal edge"], probabilities=True)
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from anytouch_jax.data.images import decode
from anytouch_jax.doors import ENGINES, WEIGHTS, enter
from anytouch_jax.encoder.arrays import ENGINE_CHOICES, Engine, EngineChoice, Pooling, Size
from anytouch_jax.encoder.arrays import check_frames as check_frames
from anytouch_jax.encoder.base import Encoder as Encoder
from anytouch_jax.encoder.base import random_encoder as random_encoder
from anytouch_jax.encoder.base import touch_features as touch_features
from anytouch_jax.encoder.base import touch_only
from anytouch_jax.encoder.interface import TouchEncoder as TouchEncoder
from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.files import read_arrays
from anytouch_jax.shown import shown_short
from anytouch_jax.weights import load, registry

# PRESS-SENSOR.jpg, and PRESS-SENSOR-background.jpg of the untouched gel
FOLDER = Path(__file__).parent / "examples"


def load_encoder(
    path: str | Path,
    *,
    step: int | None = None,
    heads: int | None = None,
    image_size: int | Size | None = None,
    engine: EngineChoice = "auto",
) -> Encoder:
    """Load an encoder: by name, or of a run folder, a checkpoint folder or a weights file.

    Names are those of `list_encoders`, and addresses hf://user/repo[@revision] on the Hugging Face
    hub. Weights files are .pth, .bin, .safetensors, .npz or an .onnx of `anytouch export`. Image
    and text towers are loaded too. Files of other families (Sparsh, T3, AnyTouch 2, SITR, DINOv2,
    DINOv3, SigLIP, ViT-MAE, ViT, DeiT) give a `FamilyEncoder`.

    Args:
        path: the name, address, folder or file.
        step: the checkpoint of a run, the latest by default.
        heads: the number of attention heads of another family, where neither its file nor a
            config.json next to it has it.
        image_size: another size of the images of another family: a side, or height and width.
        engine: what computes the features of touch, see `cached_export`. "auto" is onnxruntime on a
            CPU where it is exact, else XLA.

    Raises:
        UserError: weights without a touch encoder or with values that are not finite, and a process
            that cannot use jax.
    """
    refuse_forked()
    name = str(path)
    path = registry.locate(path)
    _refuse_features(path)
    if path.suffix == ".onnx":
        return load_engine(path, None if engine == "auto" else engine)
    if engine not in ENGINE_CHOICES:
        raise UserError(f"engine is one of {', '.join(ENGINE_CHOICES)}, not {engine!r}")
    model, weights = load.open_family(path, heads=heads, image_size=image_size)
    if model is not None:
        if engine not in ("auto", "xla"):
            raise UserError(
                f"{name} is an encoder of another family, which XLA computes; leave out {engine}"
            )
        of_family: Encoder = enter(WEIGHTS["family encoder"])(model, name, path)
        return of_family
    if heads is not None or image_size is not None:
        raise UserError(f"{name} stores its heads and image size; leave out heads and image_size")
    loaded = load.load_model(path, step=step, weights=weights)
    if "touch" not in loaded.params:
        raise UserError(
            f"{name} has no touch encoder; give a stage-1 or stage-2 run, or AnyTouch weights"
        )
    others = {part: params for part, params in loaded.params.items() if part != "touch"}
    encoder = Encoder(
        touch_only(loaded.config),
        {"touch": loaded.params["touch"]},
        name,
        trained_sensors=loaded.trained_sensors,
        universal_drawn=loaded.universal_drawn,
        whole=loaded.config.model,
        others=others,
        tokenizer_file=find_tokenizer(path),
        metadata=loaded.metadata,
        engine=engine,
        exporter=cached_export,
    )
    if engine in ("auto", "xla"):
        return encoder
    # The other engines compute in float32 only.
    return encoder.computed_in("float32")


def _refuse_features(path: Path) -> None:
    """Raise UserError for an .npz of `anytouch embed`, which is easily taken for weights."""
    names = set[str]()
    if path.suffix == ".npz":
        # the reader of weights reports a damaged file
        with suppress(OSError, ValueError):
            names = set(read_arrays(path, only=lambda _: False))
    if {"features", "rows"} <= names:
        raise UserError(
            f"{path} contains features, not an encoder; pass it to `anytouch probe label "
            "--features`"
        )


def cached_export(encoder: Encoder, frames: int, pooling: Pooling, *, fields: bool = False) -> Any:
    """Return the export of an encoder on its engine, None where XLA computes.

    It goes through the door of engines at the first touch, so that loading an encoder does not load
    them. See `export.export.cached_export`.
    """
    return enter(ENGINES["cached"])(encoder, frames, pooling, fields=fields)


def load_engine(path: str | Path, engine: Engine | None = None) -> Encoder:
    """Load an ONNX model of `export` as an encoder, on onnxruntime or another engine.

    Raises UserError.
    """
    encoder: Encoder = enter(ENGINES["onnx"])(path, engine)
    return encoder


def find_tokenizer(path: Path) -> Path | None:
    """Return the tokenizer.json of a run, or of the folder of a file.

    Of a checkpoint it is that of its run, one or two folders above it.
    """
    if not path.is_dir():
        folders = [path.parent]
    elif (path / "config.json").is_file():
        folders = [path]
    else:
        folders = [path, path.parent, path.parent.parent]
    for folder in folders:
        file = folder / "tokenizer.json"
        if file.is_file():
            return file
    return None


@shown_short
class ExampleTouch(NamedTuple):
    """A touch by one sensor, `frame` and `background` RGB u8 (h, w, 3).

    `press` names the touched place.
    """

    press: str
    sensor: str
    frame: np.ndarray
    background: np.ndarray


def example_touches() -> list[ExampleTouch]:
    """Return simulated touches: each of a few presses by several sensors.

    They are in the public domain (CC0).
    """
    touches = []
    for file in sorted(FOLDER.glob("*.jpg")):
        if file.stem.endswith("-background"):
            continue
        press, sensor = file.stem.split("-")
        background = decode(file.with_stem(f"{file.stem}-background"))
        touches.append(ExampleTouch(press, sensor, decode(file), background))
    return touches
