"""Files as torch.save writes them, made by hand: torch is not needed, and a wicked pickle is as
easy as a good one.
"""

import io
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

KINDS = {
    "f8": "Double",
    "f4": "Float",
    "f2": "Half",
    "i8": "Long",
    "i4": "Int",
    "u1": "Byte",
    "b1": "Bool",
}


@dataclass
class Global:
    """A class or function, by module and name."""

    module: str
    name: str


@dataclass
class Call:
    """A function called on arguments when the pickle is read (REDUCE), then given a state
    (BUILD).
    """

    function: Any
    args: tuple
    state: Any = None


@dataclass
class Tensor:
    """A view of a block of numbers (`data`, flat).

    Two tensors with the same `data` object share a storage.
    """

    data: np.ndarray
    shape: tuple
    stride: tuple
    offset: int = 0
    kind: str | None = None
    length: int | None = None


def tensor(array: np.ndarray) -> Tensor:
    """A contiguous tensor with these values."""
    array = np.asarray(array)
    stride = tuple(int(np.prod(array.shape[axis + 1 :])) for axis in range(array.ndim))
    return Tensor(np.ravel(array), array.shape, stride)


def pickled(value: Any, storages: list[np.ndarray], legacy: bool = False) -> bytes:
    """The protocol-2 pickle of `value`; numbers of tensors are collected in `storages`."""
    return b"\x80\x02" + _emit(value, storages, legacy) + b"."


def _emit(value: Any, storages: list[np.ndarray], legacy: bool) -> bytes:
    def emit(*values: Any) -> bytes:
        return b"".join(_emit(each, storages, legacy) for each in values)

    match value:
        case None:
            return b"N"
        case bool():
            if value:
                return b"\x88"
            return b"\x89"
        case int():
            raw = value.to_bytes(value.bit_length() // 8 + 1, "little", signed=True)
            return b"\x8a" + bytes([len(raw)]) + raw
        case float():
            return b"G" + struct.pack(">d", value)
        case str():
            return b"X" + struct.pack("<I", len(value.encode())) + value.encode()
        case tuple():
            return b"(" + emit(*value) + b"t"
        case list():
            return b"](" + emit(*value) + b"e"
        case dict():
            return b"}(" + b"".join(emit(*item) for item in value.items()) + b"u"
        case Global(module, name):
            return f"c{module}\n{name}\n".encode()
        case Call(function, args, state):
            return emit(function, args) + b"R" + (emit(state) + b"b" if state is not None else b"")
        case Tensor():
            known = [place for place, data in enumerate(storages) if data is value.data]
            if not known:
                storages.append(value.data)
            key = str(known[0] if known else len(storages) - 1)
            kind = value.kind or KINDS[value.data.dtype.str[1:]]
            length = len(value.data) if value.length is None else value.length
            pid = (
                "storage",
                Global("torch", f"{kind}Storage"),
                key,
                "cpu",
                length,
                *([None] if legacy else []),
            )
            ordered = Call(Global("collections", "OrderedDict"), ())
            rebuild = Global("torch._utils", "_rebuild_tensor_v2")
            rest = (value.offset, value.shape, value.stride)
            return emit(rebuild) + b"(" + emit(pid) + b"Q" + emit(*rest, False, ordered) + b"tR"
    raise TypeError(type(value))


def zip_bytes(content: Any, *, order: str = "little") -> bytes:
    """A file as torch.save has written it since 1.6."""
    storages: list[np.ndarray] = []
    body = pickled(content, storages)
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("archive/data.pkl", body)
        archive.writestr("archive/byteorder", order)
        for key, data in enumerate(storages):
            raw = data.astype(data.dtype.newbyteorder(">" if order == "big" else "<"))
            archive.writestr(f"archive/data/{key}", raw.tobytes())
        archive.writestr("archive/version", "3\n")
    return buffer.getvalue()


def legacy_bytes(content: Any) -> bytes:
    """A file as torch.save wrote it before 1.6."""
    storages: list[np.ndarray] = []
    head = [pickled(value, []) for value in (0x1950A86A20F9469CFC6C, 1001, {"little_endian": True})]
    body = pickled(content, storages, legacy=True)
    keys = pickled([str(key) for key in range(len(storages))], [])
    raw = [struct.pack("<q", len(data)) + data.tobytes() for data in storages]
    return b"".join([*head, body, keys, *raw])


@pytest.fixture
def write_torch(tmp_path: Path) -> Callable[..., Path]:
    """write_torch(content, name): write a file as torch.save does."""

    def write(
        content: Any, name: str = "weights.pth", *, legacy: bool = False, order: str = "little"
    ) -> Path:
        path = tmp_path / name
        path.write_bytes(legacy_bytes(content) if legacy else zip_bytes(content, order=order))
        return path

    return write
