"""Plain ViTs: the layouts of timm (Sparsh, T3, SITR, DINOv2's authors), of Hugging Face, and of AnyTouch 2."""

from __future__ import annotations

from anytouch_jax.weights.keymaps import rows
from anytouch_jax.weights.keymaps.clip import VISION

_BLOCKS = """
    fused   blocks.{}.attn.qkv   blocks/attention
    linear  blocks.{}.attn.proj  blocks/attention/out
    norm    blocks.{}.norm1      blocks/norm1
    norm    blocks.{}.norm2      blocks/norm2
    linear  blocks.{}.mlp.fc1    blocks/mlp/up
    linear  blocks.{}.mlp.fc2    blocks/mlp/down
    same    blocks.{}.ls1.gamma  blocks/scale1/scale
    same    blocks.{}.ls2.gamma  blocks/scale2/scale
"""
_TIMM = f"""
    token   cls_token          class_token
    row     pos_embed          position
    row     register_tokens    registers
    frames  patch_embed.proj   patch
    {_BLOCKS.strip()}
    norm    norm               post_norm
"""
_HUGGING_FACE = """
    token   embeddings.cls_token                          class_token
    row     embeddings.position_embeddings                position
    row     embeddings.register_tokens                    registers
    frames  embeddings.patch_embeddings.projection        patch
    linear  encoder.layer.{}.attention.attention.query    blocks/attention/query
    linear  encoder.layer.{}.attention.attention.key      blocks/attention/key
    linear  encoder.layer.{}.attention.attention.value    blocks/attention/value
    linear  encoder.layer.{}.attention.output.dense       blocks/attention/out
    norm    layernorm                                     post_norm
"""
_HF_VIT = """
    norm    encoder.layer.{}.layernorm_before             blocks/norm1
    norm    encoder.layer.{}.layernorm_after              blocks/norm2
    linear  encoder.layer.{}.intermediate.dense           blocks/mlp/up
    linear  encoder.layer.{}.output.dense                 blocks/mlp/down
"""
_HF_DINOV2 = """
    norm    encoder.layer.{}.norm1                        blocks/norm1
    norm    encoder.layer.{}.norm2                        blocks/norm2
    linear  encoder.layer.{}.mlp.fc1                      blocks/mlp/up
    linear  encoder.layer.{}.mlp.fc2                      blocks/mlp/down
    same    encoder.layer.{}.layer_scale1.lambda1         blocks/scale1/scale
    same    encoder.layer.{}.layer_scale2.lambda1         blocks/scale2/scale
"""
TIMM = rows(_TIMM)
HF_VIT = (*rows(_HUGGING_FACE), *rows(_HF_VIT))
HF_DINOV2 = (*rows(_HUGGING_FACE), *rows(_HF_DINOV2))
SPARSH = (*TIMM, *rows("same pos_embed.frequency_bands frequency"))
SPARSH_VIDEO = (*rows(_TIMM.replace("frames ", "video ")), *rows("same pos_embed.frequency_bands frequency"))
SITR = (
    *TIMM,
    *rows("frames c_patch_embed.proj calibration\nrow c_pos_embed calibration_position"),
    *rows("linear contrastive_head projection"),
)
# T3's two files are read as one: "trunk." is put before the names of the second.
T3 = (
    *rows(_TIMM.replace("norm    norm ", "norm    trunk.norm ")),
    *rows(_BLOCKS.replace("blocks.{}", "trunk.blocks.{}").replace(" blocks/", " trunk/")),
)
ANYTOUCH2 = (
    *rows("same sensor_token sensor_tokens\nkernel touch_projection projection"),
    *rows("video touch_model.embeddings.patch_embedding patch"),
    *rows(VISION, "touch_model."),
)
