"""The export that an encoder runs on: made once, compared with the live model, and stored for the next start."""

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

from anytouch_jax.encoder import engines
from anytouch_jax.encoder.arrays import Pooling
from anytouch_jax.encoder.engines import Engine
from anytouch_jax.encoder.export import FORMAT, Exported, describes, export, load
from anytouch_jax.errors import CheckError, UserError
from anytouch_jax.files import atomic_write, cache_folder, remove_old
from anytouch_jax.weights.registry import list_encoders

if TYPE_CHECKING:
    from anytouch_jax.encoder.base import Encoder

LARGEST = 16_000_000  # parameters; in larger encoders products take the time, which are equally fast in XLA
FOLDER = ".engines"  # next to the weights


def cached_export(encoder: Encoder, frames: int, pooling: Pooling, *, fields: bool = False) -> Exported | None:
    """Return the export of touches of `frames` frames on the encoder's engine, None where XLA computes.

    "auto" is onnxruntime if it is installed and jax runs on a CPU. The encoder must compute in float32 and have at most
    LARGEST parameters, and its export must differ from the live model by at most 1e-5. XLA computes clips of more than
    one segment. An export that is not whole, or of other weights, is made again. For an engine that was named, raises
    UserError if it is not installed and for bfloat16, and CheckError if the export differs.
    """
    engine, model, is_auto = encoder.engine, encoder.config.model, encoder.engine == "auto"
    if frames not in (1, model.frames):
        return None
    if is_auto and (jax.default_backend() != "cpu" or model.dtype != "float32" or _count(encoder) > LARGEST):
        return None
    if model.dtype != "float32":
        raise UserError(f"{engine} computes in float32, not in {model.dtype}; leave out --dtype, or use XLA")
    on: Engine = "onnxruntime" if engine == "auto" else engine
    try:
        name, folders = f"{_key(encoder, on, frames, pooling, fields)}.onnx", _folders(encoder.source)
        for path in (folder / name for folder in folders):
            if is_auto and _is_refused(path):
                return None
            with contextlib.suppress(UserError):
                run = load(path, on)
                for file in (path, describes(path)):
                    with contextlib.suppress(OSError):
                        os.utime(file)
                return run
        return _made(encoder, on, name, folders, frames, pooling, fields)
    except (UserError, OSError):
        if is_auto:
            return None
        raise


def _made(
    encoder: Encoder, engine: Engine, name: str, folders: list[Path], frames: int, pooling: Pooling, fields: bool
) -> Exported:
    """Make an export, and store it in the first folder that can be written. Raises CheckError, which is stored too."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / name
        try:
            export(encoder, path, frames=frames, pooling=pooling, form="onnx", fields=fields, engine=engine)
            return load(path, engine)
        except CheckError as error:
            atomic_write(describes(path), json.dumps({"refused": str(error)}))
            raise
        finally:
            files = {file.name: file.read_bytes() for file in sorted(Path(folder).iterdir())}  # the description last
            _store(files, folders)


def _store(files: dict[str, bytes], folders: list[Path]) -> None:
    for folder in folders if files else []:
        with contextlib.suppress(OSError):
            for name, data in files.items():
                atomic_write(folder / name, data)
            remove_old(folder, "*.onnx*")
            return


def _count(encoder: Encoder) -> int:
    return sum(np.size(leaf) for leaf in jax.tree.leaves(encoder.params))


def _key(encoder: Encoder, engine: Engine, frames: int, pooling: Pooling, fields: bool) -> str:
    """Return a name for everything that decides the features: weights, preprocessing, code, engine and its version."""
    params = encoder.params | ({"fields": encoder.part_params("fields")} if fields else {})
    made_by = Path(engines.__file__).read_bytes(), engines.imported(engine).__version__
    asked = FORMAT, engine, frames, pooling, fields, encoder.contract, encoder.config.data.background
    digest = hashlib.sha256(repr((asked, made_by)).encode())
    for path, leaf in jax.tree_util.tree_leaves_with_path(params):
        digest.update(f"{path} {leaf.dtype} {leaf.shape}".encode())
        digest.update(np.ascontiguousarray(leaf).tobytes())
    return digest.hexdigest()[:32]


def _folders(source: str) -> list[Path]:
    """Return where an export is looked for: next to weights of the user, then in the user's cache."""
    path, own = Path(source), cache_folder() / "engines"
    if source in list_encoders() or source.startswith("hf:") or not path.exists():
        return [own]
    return [(path if path.is_dir() else path.parent) / FOLDER, own]


def _is_refused(path: Path) -> bool:
    """Whether the export was made before, and differed from the live model."""
    try:
        return "refused" in json.loads(describes(path).read_bytes())
    except (OSError, ValueError):
        return False
