"""Exports of an encoder in a cache, made at its first touch and found by content after that."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import jax
import numpy as np

from anytouch_jax.encoder.arrays import Pooling
from anytouch_jax.errors import CheckError, UserError
from anytouch_jax.export import engines, export, graph
from anytouch_jax.export.artefact import FORMAT, Exported, describes, load
from anytouch_jax.export.engines import Engine
from anytouch_jax.export.export import ExportSettings
from anytouch_jax.files import atomic_write, cache_folder, remove_old
from anytouch_jax.weights.registry import list_encoders

if TYPE_CHECKING:
    from anytouch_jax.encoder.base import Encoder

# Parameters. In larger encoders products take the time, which are equally fast in XLA.
LARGEST = 16_000_000
_CACHE = ".engines"  # next to the weights


def cached_export(
    encoder: Encoder, frames: int, pooling: Pooling, *, fields: bool = False
) -> Exported | None:
    """Return the export of touches on the encoder's engine, None where XLA computes.

    "auto" is onnxruntime if it is installed and jax runs on a CPU. The encoder must compute in
    float32, have at most LARGEST parameters, and differ from its export by at most 3e-5. XLA
    computes clips of more than one segment.

    Args:
        encoder: what is exported.
        frames: those of a touch.
        pooling: that of the features.
        fields: export the fields too.

    Raises:
        UserError: an engine that was named is not installed, or the encoder computes in bfloat16.
        CheckError: its export on an engine that was named differs.
    """
    model = encoder.config.model
    if frames not in (1, model.frames):
        return None
    is_auto = encoder.engine == "auto"
    if is_auto and not _is_fast(encoder):
        return None
    if model.dtype != "float32":
        raise UserError(
            f"{encoder.engine} computes in float32, not in {model.dtype}; leave out --dtype, or "
            "use XLA"
        )
    engine: Engine = "onnxruntime" if encoder.engine == "auto" else encoder.engine
    settings = ExportSettings(
        frames=frames, pooling=pooling, form="onnx", fields=fields, engine=engine
    )
    try:
        name = f"{_key(encoder, settings)}.onnx"
        folders = _folders(encoder.source)
        for path in (folder / name for folder in folders):
            if is_auto and _is_refused(path):
                return None
            with contextlib.suppress(UserError):
                run = load(path, engine)
                _touch(path)
                return run
        return _made(encoder, name, folders, settings)
    except (UserError, OSError):
        # XLA computes the same features, only slower.
        if is_auto:
            return None
        raise


def _is_fast(encoder: Encoder) -> bool:
    """Whether an engine is exact and faster than XLA for an encoder on this machine."""
    count = sum(np.size(leaf) for leaf in jax.tree.leaves(encoder.params))
    is_float32 = encoder.config.model.dtype == "float32"
    return jax.default_backend() == "cpu" and is_float32 and count <= LARGEST


def _touch(path: Path) -> None:
    """Mark both files of an export as used now: the oldest ones are removed."""
    for file in (path, describes(path)):
        with contextlib.suppress(OSError):
            os.utime(file)


def _made(encoder: Encoder, name: str, folders: list[Path], settings: ExportSettings) -> Exported:
    """Make an export, and store it in the first folder that can be written.

    Raises CheckError, which is stored too, so that it is not tried again.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / name
        try:
            export.export_with(encoder, path, settings)
            return load(path, settings.engine)
        except CheckError as error:
            atomic_write(describes(path), json.dumps({"refused": str(error)}))
            raise
        finally:
            _store(Path(folder), folders)


def _store(made: Path, folders: list[Path]) -> None:
    """Copy the files of an export to the first folder that can be written."""
    # The description last: it vouches for the other file.
    files = {file.name: file.read_bytes() for file in sorted(made.iterdir())}
    if not files:
        return
    for folder in folders:
        with contextlib.suppress(OSError):
            for name, data in files.items():
                atomic_write(folder / name, data)
            remove_old(folder, "*.onnx*")
            return


def _key(encoder: Encoder, settings: ExportSettings) -> str:
    """Return a name for everything that decides the features.

    That is weights, preprocessing, the code that writes the graph, the engine and its version.
    """
    params = encoder.params
    if settings.fields:
        params = params | {"fields": encoder.part_params("fields")}
    made_by = (
        Path(graph.__file__).read_bytes(),
        Path(engines.__file__).read_bytes(),
        engines.imported(settings.engine).__version__,
    )
    asked = (
        FORMAT,
        settings.engine,
        settings.frames,
        settings.pooling,
        settings.fields,
        encoder.contract,
        encoder.config.data.background,
    )
    digest = hashlib.sha256(repr((asked, made_by)).encode())
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        digest.update(f"{path} {leaf.dtype} {leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:32]


def _folders(source: str) -> list[Path]:
    """Return where an export is looked for: next to weights of the user, then in their cache."""
    path = Path(source)
    own = cache_folder() / "engines"
    if source in list_encoders() or source.startswith("hf:") or not path.exists():
        return [own]
    return [(path if path.is_dir() else path.parent) / _CACHE, own]


def _is_refused(path: Path) -> bool:
    """Whether the export was made before, and differed from the live model."""
    try:
        return "refused" in json.loads(describes(path).read_bytes())
    except (OSError, ValueError):
        return False
