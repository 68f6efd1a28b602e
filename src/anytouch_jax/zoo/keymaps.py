"""Key maps of other families: which array of their files is which parameter of `nn.vit`.

The rows have the form of `weights.keymaps`: the kind of a layer, the key in the file with "{}" for
the number of the layer, and our name.
"""

from anytouch_jax.weights.keymaps import BLOCKS, VISION, rows

# timm's layout, which Sparsh, T3, SITR and the authors of DINOv2 use too.
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
SPARSH_VIDEO = (
    *rows(_TIMM.replace("frames ", "video ")),
    *rows("same pos_embed.frequency_bands frequency"),
)
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
