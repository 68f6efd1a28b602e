"""Tensors of a file by torch.save (.pth, .pt, .bin), without torch: the zip form and the older plain form."""

from __future__ import annotations

import io
import os
import struct
import zipfile
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np

from anytouch_jax.weights.tensors import WeightsError, existing
from anytouch_jax.weights.unpickle import Record, Storage, Tensor, read_pickle

_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_WRAPPERS = ("model", "state_dict", "model_state_dict")


def read_torch(path: str | Path) -> dict[str, np.ndarray]:
    """The state_dict of a torch file, by its own names; `{'model': ...}` and `{'state_dict': ...}` are opened.

    bfloat16 comes as float32, every other type as it is. No code in the file is ever run. Raises WeightsError: a
    truncated or foreign file, an object that is neither a tensor nor a plain container.
    """
    path = existing(path)
    try:
        with open(path, "rb") as file:
            zipped = zipfile.is_zipfile(file)
            file.seek(0)
            reader = _Zip(file) if zipped else _Legacy(file)
            return {name: tensor.read(reader.load, reader.byteorder) for name, tensor in _state(reader.content).items()}
    except WeightsError as error:
        raise WeightsError(f"{path}: {error}") from None
    except Exception as error:  # damaged bytes raise whatever they suggest
        raise WeightsError(f"{path} is damaged or not a torch file ({type(error).__name__}: {error})") from error


class _Zip:
    """torch.save since 1.6: a zip with data.pkl and one record a storage."""

    def __init__(self, file: IO[bytes]) -> None:
        self.size = os.fstat(file.fileno()).st_size
        self.archive = zipfile.ZipFile(file)
        names = self.archive.namelist()
        pickles = [name for name in names if name == "data.pkl" or name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise WeightsError("a zip file without the data.pkl of torch.save; give a state_dict or safetensors")
        self.root = pickles[0].removesuffix("data.pkl")
        if f"{self.root}constants.pkl" in names:
            raise WeightsError("a TorchScript program, not plain weights; save its state_dict() instead")
        order = self._read("byteorder") if f"{self.root}byteorder" in names else b"little"
        self.byteorder: Literal["<", ">"] = ">" if order.strip() == b"big" else "<"
        self.content = read_pickle(io.BytesIO(self._read("data.pkl")))

    def load(self, storage: Storage) -> bytes:
        return self._read(f"data/{storage.key}")

    def _read(self, name: str) -> bytes:
        info = self.archive.getinfo(self.root + name)
        if info.file_size > self.size:  # torch stores without compression: anything larger is a zip bomb
            raise ValueError(f"record {name} claims {info.file_size} bytes in a file of {self.size}")
        return self.archive.read(info)


class _Legacy:
    """torch.save before 1.6: five pickles, then the storages one after the other, each with its length."""

    byteorder: Literal["<", ">"] = "<"

    def __init__(self, file: IO[bytes]) -> None:
        if read_pickle(file) != _LEGACY_MAGIC:
            raise ValueError("no magic number of torch.save")
        read_pickle(file)  # protocol version
        read_pickle(file)  # sizes of C types on the machine that wrote it
        self.content = read_pickle(file)
        keys = read_pickle(file)
        widths = {s.key: s.dtype.itemsize for s in _storages(self.content)}
        self.data: dict[str, bytes] = {}
        for key in keys:
            (length,) = struct.unpack("<q", file.read(8))
            if length < 0 or key not in widths:
                raise ValueError(f"storage {key!r} is of unknown type or length")
            self.data[key] = file.read(length * widths[key])

    def load(self, storage: Storage) -> bytes:
        return self.data[storage.key]


def _storages(content: Any) -> list[Storage]:
    """Every storage that an unpickled object refers to."""
    found, todo, seen = [], [content], set()
    while todo:
        item = todo.pop()
        if id(item) in seen:  # a pickle may refer to itself
            continue
        seen.add(id(item))
        match item:
            case Tensor(storage=storage):
                found.append(storage)
            case dict():
                todo += item.values()
            case list() | tuple():
                todo += item
            case Record(fields=fields):
                todo += fields.values()
    return found


def _state(content: Any) -> dict[str, Tensor]:
    """The tensors by name, out of the usual wrappings of a state_dict."""
    for wrapper in _WRAPPERS:
        if isinstance(content, dict) and isinstance(content.get(wrapper), dict):
            content = content[wrapper]
            break
    if not isinstance(content, dict) or not content:
        raise WeightsError(f"it holds no state_dict, but {type(content).__name__}")
    foreign = [
        str(name) for name, value in content.items() if not (isinstance(name, str) and isinstance(value, Tensor))
    ]
    if foreign:
        raise WeightsError(
            f"it holds no state_dict: {', '.join(foreign[:5])} {'is' if len(foreign) == 1 else 'are'} no tensor"
        )
    if all(name.startswith("module.") for name in content):  # DistributedDataParallel
        content = {name.removeprefix("module."): value for name, value in content.items()}
    return content
