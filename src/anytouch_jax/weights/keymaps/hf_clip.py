"""CLIP weights of Hugging Face, whose vision transformer the authors' touch encoder is too."""

from __future__ import annotations

from collections.abc import Iterator

from anytouch_jax.config import ModelConfig, Stack, TextTower
from anytouch_jax.weights import keymaps
from anytouch_jax.weights.keymaps import LINEAR, SAME, Entry, Heads, KeyMap, Weights, layer_norm, linear

_ATTENTION = tuple(zip(("q_proj", "k_proj", "v_proj", "out_proj"), keymaps.PROJECTIONS, strict=True))
_LORA_BLOCK = [
    Entry(f"self_attn.{theirs}.lora_{side.upper()}.default.weight", f"{ours}/{side}", LINEAR)
    for theirs, ours in _ATTENTION
    for side in "ab"
]
# CLIP has no decoder. A model that starts from it gets the decoder of the authors.
DECODER = Stack(512, 8, 16, 2048)


def _block(base: str = "") -> Iterator[Entry]:
    for theirs, ours in _ATTENTION:
        yield from linear(f"self_attn.{theirs}{base}", f"attention/{ours}")
    yield from layer_norm("layer_norm1", "norm1")
    yield from layer_norm("layer_norm2", "norm2")
    yield from linear("mlp.fc1", "mlp/up")
    yield from linear("mlp.fc2", "mlp/down")


def vision(prefix: str, ours: str, depth: int, *, lora: bool = False) -> Iterator[Entry]:
    """Yield the entries of a vision transformer, except its patch kernel and its projection."""
    yield Entry(f"{prefix}.embeddings.class_embedding", f"{ours}/class_token", SAME)
    yield Entry(f"{prefix}.embeddings.position_embedding.weight", f"{ours}/position", SAME)
    yield from layer_norm(f"{prefix}.pre_layrnorm", f"{ours}/pre_norm")  # the library's spelling
    layers = f"{prefix}.encoder.base_model.model.layers" if lora else f"{prefix}.encoder.layers"
    yield from keymaps.stacked(layers, f"{ours}/blocks", depth, _block(".base_layer" if lora else ""))
    if lora:
        yield from keymaps.stacked(layers, "lora", depth, _LORA_BLOCK)
    yield from layer_norm(f"{prefix}.post_layernorm", f"{ours}/post_norm")


def towers(model: ModelConfig, *, lora: bool = False) -> Iterator[Entry]:
    """Yield the entries of the image and text towers that `model` has, and of the temperature."""
    if model.image:
        yield Entry("vision_model.embeddings.patch_embedding.weight", "image/patch/kernel", keymaps.PATCH)
        yield from vision("vision_model", "image", model.image.depth, lora=lora)
        yield Entry("visual_projection.weight", "image/projection/kernel", LINEAR)
    if model.text:
        yield Entry("text_model.embeddings.token_embedding.weight", "text/token", SAME)
        yield Entry("text_model.embeddings.position_embedding.weight", "text/position", SAME)
        yield from keymaps.stacked("text_model.encoder.layers", "text/blocks", model.text.stack.depth, _block())
        yield from layer_norm("text_model.final_layer_norm", "text/final_norm")
        yield Entry("text_projection.weight", "text/projection/kernel", LINEAR)
    if model.image or model.text:
        yield Entry("logit_scale", "logit_scale", SAME)


def detect_text_tower(weights: Weights, heads: Heads) -> TextTower | None:
    """Return the sizes of the text tower; None if there is none."""
    table = "text_model.embeddings.{}_embedding.weight"
    return keymaps.detect_text(weights, "text_model", table.format("token"), table.format("position"), heads)


def _detect(weights: Weights, heads: Heads) -> ModelConfig:
    inner = "vision_model.embeddings.{}_embedding.weight"
    tower = keymaps.detect_stack(weights, "vision_model", "image", heads, keymaps.VISION_HEADS)
    projection = weights.get("visual_projection.weight")
    return ModelConfig(
        **keymaps.image_sizes(weights, inner.format("patch"), inner.format("position")),
        embed=tower.width if projection is None else projection.shape[0],  # a vision tower alone has none
        touch=tower,
        decoder=DECODER,
        image=tower,
        text=detect_text_tower(weights, heads),
    )


TOWERS = {
    "image": r"vision_model\..*|visual_projection\..*",
    "text": r"text_model\..*|text_projection\..*",
    "logit_scale": r"logit_scale",
}
HF_CLIP = KeyMap(
    "clip",
    lambda weights: "vision_model.embeddings.patch_embedding.weight" in weights,
    lambda model: list(towers(model)),
    _detect,
    towers=TOWERS,
)
