"""Families of encoders that others published: how their files are recognised and read, and how they
are fed.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from anytouch_jax.config import (
    CLIP_MEAN,
    CLIP_STD,
    IMAGENET_MEAN,
    IMAGENET_STD,
    UNIVERSAL,
    Config,
    ModelConfig,
    Stack,
)
from anytouch_jax.config.parsing import Above0, Count, check, read_value
from anytouch_jax.errors import ConfigError, UserError
from anytouch_jax.nn.functional import Part
from anytouch_jax.nn.vit import Resample, Vit, VitConfig
from anytouch_jax.weights import convert, keymaps, load
from anytouch_jax.weights.convert import check_arrays, file_shapes, fill, refuse_unknown
from anytouch_jax.weights.keymaps import VISION_HEADS, Entry, Shape, Weights, each_layer, find_depth
from anytouch_jax.weights.safetensors import WeightsError
from anytouch_jax.weights.tree import flatten, nest

Size = tuple[int, int]
ALIASES = {"mini": "gelsight_mini"}  # names of T3's files
SHARED = ("trunk", "post_norm")  # what T3's sensors have in common
_HEADS = {192: 3, 1152: 16} | VISION_HEADS


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
_IMAGES = "photographs, no touch"
_TIMM_NEEDS = ("patch_embed.proj.weight", "cls_token", "pos_embed", "blocks.0.attn.qkv.weight")
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
        needs=(*_TIMM_NEEDS, "contrastive_head.weight"),
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
        sensors=_IMAGES,
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
        sensors=_IMAGES,
        table=keymaps.DINOV3,
        needs=("patch_embed.proj.weight", "cls_token", "register_tokens", "blocks.0.ls1.gamma"),
        **_DINOV3,
    ),
    Family(
        name="siglip",
        title="SigLIP or SigLIP 2 (vision tower of Hugging Face)",
        licence=_APACHE,
        sensors=_IMAGES,
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
        sensors=_IMAGES,
        table=keymaps.TIMM,
        needs=(*_TIMM_NEEDS, "blocks.0.ls1.gamma", "head.weight"),
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
        sensors=_IMAGES,
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
        sensors=_IMAGES,
        table=keymaps.TIMM,
        needs=(*_TIMM_NEEDS, "blocks.0.ls1.gamma", "register_tokens"),
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
        sensors=_IMAGES,
        table=keymaps.TIMM,
        needs=(*_TIMM_NEEDS, "blocks.0.ls1.gamma"),
        preparation=_PHOTO,
        resample="shifted",
        **_DINOV2,
    ),
    Family(
        name="vit_mae",
        title="ViT-MAE (Hugging Face)",
        licence=_NON_COMMERCIAL,
        sensors=_IMAGES,
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
        sensors=_IMAGES,
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
        needs=(*_TIMM_NEEDS, "trunk.norm.weight"),
        preparation=replace(_PHOTO, filter="bilinear"),
        resample="bicubic",
    ),
    Family(
        name="vit",
        title="ViT, DeiT or MAE (timm's layout)",
        licence="that of the weights (DeiT: Apache-2.0, MAE: CC BY-NC 4.0)",
        sensors=_IMAGES,
        table=keymaps.TIMM,
        needs=(*_TIMM_NEEDS, "norm.weight"),
        preparation=_PHOTO,
        unused=_PARTS,
        resample="antialias",
    ),
)


@dataclass(frozen=True)
class FamilyModel:
    """An encoder of a family, as its file has it: the form of its network, its preparation, its
    parameters.
    """

    family: Family
    form: VitConfig
    preparation: Preparation
    image_size: Size
    params: dict[str, np.ndarray] = field(repr=False)


# An array that only a relative of these families has, and why such a file is not read.
_UNREAD = {
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


def _refuse_relatives(path: Path, weights: Weights) -> None:
    """Raise WeightsError for the file of a ViT whose form is not computed here."""
    timm = weights.get("patch_embed.proj.weight")
    patch = "vision_model.embeddings.patch_embedding.weight"
    reasons = [
        _UNREAD[key]
        for key in _UNREAD
        if key in weights and (key[0] != "f" or "norm.weight" not in weights)
    ]
    if any(key.endswith(patch) and x.ndim == 2 for key, x in weights.items()):
        reasons = [
            "is the NaFlex form of SigLIP 2, for pictures of any shape; give one of a fixed size"
        ]
    elif timm is None and not any("patch_embeddings." in key for key in weights):
        reasons = []
    elif timm is not None and timm.ndim == 4 and timm.shape[1] == 3 and "cls_token" not in weights:
        reasons.append("is a ViT of photographs without a class token; give one that has it")
    if reasons:
        raise WeightsError(f"{path} {reasons[0]}")


def load_family(
    path: Path, *, heads: int | None = None, image_size: Any = None
) -> tuple[FamilyModel | None, Weights | None]:
    """Return the encoder of a family's file or folder, or None, and the arrays that were read.

    Raises WeightsError.
    """
    if not path.exists() or path.suffix.lower() == ".npz" or load.is_run_folder(path):
        return None, None
    trunks = (
        (path / "trunk.pth",)
        if path.is_dir()
        else (path.parent / "trunk.pth", path.parent.parent / "trunk.pth")
    )
    trunk = next((file for file in trunks if file.is_file()), None)
    sensors = dict[str, Path]()
    if path.is_dir() and trunk is not None:
        sensors = {
            ALIASES.get(file.stem, file.stem): file for file in sorted(path.glob("encoders/*.pth"))
        }
    file = next(iter(sensors.values())) if sensors else load.find_weights_file(path)
    weights = load.read_weights(file)
    _refuse_relatives(file, weights)
    if not weights.keys() >= {*_TIMM_NEEDS} or weights.keys() & {
        "norm.weight",
        "blocks.0.ls1.gamma",
    }:
        if file.name == "trunk.pth":
            raise WeightsError(
                f"{file} is the trunk of T3 alone; give its folder, or encoders/SENSOR.pth"
            )
        return read_family(
            file, weights, _folder(file), heads=heads, image_size=image_size
        ), weights
    if trunk is None:
        raise WeightsError(
            f"{file} has no final norm; if it is an encoder of T3, put its trunk.pth into its "
            "folder"
        )
    rest = {f"trunk.{key}": array for key, array in load.read_weights(trunk).items()}
    sensors = sensors or {ALIASES.get(file.stem, file.stem): file}
    names = (*sensors, UNIVERSAL)
    models = []
    for one in sensors.values():
        content = weights if one == file else load.read_weights(one)
        whole = {**content, **rest}
        models.append(
            read_family(
                one, whole, _folder(trunk), heads=heads, image_size=image_size, sensors=names
            )
        )
    first = models[0]
    if first is None or any(model is None or model.form != first.form for model in models):
        raise WeightsError(
            f"the encoders {', '.join(sensors)} of {path} have different forms; load one file at a "
            "time"
        )
    several = (
        []
        if len(models) == 1
        else [name for name in first.params if name.split("/")[0] not in SHARED]
    )
    params = first.params | {
        name: np.stack([m.params[name] for m in models if m]) for name in several
    }
    return replace(first, params=params), None


def _folder(file: Path) -> dict[str, Any]:
    """Return the config.json beside a file, with what it and a preprocessor_config.json state as
    `stated`.
    """
    config, theirs = (
        load.read_settings(file.with_name(f"{name}config.json")) for name in ("", "preprocessor_")
    )
    return config | {"stated": stated_steps(config, theirs)}


def find_family(weights: Weights) -> tuple[Family, dict[str, np.ndarray]] | None:
    """Return the family of a file and the arrays of its encoder, None for a file of no family."""
    found = ((family, own) for family in FAMILIES if (own := family.weights(weights)) is not None)
    return next(found, None)


def read_family(
    path: Path,
    weights: Weights,
    folder: Mapping[str, Any],
    *,
    heads: int | None = None,
    image_size: Any = None,
    sensors: tuple[str, ...] = (),
) -> FamilyModel | None:
    """Return the encoder of a file, None for a file of no family.

    `folder` is the config.json: heads, epsilon, changes of the preparation. `image_size` is a side
    or (height, width). `sensors` are T3's. Raises WeightsError.
    """
    if (found := find_family(weights)) is None:
        return None
    family, own = found
    # of Hugging Face's models with a text tower
    vision = folder.get("vision_config")
    folder = {**folder, **vision} if isinstance(vision, dict) else folder
    try:
        own = _completed(family, own, folder, heads)
        size = (
            image_size
            if image_size is None
            else (image_size,) * 2
            if isinstance(image_size, int)
            else image_size
        )
        changes, wanted, ignored = folder.get("stated", ({}, None, []))
        if (
            family.sensors != _IMAGES
        ):  # they have steps of their authors; only the statistics may be others
            changes = {key: x for key, x in changes.items() if key in ("mean", "std")}
            wanted = None
            ignored = []
        try:
            form, size = form_of(
                family, own, folder, heads, tuple(size) if size else wanted, sensors
            )
        except WeightsError:
            if size or wanted is None:
                raise
            ignored = [*ignored, f"an input of {wanted[0]} x {wanted[1]} pixels"]
            form, size = form_of(family, own, folder, heads, None, sensors)
        if ignored:
            warnings.warn(
                f"the files beside {path} ask for what is not computed: {', '.join(ignored)}",
                stacklevel=2,
            )
        settings = {**asdict(family.preparation), **changes, **folder.get("preparation", {})}
        preparation = read_value(Preparation, settings, "preparation")
        entries, shapes = entries_of(family, form)
        own = {key: np.asarray(x, np.float32) for key, x in own.items()}
        check_arrays(f"{family.title} weights", own, file_shapes(entries, shapes))
        params = fill(entries, own, shapes)
    except (WeightsError, ConfigError) as error:
        raise WeightsError(f"{path}: {error}") from None
    except (KeyError, IndexError, ValueError, TypeError) as error:
        raise WeightsError(
            f"{path} is not a whole file of {family.title}: {error} is missing or of an odd shape; "
            "download it again"
        ) from None
    load.check_finite(path, params)
    return FamilyModel(family, form, preparation, size, params)


def _completed(
    family: Family, weights: dict[str, np.ndarray], folder: Mapping[str, Any], heads: int | None
) -> dict[str, np.ndarray]:
    """Return a file's arrays with those left out: biases and periods of DINOv3, the position of a
    class token.
    """
    own = dict(weights)
    if family.bare_class:
        own["pos_embed"] = np.concatenate(
            [np.zeros_like(own["pos_embed"][:, :1]), own["pos_embed"]], axis=1
        )
    if family.name == "siglip" and "head.attention.in_proj_weight" not in own:
        own = {key: x for key, x in own.items() if not key.startswith("head.")}
    if family.name != "dinov3":
        return own
    first = own[family.needs[0]]
    width = len(first)
    quarter = width // _heads(width, heads, folder) // 4
    own.setdefault(
        "periods", float(folder.get("rope_theta", 100)) ** (np.arange(quarter) / quarter)
    )
    for key in [key for key in own if key.endswith("attn.qkv.weight")]:
        stem = key.removesuffix("qkv.weight")
        bias = own.get(f"{stem}qkv.bias", np.zeros(3 * width))
        parts = (
            own.pop(f"{stem}q_bias", bias[:width]),
            np.zeros(width),
            own.pop(f"{stem}v_bias", bias[2 * width :]),
        )
        # the authors mask the bias of keys
        own[f"{stem}qkv.bias"] = np.concatenate(parts)
    known = {re.sub(r"\d", "", key) for key in own}
    for key in [key for key in own if re.fullmatch(r"layer\.\d+\.\w+\.\w+_proj\.weight", key)]:
        other = key.removesuffix("weight") + "bias"
        if re.sub(r"\d", "", other) not in known:
            own[other] = np.zeros(len(own[key]))
    return own


def touch_of_photographs(
    model: FamilyModel, source: str, config: Config, fresh: dict[str, Any]
) -> tuple[dict[str, Any], list[str]]:
    """Return a touch encoder that gives a still the tokens of a ViT of photographs, and sentences
    to log.

    The patch kernel is divided among the frames. Its bias goes into the resized positions, and
    layer scales into the layers before them. Raises UserError for another family, and for a network
    of another form.
    """
    form = model.form
    ours = config.model
    has_tokens = {"position", "class_token"} <= model.params.keys() and not form.tanh
    if model.family.sensors != _IMAGES or form.model.touch.depth == 0 or not has_tokens:
        raise UserError(
            f"{source} is an encoder of {model.family.title}; a run starts from weights of "
            "AnyTouch, DINOv2, ViT-MAE, "
            "ViT, DeiT or CLIP"
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


def entries_of(family: Family, form: VitConfig) -> tuple[list[Entry], dict[str, Shape]]:
    """Return the arrays of a file of this form, and the shapes of our parameters."""
    shapes = {name: tuple(leaf.shape) for name, leaf in flatten(Part(Vit, form).abstract()).items()}
    return each_layer(family.table, shapes), shapes


def form_of(
    family: Family,
    weights: Weights,
    folder: Mapping[str, Any],
    heads: int | None,
    image_size: Size | None,
    sensors: tuple[str, ...],
) -> tuple[VitConfig, Size]:
    """Return the form of the network that made a file, and the size of its images, from the shapes
    of its arrays.
    """
    rows = {row.name: row for row in family.table}

    def has(name: str) -> bool:
        return name in rows and rows[name].key.format(0) in weights

    def shape(name: str) -> Shape:
        array = weights[rows[name].key.format(0)]
        array = array if rows[name].part is None else np.split(array, 3)[0]
        return rows[name].read(array).shape

    tubelet, pixels, width = shape("patch/kernel")
    patch = math.isqrt(pixels // 3)
    mlp = shape("blocks/mlp/up/kernel")[1]
    frames = max(family.frames, tubelet)
    size = image_size or family.image_size
    grid: tuple[int, int, int] | None = None
    if not has("frequency") and not has("periods"):
        grid = _grid(
            shape("position")[0] - has("class_token"), family, frames // tubelet, image_size, patch
        )
        frames = grid[0] * tubelet
        native = (grid[1] * patch, grid[2] * patch)
        size = (image_size if family.resample == "none" else size) or native
    assert size is not None
    if size[0] % patch or size[1] % patch or min(size) < patch:
        raise WeightsError(
            f"image_size {size[0]} x {size[1]} is no multiple of the patches of {patch} pixels"
        )
    outputs = shape("projection/kernel")[1] if has("projection/kernel") else 0
    own = shape("sensor_tokens") if has("sensor_tokens") else (0, 0)
    if own[0]:
        numbered = tuple(f"sensor{row}" for row in range(own[0] - 1))
        sensors = (*family.names[: own[0] - 1], *numbered[len(family.names) :], UNIVERSAL)
    eps = folder.get("layer_norm_eps", family.eps)
    if not isinstance(eps, float | int) or not 0 < eps < 1:
        raise WeightsError(f"layer_norm_eps of the config.json is {str(eps)[:40]}; correct it")
    if (stated := folder.get("hidden_act", family.activation)) != family.activation:
        ours = family.activation
        raise WeightsError(
            f"hidden_act of the config.json is {str(stated)[:40]}; only {ours} is computed here"
        )
    touch = Stack(
        width,
        find_depth(rows["blocks/norm1/scale"].key, weights),
        _heads(width, heads, folder),
        mlp,
    )
    model = ModelConfig(
        max(size),
        patch,
        outputs or width,
        touch,
        keymaps.DECODER,
        frames=frames,
        sensors=sensors or (UNIVERSAL,),
        sensor_tokens=own[1],
        norm_eps=float(eps),
    )
    return VitConfig(
        model,
        tubelet,
        grid,
        outputs=outputs,
        tanh=family.activation != "gelu",
        resample="antialias" if family.name == "dinov2" and has("registers") else family.resample,
        axes=shape("frequency")[0] if has("frequency") else 2,
        registers=shape("registers")[0] if has("registers") else 0,
        trunk=find_depth(rows["trunk/norm1/scale"].key, weights) if has("trunk/norm1/scale") else 0,
        calibration=shape("calibration/kernel")[0] if has("calibration/kernel") else 0,
        class_token=has("class_token"),
        patch_bias=has("patch/bias"),
        layer_scale=has("blocks/scale1/scale"),
        pre_norm=has("pre_norm/scale"),
        output_bias=has("projection/bias"),
        rotary=has("periods"),
        pool=has("pool/probe"),
    ), size


def _grid(
    places: int, family: Family, time: int, size: Size | None, patch: int
) -> tuple[int, int, int]:
    """Return (time, rows, columns) of stored positions: of `size` if not resized, 4:3 (Sparsh), or
    square.
    """
    rows, columns = (0, 0) if size is None else (size[0] // patch, size[1] // patch)
    given = (places // max(rows * columns, 1) if family.video else 1, rows, columns)
    grids = [given]
    if size is None or family.resample != "none":
        for steps in (1, time):
            side = math.isqrt(places // steps)
            third = math.isqrt(places // steps // 12)
            grids += [
                (steps, side, side),
                *([(steps, 4 * third, 3 * third)] if family.name == "sparsh" else []),
            ]
    found = next((grid for grid in reversed(grids) if math.prod(grid) == places > 0), None)
    if found is None:
        asked = (
            "no grid of patches" if size is None else f"not those of {size[0]} x {size[1]} pixels"
        )
        raise WeightsError(
            f"its {places} positions are {asked}; give the image_size of its training"
        )
    return found


def _heads(width: int, heads: int | None, folder: Mapping[str, Any]) -> int:
    """Return the number of heads: as given, of a config.json of Hugging Face or ours, or of the
    published width.
    """
    stacks = folder.get("model", {})
    ours = stacks.get("touch", {}) if isinstance(stacks, dict) else {}
    ours = ours.get("heads") if isinstance(ours, dict) else None
    count = heads or ours or folder.get("num_attention_heads") or _HEADS.get(width)
    if count is None:
        refuse_unknown({"touch": width})
    if type(count) is not int or not 0 < count <= 1024 or width % count:
        raise WeightsError(
            f"a width of {width} cannot have {str(count)[:40]} heads; correct the number of heads"
        )
    return count


# Preprocessing that timm (config.json) or Hugging Face (preprocessor_config.json) states in a file
# next to weights.
_FILTERS = ("nearest", "lanczos", "bilinear", "bicubic", "box", "hamming")  # by Pillow's numbers
_HF_STEPS = {"do_resize", "do_center_crop", "do_rescale", "do_normalize", "do_convert_rgb"}
_HF_VALUES = {
    "size",
    "crop_size",
    "resample",
    "rescale_factor",
    "image_mean",
    "image_std",
    "image_processor_type",
    "feature_extractor_type",
    "processor_class",
    "_valid_processor_keys",
    "data_format",
    "input_data_format",
    "return_tensors",
    "device",
    "default_to_square",
    "disable_grouping",
}
_TIMM = ("mean", "std", "interpolation", "crop_pct", "crop_mode", "input_size")


def stated_steps(
    config: Mapping[str, Any], theirs: Mapping[str, Any]
) -> tuple[dict[str, Any], Any, list[str]]:
    """Return changes of a Preparation, the (height, width) of the input or None, and what of both
    files is ignored.
    """
    if theirs:
        return _hugging_face(theirs)
    timm = config.get("pretrained_cfg", config if "architecture" in config else None)
    if isinstance(timm, Mapping) and timm.keys() & {*_TIMM}:
        return _timm(timm)
    return ({}, None, [])


def _timm(stated: Mapping[str, Any]) -> tuple[dict[str, Any], Any, list[str]]:
    changes: dict[str, Any] = {key: stated[key] for key in ("mean", "std") if key in stated}
    size = _size(list(stated.get("input_size", ()))[1:])
    ignored = list[str]()
    _add_filter(changes, stated.get("interpolation"), ignored)
    share = stated.get("crop_pct", 1.0)
    mode = stated.get("crop_mode", "center")
    if size is not None and isinstance(share, int | float) and 0 < share <= 1:
        if mode == "center":
            changes |= {"crop": "centre", "shorter": int(max(size) / share)}
        elif mode == "squash" and share == 1:
            changes |= {"crop": "none", "shorter": None}
        else:
            ignored.append(f"crop_mode {mode} with crop_pct {share}")
    elif "crop_pct" in stated:
        ignored.append(f"crop_pct {share}")
    return changes, size, ignored


def _hugging_face(stated: Mapping[str, Any]) -> tuple[dict[str, Any], Any, list[str]]:
    changes: dict[str, Any] = {}
    known = {*_HF_STEPS, *_HF_VALUES}
    ignored = [
        f"{name} {str(value)[:40]}"
        for name, value in stated.items()
        if name not in known and value not in (None, False)
    ]
    does = {
        name: stated.get(name, name != "do_center_crop" or "crop_size" in stated)
        for name in _HF_STEPS
    }
    _add_filter(changes, stated.get("resample"), ignored)
    resized = stated.get("size")
    cropped = _size(stated.get("crop_size"))
    edge = resized.get("shortest_edge") if isinstance(resized, Mapping) else None
    if edge is None and type(resized) is int and does["do_center_crop"]:
        edge = resized
    whole = None if edge is not None else _size(resized)
    size = cropped if does["do_center_crop"] and cropped else whole
    if not does["do_resize"]:
        ignored.append("do_resize false")
    elif does["do_center_crop"] and cropped and type(edge) is int:
        changes |= {"crop": "centre", "shorter": edge}
    elif whole is not None and (not does["do_center_crop"] or cropped in (None, whole)):
        changes |= {"crop": "none", "shorter": None}
    elif resized is not None:
        ignored.append(f"size {resized} with crop_size {stated.get('crop_size')}")
    scale = 1.0  # of the values 0 to 1 that are normalised here
    if not does["do_rescale"]:
        scale = 255.0
    elif isinstance(factor := stated.get("rescale_factor", 1 / 255), int | float) and factor > 0:
        scale = 255.0 * factor
    else:
        ignored.append(f"rescale_factor {str(factor)[:40]}")
    given = {"mean": stated.get("image_mean"), "std": stated.get("image_std")}
    if not does["do_normalize"]:
        given = {"mean": [0.0] * 3, "std": [1.0] * 3}
    if abs(scale - 1) > 1e-6 and all(_numbers(value) for value in given.values()):
        given = {
            name: [number / scale for number in value]
            for name, value in given.items()
            if value is not None
        }
    return (
        changes | {name: value for name, value in given.items() if value is not None},
        size,
        ignored,
    )


def _add_filter(changes: dict[str, Any], stated: Any, ignored: list[str]) -> None:
    name = _FILTERS[stated] if type(stated) is int and 0 <= stated < len(_FILTERS) else stated
    if name in _FILTERS:
        changes["filter"] = name
    elif name not in (None, "random"):  # timm's training draws one
        ignored.append(f"interpolation {str(name)[:40]}")


def _numbers(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(one, int | float) for one in value)


def _size(value: Any) -> tuple[int, int] | None:
    """Return (height, width) of a side, a list or an object with them; None for anything else."""
    if isinstance(value, Mapping):
        value = [value.get("height"), value.get("width")]
    sides = [value] * 2 if type(value) is int else value
    fits = (
        isinstance(sides, list)
        and len(sides) == 2
        and all(type(side) is int and side > 0 for side in sides)
    )
    if fits:
        return (sides[0], sides[1])
    return None
