"""Encoders of other families: their files are recognised and read by the table of `zoo.table`."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.config import UNIVERSAL, ModelConfig, Stack, read_value
from anytouch_jax.errors import ConfigError
from anytouch_jax.nn.functional import Part
from anytouch_jax.nn.vit import Vit, VitConfig
from anytouch_jax.weights import load
from anytouch_jax.weights.convert import check_arrays, file_shapes, fill, refuse_unknown
from anytouch_jax.weights.keymaps import (
    DECODER,
    VISION_HEADS,
    Entry,
    Shape,
    Weights,
    each_layer,
    find_depth,
)
from anytouch_jax.weights.safetensors import WeightsError
from anytouch_jax.weights.tree import flatten
from anytouch_jax.zoo.efficientnet import ConvModel, is_efficientnet, read_efficientnet
from anytouch_jax.zoo.preprocessing import stated_steps
from anytouch_jax.zoo.table import ALIASES as ALIASES
from anytouch_jax.zoo.table import FAMILIES as FAMILIES
from anytouch_jax.zoo.table import IMAGES, SHARED, TIMM_NEEDS, UNREAD, Family, Preparation, Size

_HEADS = {192: 3, 1152: 16} | VISION_HEADS


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


def _refuse_relatives(path: Path, weights: Weights) -> None:
    """Raise WeightsError for the file of a ViT whose form is not computed here."""
    timm = weights.get("patch_embed.proj.weight")
    patch = "vision_model.embeddings.patch_embedding.weight"
    reasons = [
        UNREAD[key]
        for key in UNREAD
        if key in weights and (key[0] != "f" or "norm.weight" not in weights)
    ]
    if any(key.endswith(patch) and x.ndim == 2 for key, x in weights.items()):
        reasons = [
            "is the NaFlex form of SigLIP 2, for images of any shape; give one of a fixed size"
        ]
    elif timm is None and not any("patch_embeddings." in key for key in weights):
        reasons = []
    elif timm is not None and timm.ndim == 4 and timm.shape[1] == 3 and "cls_token" not in weights:
        reasons.append("is a ViT of RGB images without a class token; give one that has it")
    if reasons:
        raise WeightsError(f"{path} {reasons[0]}")


def load_family(
    path: Path, *, heads: int | None = None, image_size: Any = None
) -> tuple[FamilyModel | ConvModel | None, Weights | None]:
    """Read the encoder of another family.

    Args:
        path: a file or a folder.
        heads: the number of attention heads, where no file states it.
        image_size: a side or (height, width), where it is not that of the training.

    Returns:
        The encoder, None for a file of no family, and the arrays that were read, which need not be
        read again; None if nothing was read.

    Raises:
        WeightsError: a file of a family that is damaged, or of a form that is not computed here.
    """
    if not path.exists() or path.suffix.lower() == ".npz" or load.is_run_folder(path):
        return None, None
    trunk = _find_trunk(path)
    sensors: dict[str, Path] = {}
    if path.is_dir() and trunk is not None:
        files = sorted(path.glob("encoders/*.pth"))
        sensors = {ALIASES.get(file.stem, file.stem): file for file in files}
    file = next(iter(sensors.values())) if sensors else load.find_weights_file(path)
    weights = load.read_weights(file)
    if is_efficientnet(weights):
        return read_efficientnet(file, weights, _side(image_size)), weights
    _refuse_relatives(file, weights)
    # An encoder of T3 alone is a ViT of timm that ends before the final norm, which its trunk has.
    has_end = weights.keys() & {"norm.weight", "blocks.0.ls1.gamma"}
    if has_end or not weights.keys() >= {*TIMM_NEEDS}:
        if file.name == "trunk.pth":
            raise WeightsError(
                f"{file} is the trunk of T3 alone; give its folder, or encoders/SENSOR.pth"
            )
        model = read_family(file, weights, _folder(file), heads=heads, image_size=image_size)
        return model, weights
    if trunk is None:
        raise WeightsError(
            f"{file} has no final norm; if it is an encoder of T3, put its trunk.pth into its "
            "folder"
        )
    sensors = sensors or {ALIASES.get(file.stem, file.stem): file}
    return _read_t3(path, sensors, trunk, {file: weights}, heads, image_size), None


def _side(image_size: Any) -> int | None:
    """Return the side of square images. Raises WeightsError for others."""
    if image_size is None or isinstance(image_size, int):
        return image_size
    high, wide = image_size
    if high != wide:
        raise WeightsError("an EfficientNet takes square images here; give one side")
    return int(high)


def _find_trunk(path: Path) -> Path | None:
    """Return the trunk.pth of T3 that belongs to a folder or to an encoder's file."""
    folders = [path] if path.is_dir() else [path.parent, path.parent.parent]
    for folder in folders:
        if (folder / "trunk.pth").is_file():
            return folder / "trunk.pth"
    return None


def _read_t3(
    path: Path,
    sensors: Mapping[str, Path],
    trunk: Path,
    read: Mapping[Path, Weights],
    heads: int | None,
    image_size: Any,
) -> FamilyModel:
    """Return T3 for several sensors: an encoder each, stacked by sensor, and one trunk.

    `read` are the arrays of files that were read before.
    """
    rest = {f"trunk.{key}": array for key, array in load.read_weights(trunk).items()}
    names = (*sensors, UNIVERSAL)
    models = []
    for file in sensors.values():
        own = read[file] if file in read else load.read_weights(file)
        folder = _folder(trunk)
        model = read_family(
            file, {**own, **rest}, folder, heads=heads, image_size=image_size, sensors=names
        )
        models.append(model)
    first = models[0]
    if first is None or any(model is None or model.form != first.form for model in models):
        raise WeightsError(
            f"the encoders {', '.join(sensors)} of {path} have different forms; load one file at a "
            "time"
        )
    if len(models) == 1:
        return first
    stacked = {}
    for name in first.params:
        if name.split("/")[0] not in SHARED:
            stacked[name] = np.stack([model.params[name] for model in models if model])
    return replace(first, params=first.params | stacked)


def _folder(file: Path) -> dict[str, Any]:
    """Return the config.json beside a file, with what it and a preprocessor_config.json state as
    `stated`.
    """
    config = load.read_settings(file.with_name("config.json"))
    theirs = load.read_settings(file.with_name("preprocessor_config.json"))
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

    Raises WeightsError.

    Args:
        path: of the file.
        weights: its arrays by name.
        folder: the config.json beside it: heads, epsilon, changes of the preparation.
        heads: of attention, if the user names them.
        image_size: a side or (height, width), if the user names it.
        sensors: names of T3's.
    """
    if (found := find_family(weights)) is None:
        return None
    family, own = found
    # of Hugging Face's models with a text tower
    vision = folder.get("vision_config")
    folder = {**folder, **vision} if isinstance(vision, dict) else folder
    try:
        own = _completed(family, own, folder, heads)
        size = (image_size,) * 2 if isinstance(image_size, int) else image_size
        changes, wanted, ignored = folder.get("stated", ({}, None, []))
        # Encoders of touch have steps of their authors. Only the statistics may be others.
        if family.sensors != IMAGES:
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

    Args:
        family: the kind of encoder.
        weights: arrays of the file by name.
        folder: the config.json beside it.
        heads: of attention, if the user names them.
        image_size: (height, width), if the user names it.
        sensors: names of T3's.
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
        DECODER,
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
