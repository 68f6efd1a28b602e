"""CLIP weights of Hugging Face and of OpenCLIP. The authors' touch encoder is the vision transformer of the first."""

from __future__ import annotations

from anytouch_jax.weights.keymaps import KeyMap, rows

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
