"""Weight conversion: files of the authors, HF CLIP and OpenCLIP to our parameters, and back to the
authors' layout.

Every key of a file is accounted for. One error counts the keys that are unknown, missing or of
another shape. Weights are fitted to a model: checks of its form, resized positions, sensor rows by
name.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.config import UNIVERSAL, Config, ModelConfig
from anytouch_jax.errors import UserError
from anytouch_jax.nn.vit import cubic
from anytouch_jax.weights.keymaps import (
    HF_CLIP,
    OPENCLIP,
    PROBE,
    STAGE1,
    STAGE2,
    Entry,
    Heads,
    KeyMap,
    Shape,
    Weights,
    param_shapes,
)
from anytouch_jax.weights.safetensors import WeightsError
from anytouch_jax.weights.tree import flatten, nest

Params = dict[str, Any]

# Parts that some model of ours has, and the classifier that came with a probe file.
_OWN_PARTS = (
    "touch",
    "decoder",
    "image",
    "lora",
    "text",
    "logit_scale",
    "matcher",
    "fields",
    "force",
    "head",
)
_LISTED = 6  # names in one error message
_HEAD = {"head.weight": "head/kernel", "head.bias": "head/bias"}


OWN = KeyMap("own", r"(touch|image)/.*", towers={part: rf"{part}(/.*)?" for part in _OWN_PARTS})
KEYMAPS = {keymap.name: keymap for keymap in (STAGE2, STAGE1, PROBE, OPENCLIP, HF_CLIP, OWN)}


def detect_layout(weights: Weights) -> str:
    """Return the name of a file's key map: stage1, stage2, probe, clip, openclip or own.

    Raises WeightsError.
    """
    for keymap in KEYMAPS.values():
        if any(re.fullmatch(keymap.mark, key) for key in weights):
            return keymap.name
    names = ", ".join(list(weights)[:5]) or "no arrays"
    raise WeightsError(
        f"these are not weights of AnyTouch, HF CLIP or OpenCLIP: the file has {names}"
    )


def detect_form(weights: Weights, heads: Heads) -> tuple[ModelConfig, dict[str, int]]:
    """Return the model that a file was made for, from the shapes of its arrays, and stacks of
    unknown head counts.

    Counts that neither `heads` nor a published width gives are 1, and the second value has these
    widths. A CLIP file gets the authors' decoder. Raises WeightsError.
    """
    layout = detect_layout(weights)
    if layout == "own":
        raise WeightsError(
            "its metadata lack the model; write the file again by `anytouch export --to "
            "safetensors`"
        )
    try:
        return KEYMAPS[layout].detect(weights, heads)
    except (
        KeyError,
        IndexError,
        ValueError,
        TypeError,
    ) as error:  # an array is missing or has an odd shape
        raise WeightsError(
            f"the model cannot be detected from these {layout} weights: {error} is missing or of "
            "an odd shape"
        ) from None


def refuse_unknown(stacks: Mapping[str, int]) -> None:
    """Raise WeightsError that names stacks of unknown head counts, by their widths."""
    if stacks:
        names = " and ".join(f"{name} (width {width})" for name, width in stacks.items())
        example = ", ".join(f'"{name}": {{"heads": N}}' for name in stacks)
        raise WeightsError(
            f"the weights do not store the number of attention heads of {names}. Write it to a "
            f'config.json in its folder, as {{"model": {{{example}}}}}. Or write the file by '
            "`anytouch export --to safetensors`, which stores it."
        )


def to_params(
    weights: Weights,
    model: ModelConfig,
    *,
    ignore: Collection[str] = (),
    optional: Collection[str] = (),
) -> Params:
    """Return the parameters of a file as a nested dict of float32 arrays under our names.

    Left out are parts that `model` lacks, buffers, the authors' unused arrays (golden Q2) and the
    keys in `ignore`. Position tables are resized. A probe file gives its classifier as `head`. A
    file may lack those in `optional`. Raises WeightsError.

    Args:
        weights: arrays of the file by name.
        model: the network they are for.
        ignore: keys of the file that are left out.
        optional: names of ours that a file may lack.
    """
    layout = detect_layout(weights)
    shapes = param_shapes(model)
    keymap = KEYMAPS[layout]
    entries = KEYMAPS[layout].entries(model)
    if layout == "own":  # a file of stage 1 has no towers
        parts = {key.split("/")[0] for key in weights}
        entries = [entry for entry in entries if entry.name.split("/")[0] in parts]
    entries = [entry for entry in entries if entry.key in weights or entry.name not in optional]
    head = _HEAD if layout == "probe" and weights.keys() >= _HEAD.keys() else {}
    first = {entry.key: entry for entry in entries}
    parts = {name.split("/")[0] for name in shapes}
    left_out = [pattern for part, pattern in keymap.towers.items() if part not in parts]
    # buffers
    left_out += [] if layout == "own" else [r"(.*\.)?(position_ids|attn_mask)"]
    unread = {*ignore, *head, *keymap.unused}
    arrays = {
        key: _fit(array, first[key], model) if key in first else array
        for key, array in weights.items()
        if key not in unread and not any(re.fullmatch(pattern, key) for pattern in left_out)
    }
    check_arrays(f"{layout} weights", arrays, file_shapes(entries, shapes))
    flat = fill(entries, arrays, shapes)
    for key, name in head.items():
        flat[name] = np.array(weights[key].T, np.float32, order="C")
    return nest(flat)


def fill(
    entries: Sequence[Entry], arrays: Weights, shapes: Mapping[str, Shape]
) -> dict[str, np.ndarray]:
    """Return our parameters by name, in float32, from the arrays of a file.

    Each number is copied once.
    """
    flat = {
        name: np.empty(shapes[name], np.float32)
        for name in dict.fromkeys(entry.name for entry in entries)
    }
    for entry in entries:
        array = (
            arrays[entry.key] if entry.part is None else np.split(arrays[entry.key], 3)[entry.part]
        )
        flat[entry.name][... if entry.layer is None else entry.layer] = entry.read(array)
    return flat


def to_release(
    params: Params, model: ModelConfig, *, allow_extra: bool = False
) -> dict[str, np.ndarray]:
    """Return the parameters under the authors' names: stage 2 if `params` has a tower, else stage
    1.

    Arrays that the authors' loader expects and never reads are filled in. The matching MLP of the
    paper has no place in those files: it is refused, or stored as `cross_sensor_mlp.*` with
    `allow_extra`. Raises WeightsError.
    """
    flat = {name: np.asarray(array, np.float32) for name, array in flatten(params).items()}
    keymap = STAGE2 if "image" in params or "text" in params else STAGE1
    if model.match_head == "mlp" and keymap is STAGE2 and not allow_extra:
        raise WeightsError(
            "the matching MLP of recipe paper has no counterpart in the authors' files; allow "
            "extra keys to store it"
        )
    if model.patch_encoder != "shared":
        raise WeightsError(
            "the authors' files have one patch projection for all sensors; this model has one for "
            "each"
        )
    if model.sensors[-1] != UNIVERSAL:
        last = model.sensors[-1]
        raise WeightsError(
            f"the authors' files keep the universal tokens in the last row; here it is {last!r}"
        )
    shapes = param_shapes(model)
    entries = keymap.entries(model)
    check_arrays("parameters", flat, {entry.name: shapes[entry.name] for entry in entries})
    arrays = {
        e.key: e.write(flat[e.name] if e.layer is None else flat[e.name][e.layer]) for e in entries
    }
    for key, source in keymap.unused.items():
        theirs = arrays[source]
        arrays[key] = theirs.mean(axis=1, dtype=np.float64) if theirs.ndim == 5 else theirs
    return {key: np.array(array, np.float32, order="C") for key, array in arrays.items()}


def check_arrays(title: str, arrays: Mapping[str, Any], wanted: Mapping[str, Shape]) -> None:
    """Raise WeightsError unless the arrays have the wanted names and shapes; it counts and names
    the others.
    """
    lists = {
        "unknown keys": [key for key in arrays if key not in wanted],
        "missing keys": [key for key in wanted if key not in arrays],
        "other shapes": [
            f"{key} has {tuple(arrays[key].shape)} instead of {shape}"
            for key, shape in wanted.items()
            if key in arrays and tuple(arrays[key].shape) != shape
        ],
    }
    more = {
        name: f" and {len(rows) - _LISTED} more" * (len(rows) > _LISTED)
        for name, rows in lists.items()
    }
    problems = [
        f"{n} ({len(rows)}): {', '.join(rows[:_LISTED])}{more[n]}"
        for n, rows in lists.items()
        if rows
    ]
    if problems:
        hint = _hint((*lists["unknown keys"], *lists["missing keys"]))
        raise WeightsError(f"the {title} do not fit this model; {'; '.join(problems)}{hint}")


def _fit(array: np.ndarray, entry: Entry, model: ModelConfig) -> np.ndarray:
    """Return the array in float32, its grid of positions resized to that of the model."""
    array = np.asarray(array, np.float32)
    if entry.name in ("touch/position", "image/position", "decoder/position"):
        table = array[0] if array.ndim == 3 and len(array) == 1 else array
        square = table.ndim == 2 and round((len(table) - 1) ** 0.5) ** 2 == len(table) - 1 > 0
        if square and len(table) != model.patches + 1:
            return resize_position(table, model.patches + 1).reshape(
                *array.shape[:-2], model.patches + 1, -1
            )
    return array


def file_shapes(entries: Sequence[Entry], shapes: Mapping[str, Shape]) -> dict[str, Shape]:
    """Return key -> shape in the file, by writing an array of zeros that takes no memory."""
    theirs: dict[str, Shape] = {}
    for entry in entries:
        shape = shapes[entry.name][entry.layer is not None :]
        written = entry.write(np.broadcast_to(np.float32(0), shape)).shape
        theirs[entry.key] = written if entry.part is None else (3 * written[0], *written[1:])
    return theirs


def _hint(keys: Sequence[str]) -> str:
    """Return the setting of the model that explains a difference in keys, if there is one."""
    hints = {
        r".*sensor_token_proj\.weight": "model.decoder_sensor_tokens",
        r".*lora_[AB].*": "model.lora_rank",
        r"cross_sensor_(head|mlp)\..*": "model.match_head",
        r".*\.(layers|resblocks|touch_decoder_blocks)\.\d+\..*": (
            "the depths of the model (or another preset)"
        ),
    }
    matching = (
        setting
        for pattern, setting in hints.items()
        if any(re.fullmatch(pattern, key) for key in keys)
    )
    return next((f"; look at {setting}" for setting in matching), "")


# Settings that must be equal: some leave no trace in shapes.
_FORM: tuple[str, ...] = ("patch", "patch_encoder", "embed", "frames", "sensor_tokens")
_FORM += tuple(
    f"{tower}.{size}" for tower in ("touch", "decoder") for size in ("width", "depth", "mlp")
)
_FORM += ("touch.heads", "decoder.heads", "norm_eps", "decoder_norm_eps", "pre_norm")


def check_activation(path: Path, trained: str | None, config: Config) -> None:
    """Raise UserError if weights were trained with another activation than the run's; None means
    unknown.
    """
    ours = config.model.activation
    if trained not in (None, ours):
        raise UserError(
            f"{path} was trained with {trained}, this run would use {ours}: add --model.activation "
            f"{trained}"
        )


def check_form(path: Path, before: ModelConfig, config: Config, preset: str = "custom") -> None:
    """Raise UserError with the missing options if weights, of this preset, belong to another
    network than the run's.

    Args:
        path: of the weights.
        before: the network that they are of.
        config: of the run.
        preset: of the weights, "custom" if nobody knows it.
    """
    pairs = {
        name: tuple(attrgetter(name)(model) for model in (before, config.model)) for name in _FORM
    }
    differing = {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}
    if not differing:
        return
    trained = ", ".join(f"{name} {theirs}" for name, (theirs, _) in differing.items())
    used = ", ".join(str(ours) for _, ours in differing.values())
    options = " ".join(
        _option(name.replace("_", "-"), theirs) for name, (theirs, _) in differing.items()
    )
    if differing.keys() & {"touch.width", "touch.depth"} and preset not in (
        config.preset,
        "custom",
    ):
        trained = f"preset {preset}"
        used = f"preset {config.preset}"
        options = f"--preset {preset}"
    raise UserError(f"{path} was trained with {trained}, this run would use {used}: add {options}")


def _option(name: str, value: Any) -> str:
    """Return the option that gives a setting of the model a value."""
    if type(value) is not bool:
        return f"--model.{name} {value}"
    return f"--model.{'' if value else 'no-'}{name}"


def check_clip(path: Path, clip: ModelConfig, config: Config, *, touch: bool) -> None:
    """Raise UserError if CLIP's image tower has another size than the run's image tower or, with
    `touch`, encoder.

    Args:
        path: of the weights.
        clip: the network that they are of.
        config: of the run.
        touch: also compare with the touch encoder.
    """
    theirs = (clip.touch.width, clip.touch.depth, clip.patch)
    for name, stack in (
        ("image tower", config.model.image),
        ("touch encoder", config.model.touch if touch else None),
    ):
        if stack is None or (ours := (stack.width, stack.depth, config.model.patch)) == theirs:
            continue
        sizes = [
            f"width {width}, depth {depth} and patches of {patch}"
            for width, depth, patch in (theirs, ours)
        ]
        raise UserError(
            f"the image tower in {path} has {sizes[0]}, this run's {name} {sizes[1]}: --preset "
            "large fits ViT-L/14, --preset base fits ViT-B/16; add the one that fits, or give "
            "other --clip-weights"
        )


def match_sensors(table: np.ndarray, stored: Sequence[str], wanted: Sequence[str]) -> np.ndarray:
    """Return a table's rows (R, ...) by name from `stored` to `wanted`; a new sensor gets the
    universal row.
    """
    return np.stack([table[stored.index(name if name in stored else UNIVERSAL)] for name in wanted])


def map_sensors(
    touch: Params, model: ModelConfig, change: Callable[[np.ndarray], np.ndarray]
) -> Params:
    """Return a touch encoder with its tables of sensors changed: the tokens, and the patch kernels
    if each has one.
    """
    changed: Params = {"sensor_tokens": change(np.asarray(touch["sensor_tokens"]))}
    if model.patch_encoder == "sensor":
        changed["patch"] = {"kernel": change(np.asarray(touch["patch"]["kernel"]))}
    return touch | changed


def serve_unseen(
    touch: Params, model: ModelConfig, trained: Sequence[str], *, universal_drawn: bool
) -> Params:
    """Return a touch encoder whose untrained sensors have the universal row (Sec. 3.5), or the mean
    if never drawn.

    Args:
        touch: parameters of the touch encoder.
        model: the network.
        trained: sensors that were trained on.
        universal_drawn: whether training has drawn the universal row. Otherwise the mean of the
            trained rows takes its place.
    """
    rows = [row for row, name in enumerate(model.sensors) if name in trained and name != UNIVERSAL]
    unseen = [row for row in range(len(model.sensors)) if row not in rows]
    if not rows:
        return touch

    def served(table: np.ndarray) -> np.ndarray:
        table = np.array(table)
        table[unseen] = table[model.universal_row] if universal_drawn else table[rows].mean(axis=0)
        return table

    return map_sensors(touch, model, served)


def resize_position(table: np.ndarray, rows: int) -> np.ndarray:
    """Return a (1 + M, D) table of a square grid resized to (`rows`, D); row 0, the class token's,
    is unchanged.

    Equal to torch's `interpolate(mode="bicubic", align_corners=False, antialias=False)`, computed
    in float64. Raises ValueError if either grid is not square.
    """
    old = math.isqrt(len(table) - 1)
    new = math.isqrt(rows - 1)
    if old**2 != len(table) - 1 or new**2 != rows - 1 or not old or not new:
        raise ValueError(
            f"a position table of {len(table)} rows cannot become {rows}: the grids must be square"
        )
    weights = cubic(old, new)
    grid = table[1:].astype(np.float64).reshape(old, old, -1)
    grid = np.einsum("ij,jkd->ikd", weights, grid)
    grid = np.einsum("kl,ild->ikd", weights, grid)
    return np.concatenate([table[:1], grid.reshape(new * new, -1).astype(table.dtype)])
