"""Weights of the authors' AnyTouch: stage 1, stage 2 (with towers), and probes (with a classifier)."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

from anytouch_jax.config import SENSORS, UNIVERSAL, ModelConfig
from anytouch_jax.weights import keymaps
from anytouch_jax.weights.keymaps import (
    DECODER_HEADS,
    LINEAR,
    SAME,
    VISION_HEADS,
    Entry,
    Heads,
    KeyMap,
    Weights,
    detect_stack,
    hf_clip,
    layer_norm,
    linear,
)

_STAGE2 = "touch_mae_model."
_CLIP_PATCH = "video_patch_embedding.weight"
_PROBE_PATCH = "touch_model.embeddings.patch_embedding.weight"
_MATCH_HEADS = {"mlp": "cross_sensor_mlp.up.weight", "linear": "cross_sensor_head.weight"}
_DECODER_BLOCK = [
    *linear("attention.attention.query", "attention/query"),
    *linear("attention.attention.key", "attention/key"),
    *linear("attention.attention.value", "attention/value"),
    *linear("attention.output.dense", "attention/out"),
    *linear("intermediate.dense", "mlp/up"),
    *linear("output.dense", "mlp/down"),
    *layer_norm("layernorm_before", "norm1"),
    *layer_norm("layernorm_after", "norm2"),
]


def _touch(model: ModelConfig, prefix: str = "", patch: str = _CLIP_PATCH) -> Iterator[Entry]:
    yield Entry(f"{prefix}sensor_token", "touch/sensor_tokens", SAME)
    yield Entry(f"{prefix}{patch}", "touch/patch/kernel", keymaps.PATCH)
    yield from hf_clip.vision(f"{prefix}touch_model", "touch", model.touch.depth)
    yield Entry(f"{prefix}touch_projection.weight", "touch/projection/kernel", LINEAR)


def _decoder(model: ModelConfig, prefix: str = "") -> Iterator[Entry]:
    yield Entry(f"{prefix}mask_token", "decoder/mask_token", keymaps.TOKEN)
    yield Entry(f"{prefix}decoder_pos_embed", "decoder/position", keymaps.ROW)
    if model.decoder_sensor_tokens:
        yield Entry(f"{prefix}sensor_token_proj.weight", "decoder/sensor_projection/kernel", LINEAR)
    yield from keymaps.stacked(f"{prefix}touch_decoder_blocks", "decoder/blocks", model.decoder.depth, _DECODER_BLOCK)
    yield from linear(f"{prefix}decoder_embed", "decoder/embed")
    yield from layer_norm(f"{prefix}decoder_norm", "decoder/norm")
    yield from linear(f"{prefix}decoder_pred", "decoder/still_head")
    yield from linear(f"{prefix}decoder_pred_video", "decoder/clip_head")


def _stage2(model: ModelConfig) -> list[Entry]:
    entries = [*_touch(model, _STAGE2), *_decoder(model, _STAGE2), *hf_clip.towers(model, lora=bool(model.lora_rank))]
    if model.match_head == "linear":
        entries += linear("cross_sensor_head", "matcher")
    elif model.match_head == "mlp":  # only in our files: the authors' head is linear
        entries += [*linear("cross_sensor_mlp.up", "matcher/up"), *linear("cross_sensor_mlp.down", "matcher/down")]
    return entries


def _detect(weights: Weights, heads: Heads, *, prefix: str = "", patch: str = _CLIP_PATCH) -> ModelConfig:
    position = f"{prefix}touch_model.embeddings.position_embedding.weight"
    tokens, blocks = weights[f"{prefix}sensor_token"], f"{prefix}touch_decoder_blocks"
    numbered = (*(f"sensor{row}" for row in range(len(tokens) - 1)), UNIVERSAL)
    sizes: dict[str, Any] = keymaps.image_sizes(weights, f"{prefix}{patch}", position)
    if prefix:  # stage 2
        ranks = [array.shape[0] for key, array in weights.items() if "lora_A" in key]
        heads_of_match = [name for name, key in _MATCH_HEADS.items() if key in weights]
        sizes |= {
            "image": detect_stack(weights, "vision_model", "image", heads, VISION_HEADS),
            "text": hf_clip.detect_text_tower(weights, heads),
            "match_head": heads_of_match[0] if heads_of_match else "none",
            "lora_rank": ranks[0] if ranks else 0,
        }
    decoder = hf_clip.DECODER
    if patch != _PROBE_PATCH:
        decoder = detect_stack(weights, blocks, "decoder", heads, DECODER_HEADS)
    return ModelConfig(
        **sizes,
        embed=weights[f"{prefix}touch_projection.weight"].shape[0],
        touch=detect_stack(weights, f"{prefix}touch_model", "touch", heads, VISION_HEADS),
        decoder=decoder,
        frames=weights[f"{prefix}{patch}"].shape[1],
        sensors=SENSORS if len(tokens) == len(SENSORS) else numbered,
        sensor_tokens=tokens.shape[1],
        decoder_sensor_tokens=f"{prefix}sensor_token_proj.weight" in weights,
    )


def _unused(prefix: str = "") -> dict[str, str]:
    inner = f"{prefix}touch_model.embeddings."
    return {
        f"{inner}patch_embedding.weight": f"{prefix}{_CLIP_PATCH}",
        f"{prefix}video_position_embedding.weight": f"{inner}position_embedding.weight",
    }


_TOWERS = hf_clip.TOWERS | {"matcher": r"cross_sensor_.*"}
STAGE1 = KeyMap(
    "stage1",
    lambda weights: _CLIP_PATCH in weights,
    lambda model: [*_touch(model), *_decoder(model)],
    _detect,
    _unused(),
    _TOWERS,
)
STAGE2 = KeyMap(
    "stage2",
    lambda weights: any(key.startswith(_STAGE2) for key in weights),
    _stage2,
    partial(_detect, prefix=_STAGE2),
    _unused(_STAGE2),
    _TOWERS,
)
PROBE = KeyMap(
    "probe",
    lambda weights: _PROBE_PATCH in weights,
    lambda model: list(_touch(model, patch=_PROBE_PATCH)),
    partial(_detect, patch=_PROBE_PATCH),
    towers=_TOWERS,
)
