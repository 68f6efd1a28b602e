"""A touch encoder that starts from an encoder of RGB images, such as DINOv2, ViT-MAE or DeiT."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.config import Config
from anytouch_jax.errors import UserError
from anytouch_jax.weights import convert
from anytouch_jax.weights.tree import nest
from anytouch_jax.zoo.efficientnet import ConvModel
from anytouch_jax.zoo.families import FamilyModel
from anytouch_jax.zoo.table import IMAGES


def touch_of_rgb_images(
    model: FamilyModel | ConvModel, source: str, config: Config, fresh: dict[str, Any]
) -> tuple[dict[str, Any], list[str]]:
    """Return a touch encoder that gives a still the tokens of a ViT of RGB images, and sentences
    to log.

    The patch kernel is divided among the frames. Its bias goes into the resized positions, and
    layer scales into the layers before them. Raises UserError for another family, and for a network
    of another form.

    Args:
        model: a ViT, or a network of another family, which is refused.
        source: its name for sentences.
        config: of the run.
        fresh: parameters of the touch encoder before training.
    """
    if not isinstance(model, FamilyModel):
        raise UserError(f"{source} has convolutions, and a touch encoder starts from a transformer")
    form = model.form
    ours = config.model
    has_tokens = {"position", "class_token"} <= model.params.keys() and not form.tanh
    if model.family.sensors != IMAGES or form.model.touch.depth == 0 or not has_tokens:
        raise UserError(
            f"{source} is an encoder of {model.family.title}; a run starts from weights of "
            "AnyTouch, DINOv2, ViT-MAE, ViT, DeiT or CLIP"
        )
    kept = {
        name: getattr(ours, name)
        for name in ("embed", "frames", "sensor_tokens", "patch_encoder", "decoder")
    }
    theirs = replace(
        form.model, **kept, decoder_norm_eps=ours.decoder_norm_eps, pre_norm=form.pre_norm
    )
    convert.check_form(Path(source), theirs, config)
    if ours.activation != "gelu":
        raise UserError(
            f"{source} was trained with gelu; leave out --model.activation {ours.activation}"
        )
    own = {
        name: array
        for name, array in model.params.items()
        if name.startswith(("blocks/", "post_norm/", "pre_"))
    }
    for scale, branch in (("scale1", "attention/out"), ("scale2", "mlp/down")):
        if (factor := own.pop(f"blocks/{scale}/scale", None)) is not None:
            own[f"blocks/{branch}/kernel"] = own[f"blocks/{branch}/kernel"] * factor[:, None]
            own[f"blocks/{branch}/bias"] = own[f"blocks/{branch}/bias"] * factor
    position = convert.resize_position(model.params["position"], ours.patches + 1)
    position[1:] += model.params.get("patch/bias", np.float32(0))
    shape = fresh["patch"]["kernel"].shape
    own["patch/kernel"] = np.broadcast_to(model.params["patch/kernel"][0], shape) / np.float32(
        shape[-3]
    )
    touch = {name: fresh[name] for name in ("sensor_tokens", "projection")}
    touch |= nest({**own, "position": position, "class_token": model.params["class_token"]})
    notes = [
        f"{source} gives the touch encoder; its projection, the sensor tokens and the decoder "
        "start untrained"
    ]
    if form.registers:
        notes.append(f"the {form.registers} register tokens of {source} are left out")
    return touch, notes
