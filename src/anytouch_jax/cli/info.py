"""`anytouch info`: what a run, a weights file, a manifest or features are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from anytouch_jax.config import UNIVERSAL, Config, ModelConfig
from anytouch_jax.errors import UserError

_TABLES = (".csv", ".parquet")
_SPREAD_BYTES = 1 << 28  # the features of larger files are not read
_WEIGHTS = (".safetensors", ".pth", ".pt", ".ckpt", ".bin", ".npz")


@dataclass(frozen=True)
class InfoOptions:
    """Describe files and folders: a run, weights, a manifest, features, a head or an exported encoder.

    Example: anytouch info runs/stage2 data/scenes/manifest.parquet features.npz
    """

    paths: Positional[tuple[Path, ...]]  # Files and folders.


def run(options: InfoOptions) -> int:
    """Print some lines about every path."""
    if not options.paths:
        raise UserError("There is nothing to describe. Name a file or a folder.")
    for number, path in enumerate(options.paths):
        print("\n" * bool(number) + "\n".join(_lines(path)))
    return 0


def _lines(path: Path) -> list[str]:
    if not path.exists():
        raise UserError(f"there is no {path}")
    if path.is_dir():
        return _folder(path)
    description = path.with_name(f"{path.name}.json")
    if description.is_file():
        from anytouch_jax.encoder.export import read_checked

        read_checked(path)
        return [f"{path}: an exported encoder", description.read_text("utf-8").strip()]
    if path.suffix.lower() in _TABLES:
        return _manifest(path)
    if path.suffix.lower() == ".npz" and (lines := _features(path) or _head(path)):
        return lines
    if path.suffix.lower() in _WEIGHTS or path.name.endswith(".index.json"):
        return _weights(path)
    known = f"a run folder, weights ({', '.join(_WEIGHTS)}), a manifest ({', '.join(_TABLES)}), features or a head"
    raise UserError(f"{path} has no known format. Known are {known}.")


def _folder(path: Path) -> list[str]:
    """Return lines about a run, or about the manifest in the folder: that called manifest, or the first."""
    from anytouch_jax.data.manifest.schema import is_manifest
    from anytouch_jax.weights.checkpoint import steps

    tables = [file for file in sorted(path.iterdir()) if file.suffix.lower() in _TABLES and is_manifest(file)]
    tables.sort(key=lambda file: file.stem != "manifest")
    if steps(path / "checkpoints") or not tables:
        return _run(path)
    others = ", ".join(sorted(file.name for file in tables[1:]))
    return [*_manifest(tables[0]), *([f"other manifests in this folder: {others}"] if others else [])]


def _run(path: Path) -> list[str]:
    from anytouch_jax.config import from_json
    from anytouch_jax.weights import checkpoint
    from anytouch_jax.weights.checkpoint import CheckpointError, checked, resolve

    metadata = checkpoint.read_metadata(path)
    try:
        checked(resolve(path, None))
        damage = []
    except CheckpointError as error:
        damage = [str(error)]
    config: Config = from_json(metadata["config"])
    source = metadata.get("source") or {}
    model = [_model(config.model), _sensors(config.model, metadata.get("seen"))]
    if "sensor" in source:
        adapted = f"tokens of {source['sensor']} fitted to {source['frames']} frames"
        return [f"{path}: the run {source['run']}, with {adapted}", *model, *damage]
    saved, best = checkpoint.steps(path / "checkpoints"), checkpoint.best_of(path / "checkpoints")
    checkpoints = f", checkpoints at {', '.join(map(str, saved))}" if saved else ""
    if best is not None:
        checkpoints += f" (lowest loss at {best})"
    starts = [f"{name} {source[name]}" for name in ("init", "clip") if source.get(name) is not None]
    loss = metadata.get("metrics", {}).get("loss")
    content = f" (content {metadata['data'][:12]})" if metadata.get("data") else ""
    return [
        f"{path}: a run of stage {config.stage}, step {metadata['step']} of {config.run.steps}{checkpoints}",
        f"preset {config.preset}, recipe {config.recipe}, towers {config.towers}, batch {config.data.batch_size}",
        *model,
        f"background: {config.data.background}",
        f"started from {', '.join(starts) or 'random weights'}",
        f"data: {', '.join(config.data.manifests) or 'unknown'}{content}",
        *([f"loss {loss:.4g}, the mean since the previous checkpoint"] if loss is not None else []),
        *damage,
    ]


def _model(model: ModelConfig, *, heads_known: bool = True) -> str:
    touch = model.touch
    heads = f"{touch.heads} heads" if heads_known else "heads unknown"
    return (
        f"touch encoder: width {touch.width}, depth {touch.depth}, {heads}, images of {model.image_size} "
        f"pixels, {model.patch_encoder} patches of {model.patch}, {model.embed} features"
    )


def _sensors(model: ModelConfig, trained: Sequence[str] | None) -> str:
    if trained is None:
        names = ", ".join(name for name in model.sensors if name != UNIVERSAL)
        return f"sensors: {names}. It is unknown which of them were trained."
    return f"trained sensors: {', '.join(trained) or 'none'}. All others get the universal tokens."


def _weights(path: Path) -> list[str]:
    import numpy as np

    from anytouch_jax.weights import load, safetensors
    from anytouch_jax.weights.convert import detect_layout

    weights, metadata = load.read_weights(path), safetensors.read_file_metadata(path)
    owners = {"own": "this package's", "clip": "HF CLIP's", "openclip": "OpenCLIP's"}
    layout = detect_layout(weights)
    names = owners.get(layout, f"the authors' ({layout})")
    model, unknown = load.form_of_file(path, weights)
    count = sum(array.size for array in weights.values())
    infinite = [name for name, array in weights.items() if not np.isfinite(array).all()]
    activation = load.clip_activation(path) if layout in ("clip", "openclip") else model.activation
    return [
        f"{path}: {len(weights)} arrays of {count:,} numbers, with {names} names",
        _model(model, heads_known=not unknown.keys() & {"touch", "image"}),
        *([] if activation else ["The activation is unknown. OpenAI's CLIP wants quick_gelu."]),
        *([f"Its head counts are unknown ({', '.join(unknown)}): a config.json gives them."] if unknown else []),
        *([] if layout in ("clip", "openclip") else [_sensors(model, load.trained_sensors(metadata, model))]),
        *([f"{infinite[0]} is not finite, so that these weights cannot embed anything."] if infinite else []),
    ]


def _manifest(path: Path) -> list[str]:
    from collections import Counter

    from anytouch_jax.data.manifest import manifest as manifests

    table = manifests.read(path)
    columns = table.table.column_names

    def counts(name: str) -> str:
        counter = Counter(table.column(name).to_pylist())
        return ", ".join(f"{value} {count:,}" for value, count in sorted(counter.items()))

    optional = ("image_path", "text", "background_path", "touch", "object", "field_path")
    filled = [f"{name} {int(table.present(name).sum()):,}" for name in optional if name in columns]
    labels = [name.removeprefix("label.") for name in columns if name.startswith("label.")]
    return [
        f"{path}: a manifest of {len(table):,} rows in {int(table.codes('sequence').max()) + 1:,} recordings, "
        f"{len(table.clips(3)):,} clips of three frames",
        f"splits: {counts('split')}",
        f"sensors: {counts('sensor')}",
        f"rows with {', '.join(filled) or 'no optional column'}",
        f"labels: {', '.join(labels) or 'none'}",
        f"content {table.content_hash[:12]}",
    ]


def _features(path: Path) -> list[str]:
    """Return lines about features of `anytouch embed`; [] for another .npz. Raises UserError for a damaged file."""
    from anytouch_jax.encoder.spread import spread_lines
    from anytouch_jax.files import read_arrays

    is_small = path.stat().st_size < _SPREAD_BYTES
    try:
        arrays = read_arrays(path, only=lambda name: name.startswith("about/") or (is_small and name == "features"))
    except (OSError, ValueError) as error:
        raise UserError(f"{path} is not a whole .npz file of plain arrays: {error}") from None
    if not {"features", "rows"} <= arrays.keys():
        return []
    values, rows = arrays["features"], arrays["rows"]
    if values.ndim != 2 or values.dtype.kind not in "fiu" or rows.shape != values.shape[:1]:
        raise UserError(f"{path} needs numeric features (n, d) and rows (n,), not {values.shape} and {rows.shape}.")
    keys = [name.removeprefix("key/") for name in arrays if name.startswith("key/")]
    metadata = [
        f"{name.removeprefix('about/')}: {str(arrays[name])[:200]}" for name in arrays if name.startswith("about/")
    ]
    return [
        f"{path}: {len(values):,} features of {values.shape[1]}, with {', '.join(keys) or 'row numbers'}",
        *metadata,
        *(spread_lines(values) if is_small else []),
    ]


def _head(path: Path) -> list[str]:
    """Return lines about a head of `anytouch probe label --save`; [] for another .npz."""
    from anytouch_jax.evaluate.heads import load_head
    from anytouch_jax.files import read_arrays

    if not {"format", "mark", "classes"} <= read_arrays(path, only=lambda _: False).keys():
        return []
    head = load_head(path)
    options = f"--pooling {head.pooling} --frames {head.frames}"
    return [
        f"{path}: a linear head for {head.label}: {', '.join(head.classes)}",
        f"for features of {len(head.mean)} with {options}, encoder {head.fingerprint}",
    ]
