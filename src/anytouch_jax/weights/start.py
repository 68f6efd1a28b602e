"""First parameters of a run: from another run, the authors' weights, CLIP, or another encoder."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from anytouch_jax.config import Config, ModelConfig
from anytouch_jax.doors import WEIGHTS, enter
from anytouch_jax.errors import UserError
from anytouch_jax.weights import convert, registry
from anytouch_jax.weights.convert import (
    KEYMAPS,
    check_arrays,
    detect_layout,
    map_sensors,
    resize_position,
    to_params,
)
from anytouch_jax.weights.keymaps import Weights
from anytouch_jax.weights.load import (
    RELEASE_SENSORS,
    check_finite,
    clip_activation,
    find_weights_file,
    load_model,
    model_of_file,
    open_family,
    read_weights,
)
from anytouch_jax.weights.safetensors import Loaded
from anytouch_jax.weights.tree import flatten

Params = dict[str, Any]


class InitialParams(NamedTuple):
    """The first parameters of a run, sentences to log, and the sensors that they were trained
    on.
    """

    params: Params
    notes: list[str]
    trained_sensors: tuple[str, ...]


def load_init(
    fresh: Params, config: Config, *, init: str | Path | None = None, clip: str | Path | None = None
) -> InitialParams:
    """Return the first parameters of a run: `fresh` with parts of `init` and `clip` (golden
    K_weight_loading_map).

    Raises UserError if `init` or `clip` does not fit the run.

    Args:
        fresh: parameters of the network before training.
        config: of the run.
        init: a run or a weights file, which gives the touch encoder and the decoder.
        clip: CLIP weights, which give the towers and, without `init`, the touch encoder.
    """
    notes: list[str] = []
    trained: tuple[str, ...] = ()
    stage1 = None
    towers = None
    if init is not None:
        loaded = load_model(init)
        _check_init(loaded, config)
        fresh_parts = set(fresh) - ({"image", "text"} if clip else set())
        notes += _init_notes(loaded, config, fresh_parts)
        stage1 = _fit(loaded, config)
        trained = loaded.trained_sensors or (() if loaded.from_run else RELEASE_SENSORS)
    elif config.stage == 2:
        notes.append(
            "stage 2 starts without --init: its touch encoder has not been trained on touch yet"
        )
    if clip is not None:
        file = find_weights_file(clip)
        trained_by = clip_activation(file)
        convert.check_activation(file, trained_by, config)
        towers = read_weights(file)
        check_finite(file, towers)
        if detect_layout(towers) in ("clip", "openclip"):
            convert.check_clip(file, model_of_file(file, towers), config, touch=init is None)
            if trained_by is None:
                ours, other = sorted(("gelu", "quick_gelu"), key=config.model.activation.__ne__)
                notes.append(
                    f"the activation of {file} is not stored, this run uses {ours}: OpenAI's CLIP "
                    "wants quick_gelu, most others gelu; put the config.json of the weights next "
                    f"to the file, or add --model.activation {other}"
                )
            if init is None and not towers.keys() & {"visual_projection.weight", "visual.proj"}:
                notes.append(
                    f"{file} has no projection: that of the touch encoder starts untrained"
                )
    return InitialParams(
        first_params(fresh, config.model, stage1=stage1, clip=towers), notes, trained
    )


def _check_init(loaded: Loaded, config: Config) -> None:
    """Raise UserError if a run or a file cannot start this run."""
    path = loaded.path
    model = loaded.config.model
    convert.check_activation(
        path, model.activation if loaded.from_run else clip_activation(path), config
    )
    if "touch" not in loaded.params:
        raise UserError(
            f"{path} has no touch encoder; give a run, an encoder by name, or the authors' weights"
        )
    if "decoder" not in loaded.params:  # an encoder of the package: the decoder starts untrained
        ours = config.model
        model = replace(model, decoder=ours.decoder, decoder_norm_eps=ours.decoder_norm_eps)
    convert.check_form(
        path, model, config, preset=loaded.config.preset if loaded.from_run else "custom"
    )


def _init_notes(loaded: Loaded, config: Config, fresh_parts: set[str]) -> list[str]:
    """Return a sentence for everything of `loaded` that this run changes or leaves out."""
    path = loaded.path
    background = loaded.config.data.background
    notes = []
    if background != config.data.background:
        notes.append(
            f"{path} was trained with --data.background {background}, this run with "
            f"{config.data.background}: its encoder was never trained on such touches"
        )
    ours = config.model.sensors
    lost = [
        name
        for name in loaded.config.model.sensors
        if name in (loaded.trained_sensors or ()) and name not in ours
    ]
    if lost:
        option = " ".join((*ours, *lost))
        notes.append(
            f"the tokens of {', '.join(lost)} in {path} are left out; --model.sensors {option} "
            "keeps them"
        )
    has_decoder = "decoder" in loaded.params
    if config.reconstructs and not has_decoder:
        notes.append(f"{path} has no decoder, so the decoder starts untrained")
    if dropped := sorted((fresh_parts & set(loaded.params)) - {*_STARTS}):
        decoder = " and the decoder" * has_decoder
        notes.append(
            f"{path} gives the touch encoder{decoder}; {', '.join(dropped)} start untrained"
        )
    if loaded.config.model.patches != config.model.patches:
        notes.append(
            f"the positions of {path} are resized for images of {config.model.image_size} pixels"
        )
    return notes


_STARTS = ("touch", "decoder", "fields")  # parts that a run takes from the weights it starts from


def _fit(loaded: Loaded, config: Config) -> Params:
    """Return the touch encoder and decoder with this run's positions and sensor rows."""
    parts: Params = {name: loaded.params[name] for name in _STARTS if name in loaded.params}
    rows = config.model.patches + 1
    if loaded.config.model.patches + 1 != rows:
        parts |= {
            name: parts[name]
            | {"position": resize_position(np.asarray(parts[name]["position"]), rows)}
            for name in ("touch", "decoder")
            if name in parts
        }
    if loaded.config.model.fields != config.model.fields:
        parts.pop("fields", None)
    stored = loaded.config.model.sensors
    wanted = config.model.sensors
    touch = map_sensors(
        parts["touch"], config.model, lambda table: convert.match_sensors(table, stored, wanted)
    )
    return parts | {"touch": touch}


def first_params(
    params: Params, model: ModelConfig, *, stage1: Params | None = None, clip: Weights | None = None
) -> Params:
    """Return fresh `params` with touch and decoder from `stage1`, and the towers and the
    temperature from CLIP.

    Without `stage1` the touch encoder starts from CLIP's vision tower. The patch kernel is repeated
    over the frames and not divided, as the authors do (golden Q1): the response to a still is three
    times CLIP's. A tower without a projection leaves that of `params`. Raises WeightsError.

    Args:
        params: fresh ones.
        model: the network.
        stage1: parameters of a stage-1 run, for touch encoder and decoder.
        clip: arrays of CLIP by name, for the towers and the temperature.
    """
    merged = dict(params)
    if clip is not None and stage1 is None:
        tower = replace(model, image=model.touch, text=None, match_head="none", lora_rank=0)
        image = to_params(clip, tower, optional=("image/projection/kernel", "logit_scale"))["image"]
        merged = inflate(merged, {"projection": params["touch"]["projection"], **image})
    if clip is not None and (model.image or model.text):
        towers = to_params(clip, model)
        merged = _replace(
            merged,
            {part: towers[part] for part in ("image", "text", "logit_scale") if part in towers},
        )
    if stage1 is not None:
        merged = _replace(
            merged, {part: stage1[part] for part in _STARTS if part in stage1 and part in merged}
        )
    return merged


def inflate(params: Params, image: Params, *, divide: bool = False) -> Params:
    """Return `params` with the touch encoder of an image tower; with `divide` a still's response
    equals the tower's.
    """
    # (T, ...), or (R, T, ...) with one kernel a sensor
    shape = params["touch"]["patch"]["kernel"].shape
    kernel = np.broadcast_to(np.asarray(image["patch"]["kernel"]), shape) / np.float32(
        shape[-3] if divide else 1
    )
    touch = {
        **image,
        "patch": {"kernel": kernel},
        "sensor_tokens": params["touch"]["sensor_tokens"],
    }
    return _replace(params, {"touch": touch})


def _replace(params: Params, parts: Params) -> Params:
    """Return `params` with whole parts replaced by others of the same names and shapes."""
    before = flatten({part: params[part] for part in parts if part in params})
    check_arrays(
        "weights", flatten(parts), {name: tuple(leaf.shape) for name, leaf in before.items()}
    )
    return {**params, **parts}


def load_start(
    fresh: Params, config: Config, *, init: str | Path | None = None, clip: str | Path | None = None
) -> InitialParams:
    """Return the first parameters of a run, as `load_init`, where `init` may also be an encoder of
    RGB images.

    DINOv2, ViT-MAE, ViT and DeiT start the touch encoder, through the door of other families. CLIP
    weights do so in stage 1, as `clip`. Raises UserError.
    """
    model, weights = (None, None) if init is None else open_family(registry.locate(init))
    if model is not None:
        start = (
            InitialParams(fresh, [], ()) if clip is None else load_init(fresh, config, clip=clip)
        )
        adopt = enter(WEIGHTS["image encoder"])
        touch, notes = adopt(model, str(init), config, start.params["touch"])
        return start._replace(params={**start.params, "touch": touch}, notes=[*start.notes, *notes])
    marks = [KEYMAPS[name].mark for name in ("clip", "openclip")]
    is_clip = any(re.fullmatch(mark, key) for mark in marks for key in weights or ())
    if is_clip and clip is None and config.stage == 1:
        return load_init(fresh, config, clip=init)
    return load_init(fresh, config, init=init, clip=clip)
