"""Table of the families of encoders that others published.

To add a family, add a record to `FAMILIES`: how its files are recognised, which array is which
parameter, and how its frames are prepared.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from anytouch_jax.config import CLIP_MEAN, CLIP_STD, IMAGENET_MEAN, IMAGENET_STD
from anytouch_jax.config.parsing import Above0, Count, check
from anytouch_jax.nn.vit import Resample
from anytouch_jax.weights.keymaps import Entry, Weights
from anytouch_jax.zoo import keymaps

Size = tuple[int, int]
ALIASES = {"mini": "gelsight_mini"}  # names of T3's files
SHARED = ("trunk", "post_norm")  # what T3's sensors have in common


@dataclass(frozen=True)
class Preparation:
    """How a family prepares a frame RGB u8, in this order.

    A config.json may change it (`"preparation"`).

    `difference`: Sparsh's frame - background + 127 in whole grey levels, AnyTouch 2's + 130 in
    floats, or SITR's plain difference without an offset, in grey levels.
    """

    background: Literal["keep", "subtract", "either"] = "keep"
    difference: Literal["none", "levels", "offset", "plain"] = "none"
    portrait: bool = False  # Rotate a frame that is wider than high by 90 degrees clockwise.
    crop: Literal["none", "rows", "centre", "square"] = "none"
    # Shorter side before a centre crop. None: 8/7 of the image size.
    shorter: Count[int] | None = None
    filter: Literal["nearest", "lanczos", "bilinear", "bicubic", "box", "hamming"] = "bilinear"
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: Above0[tuple[float, float, float]] = (1.0, 1.0, 1.0)
    # The order of the frames for the network. Clips are given oldest first.
    newest_first: bool = False
    stride: Count[int] = 1  # Distance of the frames of a clip.

    def __post_init__(self) -> None:
        check(self)


@dataclass(frozen=True)
class Family:
    """One layout of a family's files.

    A file is of the family if, after one of the `prefixes`, it has all keys in `needs` and none in
    `lacks`, and `beside` without the prefix. The patch kernel, first of `needs`, has five axes for
    `video`. Keys in `unused` (a regex) are not read. `renamed` comes first.
    """

    name: str
    title: str
    licence: str
    sensors: str  # What it was trained on, in words.
    table: tuple[Entry, ...]
    needs: tuple[str, ...]
    preparation: Preparation
    lacks: tuple[str, ...] = ()
    beside: str | None = None
    prefixes: tuple[str, ...] = ("",)
    unused: str = ""
    eps: float = 1e-6
    resample: Resample = "none"
    image_size: Size | None = None  # None: that of the stored positions.
    frames: int = 1
    video: bool = False
    names: tuple[str, ...] = ()  # Sensors of the rows of tokens.
    feature: Literal["class", "mean", "projected", "unit", "pooled"] = "class"
    tokens: Literal["normed", "patches", "hidden"] = "normed"
    # Other spellings of keys: a regex, and the key of the table.
    renamed: tuple[tuple[str, str], ...] = ()
    activation: str = "gelu"
    bare_class: bool = False  # The stored positions have none of the class token.

    def weights(self, weights: Weights) -> dict[str, np.ndarray] | None:
        """Return the arrays of the encoder without their prefix, None if the file is of another
        family.
        """
        if self.beside is not None and self.beside not in weights:
            return None
        for prefix in self.prefixes:
            own = {
                key.removeprefix(prefix): x for key, x in weights.items() if key.startswith(prefix)
            }
            for spelling, ours in self.renamed:
                own = {re.sub(spelling, ours, key): x for key, x in own.items()}
            if not own.keys() >= {*self.needs} or own.keys() & {*self.lacks}:
                continue
            if (own[self.needs[0]].ndim == 5) == self.video:
                return {key: x for key, x in own.items() if not re.fullmatch(self.unused, key)}
        return None


_APACHE = "Apache-2.0"
_NON_COMMERCIAL = "CC BY-NC 4.0: non-commercial"
IMAGES = "RGB images, no touch"
TIMM_NEEDS = ("patch_embed.proj.weight", "cls_token", "pos_embed", "blocks.0.attn.qkv.weight")
_HF_NEEDS = ("embeddings.patch_embeddings.projection.weight", "embeddings.cls_token")
_PARTS = r"(head|head_dist|fc_norm|pooler|classifier|decoder\w*)\..*|(decoder_pos_embed|mask_token)"
_PHOTO = Preparation(crop="centre", filter="bicubic", mean=IMAGENET_MEAN, std=IMAGENET_STD)
_DINOV2: dict[str, Any] = {"unused": r"mask_token|embeddings\.mask_token", "image_size": (224, 224)}
_DINOV3: dict[str, Any] = {
    "unused": r"(embeddings\.)?mask_token|local_cls_norm\..*|.*\.bias_mask",
    "image_size": (224, 224),
    "eps": 1e-5,
    "lacks": ("pos_embed",),
    "preparation": Preparation(filter="bicubic", mean=IMAGENET_MEAN, std=IMAGENET_STD),
    "renamed": (
        (r"rope_embed\.periods", "periods"),
        ("storage_tokens|reg_token", "register_tokens"),
        (r"\.gamma_(\d)", r".ls\1.gamma"),
        (r"^model\.layer\.", "layer."),
    ),
}
_HF_VIT: dict[str, Any] = {
    "prefixes": ("vit.", "deit.", ""),
    "unused": _PARTS,
    "eps": 1e-12,
    "resample": "bicubic",
}
# A network of convolutions, which has a reader of its own (`zoo.efficientnet`).
CONVOLUTIONAL = Family(
    name="efficientnet",
    title="EfficientNet-lite of ImageNet",
    licence=_APACHE,
    sensors=IMAGES,
    table=(),
    needs=("_conv_stem.weight",),
    preparation=Preparation("either"),
)
FAMILIES = (
    *(
        Family(
            name="sparsh",
            title=title,
            licence=_NON_COMMERCIAL,
            sensors="DIGIT, GelSight, GelSight Mini",
            table=table,
            needs=("patch_embed.proj.weight", "blocks.0.ls1.gamma"),
            preparation=Preparation(
                "either", "levels", portrait=True, crop="rows", newest_first=True, stride=stride
            ),
            prefixes=(
                "teacher_encoder.backbone.",
                "target_encoder.backbone.",
                "target_encoder.",
                "encoder.",
                "",
            ),
            lacks=("cls_token",),
            unused="mask_token",
            image_size=(320, 240),
            frames=frames,
            video=frames == 4,
            feature="mean",
            tokens="patches",
        )
        for title, table, frames, stride in (
            ("Sparsh", keymaps.SPARSH, 2, 5),
            ("Sparsh V-JEPA", keymaps.SPARSH_VIDEO, 4, 2),
        )
    ),
    Family(
        name="anytouch2",
        title="AnyTouch 2",
        licence="MIT",
        sensors="GelSight, DIGIT, GelSight Mini, DuraGel by tokens",
        table=keymaps.ANYTOUCH2,
        needs=("touch_model.embeddings.patch_embedding.weight", "sensor_token"),
        # not ImageNet's, unlike AnyTouch
        preparation=Preparation("subtract", "offset", mean=CLIP_MEAN, std=CLIP_STD),
        lacks=("video_patch_embedding.weight",),
        prefixes=("touch_mae_model.",),
        eps=1e-5,
        frames=4,
        video=True,
        unused=r"(decoder|mask_token|new_position_ids).*",
        feature="projected",
        tokens="hidden",
        names=("gelsight", "digit", "sensor2", "gelsight_mini", "duragel"),
    ),
    Family(
        name="sitr",
        title="SITR",
        licence="MIT by its README, without a licence file",
        sensors="GelSight designs, by calibration images",
        table=keymaps.SITR,
        needs=(*TIMM_NEEDS, "contrastive_head.weight"),
        preparation=Preparation(
            "subtract",
            "plain",
            crop="square",
            mean=(-1.2223, -1.8114, -1.7090),
            std=(11.7932, 12.7956, 13.6452),
        ),
        prefixes=("base_model.", ""),
        unused=r"decoder_pred\..*",
        eps=1e-5,
        feature="unit",
    ),
    Family(
        name="dinov3",
        title="DINOv3 (Hugging Face)",
        licence="DINOv3 licence",
        sensors=IMAGES,
        table=keymaps.HF_DINOV3,
        needs=(
            "embeddings.patch_embeddings.weight",
            "embeddings.cls_token",
            "layer.0.norm1.weight",
        ),
        prefixes=("dinov3_vit.", ""),
        **_DINOV3,
    ),
    Family(
        name="dinov3",
        title="DINOv3 (timm's or its authors' layout)",
        licence="DINOv3 licence",
        sensors=IMAGES,
        table=keymaps.DINOV3,
        needs=("patch_embed.proj.weight", "cls_token", "register_tokens", "blocks.0.ls1.gamma"),
        **_DINOV3,
    ),
    Family(
        name="siglip",
        title="SigLIP or SigLIP 2 (vision tower of Hugging Face)",
        licence=_APACHE,
        sensors=IMAGES,
        table=keymaps.SIGLIP,
        needs=tuple(
            f"embeddings.{name}"
            for name in (
                "patch_embedding.weight",
                "patch_embedding.bias",
                "position_embedding.weight",
            )
        ),
        preparation=Preparation(filter="bicubic", mean=(0.5,) * 3, std=(0.5,) * 3),
        lacks=("embeddings.class_embedding",),
        prefixes=("vision_model.", "model.vision_model.", ""),
        resample="bicubic",
        feature="pooled",
        activation="gelu_pytorch_tanh",
    ),
    Family(
        name="vit",
        title="DeiT III (timm's layout)",
        licence=_APACHE,
        sensors=IMAGES,
        table=keymaps.TIMM,
        needs=(*TIMM_NEEDS, "blocks.0.ls1.gamma", "head.weight"),
        preparation=_PHOTO,
        lacks=("register_tokens",),
        unused=_PARTS,
        resample="antialias",
        bare_class=True,
    ),
    Family(
        name="dinov2",
        title="DINOv2 (Hugging Face)",
        licence=_APACHE,
        sensors=IMAGES,
        table=keymaps.HF_DINOV2,
        needs=(*_HF_NEEDS, "encoder.layer.0.layer_scale1.lambda1"),
        preparation=_PHOTO,
        prefixes=("dinov2.", "dinov2_with_registers.", ""),
        resample="bicubic",
        **_DINOV2,
    ),
    Family(
        name="dinov2",
        title="DINOv2 with registers (timm's layout)",
        licence=_APACHE,
        sensors=IMAGES,
        table=keymaps.TIMM,
        needs=(*TIMM_NEEDS, "blocks.0.ls1.gamma", "register_tokens"),
        preparation=_PHOTO,
        beside="reg_token",
        renamed=(("^reg_token$", "register_tokens"),),
        bare_class=True,
        **_DINOV2,
    ),
    Family(
        name="dinov2",
        title="DINOv2 (its authors' layout)",
        licence=_APACHE,
        sensors=IMAGES,
        table=keymaps.TIMM,
        needs=(*TIMM_NEEDS, "blocks.0.ls1.gamma"),
        preparation=_PHOTO,
        resample="shifted",
        **_DINOV2,
    ),
    Family(
        name="vit_mae",
        title="ViT-MAE (Hugging Face)",
        licence=_NON_COMMERCIAL,
        sensors=IMAGES,
        table=keymaps.HF_VIT,
        needs=(*_HF_NEEDS, "encoder.layer.0.layernorm_before.weight"),
        preparation=_PHOTO,
        beside="decoder.mask_token",
        **_HF_VIT,
    ),
    Family(
        name="vit",
        title="ViT or DeiT (Hugging Face)",
        licence=_APACHE,
        sensors=IMAGES,
        table=keymaps.HF_VIT,
        needs=(*_HF_NEEDS, "encoder.layer.0.layernorm_before.weight"),
        preparation=_PHOTO,
        **_HF_VIT,
    ),
    Family(
        name="t3",
        title="T3",
        licence="MIT",
        sensors="one file for each sensor",
        table=keymaps.T3,
        needs=(*TIMM_NEEDS, "trunk.norm.weight"),
        preparation=replace(_PHOTO, filter="bilinear"),
        resample="bicubic",
    ),
    Family(
        name="vit",
        title="ViT, DeiT or MAE (timm's layout)",
        licence="that of the weights (DeiT: Apache-2.0, MAE: CC BY-NC 4.0)",
        sensors=IMAGES,
        table=keymaps.TIMM,
        needs=(*TIMM_NEEDS, "norm.weight"),
        preparation=_PHOTO,
        unused=_PARTS,
        resample="antialias",
    ),
)

# An array that only a relative of these families has, and why such a file is not read.
UNREAD = {
    "dist_token": (
        "is a distilled DeiT, which has a second class token; give a DeiT without distillation"
    ),
    "fc_norm.weight": (
        "classifies by the mean of its patches (fc_norm) and has no norm of its tokens, as a "
        "fine-tuned MAE does; give weights from before the fine-tuning"
    ),
    **dict.fromkeys(
        (
            "blocks.0.mlp.w1.weight",
            "blocks.0.mlp.w12.weight",
            "blocks.0.mlp.fc1_g.weight",
            "layer.0.mlp.gate_proj.weight",
            "model.layer.0.mlp.gate_proj.weight",
            "encoder.layer.0.mlp.weights_in.weight",
        ),
        "has gated MLPs (SwiGLU), as the largest DINOv2 and DINOv3 have; give a smaller one",
    ),
}
