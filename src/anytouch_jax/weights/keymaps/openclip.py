"""CLIP weights of OpenCLIP, which store query, key and value as one kernel."""

from __future__ import annotations

from collections.abc import Iterator

from anytouch_jax.config import ModelConfig
from anytouch_jax.weights import keymaps
from anytouch_jax.weights.keymaps import LINEAR, SAME, Entry, Heads, KeyMap, Weights, layer_norm, linear
from anytouch_jax.weights.keymaps.hf_clip import DECODER

_BLOCK = [
    *layer_norm("ln_1", "norm1"),
    *layer_norm("ln_2", "norm2"),
    *linear("attn.out_proj", "attention/out"),
    *linear("mlp.c_fc", "mlp/up"),
    *linear("mlp.c_proj", "mlp/down"),
]
for _part, _name in enumerate(keymaps.PROJECTIONS[:3]):
    _BLOCK.append(Entry("attn.in_proj_weight", f"attention/{_name}/kernel", LINEAR, part=_part))
    _BLOCK.append(Entry("attn.in_proj_bias", f"attention/{_name}/bias", SAME, part=_part))


def _entries(model: ModelConfig) -> Iterator[Entry]:
    if model.image:
        yield Entry("visual.class_embedding", "image/class_token", SAME)
        yield Entry("visual.positional_embedding", "image/position", SAME)
        yield Entry("visual.conv1.weight", "image/patch/kernel", keymaps.PATCH)
        yield from layer_norm("visual.ln_pre", "image/pre_norm")
        yield from keymaps.stacked("visual.transformer.resblocks", "image/blocks", model.image.depth, _BLOCK)
        yield from layer_norm("visual.ln_post", "image/post_norm")
        yield Entry("visual.proj", "image/projection/kernel", SAME)  # stored as (in, out), unlike a torch Linear
    if model.text:
        yield Entry("token_embedding.weight", "text/token", SAME)
        yield Entry("positional_embedding", "text/position", SAME)
        yield from keymaps.stacked("transformer.resblocks", "text/blocks", model.text.stack.depth, _BLOCK)
        yield from layer_norm("ln_final", "text/final_norm")
        yield Entry("text_projection", "text/projection/kernel", SAME)
    yield Entry("logit_scale", "logit_scale", SAME)


def _detect(weights: Weights, heads: Heads) -> ModelConfig:
    tower = keymaps.detect_stack(weights, "visual", "image", heads, keymaps.VISION_HEADS)
    return ModelConfig(
        **keymaps.image_sizes(weights, "visual.conv1.weight", "visual.positional_embedding"),
        embed=weights["visual.proj"].shape[1],
        touch=tower,
        decoder=DECODER,
        image=tower,
        text=keymaps.detect_text(weights, "transformer", "token_embedding.weight", "positional_embedding", heads),
    )


OPENCLIP = KeyMap(
    "openclip",
    lambda weights: "visual.conv1.weight" in weights,
    lambda model: list(_entries(model)),
    _detect,
    towers={
        "image": r"visual\..*",
        "text": r"text_projection|token_embedding\..*|positional_embedding|transformer\..*|ln_final\..*",
        "logit_scale": r"logit_scale",
    },
)
