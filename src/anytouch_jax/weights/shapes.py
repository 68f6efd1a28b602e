"""Name and shape of every parameter of a model, from its configuration alone; a test holds them to `Net.abstract()`."""

from __future__ import annotations

from anytouch_jax.config import STEM, ModelConfig, Stack
from anytouch_jax.weights.tree import flatten

Shape = tuple[int, ...]

PROJECTIONS = ("query", "key", "value", "out")


def param_shapes(model: ModelConfig) -> dict[str, Shape]:
    """Name -> shape of every parameter of a model."""
    pixels, rows, width, deep = 3 * model.patch**2, model.patches + 1, model.touch.width, model.decoder.width
    tree: dict[str, object] = {
        "touch": {
            **_vision_shapes(model.touch, rows, model.embed),
            "patch": _patch_shapes(model),
            "sensor_tokens": (len(model.sensors), model.sensor_tokens, width),
        },
        "decoder": {
            "embed": _dense_shapes(model.embed, deep),
            "mask_token": (deep,),
            "position": (rows, deep),
            "blocks": _block_shapes(model.decoder),
            "norm": _norm_shapes(deep),
            "still_head": _dense_shapes(deep, pixels),
            "clip_head": _dense_shapes(deep, (model.frames + 1) * pixels),
            **({"sensor_projection": {"kernel": (width, deep)}} if model.decoder_sensor_tokens else {}),
        },
    }
    if model.image:
        wide = model.image.width
        tree["image"] = {**_vision_shapes(model.image, rows, model.embed), "patch": {"kernel": (pixels, wide)}}
        if model.lora_rank:
            a, b = (model.image.depth, wide, model.lora_rank), (model.image.depth, model.lora_rank, wide)
            tree["lora"] = {name: {"a": a, "b": b} for name in PROJECTIONS}
    if model.text:
        stack = model.text.stack
        tree["text"] = {
            "token": (model.text.vocab, stack.width),
            "position": (model.text.length, stack.width),
            "blocks": _block_shapes(stack),
            "final_norm": _norm_shapes(stack.width),
            "projection": {"kernel": (stack.width, model.embed)},
        }
    if model.image or model.text or model.match_head == "cosine":
        tree["logit_scale"] = ()
    if model.match_head == "linear":
        tree["matcher"] = _dense_shapes(model.embed, 1)
    elif model.match_head == "mlp":
        tree["matcher"] = {"up": _dense_shapes(model.embed, model.embed), "down": _dense_shapes(model.embed, 1)}
    if model.force_head:
        tree["force"] = _dense_shapes(model.embed, 2)
    return flatten(tree, is_leaf=lambda node: isinstance(node, tuple))


def _dense_shapes(inner: int, outer: int) -> dict[str, Shape]:
    return {"kernel": (inner, outer), "bias": (outer,)}


def _patch_shapes(model: ModelConfig) -> dict[str, object]:
    if model.patch_encoder == "convolutional":
        few, more = STEM
        left = -(-model.patch // 4)
        return {
            "kernel": (model.frames, 25 * 3, few),
            "norm1": _norm_shapes(few),
            "second": {"kernel": (9 * few, more)},
            "norm2": _norm_shapes(more),
            "last": {"kernel": (left * left * more, model.touch.width)},
        }
    own = (len(model.sensors),) if model.patch_encoder == "sensor" else ()
    return {"kernel": (*own, model.frames, 3 * model.patch**2, model.touch.width)}


def _norm_shapes(width: int) -> dict[str, Shape]:
    return {"scale": (width,), "bias": (width,)}


def _block_shapes(stack: Stack) -> dict[str, object]:
    depth, width = stack.depth, stack.width

    def stacked(shapes: dict[str, Shape]) -> dict[str, Shape]:
        return {name: (depth, *shape) for name, shape in shapes.items()}

    return {
        "norm1": stacked(_norm_shapes(width)),
        "norm2": stacked(_norm_shapes(width)),
        "attention": {name: stacked(_dense_shapes(width, width)) for name in PROJECTIONS},
        "mlp": {"up": stacked(_dense_shapes(width, stack.mlp)), "down": stacked(_dense_shapes(stack.mlp, width))},
    }


def _vision_shapes(stack: Stack, rows: int, embed: int) -> dict[str, object]:
    return {
        "class_token": (stack.width,),
        "position": (rows, stack.width),
        "pre_norm": _norm_shapes(stack.width),
        "blocks": _block_shapes(stack),
        "post_norm": _norm_shapes(stack.width),
        "projection": {"kernel": (stack.width, embed)},
    }
