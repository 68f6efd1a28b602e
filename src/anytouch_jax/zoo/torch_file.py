"""PyTorch files (.pth, .pt, .ckpt, .bin) read without torch, in the zip form and in the form before
torch 1.6.

A pickle is a program for a stack machine. It is run by the standard library's `pickle._Unpickler`,
cut down to data: a class or function in it is only a name, looked up in `_BUILDERS` and never
imported. Anything else is an error.
"""

from __future__ import annotations

import io
import math
import os
import pickle
import pickletools
import reprlib
import struct
import warnings
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import ml_dtypes
import numpy as np

from anytouch_jax.weights.safetensors import WeightsError, existing_file

_STORAGES = {
    "DoubleStorage": "f8",
    "FloatStorage": "f4",
    "HalfStorage": "f2",
    "BFloat16Storage": "bfloat16",
    "BoolStorage": "?",
    "LongStorage": "i8",
    "IntStorage": "i4",
    "ShortStorage": "i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
}
_REPEATS = 1 << 20  # a tensor larger than its storage (stride 0) may have this many elements
# the tensors of a file may take 3 times its bytes, and 64 MiB more
_GROWTH = 3
_SPARE = 1 << 26
_LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
_WRAPPERS = ("model", "state_dict", "model_state_dict", "module", "student")
# read only where no plain weights are
_AVERAGES = ("state_dict_ema", "model_ema", "ema", "teacher")
_DEPTH = 4  # of wrappings in each other


def read_torch(path: str | Path) -> dict[str, np.ndarray]:
    """Return the state_dict of a torch file, out of its wrappings.

    bfloat16 becomes float32, other types are unchanged. No code in the file is run. Raises
    WeightsError for a truncated or foreign file, and for an object that is neither a tensor nor a
    plain container.
    """
    path = existing_file(path)
    try:
        with open(path, "rb") as file:
            zipped = zipfile.is_zipfile(file)
            size = os.fstat(file.fileno()).st_size
            file.seek(0)
            if not zipped and file.read(2) == b"PK":
                raise WeightsError(
                    "it is cut short (its zip directory is missing); download it again"
                )
            file.seek(0)
            reader = _Zip(file, size) if zipped else _Legacy(file)
            tensors = _state(_unwrap(reader.content, path))
            if (
                sum(math.prod(t.shape) * t.storage.dtype.itemsize for t in tensors.values())
                > _GROWTH * size + _SPARE
            ):
                raise ValueError("its tensors are many times larger than the file")
            return {
                name: tensor.read(reader.load(tensor.storage), big=reader.big)
                for name, tensor in tensors.items()
            }
    except WeightsError as error:
        raise WeightsError(f"{path}: {error}") from None
    except Exception as error:  # damaged bytes raise any type of error
        raise WeightsError(
            f"{path} is damaged or not a torch file ({type(error).__name__}: {error})"
        ) from error


class _Name(str):
    """A class or function that a pickle mentions."""


class _Other:
    """An object that is not rebuilt (argparse.Namespace, torch.device)."""


@dataclass(frozen=True)
class _Storage:
    """A block of numbers elsewhere in the file: its key there, the type of one number, its
    length.
    """

    key: str
    dtype: np.dtype
    length: int


@dataclass(frozen=True)
class _Tensor:
    """A view of a storage: `offset` and `stride` in elements. Nothing is read until `read`."""

    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    stride: tuple[int, ...]

    def read(self, data: bytes, *, big: bool) -> np.ndarray:
        """Return the values, given the bytes of the storage.

        Raises ValueError if the view leaves its storage.
        """
        flat = np.frombuffer(data, self.storage.dtype)
        if len(flat) != self.storage.length:
            raise ValueError(
                f"storage {self.storage.key} has {len(data)} bytes, not those it announces"
            )
        if 0 in self.shape:
            return np.empty(self.shape, flat.dtype)
        last = self.offset + sum(
            (size - 1) * step for size, step in zip(self.shape, self.stride, strict=True)
        )
        if last >= len(flat):
            raise ValueError(
                f"a tensor of shape {self.shape} reaches beyond its storage of {len(flat)} elements"
            )
        steps = tuple(step * flat.itemsize for step in self.stride)
        values = np.lib.stride_tricks.as_strided(
            flat[self.offset :], self.shape, steps, writeable=False
        )
        values = values.byteswap() if big else np.array(values, order="C")
        if values.dtype == ml_dtypes.bfloat16:
            return values.astype(np.float32)
        return values


class _Zip:
    """torch.save since 1.6: a zip with data.pkl and one record a storage."""

    def __init__(self, file: IO[bytes], size: int) -> None:
        self.size = size
        self.archive = zipfile.ZipFile(file)
        names = self.archive.namelist()
        pickles = [name for name in names if name == "data.pkl" or name.endswith("/data.pkl")]
        if len(pickles) != 1:
            raise WeightsError(
                "a zip file without the data.pkl of torch.save; give a state_dict or safetensors"
            )
        self.root = pickles[0].removesuffix("data.pkl")
        if f"{self.root}constants.pkl" in names:
            raise WeightsError(
                "a TorchScript program, not plain weights; save its state_dict() instead"
            )
        self.big = f"{self.root}byteorder" in names and self._read("byteorder").strip() == b"big"
        self.content = _Unpickler(io.BytesIO(self._read("data.pkl"))).load()

    def load(self, storage: _Storage) -> bytes:
        return self._read(f"data/{storage.key}")

    def _read(self, name: str) -> bytes:
        info = self.archive.getinfo(self.root + name)
        if (
            info.file_size > self.size
        ):  # torch stores without compression: anything larger is a zip bomb
            raise ValueError(
                f"record {name} claims {info.file_size} bytes in a file of {self.size}"
            )
        return self.archive.read(info)


class _Legacy:
    """torch.save before 1.6: five pickles, then the storages one after the other, each with its
    length.
    """

    big = False

    def __init__(self, file: IO[bytes]) -> None:
        if _Unpickler(file).load() != _LEGACY_MAGIC:
            raise ValueError("no magic number of torch.save")
        for _ in ("protocol version", "sizes of C types on the machine that wrote it"):
            _Unpickler(file).load()
        reader = _Unpickler(file)
        self.content = reader.load()
        keys = _Unpickler(file).load()
        self.data: dict[str, bytes] = {}
        for key in keys:
            (length,) = struct.unpack("<q", file.read(8))
            if length < 0 or key not in reader.storages:
                raise ValueError(f"storage {key!r} is of unknown type or length")
            self.data[key] = file.read(length * reader.storages[key].dtype.itemsize)

    def load(self, storage: _Storage) -> bytes:
        return self.data[storage.key]


def _unwrap(content: Any, path: Path) -> Any:
    """Return the state dict inside the usual wrappings, plain weights before averaged ones, which
    give a warning.
    """
    for _ in range(_DEPTH):
        inner = content if isinstance(content, dict) else {}
        name = next(
            (name for name in _WRAPPERS + _AVERAGES if isinstance(inner.get(name), dict)), None
        )
        if name is None:
            break
        if name in _AVERAGES:
            warnings.warn(
                f"{path} has no plain weights; the averaged ones in {name!r} are read", stacklevel=4
            )
        content = inner[name]
    return content


def _state(content: Any) -> dict[str, _Tensor]:
    """Return the tensors by name. Raises WeightsError for an object that is no state_dict."""
    if not isinstance(content, dict) or not content:
        raise WeightsError(f"it has no state_dict, but {type(content).__name__}")
    others = [
        str(name)
        for name, value in content.items()
        if not (type(name) is str and isinstance(value, _Tensor))
    ]
    if others:
        raise WeightsError(
            f"it has no state_dict: {', '.join(others[:5])} {'are' if others[1:] else 'is'} no "
            "tensor"
        )
    return content


def _size(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ValueError(f"{type(value).__name__} where a size was expected")
    return value


def _tensor(storage: Any, offset: Any, shape: Any, stride: Any, *_: Any) -> _Tensor:
    if (
        not isinstance(storage, _Storage)
        or not isinstance(shape, tuple)
        or not isinstance(stride, tuple)
    ):
        raise ValueError("a tensor without storage, shape or stride")
    shape = tuple(map(_size, shape))
    stride = tuple(map(_size, stride))
    if len(shape) != len(stride) or len(shape) > 32:
        raise ValueError(f"a tensor with shape {shape} and stride {stride}")
    if math.prod(shape) > max(storage.length, _REPEATS):
        raise ValueError(f"a tensor of shape {shape} over a storage of {storage.length} elements")
    return _Tensor(storage, _size(offset), shape, stride)


def _key(key: Any) -> Any:
    if isinstance(key, _Name) or not isinstance(key, str | bytes | int | float | None):
        raise ValueError(f"{type(key).__name__} as the key of a dictionary or set")
    return key


_BUILDERS: dict[str, Callable[..., Any]] = {
    "torch._utils._rebuild_tensor": _tensor,
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch._utils._rebuild_parameter": lambda data, *_: data,
    "torch.Size": lambda values=(): tuple(values),
    "torch.device": lambda *_: _Other(),
    "collections.OrderedDict": lambda pairs=(): {_key(key): value for key, value in pairs},
    "collections.defaultdict": lambda *_: {},
    "argparse.Namespace": _Other,
}
# classes of a training state, which is not read
_STATES = ("torch.optim.", "tactile_ssl.model.custom_scheduler.")
_INERT = {f"torch.{kind}" for kind in _STORAGES}
_INERT |= {
    f"torch.{n}"
    for n in ("float16", "float32", "float64", "bfloat16", "int32", "int64", "uint8", "bool")
}
_INERT |= {"builtins.dict", "__builtin__.dict"}
# Operations that only make data. BYTEARRAY8 is left out: it allocates whatever size it is given.
_DATA = """
    PROTO FRAME STOP MARK POP POP_MARK DUP
    NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG LONG1 LONG4 FLOAT BINFLOAT
    UNICODE BINUNICODE SHORT_BINUNICODE BINUNICODE8 STRING BINSTRING SHORT_BINSTRING
    BINBYTES SHORT_BINBYTES BINBYTES8
    EMPTY_DICT EMPTY_LIST EMPTY_TUPLE EMPTY_SET TUPLE TUPLE1 TUPLE2 TUPLE3 LIST APPEND APPENDS
    PUT BINPUT LONG_BINPUT MEMOIZE GET BINGET LONG_BINGET GLOBAL STACK_GLOBAL BINPERSID
"""
# Operations replaced in `_Unpickler`. Hashing a tuple that is nested 150,000 times would end the
# process.
_GUARDED = "DICT SETITEM SETITEMS ADDITEMS REDUCE NEWOBJ BUILD INST"


class _Dispatch(dict[int, Any]):
    def __missing__(self, code: int) -> Any:
        # absent from typeshed
        known = vars(pickletools)["code2op"].get(chr(code))
        raise _refused(known.name if known else f"operation {code}")


def _code(name: str) -> int:
    return int(getattr(pickle, name)[0])


def _refused(name: str) -> WeightsError:
    return WeightsError(
        f"the pickle wants {name!r}, which is neither a tensor nor a plain container; it was "
        "refused and nothing was run: save the weights as a plain state_dict or as safetensors"
    )


class _Unpickler(pickle._Unpickler):
    """The library's reader in Python, without imports or calls.

    That in C ends the process at a deep tuple as a key.
    """

    stack: list[Any]
    readline: Callable[[], bytes]
    pop_mark: Callable[[], list[Any]]

    def __init__(self, file: IO[bytes]) -> None:
        super().__init__(file, encoding="latin1")
        self.storages: dict[str, _Storage] = {}

    def load(self) -> Any:
        """Return the object pickled at the position of the file: plain containers, numbers, text
        and `_Tensor`.
        """
        try:
            return super().load()
        except IndexError:
            raise ValueError("the pickle uses a value that is not there") from None
        except pickle.UnpicklingError as error:
            raise (error.__context__ or error) from None

    def find_class(self, module: str, name: str) -> Any:
        full = f"{module}.{name}"
        if full not in _BUILDERS and full not in _INERT and not full.startswith(_STATES):
            raise _refused(full)
        return _Name(full)

    def persistent_load(self, pid: Any) -> _Storage:
        match pid:
            case ("storage", _Name() as name, str(key), str(), int(length), *rest) if rest in (
                [],
                [None],
            ):
                kind = _STORAGES.get(name.removeprefix("torch."))
                if kind is None:
                    raise ValueError(f"a storage of kind {name}")
                return self.storages.setdefault(key, _Storage(key, np.dtype(kind), _size(length)))
        raise ValueError(f"the pickle refers to {reprlib.repr(pid)}")

    def load_inst(self) -> None:
        raise _refused(" ".join(self.readline()[:-1].decode() for _ in range(2)))

    def load_reduce(self) -> None:
        args = self.stack.pop()
        function = self.stack.pop()
        is_state = isinstance(function, _Name) and function.startswith(_STATES)
        if (
            not isinstance(function, _Name)
            or not (is_state or function in _BUILDERS)
            or not isinstance(args, tuple)
        ):
            raise ValueError(f"the pickle calls {reprlib.repr(function)}")
        self.stack.append(_Other() if is_state else _BUILDERS[function](*args))

    load_newobj = load_reduce

    def load_build(self) -> None:
        # the attributes of a Namespace, or of an OrderedDict (_metadata)
        self.stack.pop()
        if not isinstance(self.stack[-1], _Other | dict):
            raise ValueError(f"the pickle sets the state of {type(self.stack[-1]).__name__}")

    def _fill(self, items: list[Any]) -> None:
        """Set items of the dictionary on top of the stack."""
        if not isinstance(self.stack[-1], dict) or len(items) % 2:
            raise ValueError("the pickle sets items of something that is no dictionary")
        self.stack[-1].update(zip(map(_key, items[::2]), items[1::2], strict=True))

    def load_dict(self) -> None:
        items = self.pop_mark()
        self.stack.append({})
        self._fill(items)

    def load_setitem(self) -> None:
        value = self.stack.pop()
        key = self.stack.pop()
        self._fill([key, value])

    def load_setitems(self) -> None:
        self._fill(self.pop_mark())

    def load_additems(self) -> None:
        items = self.pop_mark()
        if not isinstance(self.stack[-1], set):
            raise ValueError("the pickle adds to something that is no set")
        self.stack[-1].update(map(_key, items))

    dispatch = _Dispatch(
        (_code(name), pickle._Unpickler.dispatch[_code(name)]) for name in _DATA.split()
    )


for _operation in _GUARDED.split():
    _Unpickler.dispatch[_code(_operation)] = getattr(_Unpickler, f"load_{_operation.lower()}")
