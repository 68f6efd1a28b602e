"""`anytouch info`: what a run, a weights file, a manifest or features are."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from anytouch_jax.config import UNIVERSAL, Config, ModelConfig
from anytouch_jax.encoder.export import describes
from anytouch_jax.errors import UserError

_TABLES = (".csv", ".parquet")
_WEIGHTS = (".safetensors", ".pth", ".pt", ".bin", ".npz")


@dataclass(frozen=True)
class InfoOptions:
    """Describe files and folders: a run, weights, a manifest, features, a head or an exported encoder.

    Example: anytouch info runs/stage2 data/scenes/manifest.parquet features.npz
    """

    paths: Positional[tuple[Path, ...]]
    """Files and folders."""


def run(options: InfoOptions) -> int:
    """Print some lines on every path."""
    if not options.paths:
        raise UserError("name a file or a folder")
    for number, path in enumerate(options.paths):
        print("\n" * bool(number) + "\n".join(_lines(path)))
    return 0


def _lines(path: Path) -> list[str]:
    if not path.exists():
        raise UserError(f"there is no {path}")
    if path.is_dir():
        return _folder(path)
    if describes(path).is_file():
        return [f"{path}: an exported encoder; how to call it", describes(path).read_text("utf-8").strip()]
    if path.suffix.lower() in _TABLES:
        return _manifest(path)
    if path.suffix == ".npz" and (found := _features(path)):
        return found
    if path.suffix == ".npz" and (head := _head(path)):
        return head
    if path.suffix in _WEIGHTS:
        return _weights(path)
    raise UserError(f"{path} is none of a run, weights ({', '.join(_WEIGHTS)}), a manifest (.csv, .parquet), features")


def _folder(path: Path) -> list[str]:
    """A run, else the manifest that is meant: by its name, or the only one."""
    from anytouch_jax.data.manifest.schema import is_manifest
    from anytouch_jax.weights.checkpoint import steps

    found = [one for one in sorted(path.iterdir()) if one.suffix.lower() in _TABLES and is_manifest(one)]
    named = [one for one in found if one.stem == "manifest"] or found
    if steps(path / "checkpoints") or not named:
        return _run(path)
    others = [f"also in this folder: {', '.join(one.name for one in found if one != named[0])}"]
    return [*_manifest(named[0]), *(others if len(found) > 1 else [])]


def _run(path: Path) -> list[str]:
    from anytouch_jax.config import from_json
    from anytouch_jax.weights import checkpoint
    from anytouch_jax.weights.checkpoint import CheckpointError, checked, resolve

    about = checkpoint.read_metadata(path)
    try:
        checked(resolve(path, None))
        damage = []
    except CheckpointError as error:
        damage = [str(error)]
    config: Config = from_json(about["config"])
    kept = checkpoint.steps(path / "checkpoints")
    lowest = checkpoint.best_of(path / "checkpoints")
    best = "" if lowest is None else f" (lowest loss at {lowest})"
    source = about.get("source") or {}
    began = [f"{name} {source[name]}" for name in ("init", "clip") if source.get(name) is not None]
    loss = about.get("metrics", {}).get("loss")
    if "sensor" in source:
        return [
            f"{path}: the run {source['run']}, with tokens of {source['sensor']} fitted to {source['frames']} frames",
            _model(config.model),
            _sensors(config.model, about.get("seen")),
            *damage,
        ]
    return [
        f"{path}: a run of stage {config.stage}, step {about['step']} of {config.run.steps}"
        + (f"; checkpoints at {', '.join(map(str, kept))}{best}" if kept else ""),
        f"preset {config.preset}, recipe {config.recipe}, towers {config.towers}, batch {config.data.batch_size}",
        _model(config.model),
        _sensors(config.model, about.get("seen")),
        f"touches are seen {'less the untouched gel' if config.data.background == 'subtract' else 'as they are'}",
        f"began from {', '.join(began)}" if began else "began from nothing trained",
        f"data: {', '.join(config.data.manifests) or 'none named'}"
        + (f" (content {about['data'][:12]})" if about.get("data") else ""),
        *([f"loss {loss:.4g}, the mean since the checkpoint before"] if loss is not None else []),
        *damage,
    ]


def _model(model: ModelConfig) -> str:
    touch = model.touch
    read = {"shared": "", "sensor": ", each sensor by its own", "convolutional": ", read by convolutions"}
    return (
        f"touch encoder of width {touch.width}, depth {touch.depth}, {touch.heads} heads; pictures of "
        f"{model.image_size} pixels in patches of {model.patch}{read[model.patch_encoder]}; features of {model.embed}"
    )


def _sensors(model: ModelConfig, seen: Sequence[str] | None) -> str:
    named = [name for name in model.sensors if name != UNIVERSAL]
    if seen is None:
        return f"sensors: {', '.join(named)}; which of them it was trained on is not told"
    return f"sensors trained on: {', '.join(seen) or 'none'}; every other one counts as never seen"


def _weights(path: Path) -> list[str]:
    import numpy as np

    from anytouch_jax.weights import load, safetensors
    from anytouch_jax.weights.convert import detect_layout

    weights, metadata = load.read_weights(path), safetensors.read_file_metadata(path)
    names = {"own": "our own", "clip": "HF CLIP's", "openclip": "OpenCLIP's"}
    layout = detect_layout(weights)
    model = load.model_of_file(path, weights)
    trained = load.trained_sensors(metadata, model)
    count = sum(array.size for array in weights.values())
    finite = all(np.isfinite(array).all() for array in weights.values() if array.dtype.kind == "f")
    return [
        f"{path}: {len(weights)} arrays of {count:,} numbers by {names.get(layout, f'the authors ({layout})')} names",
        _model(model),
        *([] if layout in ("clip", "openclip") else [_sensors(model, trained)]),
        *([] if finite else ["some of them are not finite: nothing can be embedded with them"]),
    ]


def _manifest(path: Path) -> list[str]:
    from collections import Counter

    from anytouch_jax.data.manifest import manifest as manifests

    table = manifests.read(path)
    count = {name: Counter(table.column(name).to_pylist()) for name in ("split", "sensor")}
    listed = {
        name: ", ".join(f"{key} {number:,}" for key, number in sorted(one.items())) for name, one in count.items()
    }
    columns = table.table.column_names
    optional = ("image_path", "text", "background_path", "touch", "object", "field_path")
    there = [f"{name} {int(table.present(name).sum()):,}" for name in optional if name in columns]
    labels = [name.removeprefix("label.") for name in columns if name.startswith("label.")]
    return [
        f"{path}: a manifest of {len(table):,} rows in {int(table.codes('sequence').max()) + 1:,} recordings, "
        f"{len(table.clips(3)):,} clips of three frames",
        f"splits: {listed['split']}",
        f"sensors: {listed['sensor']}",
        f"rows with {', '.join(there) or 'nothing optional'}",
        f"labels: {', '.join(labels) or 'none'}",
        f"content {table.content_hash[:12]}",
    ]


def _features(path: Path) -> list[str]:
    """What `anytouch embed` wrote; [] for another .npz."""
    import numpy as np

    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return []
    if not {"features", "rows"} <= arrays.keys():
        return []
    values = arrays["features"]
    keys = [name.removeprefix("key/") for name in arrays if name.startswith("key/")]
    told = [f"{name.removeprefix('about/')}: {arrays[name]}" for name in arrays if name.startswith("about/")]
    return [f"{path}: {len(values):,} features of {values.shape[1]}, with {', '.join(keys) or 'row numbers'}", *told]


def _head(path: Path) -> list[str]:
    """What `anytouch probe --save` wrote; [] for another .npz."""
    from anytouch_jax.evaluate.heads import load_head

    try:
        head = load_head(path)
    except UserError:
        return []
    return [
        f"{path}: the linear head of a probe for {head.label}: {', '.join(head.classes)}",
        f"of features of {len(head.mean)}: --pooling {head.pooling} --frames {head.frames}, encoder {head.fingerprint}",
    ]
