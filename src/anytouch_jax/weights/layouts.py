"""Layouts of weights files: CLIP (Hugging Face, OpenCLIP), the authors' AnyTouch, and plain ViTs."""

from __future__ import annotations

from anytouch_jax.weights.keymaps import Entry, KeyMap, rows

# CLIP of Hugging Face and of OpenCLIP. The authors' touch encoder is the vision transformer of the first.
BLOCKS = """
    linear  encoder.layers.{}.self_attn.q_proj    blocks/attention/query
    linear  encoder.layers.{}.self_attn.k_proj    blocks/attention/key
    linear  encoder.layers.{}.self_attn.v_proj    blocks/attention/value
    linear  encoder.layers.{}.self_attn.out_proj  blocks/attention/out
    norm    encoder.layers.{}.layer_norm1         blocks/norm1
    norm    encoder.layers.{}.layer_norm2         blocks/norm2
    linear  encoder.layers.{}.mlp.fc1             blocks/mlp/up
    linear  encoder.layers.{}.mlp.fc2             blocks/mlp/down
"""
VISION = f"""
    same    embeddings.class_embedding            class_token
    same    embeddings.position_embedding.weight  position
    norm    pre_layrnorm                          pre_norm
    {BLOCKS.strip()}
    norm    post_layernorm                        post_norm
"""  # "pre_layrnorm" is the library's spelling
_TEXT = f"""
    same    embeddings.token_embedding.weight     token
    same    embeddings.position_embedding.weight  position
    {BLOCKS.strip()}
    norm    final_layer_norm                      final_norm
"""
TABLE = (
    *rows("patch vision_model.embeddings.patch_embedding image/patch"),
    *rows(VISION, "vision_model.", "image/"),
    *rows("kernel visual_projection image/projection"),
    *rows(_TEXT, "text_model.", "text/"),
    *rows("kernel text_projection text/projection"),
    *rows("same logit_scale logit_scale"),
)
TOWERS = {
    "image": r"vision_model\..*|visual_projection\..*",
    "text": r"text_model\..*|text_projection\..*",
    "logit_scale": r"logit_scale",
}
HF_CLIP = KeyMap("clip", r"vision_model\.embeddings\.patch_embedding\.weight", TABLE, towers=TOWERS)

_OPEN_BLOCKS = """
    norm    transformer.resblocks.{}.ln_1           blocks/norm1
    norm    transformer.resblocks.{}.ln_2           blocks/norm2
    linear  transformer.resblocks.{}.attn.out_proj  blocks/attention/out
    linear  transformer.resblocks.{}.mlp.c_fc       blocks/mlp/up
    linear  transformer.resblocks.{}.mlp.c_proj     blocks/mlp/down
    qkv     transformer.resblocks.{}.attn.in_proj   blocks/attention
"""
_OPEN_VISION = f"""
    same    class_embedding                         class_token
    same    positional_embedding                    position
    patch   conv1                                   patch
    norm    ln_pre                                  pre_norm
    {_OPEN_BLOCKS.strip()}
    norm    ln_post                                 post_norm
    same    proj                                    projection/kernel
"""  # the projections are stored as (in, out), unlike a torch Linear
_OPEN_TEXT = f"""
    same    token_embedding.weight                  token
    same    positional_embedding                    position
    {_OPEN_BLOCKS.strip()}
    norm    ln_final                                final_norm
    same    text_projection                         projection/kernel
"""
OPENCLIP = KeyMap(
    "openclip",
    r"visual\.conv1\.weight",
    (*rows(_OPEN_VISION, "visual.", "image/"), *rows(_OPEN_TEXT, "", "text/"), *rows("same logit_scale logit_scale")),
    towers={
        "image": r"visual\..*",
        "text": r"text_projection|token_embedding\..*|positional_embedding|transformer\..*|ln_final\..*",
        "logit_scale": r"logit_scale",
    },
)

# AnyTouch of the authors: stage 1, stage 2 (with towers), and probes (with a classifier).
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

# Plain ViTs: the layouts of timm (Sparsh, T3, SITR, DINOv2's authors), of Hugging Face, and of AnyTouch 2.
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
_HF_DINOV3 = """
    token   embeddings.cls_token                          class_token
    row     embeddings.register_tokens                    registers
    frames  embeddings.patch_embeddings                   patch
    linear  layer.{}.attention.q_proj                     blocks/attention/query
    linear  layer.{}.attention.k_proj                     blocks/attention/key
    linear  layer.{}.attention.v_proj                     blocks/attention/value
    linear  layer.{}.attention.o_proj                     blocks/attention/out
    norm    layer.{}.norm1                                blocks/norm1
    norm    layer.{}.norm2                                blocks/norm2
    linear  layer.{}.mlp.up_proj                          blocks/mlp/up
    linear  layer.{}.mlp.down_proj                        blocks/mlp/down
    same    layer.{}.layer_scale1.lambda1                 blocks/scale1/scale
    same    layer.{}.layer_scale2.lambda1                 blocks/scale2/scale
    same    periods                                       periods
    norm    norm                                          post_norm
"""
_SIGLIP = f"""
    frames  embeddings.patch_embedding                    patch
    same    embeddings.position_embedding.weight          position
    {BLOCKS.strip()}
    norm    post_layernorm                                post_norm
    token   head.probe                                    pool/probe
    qkv     head.attention.in_proj                        pool/attention
    linear  head.attention.out_proj                       pool/attention/out
    norm    head.layernorm                                pool/norm
    linear  head.mlp.fc1                                  pool/mlp/up
    linear  head.mlp.fc2                                  pool/mlp/down
"""
TIMM = rows(_TIMM)
DINOV3 = (*TIMM, *rows("same periods periods"))
HF_DINOV3 = rows(_HF_DINOV3)
SIGLIP = rows(_SIGLIP)
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
