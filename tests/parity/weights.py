"""Golden cases of weights: full-size keys, shapes and decay groups, what is loaded from where,
stored parameters.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from anytouch_jax.config import Config, ModelConfig, Stack, preset
from anytouch_jax.nn.functional import build
from anytouch_jax.weights import convert, load, start
from anytouch_jax.weights.keymaps import param_shapes
from anytouch_jax.weights.tree import flatten, nest
from tests.parity.golden_files import Arrays, Case, read_arrays
from tests.support.release_keys import release_names, release_shapes

STAGE1 = preset("large", recipe="release")
STAGE2 = preset("large", stage=2, recipe="release", towers="pretrained")
# entry of K_manifest -> the layout of that file and the preset that it is a file of
_FULL_SIZE: dict[str, tuple[str, Config]] = {
    "stage1": ("stage1", STAGE1),
    "stage2": ("stage2", STAGE2),
    "probe_material": ("probe", STAGE1),
    "hf_clip_vit_l_14": ("clip", STAGE2),
}
_FRESH = "kept at its fresh initial value"


def manifest(case: Case) -> None:
    """Keys and shapes of the four full-size files against preset large; decay groups and freezing
    against our rules.
    """
    for kind, (layout, config) in _FULL_SIZE.items():
        rows = [row for row in case.info[kind]["state_dict"] if not row[0].startswith("head.")]
        ours = release_shapes(config.model, layout)
        _same(case, f"{kind}/keys", ours, {key: tuple(shape) for key, shape, *_ in rows})
        if layout in ("stage1", "stage2"):
            shapes = {
                name: tuple(leaf.shape)
                for name, leaf in flatten(build(config.model).abstract()).items()
            }
            _same(case, f"{kind}/network", param_shapes(config.model), shapes)
            _groups(case, kind, config, rows)


def _groups(case: Case, kind: str, config: Config, rows: Iterable[Any]) -> None:
    """The decay group of every array that something reads; `text` runs without gradient there
    (golden Q10).
    """
    names = release_names(config.model)
    ours = {}
    theirs = {}
    for key, _, _, group in rows:
        if key in names:
            name = names[key]
            decay = "decay" if _first(config.weight_decay, name) else "no_decay"
            ours[key] = "frozen" if _first(config.frozen, name) else decay
            theirs[key] = "frozen" if name.startswith("text/") else group
    _same(case, f"{kind}/groups", ours, theirs)


def _first(rules: Iterable[tuple[str, Any]], name: str) -> Any:
    return next(value for pattern, value in rules if re.search(pattern, name))


def _same(case: Case, what: str, ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> None:
    """A failing row for each entry that differs, and a row with the number of entries."""
    for key in sorted(set(ours) | set(theirs)):
        if ours.get(key) != theirs.get(key):
            case.fail(f"{what}/{key}", f"{ours.get(key)} instead of {theirs.get(key)}")
    case.check(what, len(ours), len(theirs), 0.0)


def loading_map(case: Case) -> None:
    """Every used key has, after our loading, the value that the authors' loader would give it.

    The map is that of a two-layer model of any width; LoRA is inserted after loading.
    """
    model1, model2 = _two_layers()
    files = {
        "clip": _values(release_shapes(model2, "clip"), 1),
        "mae": _values(release_shapes(model1), 2),
        "stage2": _values(release_shapes(model2), 3),
    }
    for name, sources in case.info.items():
        if isinstance(sources, dict) and "_from_" in name:
            if name.startswith("probe"):
                _probe_map(case, name, sources, model1 if "mae" in str(sources) else model2, files)
            else:
                _stage_map(
                    case, name, sources, model1 if name.startswith("stage1") else model2, files
                )


def _two_layers() -> tuple[ModelConfig, ModelConfig]:
    """Stage 1 and stage 2 of the preset in small."""
    stack = Stack(16, 2, 4, 24)
    sizes: Any = {
        "image_size": 28,
        "patch": 14,
        "embed": 12,
        "touch": stack,
        "decoder": Stack(8, 2, 2, 16),
    }
    assert STAGE2.model.text is not None
    text = replace(STAGE2.model.text, stack=Stack(10, 2, 2, 14), vocab=30)
    return replace(STAGE1.model, **sizes), replace(
        STAGE2.model, **sizes, image=stack, text=text, lora_rank=0
    )


def _values(shapes: Mapping[str, Any], seed: int) -> Arrays:
    rng = np.random.default_rng(seed)
    return {key: rng.normal(size=shape).astype(np.float32) for key, shape in shapes.items()}


def _expected(key: str, source: str, files: Mapping[str, Arrays]) -> np.ndarray:
    """The array at a key's source; CLIP's 2-D patch kernel is repeated over the frames (golden
    Q1).
    """
    file, _, theirs = source.partition(":")
    array = files[file][theirs]
    repeated = key.endswith("video_patch_embedding.weight") and file == "clip"
    if repeated:
        return np.repeat(array[:, None], 3, axis=1)
    return array


def _stage_map(
    case: Case,
    name: str,
    sources: Mapping[str, str],
    model: ModelConfig,
    files: Mapping[str, Arrays],
) -> None:
    fresh = nest(_values(param_shapes(model), 4))
    begun = "stage1" in name and not name.startswith("stage1")
    stage1 = convert.to_params(files["mae"], _two_layers()[0]) if begun else None
    merged = start.first_params(fresh, model, stage1=stage1, clip=files["clip"])
    ours = convert.to_release(merged, model)
    before = convert.to_release(fresh, model)
    used = release_names(model)
    for key in used:
        source = sources.get(key, "nowhere")
        expected = (
            before[key]
            if source == _FRESH
            else _expected(key, source, files)
            if key in sources
            else None
        )
        if expected is None or not np.array_equal(ours[key], expected):
            case.fail(f"{name}/{key}", f"its value is not that of {source}")
    case.check(f"{name}/keys", len(used), len(used.keys() & sources.keys()), 0.0)


def _probe_map(
    case: Case,
    name: str,
    sources: Mapping[str, str],
    model: ModelConfig,
    files: Mapping[str, Arrays],
) -> None:
    """A probe's file, filled as the map says, is read as the touch encoder of its source."""
    (source,) = {value.partition(":")[0] for value in sources.values() if value != _FRESH}
    probe = {key: _expected(key, value, files) for key, value in sources.items() if value != _FRESH}
    ours, theirs = (flatten(convert.to_params(w, model)["touch"]) for w in (probe, files[source]))
    _equal(case, f"{name}/touch", ours, theirs)


def parameters(case: Case) -> None:
    """A file of parameters that other cases use: the recorded keys, shapes and types."""
    stored = {key: (array.shape, str(array.dtype)) for key, array in case.arrays.items()}
    _same(
        case,
        "keys",
        stored,
        {key: (tuple(shape), kind) for key, (shape, kind) in case.info["keys"].items()},
    )


def checkpoint(case: Case) -> None:
    """A `.pth` in the authors' format gives exactly the stored parameters."""
    stage = 2 if case.name.startswith("stage2") else 1
    weights = load.read_weights(case.folder / case.name)
    stored = read_arrays(case.folder / f"stage{stage}_params.npz")
    extra = {
        key for key in stored if key not in weights and key.endswith("sensor_token_proj.weight")
    }
    expected = {key: value for key, value in stored.items() if key not in extra}
    ours, theirs = (
        flatten(convert.to_params(w, convert.detect_form(w, {})[0])) for w in (weights, expected)
    )
    _equal(case, "parameters", ours, theirs)


def _equal(case: Case, what: str, ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> None:
    """A failing row for each parameter that differs in any bit or that one of the two lacks; a row
    with the count.
    """
    for name in sorted(ours.keys() | theirs.keys()):
        if name not in ours or name not in theirs or not np.array_equal(ours[name], theirs[name]):
            case.fail(f"{what}/{name}", "differs from the parameters that it should be equal to")
    case.check(what, len(ours), len(theirs), 0.0)
