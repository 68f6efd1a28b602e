"""Loading of parameters: run folders, checkpoints, weights files, the authors' .pth files and CLIP towers."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from anytouch_jax.config import SENSORS, Config, DataConfig, ModelConfig, from_json, to_json
from anytouch_jax.errors import UserError
from anytouch_jax.weights import checkpoint, compatible
from anytouch_jax.weights.compatible import map_sensors, match_sensors, resize_position, serve_unseen
from anytouch_jax.weights.convert import check_arrays, detect_layout, detect_model, to_params
from anytouch_jax.weights.keymaps import Weights
from anytouch_jax.weights.safetensors import (
    BACKGROUND_KEY,
    MODEL_KEY,
    SEEN_KEY,
    WeightsError,
    as_float32,
    existing_file,
    read_file_metadata,
    read_npz,
    read_safetensors,
)
from anytouch_jax.weights.torch_file import read_torch
from anytouch_jax.weights.tree import flatten

Params = dict[str, Any]

_RELEASE_SENSORS = SENSORS[:5]  # the authors' weights were trained on these, and on the universal tokens
_PATTERNS = ("*.safetensors", "*.bin", "*.pth", "*.pt")


@dataclass(frozen=True)
class Loaded:
    """Parameters from a run or a weights file, with every part it has: touch, decoder, image, text and others.

    Sensors outside `trained_sensors` have the universal row. `trained_sensors` is None if the file does not store it.
    `universal_drawn` is False if training never drew the universal tokens. `config` of a file has its model and its
    background, and defaults elsewhere. `metadata` is that of the checkpoint or the file.
    """

    path: Path
    params: Params = field(repr=False)
    config: Config
    trained_sensors: tuple[str, ...] | None
    universal_drawn: bool
    metadata: Mapping[str, Any]
    from_run: bool

    def export_metadata(self) -> dict[str, str]:
        """Return the metadata of a safetensors file with these parameters."""
        metadata = {"source": str(self.path), MODEL_KEY: to_json(self.config.model)}
        metadata[BACKGROUND_KEY] = self.config.data.background
        if self.trained_sensors is not None and "touch" in self.params:
            metadata[SEEN_KEY] = ",".join(self.trained_sensors)
        return metadata


class Start(NamedTuple):
    """The first parameters of a run, sentences to log, and the sensors that they were trained on."""

    params: Params
    notes: list[str]
    trained_sensors: tuple[str, ...]


def load_model(path: str | Path, *, step: int | None = None, stored_rows: bool = False) -> Loaded:
    """Load a run folder, a checkpoint folder, a weights file or a folder with a .pth file.

    `step` chooses a checkpoint of a run, the latest by default. With `stored_rows` the rows of a file for sensors
    outside its training are unchanged, as a conversion needs them. Raises UserError.
    """
    path = Path(path)
    if not path.exists():
        raise UserError(f"there is no run folder or weights file at {path}; give another path")
    trained: Any
    if path.is_dir() and not any(path.glob("*.pth")):
        params, text, metadata = checkpoint.load_params(path, step)
        config: Config = from_json(text)
        trained = metadata.get("seen")
        drawn, from_run = config.objective.universal_start + config.objective.universal_end > 0, True
    else:
        path = find_weights_file(path)
        weights = read_weights(path)
        model, file_metadata = model_of_file(path, weights), read_file_metadata(path)
        background: Any = file_metadata.get(BACKGROUND_KEY, "keep")
        params, config = to_params(weights, model), Config(model, data=DataConfig(background=background))
        # A run without universal tokens was exported with the mean of its sensors in their place.
        trained, drawn, from_run = trained_sensors(file_metadata, model), True, False
        metadata = dict(file_metadata)
    if trained is not None and "touch" in params and (from_run or not stored_rows):
        params |= {"touch": serve_unseen(params["touch"], config.model, trained, universal_drawn=drawn)}
    return Loaded(path, params, config, None if trained is None else tuple(trained), drawn, metadata, from_run)


def trained_sensors(metadata: Mapping[str, str], model: ModelConfig) -> tuple[str, ...] | None:
    """Return the sensors that a file was trained on: as its metadata says, or the authors' for a file of theirs."""
    if SEEN_KEY in metadata:
        return tuple(metadata[SEEN_KEY].split(","))
    return _RELEASE_SENSORS if MODEL_KEY not in metadata and model.sensors == SENSORS else None


def load_init(
    fresh: Params, config: Config, *, init: str | Path | None = None, clip: str | Path | None = None
) -> Start:
    """Return the first parameters of a run: `fresh` with parts of `init` and `clip` (golden K_weight_loading_map).

    `init`, a run or a weights file, gives the touch encoder and the decoder. `clip`, CLIP weights, gives the towers
    and, without `init`, the touch encoder. Raises UserError if either does not fit the run.
    """
    notes: list[str] = []
    trained: tuple[str, ...] = ()
    stage1, towers = None, None
    if init is not None:
        loaded = load_model(init)
        _check_init(loaded, config)
        fresh_parts = set(fresh) - ({"image", "text"} if clip else set())
        notes += _init_notes(loaded, config, fresh_parts)
        stage1 = _fit(loaded, config)
        trained = loaded.trained_sensors or (() if loaded.from_run else _RELEASE_SENSORS)
    elif config.stage == 2:
        notes.append("stage 2 starts without --init: its touch encoder has not been trained on touch yet")
    if clip is not None:
        file = find_weights_file(Path(clip))
        compatible.check_activation(file, clip_activation(file), config)
        towers = read_weights(file)
        if detect_layout(towers) in ("clip", "openclip"):
            compatible.check_clip(file, detect_model(towers), config, touch=init is None)
    return Start(first_params(fresh, config.model, stage1=stage1, clip=towers), notes, trained)


def _check_init(loaded: Loaded, config: Config) -> None:
    """Raise UserError if a run or a file cannot start this run."""
    path, model = loaded.path, loaded.config.model
    if loaded.from_run:
        compatible.check_preset(path, loaded.config, config)
    compatible.check_activation(path, model.activation if loaded.from_run else clip_activation(path), config)
    if "touch" not in loaded.params or "decoder" not in loaded.params:
        raise UserError(f"{path} has no touch encoder and decoder; give a stage-1 run or the authors' weights")
    # The head counts of a file without our metadata are guesses.
    exact = loaded.from_run or MODEL_KEY in loaded.metadata
    compatible.check_form(path, model, config, (*compatible.SHAPED, *(compatible.SHAPELESS if exact else ())))


def _init_notes(loaded: Loaded, config: Config, fresh_parts: set[str]) -> list[str]:
    """Return a sentence for everything of `loaded` that this run changes or leaves out."""
    path, background, notes = loaded.path, loaded.config.data.background, []
    if background != config.data.background:
        notes.append(
            f"{path} was trained with --data.background {background}, this run with {config.data.background}: its "
            "encoder was never trained on such touches"
        )
    ours = config.model.sensors
    lost = [name for name in loaded.config.model.sensors if name in (loaded.trained_sensors or ()) and name not in ours]
    if lost:
        notes.append(
            f"the tokens of {', '.join(lost)} in {path} are left out; --model.sensors {' '.join((*ours, *lost))} "
            "keeps them"
        )
    if dropped := sorted((fresh_parts & set(loaded.params)) - {"touch", "decoder"}):
        notes.append(f"{path} gives the touch encoder and the decoder; {', '.join(dropped)} start untrained")
    if loaded.config.model.patches != config.model.patches:
        notes.append(f"the positions of {path} are resized for images of {config.model.image_size} pixels")
    return notes


def _fit(loaded: Loaded, config: Config) -> Params:
    """Return the touch encoder and decoder with this run's positions and sensor rows."""
    parts, rows = {name: loaded.params[name] for name in ("touch", "decoder")}, config.model.patches + 1
    if loaded.config.model.patches + 1 != rows:
        parts = {n: p | {"position": resize_position(np.asarray(p["position"]), rows)} for n, p in parts.items()}
    stored, wanted = loaded.config.model.sensors, config.model.sensors
    touch = map_sensors(parts["touch"], config.model, lambda table: match_sensors(table, stored, wanted))
    return parts | {"touch": touch}


def first_params(
    params: Params, model: ModelConfig, *, stage1: Params | None = None, clip: Weights | None = None
) -> Params:
    """Return fresh `params` with touch and decoder from `stage1`, and the towers and the temperature from CLIP.

    Without `stage1` the touch encoder starts from CLIP's vision tower, see `clip_to_touch`. LoRA and the matching
    head stay fresh. Raises WeightsError.
    """
    merged = dict(params)
    if clip is not None:
        merged = merged if stage1 is not None else clip_to_touch(clip, model, merged)
        towers = to_params(clip, model) if model.image or model.text else {}
        merged = _replace(merged, {part: towers[part] for part in ("image", "text", "logit_scale") if part in towers})
    if stage1 is not None:
        merged = _replace(merged, {part: stage1[part] for part in ("touch", "decoder")})
    return merged


def clip_to_touch(weights: Weights, model: ModelConfig, params: Params) -> Params:
    """Return `params` with the touch encoder from CLIP's vision tower.

    The 2-D patch kernel is repeated over the frames, as the authors do, and not divided by their number (golden Q1).
    The response to a still is then three times CLIP's. Raises WeightsError.
    """
    tower = replace(model, image=model.touch, text=None, match_head="none", lora_rank=0)
    return inflate(params, to_params(weights, tower)["image"])


def inflate(params: Params, image: Params, *, divide: bool = False) -> Params:
    """Return `params` with the touch encoder from the image tower `image`; sensor tokens are unchanged.

    The patch kernel is repeated over the frames. With `divide` the response to a still equals the tower's.
    Raises WeightsError for a touch encoder of convolutions.
    """
    if set(params["touch"]["patch"]) != {"kernel"}:
        raise WeightsError(
            "an image tower's patch projection does not fit convolutions: leave out --model.patch-encoder "
            "convolutional, or --clip-weights"
        )
    shape = params["touch"]["patch"]["kernel"].shape  # (T, ...), or (R, T, ...) with one kernel a sensor
    kernel = np.broadcast_to(np.asarray(image["patch"]["kernel"]), shape) / np.float32(shape[-3] if divide else 1)
    touch = {**image, "patch": {"kernel": kernel}, "sensor_tokens": params["touch"]["sensor_tokens"]}
    return _replace(params, {"touch": touch})


def _replace(params: Params, parts: Params) -> Params:
    """Return `params` with whole parts replaced by others of the same names and shapes."""
    before = flatten({part: params[part] for part in parts if part in params})
    check_arrays("weights", flatten(parts), {name: tuple(leaf.shape) for name, leaf in before.items()})
    return {**params, **parts}


def find_weights_file(path: str | Path) -> Path:
    """Return the weights file in a downloaded folder, or the file itself. Raises UserError if there is none."""
    path = Path(path)
    if not path.is_dir():
        return path
    files = [file for pattern in _PATTERNS for file in sorted(path.glob(pattern))]
    if not files:
        raise UserError(f"there are no weights (*.safetensors, *.bin, *.pth) in {path}; give another path")
    return files[0]


def read_weights(path: str | Path) -> dict[str, np.ndarray]:
    """Return the arrays of a .safetensors, .npz, .pth, .pt or .bin file under their names, floats as float32.

    No code in a pickle is run. Raises WeightsError for a missing, truncated, foreign or unsafe file.
    """
    path = existing_file(path)
    if path.suffix == ".safetensors":
        arrays = read_safetensors(path)[0]
    elif path.suffix == ".npz":
        arrays = read_npz(path)
    elif path.suffix in (".pth", ".pt", ".bin"):
        arrays = read_torch(path)
    else:
        raise WeightsError(f"{path} is of unknown type; give a .safetensors, .npz, .pth, .pt or .bin file")
    if words := [name for name, array in arrays.items() if array.dtype.kind in "USOMm"]:
        raise WeightsError(f"{path} has no weights: {words[0]} is {arrays[words[0]].dtype}, not numbers")
    return {name: array if array.dtype.kind in "iub" else as_float32(array) for name, array in arrays.items()}


def model_of_file(path: str | Path, weights: Weights) -> ModelConfig:
    """Return the model of a weights file, from its metadata if it is ours, else from its shapes (`detect_model`).

    The activation of CLIP weights comes from the configuration in their folder. Raises WeightsError.
    """
    if text := read_file_metadata(path).get(MODEL_KEY):
        stored: ModelConfig = from_json(text, ModelConfig)
        return stored
    activation: Any = clip_activation(path) if detect_layout(weights) in ("clip", "openclip") else None
    model = detect_model(weights)
    return model if activation is None else replace(model, activation=activation)


def clip_activation(path: str | Path) -> str | None:
    """Return the activation of weights, which leaves no trace in the arrays; None if it is not stored.

    It stands in the metadata of our files, in HF's config.json, or in OpenCLIP's open_clip_config.json. Raises
    WeightsError for a file that is not JSON, and for an activation that this network does not have.
    """
    path, names = Path(path), set()
    if text := read_file_metadata(path).get(MODEL_KEY):
        return str(from_json(text, ModelConfig).activation)
    towers = _read_json(path.with_name("config.json"))
    for tower in ("text_config", "vision_config"):
        if isinstance(towers.get(tower), dict):
            names.add(towers[tower].get("hidden_act", "quick_gelu"))  # HF's default
    model = _read_json(path.with_name("open_clip_config.json")).get("model_cfg")
    if not names and isinstance(model, dict):
        names.add("quick_gelu" if model.get("quick_gelu") else "gelu")
    if len(names) > 1 or not names <= {"gelu", "quick_gelu"}:
        raise WeightsError(
            f"the configuration in the folder of {path} names the activation {' and '.join(sorted(map(str, names)))}; "
            "give CLIP weights of which both towers use gelu, or both quick_gelu"
        )
    return next(iter(names), None)


def _read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file, {} if there is no file. Raises WeightsError."""
    if not path.is_file():
        return {}
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        raise WeightsError(f"{path} is not JSON; correct it, or move the weights to a folder without it") from None
    return value if isinstance(value, dict) else {}
