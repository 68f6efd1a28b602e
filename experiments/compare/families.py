"""Untrained encoders of every family at its released size, for what depends on the form alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import numpy as np

from anytouch_jax.config import UNIVERSAL, Config, DataConfig, ModelConfig, Stack, preset
from anytouch_jax.encoder.base import Encoder, random_encoder
from anytouch_jax.nn.functional import Part
from anytouch_jax.nn.vit import Vit, VitConfig
from anytouch_jax.zoo.encoder import FamilyEncoder
from anytouch_jax.zoo.families import FAMILIES, Family

SMALL = Stack(384, 12, 6, 1536)
BASE = Stack(768, 12, 12, 3072)
_T3 = Stack(768, 3, 12, 3072)
_GRID14 = (1, 37, 37)
_GRID16 = (1, 14, 14)
_DINO: dict[str, Any] = {"patch": 14, "grid": _GRID14, "layer_scale": True}
_SPARSH: dict[str, Any] = {"tubelet": 2, "class_token": False, "layer_scale": True, "frames": 2}
# name -> title of the family, stack, and what differs from a plain ViT of patches of 16 pixels
FORMS: dict[str, tuple[str, Stack, dict[str, Any]]] = {
    "Sparsh MAE or I-JEPA, small": ("Sparsh", SMALL, _SPARSH),
    "Sparsh DINO, base": ("Sparsh", BASE, {**_SPARSH, "registers": 1}),
    "Sparsh V-JEPA, base": ("Sparsh V-JEPA", BASE, {**_SPARSH, "frames": 4, "axes": 3}),
    "T3, medium": ("T3", _T3, {"grid": _GRID16, "trunk": 9}),
    "AnyTouch 2": (
        "AnyTouch 2",
        BASE,
        {
            "tubelet": 2,
            "frames": 4,
            "grid": (2, 14, 14),
            "patch_bias": False,
            "pre_norm": True,
            "outputs": 512,
            "sensors": 20,
            "sensor_tokens": 5,
        },
    ),
    "SITR, 18 images": (
        "SITR",
        BASE,
        {"grid": _GRID16, "calibration": 18, "outputs": 128, "output_bias": True},
    ),
    "DINOv2, small": ("DINOv2 (Hugging Face)", SMALL, _DINO),
    "DINOv2 with registers, base": ("DINOv2 (Hugging Face)", BASE, {**_DINO, "registers": 4}),
    "ViT-MAE, base": ("ViT-MAE (Hugging Face)", BASE, {"grid": _GRID16}),
    "ViT or DeiT, base": ("ViT or DeiT (Hugging Face)", BASE, {"grid": _GRID16}),
}
OURS = {
    "AnyTouch, ViT-L/14 (preset large)": "large",
    "AnyTouch, preset base": "base",
    "AnyTouch, preset tiny": "tiny",
}


def form_of(name: str) -> tuple[Family, VitConfig]:
    """Return the family of a row of FORMS and the form of its network."""
    title, stack, more = FORMS[name]
    family = next(one for one in FAMILIES if one.title == title)
    more = dict(more)
    patch = more.pop("patch", 16)
    frames = more.pop("frames", 1)
    size = max(family.image_size or (224, 224))
    rows = more.pop("sensors", 1)
    tokens = more.pop("sensor_tokens", 0)
    sensors = (*(f"sensor{row}" for row in range(rows - 1)), UNIVERSAL)
    model = ModelConfig(
        size,
        patch,
        more.get("outputs", 0) or stack.width,
        stack,
        Stack(512, 8, 16, 2048),
        frames=frames,
        sensors=sensors,
        sensor_tokens=tokens,
        norm_eps=family.eps,
    )
    return family, VitConfig(model, resample=family.resample, **more)


def untrained(name: str) -> Encoder:
    """Return the untrained encoder of a row of FORMS or OURS."""
    if name in OURS:
        return random_encoder(preset(OURS[name]))  # type: ignore[arg-type]
    family, form = form_of(name)
    size = family.image_size or (224, 224)
    params = Part(Vit, form).init(jax.random.key(0))
    data = DataConfig(background=family.preparation.background)
    encoder = FamilyEncoder(
        Config(form.model, data=data),
        params,
        f"untrained {name}",
        family=family,
        form=form,
        preparation=family.preparation,
        image_size=size,
    )
    if form.calibration:
        encoder = replace(encoder, calibration=np.zeros((form.calibration, *size, 3), np.float32))
    return encoder
