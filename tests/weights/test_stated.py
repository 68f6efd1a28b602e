import json

import numpy as np
import pytest
from PIL import Image
from safetensors.numpy import save_file

from anytouch_jax.encoder.family import prepare
from anytouch_jax.weights.families import load_family
from tests.weights.test_families import HF, TIMM, made

RNG = np.random.default_rng(0)
FRAME = RNG.integers(0, 256, (60, 80, 3), np.uint8)
SIDE = {"height": 48, "width": 48}
CLIP = {"size": {"shortest_edge": 52}, "crop_size": SIDE, "do_center_crop": True, "image_mean": [0.1] * 3,
        "image_std": [0.2] * 3, "resample": 3}  # fmt: skip
TIMM_CFG = {"mean": [0.5] * 3, "std": [0.5] * 3, "crop_pct": 0.9, "interpolation": "bicubic", "input_size": [3, 48, 48]}


def resized(size, kernel):
    return np.asarray(Image.fromarray(FRAME).resize(size[::-1], kernel), np.float32)


def cropped(short, kernel, side=48):
    """What torchvision's Resize(short) and CenterCrop(side) return."""
    pixels = resized((short, int(short * 80 / 60)), kernel)
    top, left = (round((length - side) / 2) for length in pixels.shape[:2])
    return pixels[top : top + side, left : left + side]


BILINEAR, BICUBIC, LANCZOS = Image.Resampling.BILINEAR, Image.Resampling.BICUBIC, Image.Resampling.LANCZOS


@pytest.mark.parametrize(
    ("stated", "expected", "ignored"),
    [
        ({"config": {"architecture": "vit", "pretrained_cfg": TIMM_CFG}}, (cropped(53, BICUBIC) / 255 - 0.5) / 0.5, ""),
        ({"config": {"architecture": "vit"} | TIMM_CFG | {"crop_pct": 1.0, "interpolation": "bilinear"}},
         (cropped(48, BILINEAR) / 255 - 0.5) / 0.5, ""),
        ({"config": {"pretrained_cfg": TIMM_CFG | {"crop_mode": "squash", "crop_pct": 1.0}}},
         (resized((48, 48), BICUBIC) / 255 - 0.5) / 0.5, ""),
        ({"config": {"pretrained_cfg": TIMM_CFG | {"crop_mode": "border"}}}, None, "crop_mode border with crop_pct"),
        ({"preprocessor_config": CLIP}, (cropped(52, BICUBIC) / 255 - 0.1) / 0.2, ""),
        ({"preprocessor_config": CLIP | {"size": 52, "crop_size": 48, "resample": 1}},
         (cropped(52, LANCZOS) / 255 - 0.1) / 0.2, ""),
        ({"preprocessor_config": {"size": SIDE, "resample": 2, "do_normalize": False}},
         resized((48, 48), BILINEAR) / 255, ""),
        ({"preprocessor_config": {"size": 48, "resample": 2, "image_mean": [0.5] * 3, "image_std": [0.5] * 3,
                                  "rescale_factor": 1 / 127.5}}, (resized((48, 48), BILINEAR) / 127.5 - 0.5) / 0.5, ""),
        ({"preprocessor_config": {"size": 48, "resample": 2, "image_mean": [9.0] * 3, "image_std": [3.0] * 3,
                                  "do_rescale": False}}, (resized((48, 48), BILINEAR) - 9) / 3, ""),
        ({"preprocessor_config": CLIP, "config": {"pretrained_cfg": TIMM_CFG}},
         (cropped(52, BICUBIC) / 255 - 0.1) / 0.2, ""),
        ({"preprocessor_config": CLIP | {"do_pad": True, "pad_size": SIDE}}, None, "do_pad True, pad_size"),
        ({"preprocessor_config": {"size": {"shortest_edge": 52}}}, None, "size {'shortest_edge': 52}"),
        ({"preprocessor_config": {"size": 47}}, None, "an input of 47 x 47 pixels"),
        ({"config": {"preparation": {"mean": [0.3] * 3, "std": [1.0] * 3}, "pretrained_cfg": TIMM_CFG}},
         cropped(53, BICUBIC) / 255 - 0.3, ""),
    ],
)  # fmt: skip
@pytest.mark.parametrize("title", [TIMM, HF])
def test_what_is_stated_beside_the_weights_is_computed_or_named(tmp_path, recwarn, title, stated, expected, ignored):
    more = {"grid": (1, 6, 6)} | ({"layer_scale": True} if title == HF else {})
    save_file(made(title, (16, 1, 2, 32), 8, more, (48, 48))[2], str(tmp_path / "model.safetensors"))
    for name, content in stated.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(content))
    model, _ = load_family(tmp_path, heads=2)
    words = " ".join(str(one.message) for one in recwarn)
    assert (ignored in words) if ignored else not words
    if expected is not None:
        assert model.image_size == (48, 48)
        np.testing.assert_allclose(prepare(FRAME, None, model.preparation, model.image_size), expected, atol=1e-5)
