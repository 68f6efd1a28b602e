"""Small models with their parameters and weights files, for the tests of weights."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.config import Config, ModelConfig, Stack, TextTower, to_json
from anytouch_jax.weights.checkpoint import Checkpoints
from anytouch_jax.weights.convert import to_release
from anytouch_jax.weights.keymaps import param_shapes
from anytouch_jax.weights.safetensors import write_safetensors
from anytouch_jax.weights.tree import flatten, nest
from tests.support.release_keys import release_names, release_shapes

STAGE1 = ModelConfig(28, 14, 12, Stack(16, 2, 4, 24), Stack(8, 3, 2, 20))
STAGE2 = replace(
    STAGE1, image=Stack(16, 2, 4, 24), text=TextTower(Stack(10, 2, 2, 14), vocab=30, length=7), match_head="linear",
    lora_rank=3,
)  # fmt: skip
NO_LORA = replace(STAGE2, lora_rank=0)
MLP = replace(STAGE2, match_head="mlp")
DECODER_TOKENS = replace(STAGE1, decoder_sensor_tokens=True)


def weights_of(model: ModelConfig, layout: str | None = None, seed: int = 0) -> dict[str, np.ndarray]:
    """Random arrays of a file of `model`, under its own keys."""
    rng = np.random.default_rng(seed)
    return {key: rng.normal(size=shape).astype("f4") for key, shape in release_shapes(model, layout).items()}


def params_of(model: ModelConfig, seed: int = 0) -> dict[str, Any]:
    """Random parameters of a model."""
    rng = np.random.default_rng(seed)
    return nest({name: rng.normal(size=shape).astype("f4") for name, shape in param_shapes(model).items()})


def assert_same(first: Any, second: Any) -> None:
    """Two trees have the same names and the same numbers, to the bit."""
    first, second = flatten(first), flatten(second)
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)


def save_run(folder: Path, config: Config, params: Any, **metadata: Any) -> Path:
    """A run folder with one checkpoint of these parameters."""
    saver = Checkpoints(folder / "checkpoints", keep=1, config_json=to_json(config), metadata=metadata)
    saver.save(1, {"trainable": params}, {"loss": 1.0})
    saver.close()
    return folder


def save_clip(folder: Path, model: ModelConfig, params: Any) -> Path:
    """The image and text towers of a model as a folder with HF CLIP weights and their head counts."""
    plain = replace(model, lora_rank=0)
    arrays = to_release({n: p for n, p in params.items() if n != "lora"}, plain, allow_extra=True)
    keys = release_names(plain, "clip")
    folder.mkdir(exist_ok=True)
    write_safetensors(folder / "model.safetensors", {key: arrays[key] for key in keys}, {"format": "pt"})
    write_heads(folder, model)
    return folder


def write_heads(folder: Path, model: ModelConfig) -> None:
    """The config.json beside weights, with the head counts of a model alone."""
    heads = {name: stack.heads for name in ("touch", "decoder", "image") if (stack := getattr(model, name))}
    heads |= {"text": model.text.stack.heads} if model.text else {}
    settings = {name: {"heads": count} for name, count in heads.items()}
    (folder / "config.json").write_text(json.dumps({"model": settings}))


def openclip_of(params, model: ModelConfig) -> dict[str, np.ndarray]:
    """OpenCLIP's names and layouts, written down a second time."""
    weights = {"logit_scale": params["logit_scale"], "attn_mask": np.zeros((7, 7), "f4")}
    towers = {
        "visual.": (
            "image", model.image, {"class_embedding": "class_token", "positional_embedding": "position"}, "visual.proj",
        ),
        "": (
            "text", model.text.stack, {"token_embedding.weight": "token", "positional_embedding": "position"},
            "text_projection",
        ),
    }  # fmt: skip
    for prefix, (part, stack, tables, projection) in towers.items():
        tower = params[part]
        weights |= {prefix + key: tower[name] for key, name in tables.items()}
        weights[projection] = tower["projection"]["kernel"]
        norms = {"ln_pre": "pre_norm", "ln_post": "post_norm"} if prefix else {"ln_final": "final_norm"}
        for key, name in norms.items():
            weights |= {f"{prefix}{key}.weight": tower[name]["scale"], f"{prefix}{key}.bias": tower[name]["bias"]}
        for layer in range(stack.depth):
            block = f"{prefix}transformer.resblocks.{layer}."
            rows = tower["blocks"]
            attention = rows["attention"]
            qkv = [attention[name] for name in ("query", "key", "value")]
            weights[f"{block}attn.in_proj_weight"] = np.concatenate([dense["kernel"][layer].T for dense in qkv])
            weights[f"{block}attn.in_proj_bias"] = np.concatenate([dense["bias"][layer] for dense in qkv])
            dense = {
                "attn.out_proj": attention["out"], "mlp.c_fc": rows["mlp"]["up"], "mlp.c_proj": rows["mlp"]["down"],
            }  # fmt: skip
            for key, leaf in dense.items():
                weights |= {f"{block}{key}.weight": leaf["kernel"][layer].T, f"{block}{key}.bias": leaf["bias"][layer]}
            for key, name in {"ln_1": "norm1", "ln_2": "norm2"}.items():
                weights |= {
                    f"{block}{key}.weight": rows[name]["scale"][layer],
                    f"{block}{key}.bias": rows[name]["bias"][layer],
                }
    kernel = params["image"]["patch"]["kernel"]
    weights["visual.conv1.weight"] = kernel.reshape(14, 14, 3, -1).transpose(3, 2, 0, 1)
    return weights
