"""Preprocessing that timm (config.json) or Hugging Face (preprocessor_config.json) states in a file next to weights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_FILTERS = ("nearest", "lanczos", "bilinear", "bicubic", "box", "hamming")  # by Pillow's numbers
_HF_STEPS = {"do_resize", "do_center_crop", "do_rescale", "do_normalize", "do_convert_rgb"}
_HF_VALUES = {"size", "crop_size", "resample", "rescale_factor", "image_mean", "image_std", "image_processor_type",
              "feature_extractor_type", "processor_class", "_valid_processor_keys", "data_format", "input_data_format",
              "return_tensors", "device", "default_to_square", "disable_grouping"}  # fmt: skip
_TIMM = ("mean", "std", "interpolation", "crop_pct", "crop_mode", "input_size")


def stated_steps(config: Mapping[str, Any], theirs: Mapping[str, Any]) -> tuple[dict[str, Any], Any, list[str]]:
    """Return changes of a Preparation, the (height, width) of the input or None, and sentences about what is ignored.

    `config` is a config.json and `theirs` a preprocessor_config.json, {} if there is none; the latter goes first.
    """
    if theirs:
        return _hugging_face(theirs)
    timm = config.get("pretrained_cfg", config if "architecture" in config else None)
    return _timm(timm) if isinstance(timm, Mapping) and timm.keys() & {*_TIMM} else ({}, None, [])


def _timm(stated: Mapping[str, Any]) -> tuple[dict[str, Any], Any, list[str]]:
    changes: dict[str, Any] = {key: stated[key] for key in ("mean", "std") if key in stated}
    size, ignored = _size(list(stated.get("input_size", ()))[1:]), list[str]()
    _add_filter(changes, stated.get("interpolation"), ignored)
    share, mode = stated.get("crop_pct", 1.0), stated.get("crop_mode", "center")
    if size is not None and isinstance(share, int | float) and 0 < share <= 1:
        if mode == "center":
            changes |= {"crop": "centre", "shorter": int(max(size) / share)}
        elif mode == "squash" and share == 1:
            changes |= {"crop": "none", "shorter": None}
        else:
            ignored.append(f"crop_mode {mode} with crop_pct {share}")
    elif "crop_pct" in stated:
        ignored.append(f"crop_pct {share}")
    return changes, size, ignored


def _hugging_face(stated: Mapping[str, Any]) -> tuple[dict[str, Any], Any, list[str]]:
    changes: dict[str, Any] = {}
    known = {*_HF_STEPS, *_HF_VALUES}
    ignored = [f"{name} {str(value)[:40]}" for name, value in stated.items()
               if name not in known and value not in (None, False)]  # fmt: skip
    does = {name: stated.get(name, name != "do_center_crop" or "crop_size" in stated) for name in _HF_STEPS}
    _add_filter(changes, stated.get("resample"), ignored)
    resized, cropped = stated.get("size"), _size(stated.get("crop_size"))
    edge = resized.get("shortest_edge") if isinstance(resized, Mapping) else None
    if edge is None and type(resized) is int and does["do_center_crop"]:
        edge = resized
    whole = None if edge is not None else _size(resized)
    size = cropped if does["do_center_crop"] and cropped else whole
    if not does["do_resize"]:
        ignored.append("do_resize false")
    elif does["do_center_crop"] and cropped and type(edge) is int:
        changes |= {"crop": "centre", "shorter": edge}
    elif whole is not None and (not does["do_center_crop"] or cropped in (None, whole)):
        changes |= {"crop": "none", "shorter": None}
    elif resized is not None:
        ignored.append(f"size {resized} with crop_size {stated.get('crop_size')}")
    scale = 1.0  # of the values 0 to 1 that are normalised here
    if not does["do_rescale"]:
        scale = 255.0
    elif isinstance(factor := stated.get("rescale_factor", 1 / 255), int | float) and factor > 0:
        scale = 255.0 * factor
    else:
        ignored.append(f"rescale_factor {str(factor)[:40]}")
    given = {"mean": stated.get("image_mean"), "std": stated.get("image_std")}
    if not does["do_normalize"]:
        given = {"mean": [0.0] * 3, "std": [1.0] * 3}
    if abs(scale - 1) > 1e-6 and all(_numbers(value) for value in given.values()):
        given = {name: [number / scale for number in value] for name, value in given.items() if value is not None}
    return changes | {name: value for name, value in given.items() if value is not None}, size, ignored


def _add_filter(changes: dict[str, Any], stated: Any, ignored: list[str]) -> None:
    name = _FILTERS[stated] if type(stated) is int and 0 <= stated < len(_FILTERS) else stated
    if name in _FILTERS:
        changes["filter"] = name
    elif name not in (None, "random"):  # timm's training draws one
        ignored.append(f"interpolation {str(name)[:40]}")


def _numbers(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(one, int | float) for one in value)


def _size(value: Any) -> tuple[int, int] | None:
    """Return (height, width) of a side, a list or an object with them; None for anything else."""
    if isinstance(value, Mapping):
        value = [value.get("height"), value.get("width")]
    sides = [value] * 2 if type(value) is int else value
    fits = isinstance(sides, list) and len(sides) == 2 and all(type(side) is int and side > 0 for side in sides)
    return (sides[0], sides[1]) if fits else None
