"""Weights of the authors' AnyTouch: stage 1, stage 2 (with towers), and probes (with a classifier)."""

from __future__ import annotations

from anytouch_jax.weights.keymaps import Entry, KeyMap, rows
from anytouch_jax.weights.keymaps.clip import BLOCKS, TABLE, TOWERS, VISION

_DECODER = """
    token   mask_token                                         mask_token
    row     decoder_pos_embed                                  position
    kernel  sensor_token_proj                                  sensor_projection
    linear  touch_decoder_blocks.{}.attention.attention.query  blocks/attention/query
    linear  touch_decoder_blocks.{}.attention.attention.key    blocks/attention/key
    linear  touch_decoder_blocks.{}.attention.attention.value  blocks/attention/value
    linear  touch_decoder_blocks.{}.attention.output.dense     blocks/attention/out
    linear  touch_decoder_blocks.{}.intermediate.dense         blocks/mlp/up
    linear  touch_decoder_blocks.{}.output.dense               blocks/mlp/down
    norm    touch_decoder_blocks.{}.layernorm_before           blocks/norm1
    norm    touch_decoder_blocks.{}.layernorm_after            blocks/norm2
    linear  decoder_embed                                      embed
    norm    decoder_norm                                       norm
    linear  decoder_pred                                       still_head
    linear  decoder_pred_video                                 clip_head
"""
_MATCHER = """
    linear  cross_sensor_head      matcher
    linear  cross_sensor_mlp.up    matcher/up
    linear  cross_sensor_mlp.down  matcher/down
"""  # the MLP only in our files: the authors' head is linear
_LORA = """
    lora    layers.{}.self_attn.q_proj    query
    lora    layers.{}.self_attn.k_proj    key
    lora    layers.{}.self_attn.v_proj    value
    lora    layers.{}.self_attn.out_proj  out
"""
_CLIP_PATCH, _PROBE_PATCH = "video_patch_embedding", "touch_model.embeddings.patch_embedding"
_PEFT = "vision_model.encoder.base_model.model."  # the library of LoRA puts the tower into a wrapper


def _touch(prefix: str = "", patch: str = _CLIP_PATCH) -> tuple[Entry, ...]:
    own = f"same sensor_token sensor_tokens\npatch {patch} patch\nkernel touch_projection projection"
    return (*rows(own, prefix, "touch/"), *rows(VISION, f"{prefix}touch_model.", "touch/"))


def _unused(prefix: str = "") -> dict[str, str]:
    inner = f"{prefix}touch_model.embeddings."
    return {
        f"{inner}patch_embedding.weight": f"{prefix}{_CLIP_PATCH}.weight",
        f"{prefix}video_position_embedding.weight": f"{inner}position_embedding.weight",
    }


_STAGE2 = "touch_mae_model."
_TOWERS = TOWERS | {"matcher": r"cross_sensor_.*"}
STAGE1 = KeyMap(
    "stage1",
    r"video_patch_embedding\.weight",
    (*_touch(), *rows(_DECODER, "", "decoder/")),
    unused=_unused(),
    towers=_TOWERS,
)
STAGE2 = KeyMap(
    "stage2",
    r"touch_mae_model\..*",
    (*_touch(_STAGE2), *rows(_DECODER, _STAGE2, "decoder/"), *TABLE, *rows(_MATCHER)),
    lora=(
        *rows(BLOCKS.replace("encoder.", "").replace("_proj", "_proj.base_layer"), _PEFT, "image/"),
        *rows(_LORA, _PEFT, "lora/"),
    ),
    unused=_unused(_STAGE2),
    towers=_TOWERS,
)
PROBE = KeyMap("probe", r"touch_model\.embeddings\.patch_embedding\.weight", _touch(patch=_PROBE_PATCH), towers=_TOWERS)
