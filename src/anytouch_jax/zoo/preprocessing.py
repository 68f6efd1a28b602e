"""Preprocessing that timm (config.json) or Hugging Face (preprocessor_config.json) states in a file
beside weights.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_FILTERS = ("nearest", "lanczos", "bilinear", "bicubic", "box", "hamming")  # by Pillow's numbers
_HF_STEPS = {"do_resize", "do_center_crop", "do_rescale", "do_normalize", "do_convert_rgb"}
_HF_VALUES = {
    "size",
    "crop_size",
    "resample",
    "rescale_factor",
    "image_mean",
    "image_std",
    "image_processor_type",
    "feature_extractor_type",
    "processor_class",
    "_valid_processor_keys",
    "data_format",
    "input_data_format",
    "return_tensors",
    "device",
    "default_to_square",
    "disable_grouping",
}
_TIMM = ("mean", "std", "interpolation", "crop_pct", "crop_mode", "input_size")


def stated_steps(
    config: Mapping[str, Any], theirs: Mapping[str, Any]
) -> tuple[dict[str, Any], Any, list[str]]:
    """Return changes of a Preparation, the (height, width) of the input or None, and what of both
    files is ignored.
    """
    if theirs:
        return _hugging_face(theirs)
    timm = config.get("pretrained_cfg", config if "architecture" in config else None)
    if isinstance(timm, Mapping) and timm.keys() & {*_TIMM}:
        return _timm(timm)
    return ({}, None, [])


def _timm(stated: Mapping[str, Any]) -> tuple[dict[str, Any], Any, list[str]]:
    changes: dict[str, Any] = {key: stated[key] for key in ("mean", "std") if key in stated}
    size = _size(list(stated.get("input_size", ()))[1:])
    ignored = list[str]()
    _add_filter(changes, stated.get("interpolation"), ignored)
    fraction = stated.get("crop_pct", 1.0)
    mode = stated.get("crop_mode", "center")
    if size is not None and isinstance(fraction, int | float) and 0 < fraction <= 1:
        if mode == "center":
            changes |= {"crop": "centre", "shorter": int(max(size) / fraction)}
        elif mode == "squash" and fraction == 1:
            changes |= {"crop": "none", "shorter": None}
        else:
            ignored.append(f"crop_mode {mode} with crop_pct {fraction}")
    elif "crop_pct" in stated:
        ignored.append(f"crop_pct {fraction}")
    return changes, size, ignored


def _hugging_face(stated: Mapping[str, Any]) -> tuple[dict[str, Any], Any, list[str]]:
    """Read a preprocessor_config.json, see `stated_steps`."""
    known = {*_HF_STEPS, *_HF_VALUES}
    ignored = [
        f"{name} {str(value)[:40]}"
        for name, value in stated.items()
        if name not in known and value not in (None, False)
    ]
    # A step that is not named is done, but a crop only where its size is given.
    does = {name: stated.get(name, True) for name in _HF_STEPS}
    does["do_center_crop"] = stated.get("do_center_crop", "crop_size" in stated)
    changes: dict[str, Any] = {}
    _add_filter(changes, stated.get("resample"), ignored)
    size = _add_geometry(changes, stated, does, ignored)
    _add_statistics(changes, stated, does, ignored)
    return changes, size, ignored


def _add_geometry(
    changes: dict[str, Any], stated: Mapping[str, Any], does: Mapping[str, Any], ignored: list[str]
) -> tuple[int, int] | None:
    """Enter how an image is resized and cropped, and return the (height, width) of the input."""
    resized = stated.get("size")
    crops = does["do_center_crop"]
    cropped = _size(stated.get("crop_size"))
    edge = resized.get("shortest_edge") if isinstance(resized, Mapping) else None
    if edge is None and type(resized) is int and crops:
        edge = resized
    whole = None if edge is not None else _size(resized)
    if not does["do_resize"]:
        ignored.append("do_resize false")
    elif crops and cropped and type(edge) is int:
        changes |= {"crop": "centre", "shorter": edge}
    elif whole is not None and (not crops or cropped in (None, whole)):
        changes |= {"crop": "none", "shorter": None}
    elif resized is not None:
        ignored.append(f"size {resized} with crop_size {stated.get('crop_size')}")
    if crops and cropped:
        return cropped
    return whole


def _add_statistics(
    changes: dict[str, Any], stated: Mapping[str, Any], does: Mapping[str, Any], ignored: list[str]
) -> None:
    """Enter mean and standard deviation, for values of 0 to 1.

    A factor other than 1/255 scales the values before they are normalised. Dividing the statistics
    by it is the same.
    """
    scale = 1.0
    factor = stated.get("rescale_factor", 1 / 255)
    if not does["do_rescale"]:
        scale = 255.0
    elif isinstance(factor, int | float) and factor > 0:
        scale = 255.0 * factor
    else:
        ignored.append(f"rescale_factor {str(factor)[:40]}")
    stored = {"mean": stated.get("image_mean"), "std": stated.get("image_std")}
    if not does["do_normalize"]:
        stored = {"mean": [0.0] * 3, "std": [1.0] * 3}
    given: dict[str, Any] = {name: value for name, value in stored.items() if value is not None}
    is_scaled = abs(scale - 1) > 1e-6
    if is_scaled and len(given) == 2 and all(_numbers(value) for value in given.values()):
        given = {name: [number / scale for number in value] for name, value in given.items()}
    changes |= given


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
    fits = (
        isinstance(sides, list)
        and len(sides) == 2
        and all(type(side) is int and side > 0 for side in sides)
    )
    if fits:
        return (sides[0], sides[1])
    return None
