"""Which array of a PyTorch file is which parameter: the key tables of the authors' files, of HF CLIP and of OpenCLIP.

Our names and shapes are those of `Net.abstract()`: a path joined with "/", blocks stacked on axis 0, kernels
(in, out). D touch width, E embedding, N positions, P patch, R sensor rows.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from anytouch_jax.config import ModelConfig
from anytouch_jax.weights.shapes import PROJECTIONS, param_shapes

Layout = Literal["stage1", "stage2", "probe", "clip", "openclip", "own"]


@dataclass(frozen=True)
class Form:
    """How an array of the file becomes ours (`read`) and ours becomes theirs (`write`); both exact."""

    read: Callable[[np.ndarray], np.ndarray]
    write: Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Entry:
    """One array of a file: its `key` there, the parameter `name`, the `layer` of a stack, the `part` of three."""

    key: str
    name: str
    form: Form
    layer: int | None = None
    part: int | None = None


def _read_kernel(weight: np.ndarray) -> np.ndarray:  # (D, colour, row, col) -> (P*P*3, D)
    return weight.transpose(2, 3, 1, 0).reshape(-1, len(weight))


def _write_kernel(kernel: np.ndarray) -> np.ndarray:
    side = math.isqrt(kernel.shape[0] // 3)
    return kernel.reshape(side, side, 3, -1).transpose(3, 2, 0, 1)


def _read_clip_kernel(
    weight: np.ndarray,
) -> np.ndarray:  # (D, frame, colour, row, col) -> (frames, P*P*3, D), golden Q1
    return np.stack([_read_kernel(weight[:, frame]) for frame in range(weight.shape[1])])


def _write_clip_kernel(kernel: np.ndarray) -> np.ndarray:
    return np.stack([_write_kernel(frame) for frame in kernel], axis=1)


SAME = Form(lambda x: x, lambda x: x)
LINEAR = Form(lambda x: x.T, lambda x: x.T)
ROW = Form(lambda x: x[0], lambda x: x[None])
TOKEN = Form(lambda x: x[0, 0], lambda x: x[None, None])
PATCH = Form(_read_kernel, _write_kernel)
CLIP_PATCH = Form(_read_clip_kernel, _write_clip_kernel)

_Rows = tuple[tuple[str, str, Form], ...]


def _dense(theirs: str, ours: str) -> _Rows:
    return (f"{theirs}.weight", f"{ours}/kernel", LINEAR), (f"{theirs}.bias", f"{ours}/bias", SAME)


def _norm(theirs: str, ours: str) -> _Rows:
    return (f"{theirs}.weight", f"{ours}/scale", SAME), (f"{theirs}.bias", f"{ours}/bias", SAME)


_PROJECTIONS = dict(zip(("q_proj", "k_proj", "v_proj", "out_proj"), PROJECTIONS, strict=True))
_HF_REST = (
    *_norm("layer_norm1", "norm1"),
    *_norm("layer_norm2", "norm2"),
    *_dense("mlp.fc1", "mlp/up"),
    *_dense("mlp.fc2", "mlp/down"),
)


def _hf_block(base: str = "") -> _Rows:
    attention = [
        row for theirs, ours in _PROJECTIONS.items() for row in _dense(f"self_attn.{theirs}{base}", f"attention/{ours}")
    ]
    return (*attention, *_HF_REST)


_DECODER_BLOCK = (
    *_dense("attention.attention.query", "attention/query"),
    *_dense("attention.attention.key", "attention/key"),
    *_dense("attention.attention.value", "attention/value"),
    *_dense("attention.output.dense", "attention/out"),
    *_dense("intermediate.dense", "mlp/up"),
    *_dense("output.dense", "mlp/down"),
    *_norm("layernorm_before", "norm1"),
    *_norm("layernorm_after", "norm2"),
)
_OPENCLIP_BLOCK = (
    *_norm("ln_1", "norm1"),
    *_norm("ln_2", "norm2"),
    *_dense("attn.out_proj", "attention/out"),
    *_dense("mlp.c_fc", "mlp/up"),
    *_dense("mlp.c_proj", "mlp/down"),
)
_LORA_BLOCK = tuple(
    (f"self_attn.{theirs}.lora_{side.upper()}.default.weight", f"{ours}/{side}", LINEAR)
    for theirs, ours in _PROJECTIONS.items()
    for side in "ab"
)


def _plain(rows: _Rows) -> Iterator[Entry]:
    return (Entry(*row) for row in rows)


def _stacked(theirs: str, ours: str, depth: int, rows: _Rows) -> Iterator[Entry]:
    return (
        Entry(f"{theirs}.{layer}.{key}", f"{ours}/{name}", form, layer)
        for layer in range(depth)
        for key, name, form in rows
    )


def _vision(prefix: str, ours: str, depth: int, *, lora: bool = False) -> Iterator[Entry]:
    """The vision transformer of HF CLIP, which the touch encoder is too; its patch kernel and projection apart."""
    yield Entry(f"{prefix}.embeddings.class_embedding", f"{ours}/class_token", SAME)
    yield Entry(f"{prefix}.embeddings.position_embedding.weight", f"{ours}/position", SAME)
    yield from _plain(_norm(f"{prefix}.pre_layrnorm", f"{ours}/pre_norm"))
    layers = f"{prefix}.encoder.base_model.model.layers" if lora else f"{prefix}.encoder.layers"
    yield from _stacked(layers, f"{ours}/blocks", depth, _hf_block(".base_layer" if lora else ""))
    if lora:
        yield from _stacked(layers, "lora", depth, _LORA_BLOCK)
    yield from _plain(_norm(f"{prefix}.post_layernorm", f"{ours}/post_norm"))


def _touch(model: ModelConfig, prefix: str, patch_key: str = "video_patch_embedding.weight") -> Iterator[Entry]:
    yield Entry(f"{prefix}sensor_token", "touch/sensor_tokens", SAME)
    yield Entry(f"{prefix}{patch_key}", "touch/patch/kernel", CLIP_PATCH)
    yield from _vision(f"{prefix}touch_model", "touch", model.touch.depth)
    yield Entry(f"{prefix}touch_projection.weight", "touch/projection/kernel", LINEAR)


def _decoder(model: ModelConfig, prefix: str) -> Iterator[Entry]:
    yield Entry(f"{prefix}mask_token", "decoder/mask_token", TOKEN)
    yield Entry(f"{prefix}decoder_pos_embed", "decoder/position", ROW)
    if model.decoder_sensor_tokens:
        yield Entry(f"{prefix}sensor_token_proj.weight", "decoder/sensor_projection/kernel", LINEAR)
    yield from _stacked(f"{prefix}touch_decoder_blocks", "decoder/blocks", model.decoder.depth, _DECODER_BLOCK)
    yield from _plain(_dense(f"{prefix}decoder_embed", "decoder/embed"))
    yield from _plain(_norm(f"{prefix}decoder_norm", "decoder/norm"))
    yield from _plain(_dense(f"{prefix}decoder_pred", "decoder/still_head"))
    yield from _plain(_dense(f"{prefix}decoder_pred_video", "decoder/clip_head"))


def _towers(model: ModelConfig, *, lora: bool) -> Iterator[Entry]:
    if model.image:
        yield Entry("vision_model.embeddings.patch_embedding.weight", "image/patch/kernel", PATCH)
        yield from _vision("vision_model", "image", model.image.depth, lora=lora)
        yield Entry("visual_projection.weight", "image/projection/kernel", LINEAR)
    if model.text:
        yield Entry("text_model.embeddings.token_embedding.weight", "text/token", SAME)
        yield Entry("text_model.embeddings.position_embedding.weight", "text/position", SAME)
        yield from _stacked("text_model.encoder.layers", "text/blocks", model.text.stack.depth, _hf_block())
        yield from _plain(_norm("text_model.final_layer_norm", "text/final_norm"))
        yield Entry("text_projection.weight", "text/projection/kernel", LINEAR)
    if model.image or model.text:
        yield Entry("logit_scale", "logit_scale", SAME)


def _openclip_blocks(theirs: str, ours: str, depth: int) -> Iterator[Entry]:
    yield from _stacked(theirs, ours, depth, _OPENCLIP_BLOCK)
    for layer in range(depth):
        for part, name in enumerate(("query", "key", "value")):
            inner = f"{theirs}.{layer}.attn.in_proj"
            yield Entry(f"{inner}_weight", f"{ours}/attention/{name}/kernel", LINEAR, layer, part)
            yield Entry(f"{inner}_bias", f"{ours}/attention/{name}/bias", SAME, layer, part)


def _openclip(model: ModelConfig) -> Iterator[Entry]:
    if model.image:
        yield Entry("visual.class_embedding", "image/class_token", SAME)
        yield Entry("visual.positional_embedding", "image/position", SAME)
        yield Entry("visual.conv1.weight", "image/patch/kernel", PATCH)
        yield from _plain(_norm("visual.ln_pre", "image/pre_norm"))
        yield from _openclip_blocks("visual.transformer.resblocks", "image/blocks", model.image.depth)
        yield from _plain(_norm("visual.ln_post", "image/post_norm"))
        yield Entry("visual.proj", "image/projection/kernel", SAME)  # stored (in, out), unlike a torch Linear
    if model.text:
        yield Entry("token_embedding.weight", "text/token", SAME)
        yield Entry("positional_embedding", "text/position", SAME)
        yield from _openclip_blocks("transformer.resblocks", "text/blocks", model.text.stack.depth)
        yield from _plain(_norm("ln_final", "text/final_norm"))
        yield Entry("text_projection", "text/projection/kernel", SAME)
    yield Entry("logit_scale", "logit_scale", SAME)


def entries(layout: Layout, model: ModelConfig) -> list[Entry]:
    """Every array that a file of this layout must have to fill `model`; own files are flat already."""
    if layout == "clip":
        return list(_towers(model, lora=False))
    if layout == "openclip":
        return list(_openclip(model))
    if layout == "probe":
        return list(_touch(model, "", "touch_model.embeddings.patch_embedding.weight"))
    if layout == "own":
        return [Entry(name, name, SAME) for name in param_shapes(model)]
    prefix = "touch_mae_model." if layout == "stage2" else ""
    rows = [*_touch(model, prefix), *_decoder(model, prefix)]
    if layout == "stage2":
        rows += _towers(model, lora=bool(model.lora_rank))
        if model.match_head == "linear":
            rows += _plain(_dense("cross_sensor_head", "matcher"))
        elif model.match_head == "mlp":  # ours alone: the authors' head is linear
            rows += _plain(
                (*_dense("cross_sensor_mlp.up", "matcher/up"), *_dense("cross_sensor_mlp.down", "matcher/down"))
            )
    return rows


def unused(layout: Layout) -> dict[str, tuple[str, str]]:
    """Arrays that the authors' files hold and nothing reads (golden Q2): key -> (like this key, how it is made)."""
    if layout not in ("stage1", "stage2"):
        return {}
    prefix = "touch_mae_model." if layout == "stage2" else ""
    inner = f"{prefix}touch_model.embeddings."
    return {
        f"{inner}patch_embedding.weight": (f"{prefix}video_patch_embedding.weight", "mean over frames"),
        f"{prefix}video_position_embedding.weight": (f"{inner}position_embedding.weight", "copy"),
    }


_BUFFERS = re.compile(r"(.*\.)?(position_ids|attn_mask)")
_TOWER_KEYS = {
    "image": re.compile(r"vision_model\..*|visual_projection\..*|visual\..*"),
    "text": re.compile(
        r"text_model\..*|text_projection(\..*)?|token_embedding\..*|positional_embedding|transformer\..*|ln_final\..*"
    ),
    "matcher": re.compile(r"cross_sensor_.*"),
    "logit_scale": re.compile(r"logit_scale"),
}


# What some model of ours has: its parts, and the classifier that came with a probe file.
_OWN_PARTS = frozenset(("touch", "decoder", "image", "lora", "text", "logit_scale", "matcher", "force", "head"))


def is_left_out(key: str, layout: Layout, model: ModelConfig) -> bool:
    """Whether a key of a file is known and not needed: an unused array, a buffer, a tower that `model` lacks."""
    if layout == "own":
        part = key.split("/")[0]
        return part in _OWN_PARTS and part not in {name.split("/")[0] for name in param_shapes(model)}
    absent = {
        "image": model.image is None,
        "text": model.text is None,
        "matcher": model.match_head in ("none", "cosine"),
        "logit_scale": "logit_scale" not in param_shapes(model),
    }
    return (
        key in unused(layout)
        or _BUFFERS.fullmatch(key) is not None
        or any(gone and _TOWER_KEYS[part].fullmatch(key) for part, gone in absent.items())
    )
