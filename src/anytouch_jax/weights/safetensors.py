"""Files of flat arrays: safetensors in and out, npz in; parameters with what is known of them."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.config import Config, to_json
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, placeholder
from anytouch_jax.shown import shown_short
from anytouch_jax.weights.tree import flatten

# Metadata of our files: heads, activation and training data leave no trace in shapes.
MODEL_KEY = "anytouch_jax.model"
BACKGROUND_KEY = "anytouch_jax.background"
SEEN_KEY = "anytouch_jax.seen"
FIELDS_KEY = "fields"  # calibration of what is measured, as JSON: `encoder.fields.scale_of`


class WeightsError(UserError):
    """A weights file that cannot be read or does not fit; the message names the file or the
    keys.
    """


@shown_short
@dataclass(frozen=True)
class Loaded:
    """Parameters from a run or a weights file, with every part it has: touch, decoder, image, text
    and others.

    Sensors outside `trained_sensors` have the universal row. `trained_sensors` is None if the file
    does not store it. `universal_drawn` is False if training never drew the universal tokens.
    `config` of a file has its model and its background, and defaults elsewhere. `metadata` is that
    of the checkpoint or the file.
    """

    path: Path
    params: dict[str, Any] = field(repr=False)
    config: Config
    trained_sensors: tuple[str, ...] | None
    universal_drawn: bool
    metadata: Mapping[str, Any]
    from_run: bool

    def export_metadata(self) -> dict[str, str]:
        """Return the metadata of a safetensors file with these parameters."""
        metadata = {"source": str(self.path), MODEL_KEY: to_json(self.config.model)}
        metadata[BACKGROUND_KEY] = self.config.data.background
        if "fields" in self.params and FIELDS_KEY in self.metadata:
            stored = self.metadata[FIELDS_KEY]
            metadata[FIELDS_KEY] = stored if isinstance(stored, str) else json.dumps(stored)
        if self.trained_sensors is not None and "touch" in self.params:
            metadata[SEEN_KEY] = ",".join(self.trained_sensors)
        return metadata


def write_safetensors(
    path: str | Path, arrays: Mapping[str, np.ndarray], metadata: Mapping[str, str]
) -> None:
    """Write arrays to one safetensors file, whole or not at all; `metadata` is text by name.

    Raises WeightsError.
    """
    from safetensors.numpy import save_file

    path = Path(path)
    try:
        with atomic_path(path) as part:
            # the library ignores strides: a transposed view would be written in the wrong order
            save_file(
                {n: np.ascontiguousarray(a).reshape(a.shape) for n, a in arrays.items()},
                part,
                dict(metadata),
            )
            _sort_metadata(part)
            umask = os.umask(0)
            os.umask(umask)
            # the library writes a file that only its owner may read
            os.chmod(part, 0o666 & ~umask)
    except Exception as error:  # the library wraps OSError in its own type
        advice = "; free some space" if "No space left" in str(error) else ""
        raise WeightsError(f"could not write {path}: {error}{advice}") from error


def _sort_metadata(file: Path) -> None:
    """Sort the metadata of a file: the library writes them in a random order, but equal weights are
    equal bytes.
    """
    with file.open("r+b") as header:
        size = int.from_bytes(header.read(8), "little")
        entries = json.loads(header.read(size))
        entries = {"__metadata__": dict(sorted(entries.pop("__metadata__", {}).items())), **entries}
        text = json.dumps(entries, separators=(",", ":"), ensure_ascii=False).encode()
        if len(text) <= size:
            header.seek(8)
            header.write(text.ljust(size))


def export_safetensors(path: str | Path, params: Any, metadata: Mapping[str, str]) -> None:
    """Write a parameter tree to one safetensors file, names joined with "/".

    Raises WeightsError.
    """
    write_safetensors(
        path, {name: np.asarray(leaf) for name, leaf in flatten(params).items()}, metadata
    )


def read_safetensors(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    """Return (arrays in their stored types, metadata) of a safetensors file.

    Raises WeightsError.
    """
    with _opened(path) as file:
        return {name: file.get_tensor(name) for name in file.keys()}, dict(file.metadata() or {})  # noqa: SIM118


def read_file_metadata(path: str | Path) -> dict[str, str]:
    """Return the metadata of a safetensors file without its arrays; {} for a file of another
    type.
    """
    if Path(path).suffix.lower() != ".safetensors":
        return {}
    with _opened(path) as file:
        return dict(file.metadata() or {})


@contextmanager
def _opened(path: str | Path) -> Iterator[Any]:
    import ml_dtypes  # noqa: F401  gives numpy the name bfloat16
    from safetensors import safe_open

    path = existing_file(path)
    try:
        with safe_open(path, framework="numpy") as file:
            yield file
    except Exception as error:  # a foreign file raises any type of error
        raise WeightsError(f"{path} is not a whole safetensors file: {error}") from error


def existing_file(path: str | Path) -> Path:
    """Return `path` if it is a file. Raises WeightsError."""
    path = Path(path)
    if not path.is_file():
        raise WeightsError(
            f"there is no weights file {path}; give the path of a .safetensors, .npz, .pth, .pt, "
            ".ckpt or .bin file"
        )
    if kind := placeholder(path):
        raise WeightsError(f"{path} is {kind}")
    return path
