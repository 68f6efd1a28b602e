"""Whose weights a file holds, and for which model they were made, from the names and shapes of its arrays."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.config import SENSORS, UNIVERSAL, ModelConfig, Stack, TextTower, from_json
from anytouch_jax.weights.names import Layout
from anytouch_jax.weights.tensors import WeightsError, read_metadata

Weights = Mapping[str, np.ndarray]
# Metadata of our safetensors files: heads and activation leave no trace in shapes, nor does what was seen in training.
MODEL_KEY = "anytouch_jax.model"
BACKGROUND_KEY, SEEN_KEY = "anytouch_jax.background", "anytouch_jax.seen"


def detect_layout(weights: Weights) -> Layout:
    """Whose names a file uses: the authors' stage 1, stage 2 or probe, HF CLIP, OpenCLIP, or our own.

    Raises WeightsError when it is none of them.
    """
    if any(key.startswith("touch_mae_model.") for key in weights):
        return "stage2"
    if "video_patch_embedding.weight" in weights:
        return "stage1"
    if "touch_model.embeddings.patch_embedding.weight" in weights:
        return "probe"
    if "visual.conv1.weight" in weights:
        return "openclip"
    if "vision_model.embeddings.patch_embedding.weight" in weights:
        return "clip"
    if any(key.startswith(("touch/", "image/")) for key in weights):
        return "own"
    shown = ", ".join(list(weights)[:5]) or "no arrays at all"
    raise WeightsError(f"these are not weights of AnyTouch, HF CLIP or OpenCLIP (they hold {shown})")


def detect_model(weights: Weights, *, heads: int | None = None, decoder_heads: int | None = None) -> ModelConfig:
    """The model a file was made for, from the shapes of its arrays.

    The number of heads leaves no trace: `heads` of touch and image towers is width / 64 unless given, as in CLIP,
    `decoder_heads` width / 32 as in the authors' decoder. Change any other guess with dataclasses.replace.
    A CLIP file gets the authors' decoder sizes. Raises WeightsError.
    """
    layout = detect_layout(weights)
    if layout == "own":
        raise WeightsError("a file in our own names does not tell its model; use the configuration it was saved with")
    try:
        return _detected(layout, weights, heads, decoder_heads)
    except (KeyError, IndexError, ValueError, TypeError) as error:  # an array absent, or of an odd shape
        raise WeightsError(f"the model cannot be told from these {layout} weights: {error} is absent or odd") from None


def model_of(path: str | Path, weights: Weights) -> ModelConfig:
    """The model of a weights file: as the file tells it under `MODEL_KEY`, as ours do, else `detect_model`, with the
    activation that CLIP's configuration beside it tells."""
    told = read_metadata(path).get(MODEL_KEY)
    if told is None:
        activation: Any = told_activation(path) if detect_layout(weights) in ("clip", "openclip") else None
        found = detect_model(weights)
        return found if activation is None else replace(found, activation=activation)
    model: ModelConfig = from_json(told, ModelConfig)
    return model


def told_activation(path: str | Path) -> str | None:
    """The activation of CLIP weights, which leaves no trace in the arrays: as the file tells it under `MODEL_KEY`, else
    HF's config.json or OpenCLIP's open_clip_config.json beside it. None where nothing tells.

    Raises WeightsError for a file that is not JSON and for an activation that this network does not have.
    """
    path, told = Path(path), set()
    if own := read_metadata(path).get(MODEL_KEY):
        return str(from_json(own, ModelConfig).activation)
    towers = _json(path.with_name("config.json"))
    for tower in ("text_config", "vision_config"):
        if isinstance(towers.get(tower), dict):
            told.add(towers[tower].get("hidden_act", "quick_gelu"))  # HF's default
    model = _json(path.with_name("open_clip_config.json")).get("model_cfg")
    if not told and isinstance(model, dict):
        told.add("quick_gelu" if model.get("quick_gelu") else "gelu")
    if len(told) > 1 or not told <= {"gelu", "quick_gelu"}:
        raise WeightsError(
            f"the configuration beside {path} tells of the activation {' and '.join(sorted(map(str, told)))}; give "
            "CLIP weights of which both towers use gelu, or both quick_gelu"
        )
    return next(iter(told), None)


def _json(path: Path) -> dict[str, Any]:
    """The object in a JSON file, {} where there is none. Raises WeightsError."""
    if not path.is_file():
        return {}
    try:
        value = json.loads(path.read_text(encoding="utf-8"))
    except ValueError:
        raise WeightsError(f"{path} is not JSON; mend it, or move the weights to a folder without it") from None
    return value if isinstance(value, dict) else {}


def _detected(layout: Layout, weights: Weights, heads: int | None, decoder_heads: int | None) -> ModelConfig:
    prefix = "touch_mae_model." if layout == "stage2" else ""
    vision = {"clip": "vision_model", "openclip": "visual"}.get(layout, f"{prefix}touch_model")
    if layout == "openclip":
        patch, positions = weights["visual.conv1.weight"], weights["visual.positional_embedding"]
        embed = weights["visual.proj"].shape[1]
    else:
        patch = weights[f"{vision}.embeddings.patch_embedding.weight"]
        positions = weights[f"{vision}.embeddings.position_embedding.weight"]
        projection = "visual_projection" if layout == "clip" else f"{prefix}touch_projection"
        embed = weights[f"{projection}.weight"].shape[0]
    tower = _stack(weights, vision, 64, heads)
    side = round((len(positions) - 1) ** 0.5) * patch.shape[-1]
    if layout in ("clip", "openclip"):
        text = _text(weights, "text_model" if layout == "clip" else "")
        return ModelConfig(side, patch.shape[-1], embed, tower, Stack(512, 8, 16, 2048), image=tower, text=text)
    clip_patch = patch if layout == "probe" else weights[f"{prefix}video_patch_embedding.weight"]
    tokens = weights[f"{prefix}sensor_token"]
    model: dict[str, Any] = {
        "frames": clip_patch.shape[1],
        "sensors": SENSORS if len(tokens) == len(SENSORS) else _numbered(len(tokens)),
        "sensor_tokens": tokens.shape[1],
        "decoder_sensor_tokens": f"{prefix}sensor_token_proj.weight" in weights,
    }
    if layout == "stage2":
        a = [array.shape[0] for key, array in weights.items() if "lora_A" in key]
        model |= {
            "image": _stack(weights, "vision_model", 64, heads),
            "text": _text(weights, "text_model"),
            "match_head": "linear" if "cross_sensor_head.weight" in weights else "none",
            "lora_rank": a[0] if a else 0,
        }
        if "cross_sensor_mlp.up.weight" in weights:
            model["match_head"] = "mlp"
    decoder = (
        Stack(512, 8, 16, 2048)
        if layout == "probe"
        else _stack(weights, f"{prefix}touch_decoder_blocks", 32, decoder_heads)
    )
    return ModelConfig(side, patch.shape[-1], embed, tower, decoder, **model)


def _stack(weights: Weights, prefix: str, per_head: int, heads: int | None) -> Stack:
    """Sizes of the transformer blocks under `prefix`; the feed-forward bias tells depth, its kernel the widths."""
    up = re.compile(
        re.escape(prefix) + r"\.(?:encoder\.|base_model\.model\.|layers\.|transformer\.|resblocks\.)*(\d+)\."
        r"(?:mlp\.fc1|mlp\.c_fc|intermediate\.dense)\.weight"
    )
    found = {int(match[1]): array.shape for key, array in weights.items() if (match := up.fullmatch(key))}
    if not found:
        raise KeyError(f"{prefix} blocks")
    mlp, width = found[0]
    return Stack(width, max(found) + 1, heads or max(1, width // per_head), mlp)


def _text(weights: Weights, prefix: str) -> TextTower | None:
    names = ("token_embedding.weight", "positional_embedding")
    if prefix:
        names = (f"{prefix}.embeddings.token_embedding.weight", f"{prefix}.embeddings.position_embedding.weight")
    if names[0] not in weights:
        return None
    stack = _stack(weights, prefix or "transformer", 64, None)
    return TextTower(stack, vocab=len(weights[names[0]]), length=len(weights[names[1]]))


def _numbered(count: int) -> tuple[str, ...]:
    return (*(f"sensor{row}" for row in range(count - 1)), UNIVERSAL)
