"""Newer backbones of RGB images against timm 1.0.31 and transformers 5.24 with torch 2.13, and
what is not read.

data/backbones.npz has networks of width 16, depth 2, two heads and patches of 4 pixels: drawn
weights (multiples of 1/16, stored as float16), drawn images (2, H, W, 3) and the tokens after the
last norm, in float32 on a CPU. They come from `VisionTransformer(reg_tokens=4, no_embed_class=True,
init_values=1e-5)` and `Eva(rope_type="dinov3", num_reg_tokens=4)` of timm, and from
`DINOv3ViTModel` and `SiglipVisionModel`. Meta's layout is timm's by other names, given to timm's
own conversion, with a key bias that the mask takes out.
"""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from anytouch_jax import load_encoder
from anytouch_jax.config import preset
from anytouch_jax.errors import UserError
from anytouch_jax.nn.functional import build
from anytouch_jax.weights.start import load_start

with np.load(Path(__file__).parent / "data" / "backbones.npz") as _file:
    ARRAYS = dict(_file)
NAMES = sorted({name.split("|")[0] for name in ARRAYS})


def weights_of(name: str) -> dict[str, np.ndarray]:
    shapes = json.loads(str(ARRAYS[f"{name}|keys"]))
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes.values()])[:-1]
    parts = zip(shapes.items(), np.split(ARRAYS[f"{name}|weights"].astype("f4"), ends), strict=True)
    return {key: x.reshape(shape) for (key, shape), x in parts}


def written(folder: Path, weights: dict[str, np.ndarray], **config) -> Path:
    folder.mkdir(exist_ok=True)
    save_file(
        {key: np.ascontiguousarray(x) for key, x in weights.items()}, folder / "model.safetensors"
    )
    (folder / "config.json").write_text(json.dumps(config))
    return folder


@pytest.mark.parametrize("name", NAMES)
def test_tokens_are_those_of_the_library(name, tmp_path):
    images = ARRAYS[f"{name}|input"]
    tokens = ARRAYS[f"{name}|tokens"]
    encoder = load_encoder(
        written(tmp_path / "one", weights_of(name)), heads=2, image_size=images.shape[1:3]
    )
    np.testing.assert_allclose(encoder.encode_tokens(images), tokens, rtol=1e-4, atol=2e-5)
    start = 0 if "SigLIP" in name else 5
    np.testing.assert_allclose(
        encoder.encode_touch(images, pooling="mean"), tokens[:, start:].mean(1), atol=2e-5
    )
    own = ARRAYS.get(f"{name}|pooled", tokens.mean(1) if "SigLIP" in name else tokens[:, 0])
    np.testing.assert_allclose(encoder.encode_touch(images), own, rtol=1e-4, atol=2e-5)


@pytest.mark.parametrize("name", ["HF DINOv3", "HF SigLIP 2"])
def test_other_spellings_of_keys_and_a_nested_config(name, tmp_path):
    weights = weights_of(name)
    images = ARRAYS[f"{name}|input"]
    size = images.shape[1:3]
    wanted = load_encoder(
        written(tmp_path / "one", weights), heads=2, image_size=size
    ).encode_touch(images)
    text = {
        "text_model.embeddings.token_embedding.weight": np.zeros((3, 16), "f4"),
        "logit_bias": np.zeros(1, "f4"),
    }
    prefix, more = ("vision_model.", text) if "SigLIP" in name else ("", {})
    other = {f"{prefix}{key.removeprefix('model.')}": x for key, x in weights.items()} | more
    folder = written(tmp_path / "two", other, vision_config={"num_attention_heads": 2})
    np.testing.assert_array_equal(
        load_encoder(folder, image_size=size).encode_touch(images), wanted
    )


def test_backbones_without_positions_or_a_class_token_start_no_training(tmp_path):
    config = preset("tiny")
    fresh = build(config.model).abstract()
    for name in ("timm DINOv3", "HF SigLIP 2"):
        folder = written(tmp_path / name[:2], weights_of(name), num_attention_heads=2)
        with pytest.raises(UserError, match="a run starts from"):
            load_start(fresh, config, init=folder)


TIMM = weights_of("timm DINOv2 with registers")
HF = weights_of("HF DINOv3")
SIGLIP = weights_of("HF SigLIP 2")


@pytest.mark.parametrize(
    ("weights", "without", "words"),
    [
        (
            TIMM | {"fc_norm.weight": np.ones(16, "f4"), "head.weight": np.ones((3, 16), "f4")},
            r"norm\.",
            "fine-tuned",
        ),
        (TIMM, r"cls_token|reg_token", "without a class token"),
        (TIMM, r"norm\.|.*ls\d|reg_token", "no final norm"),
        (TIMM | {"fc_norm.weight": np.ones(16, "f4")}, r"norm\.|cls_token", "fine-tuned"),
        (TIMM | {"dist_token": np.ones((1, 1, 16), "f4")}, "reg_token", "distilled"),
        (TIMM | {"blocks.0.mlp.w12.weight": np.ones((3, 16), "f4")}, "nothing", "SwiGLU"),
        (HF | {"model.layer.0.mlp.gate_proj.weight": np.ones((3, 16), "f4")}, "nothing", "SwiGLU"),
        (
            {f"vision_model.{key}": x for key, x in SIGLIP.items()}
            | {"vision_model.embeddings.patch_embedding.weight": np.ones((16, 48), "f4")},
            "nothing",
            "NaFlex",
        ),
    ],
)
def test_relatives_that_are_not_read_get_a_true_sentence(weights, without, words, tmp_path):
    kept = {key: x for key, x in weights.items() if not re.match(without, key)}
    with pytest.raises(UserError, match=words) as error:
        load_encoder(written(tmp_path / "one", kept), heads=2)
    assert "Sparsh" not in str(error.value) and ".safetensors is an encoder" not in str(error.value)
