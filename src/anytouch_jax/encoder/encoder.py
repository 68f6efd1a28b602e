"""Encoders of touch, loaded by name, from a run folder, or from a weights file of any family.

>>> encoder = load_encoder("runs/stage2")
>>> touch = encoder.encode_touch(encoder.preprocess(frame), "digit")
>>> encoder.similarity(touch, ["a soft sponge", "a hard metal edge"], probabilities=True)
"""

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from anytouch_jax.config import UNIVERSAL, from_json
from anytouch_jax.data.images import decode
from anytouch_jax.encoder.arrays import METADATA, Join, Pooling, check_frames, rows_of_sensors
from anytouch_jax.encoder.base import Encoder, as_clips, random_encoder, touch_features, touch_only
from anytouch_jax.errors import UserError, refuse_forked
from anytouch_jax.export import export
from anytouch_jax.export.engines import Engine, EngineChoice
from anytouch_jax.fields.measure import missing
from anytouch_jax.fields.outputs import FieldOutput
from anytouch_jax.files import read_arrays
from anytouch_jax.shown import shown_short
from anytouch_jax.weights import load, registry
from anytouch_jax.zoo.encoder import family_encoder
from anytouch_jax.zoo.families import Size, load_family

__all__ = [
    "Encoder",
    "EngineEncoder",
    "ExampleTouch",
    "check_frames",
    "example_touches",
    "find_tokenizer",
    "load_encoder",
    "load_engine",
    "random_encoder",
    "touch_features",
]
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
    hub. Weights files are .pth, .bin, .safetensors, .npz or an .onnx of `anytouch export`. `step`
    chooses a checkpoint of a run, the latest by default. Image and text towers are loaded too.
    `engine` computes the features of touch, see `cached_export`: "auto" is onnxruntime on a CPU
    where it is exact, else XLA.

    Files of other families (Sparsh, T3, AnyTouch 2, SITR, DINOv2, DINOv3, SigLIP, ViT-MAE, ViT,
    DeiT) give a `FamilyEncoder`. `heads` is their number of attention heads, where neither the file
    nor a config.json next to it has it. `image_size` (a side, or height and width) changes the size
    of their images. Raises UserError for weights without a touch encoder or with values that are
    not finite, and in a process that cannot use jax.
    """
    refuse_forked()
    name = str(path)
    path = registry.locate(path)
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
    if path.suffix == ".onnx":
        return load_engine(path, None if engine == "auto" else engine)
    if engine not in (known := ("auto", "xla", "onnxruntime", "openvino")):
        raise UserError(f"engine is one of {', '.join(known)}, not {engine!r}")
    model, weights = load_family(path, heads=heads, image_size=image_size)
    if model is not None:
        if engine not in ("auto", "xla"):
            raise UserError(
                f"{name} is an encoder of another family, which XLA computes; leave out {engine}"
            )
        return family_encoder(model, name, path)
    if heads is not None or image_size is not None:
        raise UserError(f"{name} stores its heads and image size; leave out heads and image_size")
    loaded = load.load_model(path, step=step, weights=weights)
    if "touch" not in loaded.params:
        raise UserError(
            f"{name} has no touch encoder; give a stage-1 or stage-2 run, or AnyTouch weights"
        )
    others = {name: part for name, part in loaded.params.items() if name != "touch"}
    encoder = Encoder(
        touch_only(loaded.config),
        {"touch": loaded.params["touch"]},
        name,
        loaded.trained_sensors,
        loaded.universal_drawn,
        loaded.config.model,
        others,
        find_tokenizer(path),
        loaded.metadata,
        engine,
        export.cached_export,
    )
    if engine in ("auto", "xla"):
        return encoder
    return encoder.computed_in("float32")


@dataclass(frozen=True, repr=False)
class EngineEncoder(Encoder):
    """An exported encoder on an engine: for one number of frames and one pooling.

    It has no parameters.
    """

    run: export.Exported = field(kw_only=True, repr=False)

    @cached_property
    def fingerprint(self) -> str:  # that of the encoder it was exported from
        return str(self.run.about["weights"])

    @property
    def contract(self) -> str:
        return str(self.run.about["sha256"])

    @property
    def gels(self) -> dict[str, np.ndarray]:
        return self.run.gels

    @property
    def measures(self) -> bool:
        return "fields" in self.run.about

    def encode_and_measure(
        self, clips: np.ndarray, rows: np.ndarray, aspect: np.ndarray, pooling: Pooling = "class"
    ) -> tuple[np.ndarray, FieldOutput]:
        if not self.measures:
            raise missing(self.source)
        return self.run.measure(clips, rows, aspect)

    def computed_in(self, dtype: Literal["trained", "float32", "bfloat16"]) -> Encoder:
        if dtype == "bfloat16":
            raise UserError(f"{self.source} is computed in float32 or int8; leave out --dtype")
        return self

    def traceable(self, pooling: Pooling = "class", join: Join = "mean") -> Callable[..., Any]:
        raise UserError(
            f"{self.source} has no parameters for jax; name the encoder that it was exported from"
        )

    def encode_touch(
        self,
        frames: Any,
        sensor: str | Sequence[str] | np.ndarray = UNIVERSAL,
        *,
        pooling: Pooling = "class",
        join: Join = "mean",
    ) -> np.ndarray:
        frames = as_clips(frames)
        about = self.run.about
        if pooling != about["pooling"]:
            raise UserError(
                f"{self.source} has pooling {about['pooling']}, not {pooling}; export it again "
                "with that"
            )
        rows = rows_of_sensors(sensor, len(frames), self.sensor_row, len(self.config.model.sensors))
        if len(frames):
            return self.run(frames, rows)
        return np.zeros((0, about["features"]), np.float32)


def load_engine(path: str | Path, engine: Engine | None = None) -> EngineEncoder:
    """Load an ONNX model of `export` as an encoder, on onnxruntime or another engine.

    Raises UserError.
    """
    run = export.load(path, engine)
    if run.about["form"] != "onnx":
        raise UserError(
            f"{path} is for jax alone; call it by anytouch_jax.load_exported, or export it with "
            "--to onnx"
        )
    config = from_json(json.dumps(run.about["config"]))
    trained = run.about.get("trained_sensors")
    sensors = trained and tuple(map(str, trained))
    metadata = {METADATA: run.about.get("fields", {}).get("calibration", {})}
    return EngineEncoder(
        config, {}, str(path), sensors, run.about["universal_drawn"], metadata=metadata, run=run
    )


def find_tokenizer(path: Path) -> Path | None:
    """Return the tokenizer.json of a run, of the run of a checkpoint, or of the folder of a
    file.
    """
    is_checkpoint = path.is_dir() and not (path / "config.json").is_file()
    folders = (
        [path, path.parent, path.parent.parent]
        if is_checkpoint
        else [path if path.is_dir() else path.parent]
    )
    return next(
        (folder / "tokenizer.json" for folder in folders if (folder / "tokenizer.json").is_file()),
        None,
    )


@shown_short
class ExampleTouch(NamedTuple):
    """A touch by one sensor: `frame` and `background` are RGB u8 (h, w, 3), `press` names the
    touched place.
    """

    press: str
    sensor: str
    frame: np.ndarray
    background: np.ndarray


def example_touches() -> list[ExampleTouch]:
    """Return simulated touches: each of a few presses by several sensors.

    They are in the public domain (CC0).
    """
    files = sorted(file for file in FOLDER.glob("*.jpg") if not file.stem.endswith("-background"))
    touches = []
    for file in files:
        press, sensor = file.stem.split("-")
        touches.append(
            ExampleTouch(
                press, sensor, decode(file), decode(file.with_stem(f"{file.stem}-background"))
            )
        )
    return touches
