"""Loading of parameters: run folders, checkpoints, weights files, the authors' .pth files and CLIP
towers.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.config import SENSORS, Config, DataConfig, ModelConfig, from_json, parse_json
from anytouch_jax.doors import HEADS, WEIGHTS, enter
from anytouch_jax.errors import UserError
from anytouch_jax.files import read_arrays
from anytouch_jax.weights import checkpoint, convert, registry, safetensors
from anytouch_jax.weights.convert import (
    check_arrays,
    detect_form,
    detect_layout,
    to_params,
)
from anytouch_jax.weights.keymaps import Weights, param_shapes
from anytouch_jax.weights.safetensors import Loaded, WeightsError
from anytouch_jax.weights.tree import flatten, nest

Params = dict[str, Any]

# the authors' weights were trained on these, and on the universal tokens
RELEASE_SENSORS = SENSORS[:5]
_TORCH = (".pth", ".pt", ".ckpt", ".bin")
_INDEX = ".index.json"  # of weights in several files
_PATTERNS = (
    "*.safetensors",
    f"*.safetensors{_INDEX}",
    "*.bin",
    f"*.bin{_INDEX}",
    "*.pth",
    "*.pt",
    "*.ckpt",
)
_SHARD = re.compile(r"(.+)-\d{5}-of-(\d{5})(\.\w+)")
# DistributedDataParallel, torch.compile, Lightning
_PREFIX = re.compile(r"(module|_orig_mod|model)\.")
_INNER = re.compile(r"(^|\.)(_orig_mod|_fsdp_wrapped_module|_checkpoint_wrapped_module)\.")


def load_model(
    path: str | Path,
    *,
    step: int | None = None,
    stored_rows: bool = False,
    weights: Weights | None = None,
) -> Loaded:
    """Load an encoder by name, a run folder, a checkpoint folder, a weights file or a folder with a
    .pth file.

    Raises UserError.

    Args:
        path: name of an encoder, a run, a checkpoint, a weights file or its folder.
        step: of a checkpoint, by default the latest.
        stored_rows: leave the rows of sensors outside the training unchanged, as a conversion
            needs them.
        weights: those of the file, if they are read already.
    """
    path = registry.locate(path)
    if not path.exists():
        raise UserError(
            f"there is no run folder or weights file at {path}; give another path, or one of "
            f"{', '.join(registry.list_encoders())}"
        )
    trained: Any
    if is_run_folder(path):
        params, text, metadata = checkpoint.load_params(path, step)
        config: Config = from_json(text)
        wanted = {
            name: form
            for name, form in param_shapes(config.model).items()
            if name.split("/")[0] in params
        }
        arrays = _completed(flatten(params))  # runs of version 0.1 have more
        if "fields" in params:
            params = nest(arrays)
        check_arrays(
            f"arrays of {path}", {name: x for name, x in arrays.items() if name in wanted}, wanted
        )
        trained = metadata.get("seen")
        drawn = config.objective.universal_start + config.objective.universal_end > 0
        from_run = True
    else:
        path = find_weights_file(path)
        weights = read_weights(path) if weights is None else weights
        model = model_of_file(path, weights)
        file_metadata = safetensors.read_file_metadata(path)
        background: Any = file_metadata.get(safetensors.BACKGROUND_KEY, "keep")
        with _naming(path):
            params = to_params(_completed(weights), model)
            config = Config(model, data=DataConfig(background=background))
        # A run without universal tokens was exported with the mean of its sensors in their place.
        trained = trained_sensors(file_metadata, model)
        drawn = True
        from_run = False
        metadata = dict(file_metadata)
    check_finite(path, flatten(params))
    # an array that nobody reads shows a damaged file, too
    check_finite(path, weights or {})
    if trained is not None and "touch" in params and (from_run or not stored_rows):
        params |= {
            "touch": convert.serve_unseen(
                params["touch"], config.model, trained, universal_drawn=drawn
            )
        }
    return Loaded(
        path, params, config, None if trained is None else tuple(trained), drawn, metadata, from_run
    )


def _completed(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """Return the arrays with those that a decoder of fields of version 0.2 lacks."""
    if not any(name.startswith("fields/") for name in arrays):
        return dict(arrays)
    completed: dict[str, Any] = enter(HEADS["fields older"])(arrays)
    return completed


@contextmanager
def _naming(path: str | Path) -> Iterator[None]:
    """Put the name of the file before an error about its content that lacks it."""
    try:
        yield
    except UserError as error:
        text = str(error.args[0])
        raise error if str(path) in text else WeightsError(f"{path}: {text}") from None


def trained_sensors(metadata: Mapping[str, str], model: ModelConfig) -> tuple[str, ...] | None:
    """Return the sensors that a file was trained on: as its metadata says, or the authors' for a
    file of theirs.
    """
    if safetensors.SEEN_KEY in metadata:
        return tuple(metadata[safetensors.SEEN_KEY].split(","))
    if safetensors.MODEL_KEY not in metadata and model.sensors == SENSORS:
        return RELEASE_SENSORS
    return None


def check_finite(path: str | Path, arrays: Mapping[str, Any]) -> None:
    """Raise WeightsError that names the first of these arrays with NaN or infinite values."""
    wrong = [name for name, array in arrays.items() if not np.isfinite(array).all()]
    if wrong:
        others = f" and {len(wrong) - 1} other arrays have" if len(wrong) > 1 else " has"
        raise WeightsError(
            f"{path}: {wrong[0]}{others} values that are not finite (NaN or infinite); its "
            "training diverged or the file is damaged, so take an earlier checkpoint or another "
            "file"
        )


def open_family(
    path: Path, *, heads: int | None = None, image_size: int | tuple[int, int] | None = None
) -> tuple[Any, Weights | None]:
    """Return the model of another family in a file or folder, or None, and arrays that were read.

    The readers of other families are asked about every file that does not say itself that it is of
    AnyTouch: the authors' .pth files do not. They are not imported for a run, and not for weights
    that this package wrote.
    """
    if not path.exists() or is_run_folder(path):
        return None, None
    if path.is_file() and safetensors.MODEL_KEY in safetensors.read_file_metadata(path):
        return None, None
    model, weights = enter(WEIGHTS["family"])(path, heads=heads, image_size=image_size)
    return model, weights


def is_run_folder(path: Path) -> bool:
    """Return whether a folder is that of a run or of a checkpoint, and not of weights files."""
    return (
        path.is_dir()
        and not any(path.glob("*.pth"))
        and (checkpoint.is_run(path) or not _weights_files(path))
    )


def find_weights_file(path: str | Path) -> Path:
    """Return the weights file in a downloaded folder, or the file itself.

    Raises UserError if there is none.
    """
    path = Path(path)
    if not path.is_dir():
        return path
    if files := _weights_files(path):
        return files[0]
    raise UserError(
        f"there are no weights (*.safetensors, *.bin, *.pth, *.ckpt) in {path}; give another path"
    )


def _weights_files(folder: Path) -> list[Path]:
    files = [file for pattern in _PATTERNS for file in sorted(folder.glob(pattern))]
    return [file for file in files if not _SHARD.fullmatch(file.name)] or files


def read_weights(path: str | Path) -> dict[str, np.ndarray]:
    """Return the arrays of a .safetensors, .npz, .pth, .pt, .ckpt or .bin file by name, floats as
    float32.

    An index stands for all of its files. Prefixes of training frameworks are removed. No code in a
    pickle is run. Raises WeightsError for a missing, truncated, foreign or unsafe file.
    """
    path = safetensors.existing_file(path)
    if shard := _SHARD.fullmatch(path.name):
        index = path.with_name(f"{shard[1]}{shard[3]}{_INDEX}")
        if not index.is_file():
            raise WeightsError(
                f"{path} is one of {int(shard[2])} parts; put them and {index.name} into one folder"
            )
        path = index
    arrays = _strip_prefixes(_read_parts(path) if path.name.endswith(_INDEX) else _read_file(path))
    for name, array in arrays.items():
        # numpy calls bfloat16 and float8 a "V" too, as it does records.
        if array.dtype.kind in "USOMmc" or array.dtype.type is np.void:
            raise WeightsError(f"{path} has no weights: {name} is {array.dtype}, not real numbers")
    # what is too large becomes infinite, which is refused by its name
    with np.errstate(over="ignore"):
        return {
            name: one if one.dtype.kind in "iub" else one.astype(np.float32)
            for name, one in arrays.items()
        }


def _read_file(path: Path) -> dict[str, np.ndarray]:
    suffix = path.suffix.lower()
    if suffix == ".safetensors":
        return safetensors.read_safetensors(path)[0]
    if suffix in _TORCH:
        arrays: dict[str, np.ndarray] = enter(WEIGHTS["torch"])(path)
        return arrays
    if suffix != ".npz":
        raise WeightsError(
            f"{path} is of unknown type; give a .safetensors, .npz, .pth, .pt, .ckpt or .bin file"
        )
    try:
        return read_arrays(safetensors.existing_file(path))
    except (OSError, ValueError) as error:
        raise WeightsError(f"{path} is not a whole npz file of plain arrays: {error}") from error


def _strip_prefixes(weights: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the arrays without prefixes that all names share, nor wrappers inside a name, if names
    stay different.
    """
    names = {name: _INNER.sub(r"\1", name) for name in weights}
    while (
        len(shared := {(_PREFIX.match(name) or [""])[0] for name in names.values()}) == 1
        and "" not in shared
    ):
        names = {old: _INNER.sub(r"\1", new.removeprefix(*shared)) for old, new in names.items()}
    if len(set(names.values())) == len(names):
        return {names[old]: value for old, value in weights.items()}
    return weights


def _read_parts(index: Path) -> dict[str, np.ndarray]:
    """Return the arrays of all files that an index names.

    Raises WeightsError for missing files and arrays.
    """
    homes = _object(read_settings(index), "weight_map")
    if not homes or not all(
        isinstance(part, str) and Path(part).name == part for part in homes.values()
    ):
        raise WeightsError(
            f"{index} is no index of weights: it needs weight_map, the file of each array"
        )
    arrays: dict[str, np.ndarray] = {}
    for part in sorted(set(homes.values())):
        if not (index.parent / part).is_file():
            raise WeightsError(
                f"{index} names the file {part}, which is not there; download all parts"
            )
        content = _read_file(index.parent / part)
        arrays |= {name: array for name, array in content.items() if homes.get(name) == part}
    if missing := sorted(homes.keys() - arrays.keys()):
        raise WeightsError(
            f"{index} names {missing[0]} in {homes[missing[0]]}, which lacks it; download it again"
        )
    return arrays


def model_of_file(path: str | Path, weights: Weights) -> ModelConfig:
    """Return the model of a weights file, see `form_of_file`.

    Raises WeightsError for unknown head counts.
    """
    model, unknown = form_of_file(path, weights)
    with _naming(path):
        convert.refuse_unknown(unknown)
    return model


def form_of_file(path: str | Path, weights: Weights) -> tuple[ModelConfig, dict[str, int]]:
    """Return the model of a file, and widths of stacks of unknown heads, by metadata or shapes.

    Raises WeightsError.
    """
    if (text := safetensors.read_file_metadata(path).get(safetensors.MODEL_KEY)) is not None:
        return from_json(text, ModelConfig), {}
    config, openclip = _folder_config(path)
    with _naming(path):
        model, unknown = detect_form(weights, _stored_heads(path, config, openclip))
    activation: Any = _object(config, "model").get("activation")
    if detect_layout(weights) in (
        "clip",
        "openclip",
    ):  # CLIP's configuration says nothing of the authors' weights
        activation = clip_activation(path)
    return (model if activation is None else replace(model, activation=activation)), unknown


def _folder_config(path: str | Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the config.json in the folder of weights, of a run or of HF, and the model of
    OpenCLIP's file.
    """
    config = read_settings(Path(path).with_name("config.json"))
    if config.get("model_type") == "clip_vision_model":  # of the vision tower alone
        config = {"vision_config": config} | config
    return config, _object(
        read_settings(Path(path).with_name("open_clip_config.json")), "model_cfg"
    )


def _stored_heads(
    path: str | Path, config: dict[str, Any], openclip: dict[str, Any]
) -> dict[str, int]:
    """Return the head counts of stacks.

    Raises WeightsError for a count that is no positive integer.
    """
    tower = _object(openclip, "vision_cfg")
    ours = _object(config, "model")
    heads = dict[str, Any]()
    if (
        isinstance(tower.get("width"), int)
        and isinstance(size := tower.get("head_width", 64), int)
        and size > 0
    ):
        heads["image"] = tower["width"] // size
    heads["text"] = _object(openclip, "text_cfg").get("heads")
    for name, theirs in (("image", "vision_config"), ("text", "text_config")):
        heads[name] = _object(config, theirs).get("num_attention_heads", heads.get(name))
    stacks = {name: _object(ours, name) for name in ("touch", "decoder", "image", "text")}
    stacks["text"] = _object(stacks["text"], "stack") or stacks["text"]
    heads |= {name: stack["heads"] for name, stack in stacks.items() if "heads" in stack}
    for name, count in heads.items():
        if count is not None and (type(count) is not int or not 0 < count <= 1024):
            raise WeightsError(
                f"the configuration in the folder of {path} gives {name} {str(count)[:40]} heads; "
                "correct it"
            )
    return {name: count for name, count in heads.items() if count is not None}


def _object(value: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return an object in a JSON object, {} for another value."""
    inner = value.get(name)
    if isinstance(inner, dict):
        return inner
    return {}


def clip_activation(path: str | Path) -> str | None:
    """Return the activation that the files beside weights state, None if they do not.

    Raises WeightsError.
    """
    if (text := safetensors.read_file_metadata(path).get(safetensors.MODEL_KEY)) is not None:
        return str(from_json(text, ModelConfig).activation)
    config, openclip = _folder_config(path)
    towers = [
        tower
        for name in ("text_config", "vision_config")
        if isinstance(tower := config.get(name), dict)
    ]
    # HF's default
    names = {str(tower.get("hidden_act", "quick_gelu")) for tower in towers}
    names |= {str(name) for key, name in _object(config, "model").items() if key == "activation"}
    if not names and openclip:
        names.add("quick_gelu" if openclip.get("quick_gelu") else "gelu")
    if len(names) > 1 or not names <= {"gelu", "quick_gelu"}:
        raise WeightsError(
            f"the configuration in the folder of {path} names the activation "
            f"{' and '.join(sorted(names))}; give CLIP weights of which both towers use gelu, or "
            "both quick_gelu"
        )
    return next(iter(names), None)


def read_settings(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file, {} if there is no file. Raises WeightsError."""
    if not path.is_file():
        return {}
    try:
        value = parse_json(path.read_bytes())
    except ValueError as error:
        raise WeightsError(
            f"{path} {error}; correct it, or move the weights to a folder without it"
        ) from None
    if not isinstance(value, dict):
        raise WeightsError(
            f"{path} is no JSON object; correct it, or move the weights to a folder without it"
        )
    return value
