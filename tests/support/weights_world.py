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
    STAGE1,
    image=Stack(16, 2, 4, 24),
    text=TextTower(Stack(10, 2, 2, 14), vocab=30, length=7),
    match_head="linear",
    lora_rank=3,
)
NO_LORA = replace(STAGE2, lora_rank=0)
MLP = replace(STAGE2, match_head="mlp")
DECODER_TOKENS = replace(STAGE1, decoder_sensor_tokens=True)


def weights_of(
    model: ModelConfig, layout: str | None = None, seed: int = 0
) -> dict[str, np.ndarray]:
    """Random arrays of a file of `model`, under its own keys."""
    rng = np.random.default_rng(seed)
    return {
        key: rng.normal(size=shape).astype("f4")
        for key, shape in release_shapes(model, layout).items()
    }


def params_of(model: ModelConfig, seed: int = 0) -> dict[str, Any]:
    """Random parameters of a model."""
    rng = np.random.default_rng(seed)
    return nest(
        {name: rng.normal(size=shape).astype("f4") for name, shape in param_shapes(model).items()}
    )


def assert_same(first: Any, second: Any) -> None:
    """Two trees have the same names and the same numbers, to the bit."""
    first = flatten(first)
    second = flatten(second)
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name], second[name], err_msg=name)


def save_run(folder: Path, config: Config, params: Any, **metadata: Any) -> Path:
    """A run folder with one checkpoint of these parameters."""
    saver = Checkpoints(
        folder / "checkpoints", keep=1, config_json=to_json(config), metadata=metadata
    )
    saver.save(1, {"trainable": params}, {"loss": 1.0})
    saver.close()
    return folder


def save_clip(folder: Path, model: ModelConfig, params: Any) -> Path:
    """The image and text towers of a model as a folder with HF CLIP weights and their head
    counts.
    """
    plain = replace(model, lora_rank=0)
    arrays = to_release({n: p for n, p in params.items() if n != "lora"}, plain, allow_extra=True)
    keys = release_names(plain, "clip")
    folder.mkdir(exist_ok=True)
    write_safetensors(
        folder / "model.safetensors", {key: arrays[key] for key in keys}, {"format": "pt"}
    )
    write_heads(folder, model)
    return folder


def write_heads(folder: Path, model: ModelConfig) -> None:
    """The config.json beside weights, with the head counts of a model alone."""
    heads = {
        name: stack.heads
        for name in ("touch", "decoder", "image")
        if (stack := getattr(model, name))
    }
    heads |= {"text": model.text.stack.heads} if model.text else {}
    settings = {name: {"heads": count} for name, count in heads.items()}
    (folder / "config.json").write_text(json.dumps({"model": settings}))


OPENCLIP = {
    "vision_model.": "visual.",
    "text_model.": "",
    "embeddings.": "",
    "encoder.layers": "transformer.resblocks",
    "self_attn": "attn",
    "pre_layrnorm": "ln_pre",
    "post_layernorm": "ln_post",
    "final_layer_norm": "ln_final",
    "layer_norm": "ln_",
    "mlp.fc1": "mlp.c_fc",
    "mlp.fc2": "mlp.c_proj",
    "patch_embedding": "conv1",
    "position_embedding.weight": "positional_embedding",
    "visual_projection.weight": "visual.proj",
    "text_projection.weight": "text_projection",
}


def openclip_of(clip: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of CLIP by Hugging Face under the names and in the layouts of OpenCLIP."""
    weights = {"attn_mask": np.zeros((7, 7), "f4")}
    for key, array in clip.items():
        for theirs, ours in OPENCLIP.items():
            key = key.replace(theirs, ours)
        weights[key] = array.T if key in ("visual.proj", "text_projection") else array
    for key in [key for key in weights if "q_proj." in key]:
        thirds = [
            weights.pop(key.replace("q_proj", part)) for part in ("q_proj", "k_proj", "v_proj")
        ]
        weights[key.replace("q_proj.", "in_proj_")] = np.concatenate(thirds)
    return weights
