"""A pickle reader that cannot run code: it rebuilds tensors, plain containers and inert records, nothing else.

A pickle is a program for a stack machine. This module runs that program itself: a class or function named in it is
only ever a name, looked up in the table `_BUILDERS` below, never imported, and anything outside the table is an error.
"""

from __future__ import annotations

import pickletools
import reprlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import IO, Any, Literal

import numpy as np

from anytouch_jax.weights.tensors import WeightsError

# What torch calls a storage, as the numpy type of its bytes; bfloat16 is widened by `Tensor.read`.
STORAGES = {
    "DoubleStorage": "f8",
    "FloatStorage": "f4",
    "HalfStorage": "f2",
    "BFloat16Storage": "u2",
    "LongStorage": "i8",
    "IntStorage": "i4",
    "ShortStorage": "i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
    "BoolStorage": "?",
}
_REPEATS = 1 << 20  # an expanded tensor (stride 0) may grow to this many elements, no further


@dataclass(frozen=True)
class Name:
    """A class or function that a pickle mentions."""

    name: str


@dataclass
class Record:
    """An object whose class is not rebuilt (argparse.Namespace, torch.device): its name and its fields."""

    name: str
    fields: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Storage:
    """A block of numbers kept elsewhere in the file: its key there, its kind in `STORAGES`, its length."""

    key: str
    kind: str
    length: int

    @property
    def dtype(self) -> np.dtype:
        """Type of one element in the file."""
        return np.dtype(STORAGES[self.kind])


@dataclass(frozen=True)
class Tensor:
    """A view of a storage: `offset` and `stride` in elements. Nothing is read until `read`."""

    storage: Storage
    offset: int
    shape: tuple[int, ...]
    stride: tuple[int, ...]

    def read(self, load: Callable[[Storage], bytes], byteorder: Literal["<", ">"] = "<") -> np.ndarray:
        """The values, given the bytes of the storage. Raises ValueError when the view leaves its storage."""
        data = load(self.storage)
        if len(data) != self.storage.length * self.storage.dtype.itemsize:
            raise ValueError(f"storage {self.storage.key} has {len(data)} bytes, not those it announces")
        flat = np.frombuffer(data, self.storage.dtype.newbyteorder(byteorder))
        if 0 in self.shape:
            values = np.empty(self.shape, flat.dtype)
        else:
            last = self.offset + sum((size - 1) * step for size, step in zip(self.shape, self.stride, strict=True))
            if last >= len(flat):
                raise ValueError(f"a tensor of shape {self.shape} reaches beyond its storage of {len(flat)} elements")
            steps = tuple(step * flat.itemsize for step in self.stride)
            values = np.lib.stride_tricks.as_strided(flat[self.offset :], self.shape, steps, writeable=False)
        values = values.astype(flat.dtype.newbyteorder("="), order="C")
        if self.storage.kind == "BFloat16Storage":  # the upper half of a float32
            return (values.astype(np.uint32) << 16).view(np.float32)
        return values


def read_pickle(file: IO[bytes]) -> Any:
    """The object pickled at the position of `file`, made of plain containers, numbers, text, Tensor, Record and Name.

    Raises WeightsError that names the class or function when the pickle wants any other, ValueError for a damaged one.
    """
    machine = _Machine()
    for opcode, arg, _ in pickletools.genops(file):
        machine.run(opcode.name, arg)
    if len(machine.stack) != 1:
        raise ValueError("the pickle leaves its stack in disorder")
    return machine.stack[0]


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ValueError(f"{type(value).__name__} where a size was expected")
    return value


def _plain(key: Any) -> Any:
    """A key that may be hashed; hashing a tuple nested a million times would end the process."""
    if not isinstance(key, str | bytes | int | float | None):
        raise ValueError(f"{type(key).__name__} as the key of a dictionary or set")
    return key


def _tensor(storage: Any, offset: Any, shape: Any, stride: Any, *_: Any) -> Tensor:
    if not isinstance(storage, Storage) or not isinstance(shape, tuple) or not isinstance(stride, tuple):
        raise ValueError("a tensor without storage, shape or stride")
    shape, stride = tuple(map(_whole, shape)), tuple(map(_whole, stride))
    if len(shape) != len(stride) or len(shape) > 32:
        raise ValueError(f"a tensor with shape {shape} and stride {stride}")
    elements = 1
    for size in shape:
        elements *= size
    if elements > max(storage.length, _REPEATS):
        raise ValueError(f"a tensor of shape {shape} over a storage of {storage.length} elements")
    return Tensor(storage, _whole(offset), shape, stride)


def _parameter(data: Any, *_: Any) -> Any:
    return data


def _ordered(pairs: Any = ()) -> dict[Any, Any]:
    return {_plain(key): value for key, value in pairs}


def _size(values: Any = ()) -> tuple[Any, ...]:
    return tuple(values)


_BUILDERS: dict[str, Callable[..., Any]] = {
    "torch._utils._rebuild_tensor": _tensor,
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch._utils._rebuild_parameter": _parameter,
    "torch.Size": _size,
    "torch.device": lambda *args: Record("torch.device", {"args": args}),
    "collections.OrderedDict": _ordered,
    "argparse.Namespace": lambda: Record("argparse.Namespace"),
}
_INERT = {f"torch.{kind}" for kind in STORAGES} | {
    f"torch.{name}" for name in ("float16", "float32", "float64", "bfloat16", "int32", "int64", "uint8", "bool")
}
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_EMPTY: dict[str, Callable[[], Any]] = {"EMPTY_DICT": dict, "EMPTY_LIST": list, "EMPTY_TUPLE": tuple, "EMPTY_SET": set}
_LITERALS = frozenset(
    {
        "INT",
        "BININT",
        "BININT1",
        "BININT2",
        "LONG",
        "LONG1",
        "LONG4",
        "FLOAT",
        "BINFLOAT",
        "UNICODE",
        "BINUNICODE",
        "SHORT_BINUNICODE",
        "BINUNICODE8",
        "STRING",
        "BINSTRING",
        "SHORT_BINSTRING",
        "BINBYTES",
        "SHORT_BINBYTES",
        "BINBYTES8",
    }
)
_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_MARK = object()


def _named(name: str) -> Name:
    if name not in _BUILDERS and name not in _INERT:
        raise WeightsError(
            f"the pickle wants {name!r}, which is neither a tensor nor a plain container; it was refused and nothing "
            f"was run: save the weights as a plain state_dict or as safetensors"
        )
    return Name(name)


class _Machine:
    """The pickle stack machine, without any operation that would import or call."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def run(self, opcode: str, arg: Any) -> None:
        """Do one operation of the pickle."""
        if opcode in _LITERALS:
            self.stack.append(arg)
        elif opcode in _CONSTANTS:
            self.stack.append(_CONSTANTS[opcode])
        elif opcode in _EMPTY:
            self.stack.append(_EMPTY[opcode]())
        elif opcode in _TUPLES:
            self.stack.append(tuple(self._take(_TUPLES[opcode])))
        elif opcode in ("PUT", "BINPUT", "LONG_BINPUT", "MEMOIZE"):
            self.memo[len(self.memo) if opcode == "MEMOIZE" else arg] = self._top()
        elif opcode in ("GET", "BINGET", "LONG_BINGET"):
            self.stack.append(self.memo[arg])
        elif opcode not in ("PROTO", "FRAME", "STOP"):
            operation = getattr(self, f"_{opcode.lower()}", None)
            if operation is None:
                wanted = opcode if arg is None else f"{opcode} {str(arg)[:80]!r}"
                raise WeightsError(f"the pickle wants {wanted}, which tensors and plain containers do not need")
            operation(arg)

    def _top(self) -> Any:
        if not self.stack or self.stack[-1] is _MARK:
            raise ValueError("the pickle uses a value that is not there")
        return self.stack[-1]

    def _take(self, count: int) -> list[Any]:
        taken = self.stack[len(self.stack) - count :] if len(self.stack) >= count else [_MARK]
        if any(value is _MARK for value in taken):
            raise ValueError("the pickle uses a value that is not there")
        del self.stack[len(self.stack) - count :]
        return taken

    def _since_mark(self) -> list[Any]:
        taken: list[Any] = []
        while self.stack:
            value = self.stack.pop()
            if value is _MARK:
                return taken[::-1]
            taken.append(value)
        raise ValueError("the pickle lacks a mark")

    def _mark(self, _: Any) -> None:
        self.stack.append(_MARK)

    def _pop(self, _: Any) -> None:
        if not self.stack:
            raise ValueError("the pickle uses a value that is not there")
        self.stack.pop()

    def _pop_mark(self, _: Any) -> None:
        self._since_mark()

    def _dup(self, _: Any) -> None:
        self.stack.append(self._top())

    def _tuple(self, _: Any) -> None:
        self.stack.append(tuple(self._since_mark()))

    def _list(self, _: Any) -> None:
        self.stack.append(self._since_mark())

    def _dict(self, _: Any) -> None:
        items = self._since_mark()
        self.stack.append({})
        self._set(items)

    def _append(self, _: Any) -> None:
        self._extend(self._take(1))

    def _appends(self, _: Any) -> None:
        self._extend(self._since_mark())

    def _extend(self, values: list[Any]) -> None:
        target = self._top()
        if not isinstance(target, list):
            raise ValueError("the pickle appends to something that is no list")
        target.extend(values)

    def _additems(self, _: Any) -> None:
        values = self._since_mark()
        target = self._top()
        if not isinstance(target, set):
            raise ValueError("the pickle adds to something that is no set")
        target.update(map(_plain, values))

    def _frozenset(self, _: Any) -> None:
        self.stack.append(frozenset(map(_plain, self._since_mark())))

    def _setitem(self, _: Any) -> None:
        self._set(self._take(2))

    def _setitems(self, _: Any) -> None:
        self._set(self._since_mark())

    def _set(self, items: list[Any]) -> None:
        target = self._top()
        if not isinstance(target, dict) or len(items) % 2:
            raise ValueError("the pickle sets items of something that is no dictionary")
        target.update(zip(map(_plain, items[::2]), items[1::2], strict=True))

    def _global(self, arg: str) -> None:
        self.stack.append(_named(arg.replace(" ", ".")))

    def _stack_global(self, _: Any) -> None:
        module, name = self._take(2)
        self.stack.append(_named(f"{module}.{name}"))

    def _reduce(self, _: Any) -> None:
        function, args = self._take(2)
        if not isinstance(function, Name) or function.name not in _BUILDERS or not isinstance(args, tuple):
            raise ValueError(f"the pickle calls {reprlib.repr(function)}")
        self.stack.append(_BUILDERS[function.name](*args))

    _newobj = _reduce

    def _build(self, _: Any) -> None:
        state = self._take(1)[0]
        target = self._top()
        if isinstance(target, Record) and isinstance(state, dict):
            target.fields.update(state)
        elif not isinstance(target, dict):  # an OrderedDict with attributes (_metadata): the items are all that counts
            raise ValueError(f"the pickle sets the state of {type(target).__name__}")

    def _binpersid(self, _: Any) -> None:
        match self._take(1)[0]:
            case ("storage", Name(name), str(key), str(), int(length), *rest) if rest in ([], [None]):
                kind = name.removeprefix("torch.")
                if kind not in STORAGES:
                    raise ValueError(f"a storage of kind {name}")
                self.stack.append(Storage(key, kind, _whole(length)))
            case other:
                raise ValueError(f"the pickle refers to {reprlib.repr(other)}")
