"""Weights of PyTorch projects in and out, without importing torch: the authors' AnyTouch, HF CLIP, OpenCLIP.

`read_weights` gives the arrays of a file by its own names, `to_params` a parameter tree, `to_release` the way back.
Every key is accounted for: one error tells how many are unknown, missing or of another shape, and names the first ones.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.config import SENSORS, UNIVERSAL, ModelConfig
from anytouch_jax.weights.detect import (
    BACKGROUND_KEY,
    MODEL_KEY,
    SEEN_KEY,
    detect_layout,
    detect_model,
    model_of,
    told_activation,
)
from anytouch_jax.weights.names import Entry, Layout, entries, is_left_out, unused
from anytouch_jax.weights.resize import resize_position
from anytouch_jax.weights.sensors import RELEASED, match_sensors, seen_by_file, serve_unseen, served
from anytouch_jax.weights.shapes import Shape, param_shapes
from anytouch_jax.weights.tensors import (
    WeightsError,
    as_float32,
    existing,
    read_metadata,
    read_npz,
    read_safetensors,
    write_safetensors,
)
from anytouch_jax.weights.torch_file import read_torch
from anytouch_jax.weights.tree import flatten, nest

__all__ = [
    "BACKGROUND_KEY",
    "MODEL_KEY",
    "RELEASED",
    "SEEN_KEY",
    "WeightsError",
    "clip_to_touch",
    "detect_layout",
    "detect_model",
    "first_params",
    "inflate",
    "match_sensors",
    "model_of",
    "read_metadata",
    "read_weights",
    "release_names",
    "release_shapes",
    "seen_by_file",
    "serve_unseen",
    "served",
    "to_params",
    "to_release",
    "told_activation",
    "write_safetensors",
]

Params = dict[str, Any]
Weights = Mapping[str, np.ndarray]

_SHOWN = 6  # names listed in one error message
_HEAD = frozenset(("head.weight", "head.bias"))


def read_weights(path: str | Path) -> dict[str, np.ndarray]:
    """The arrays of a .safetensors, .npz, .pth, .pt or .bin file by its own names; every float type becomes float32.

    A pickle is read without running any code in it. Raises WeightsError: no such file, truncated, foreign, unsafe.
    """
    path = existing(path)
    if path.suffix == ".safetensors":
        arrays = read_safetensors(path)[0]
    elif path.suffix == ".npz":
        arrays = read_npz(path)
    elif path.suffix in (".pth", ".pt", ".bin"):
        arrays = read_torch(path)
    else:
        raise WeightsError(f"{path} is of unknown type; give a .safetensors, .npz, .pth, .pt or .bin file")
    if words := [name for name, array in arrays.items() if array.dtype.kind in "USOMm"]:
        raise WeightsError(f"{path} holds no weights: {words[0]} is {arrays[words[0]].dtype}, not numbers")
    integers = ("i", "u", "b")
    return {name: array if array.dtype.kind in integers else as_float32(array) for name, array in arrays.items()}


def to_params(weights: Weights, model: ModelConfig, *, ignore: Collection[str] = ()) -> Params:
    """The parameters that a file holds, as a nested dict of float32 arrays under our names.

    The file's layout is detected. Towers and heads that `model` does not have, buffers, the authors' unused arrays
    (golden Q2) and the keys in `ignore` are left out. Position tables of another image size are resized (bicubic, the
    grid only). A probe file gives its classifier as `head`. Raises WeightsError that counts the keys that
    are unknown, missing or of another shape, and names the first of each.
    """
    layout = detect_layout(weights)
    shapes = param_shapes(model)
    wanted = entries(layout, model)
    if layout == "own":  # a file of stage 1 has no towers
        present = {key.split("/")[0] for key in weights}
        wanted = [entry for entry in wanted if entry.name.split("/")[0] in present]
    left_out = {key for key in weights if key in ignore or is_left_out(key, layout, model)}
    head = _HEAD if layout == "probe" and weights.keys() >= _HEAD else frozenset()
    found = {
        key: _fitted(key, weights[key], wanted_, model) for key, wanted_ in _by_key(wanted).items() if key in weights
    }
    _account(layout, weights, found, _file_shapes(wanted, shapes), left_out | head)
    flat: dict[str, Any] = {}
    for entry in wanted:
        array = entry.form.read(_third(found[entry.key], entry.part))
        if entry.layer is None:
            flat[entry.name] = array
        else:
            flat.setdefault(entry.name, {})[entry.layer] = array
    if head:
        flat |= {"head/kernel": weights["head.weight"].T, "head/bias": weights["head.bias"]}
    return nest({name: _assembled(value) for name, value in flat.items()})


def to_release(params: Params, model: ModelConfig, *, allow_extra: bool = False) -> dict[str, np.ndarray]:
    """The parameters under the authors' names: stage 2 when `params` holds a tower, else stage 1.

    The arrays that nothing reads but the authors' loader expects are filled in: the 2-D patch kernel is the
    mean over the frames, the video position table a copy. The paper's matching MLP has no place in those files: it is
    refused, or with `allow_extra` stored as `cross_sensor_mlp.*`. Raises WeightsError.
    """
    flat = {name: as_float32(array) for name, array in flatten(params).items()}
    layout: Layout = "stage2" if "image" in params or "text" in params else "stage1"
    if model.match_head == "mlp" and layout == "stage2" and not allow_extra:
        raise WeightsError(
            "the matching MLP of recipe paper has no counterpart in the authors' files; allow extra keys to store it"
        )
    if model.patch_encoder != "shared":
        own = "one for each" if model.patch_encoder == "sensor" else "convolutions"
        raise WeightsError(f"the authors' files have one patch projection for all sensors; this model has {own}")
    if model.sensors[-1] != UNIVERSAL:
        raise WeightsError(
            f"the authors' files keep the universal tokens in the last row; here it is {model.sensors[-1]!r}"
        )
    shapes = param_shapes(model)
    wanted = entries(layout, model)
    known = {entry.name for entry in wanted}
    _compare("parameters", flat, {name: shapes[name] for name in known})
    arrays = {e.key: e.form.write(flat[e.name] if e.layer is None else flat[e.name][e.layer]) for e in wanted}
    for key, (source, how) in unused(layout).items():
        arrays[key] = arrays[source] if how == "copy" else arrays[source].mean(axis=1, dtype=np.float64)
    return {key: np.array(array, np.float32, order="C") for key, array in arrays.items()}


def release_shapes(model: ModelConfig, layout: Layout | None = None) -> dict[str, Shape]:
    """Key -> shape of a file of `model`: stage 2 when it has a tower, else stage 1, or the layout named.

    The classifier of a probe file is not among them: its size is that of the task.
    """
    layout = layout or ("stage2" if model.image or model.text else "stage1")
    shapes = _file_shapes(entries(layout, model), param_shapes(model))
    for key, (source, how) in unused(layout).items():
        shapes[key] = shapes[source] if how == "copy" else (shapes[source][0], *shapes[source][2:])
    return shapes


def release_names(model: ModelConfig, layout: Layout | None = None) -> dict[str, str]:
    """Key -> our parameter name, for the keys of `release_shapes` that are used."""
    layout = layout or ("stage2" if model.image or model.text else "stage1")
    return {entry.key: entry.name for entry in entries(layout, model)}


def clip_to_touch(weights: Weights, model: ModelConfig, params: Params) -> Params:
    """`params` of either stage with the touch encoder from CLIP's vision tower; the rest stays as it is.

    The 2-D patch kernel is repeated over the frames, as the authors do, not divided by their number (golden Q1): the
    response to a still is then three times CLIP's. Raises WeightsError.
    """
    tower = dataclasses.replace(model, image=model.touch, text=None, match_head="none", lora_rank=0)
    return inflate(params, to_params(weights, tower)["image"])


def first_params(
    params: Params, model: ModelConfig, *, stage1: Params | None = None, clip: Weights | None = None
) -> Params:
    """Fresh `params` of a stage: touch and decoder from `stage1`, the towers and the temperature from CLIP's weights.

    Without `stage1` the touch encoder starts from CLIP's vision tower, as in `clip_to_touch`. LoRA and the matching
    head stay fresh. Entries for parts that `params` lacks are errors. Raises WeightsError.
    """
    merged = dict(params)
    if clip is not None:
        merged = merged if stage1 is not None else clip_to_touch(clip, model, merged)
        towers = to_params(clip, model) if model.image or model.text else {}
        merged = _grafted(merged, {part: towers[part] for part in ("image", "text", "logit_scale") if part in towers})
    if stage1 is not None:
        merged = _grafted(merged, {part: stage1[part] for part in ("touch", "decoder")})
    return merged


def resized(params: Params, patches: int) -> Params:
    """The parameters for pictures of another number of patches: bicubic resize of all tables of positions."""

    def fitted(part: Params) -> Params:
        return part | {"position": resize_position(np.asarray(part["position"]), patches + 1)}

    return {name: fitted(part) if "position" in part and name != "text" else part for name, part in params.items()}


def _by_key(wanted: Sequence[Entry]) -> dict[str, Entry]:
    return {entry.key: entry for entry in wanted}


def _fitted(key: str, array: np.ndarray, entry: Entry, model: ModelConfig) -> np.ndarray:
    """The array in float32, its grid of positions or its sensor rows brought to the model's where they differ."""
    array = as_float32(array)
    if entry.name in ("touch/position", "image/position", "decoder/position"):
        table = array[0] if array.ndim == 3 and len(array) == 1 else array
        square = table.ndim == 2 and round((len(table) - 1) ** 0.5) ** 2 == len(table) - 1 > 0
        if square and len(table) != model.patches + 1:
            return resize_position(table, model.patches + 1).reshape(*array.shape[:-2], model.patches + 1, -1)
    if entry.name == "touch/sensor_tokens" and array.ndim == 3 and len(array) == len(SENSORS) != len(model.sensors):
        return match_sensors(array, SENSORS, model.sensors)
    return array


def _third(array: np.ndarray, part: int | None) -> np.ndarray:
    """Query, key or value out of a kernel that stacks all three on axis 0."""
    return array if part is None else array[part * len(array) // 3 : (part + 1) * len(array) // 3]


def _assembled(value: Any) -> np.ndarray:
    """One parameter, its layers stacked on axis 0; each number is copied once."""
    if not isinstance(value, dict):
        return np.array(value, np.float32, order="C")
    stacked = np.empty((len(value), *value[0].shape), np.float32)
    for layer, array in value.items():
        stacked[layer] = array
    return stacked


def _file_shapes(wanted: Sequence[Entry], shapes: Mapping[str, Shape]) -> dict[str, Shape]:
    """Key -> shape in the file, by writing an array of zeros that takes no memory."""
    found: dict[str, Shape] = {}
    for entry in wanted:
        shape = shapes[entry.name][entry.layer is not None :]
        theirs = entry.form.write(np.broadcast_to(np.float32(0), shape)).shape
        found[entry.key] = theirs if entry.part is None else (3 * theirs[0], *theirs[1:])
    return found


def _account(
    layout: str, weights: Weights, found: Weights, wanted: Mapping[str, Shape], left_out: Collection[str]
) -> None:
    """Raise WeightsError unless the file holds the wanted keys, in the wanted shapes, and nothing else."""
    unknown = [key for key in weights if key not in wanted and key not in left_out]
    missing = [key for key in wanted if key not in weights]
    shapes = [
        f"{key} has {tuple(weights[key].shape)} instead of {wanted[key]}"
        for key, array in found.items()
        if tuple(array.shape) != wanted[key]
    ]
    lists = {"unknown keys": unknown, "missing keys": missing, "other shapes": shapes}
    problems = [f"{title} ({len(rows)}): {_few(rows)}" for title, rows in lists.items() if rows]
    if problems:
        raise WeightsError(
            f"the {layout} weights do not fit this model; {'; '.join(problems)}{_hint(unknown, missing)}"
        )


def _few(rows: Sequence[str]) -> str:
    """The first rows; other sizes alone can be of hundreds of keys."""
    more = len(rows) - _SHOWN
    return ", ".join(rows) if more <= 0 else f"{', '.join(rows[:_SHOWN])} and {more} more"


def _hint(unknown: Sequence[str], missing: Sequence[str]) -> str:
    """Which setting of the model explains a difference in keys, where one does."""
    hints = {
        r".*sensor_token_proj\.weight": "model.decoder_sensor_tokens",
        r".*lora_[AB].*": "model.lora_rank",
        r"cross_sensor_(head|mlp)\..*": "model.match_head",
        r".*\.(layers|resblocks|touch_decoder_blocks)\.\d+\..*": "the depths of the model (or another preset)",
    }
    for pattern, setting in hints.items():
        if any(re.fullmatch(pattern, key) for key in (*unknown, *missing)):
            return f"; look at {setting}"
    return ""


def _compare(what: str, flat: Mapping[str, Any], wanted: Mapping[str, Shape]) -> None:
    """Raise WeightsError that names the first parameters that are missing, unknown or of another shape."""
    problems = [f"{name} is missing" for name in wanted if name not in flat]
    problems += [f"{name} is unknown" for name in flat if name not in wanted]
    problems += [
        f"{name} has {tuple(flat[name].shape)} instead of {shape}"
        for name, shape in wanted.items()
        if name in flat and tuple(flat[name].shape) != tuple(shape)
    ]
    if problems:
        raise WeightsError(f"the {what} do not fit this model: {_few(problems)}")


def _grafted(params: Params, parts: Params) -> Params:
    """`params` with whole parts replaced by others of the same names and shapes."""
    old = flatten({part: params[part] for part in parts if part in params})
    _compare("weights", flatten(parts), {name: tuple(leaf.shape) for name, leaf in old.items()})
    return {**params, **parts}


def inflate(params: Params, image: Params, *, divide: bool = False) -> Params:
    """`params` with the touch encoder from the image tower `image`, see `clip_to_touch`; sensor tokens stay. `divide`
    makes the response to a still the tower's. Raises WeightsError for a touch encoder without such a projection."""
    if set(params["touch"]["patch"]) != {"kernel"}:
        raise WeightsError(
            "an image tower's patch projection has no place in convolutions: leave out --model.patch-encoder "
            "convolutional, or the --clip weights"
        )
    shape = params["touch"]["patch"]["kernel"].shape  # (T, ...), one of them for each sensor where it has its own
    kernel = np.broadcast_to(np.asarray(image["patch"]["kernel"]), shape) / np.float32(shape[-3] if divide else 1)
    touch = {**image, "patch": {"kernel": kernel}, "sensor_tokens": params["touch"]["sensor_tokens"]}
    return _grafted(params, {"touch": touch})
