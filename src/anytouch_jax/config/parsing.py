"""Strict reading of JSON and of dataclasses from it, with ranges and choices of their fields."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import types
import typing
from collections.abc import Iterator
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

from anytouch_jax.errors import ConfigError


class Range(NamedTuple):
    """Numbers from `low` to `high`, both included, and their description in messages."""

    low: float
    high: float
    words: str


T = TypeVar("T")
# Annotations of fields that `check` compares with their range, as in `steps: Count[int]`.
Count = Annotated[T, Range(1, math.inf, "1 or more")]
Finite = Annotated[T, Range(-math.inf, math.inf, "a number")]
Threads = Annotated[int, Range(1, 1024, "1 to 1024")]
NotNegative = Annotated[T, Range(0, math.inf, "0 or more")]
Above0 = Annotated[T, Range(math.ulp(0.0), math.inf, "above 0")]
Ratio = Annotated[float, Range(0, 1, "0 to 1")]
Seed = Annotated[int, Range(0, 2**32 - 1, "0 to 4294967295")]
Below1 = Annotated[float, Range(0, math.nextafter(1, 0), "0 or more and below 1")]
_FLOAT32 = 3.4e38  # larger numbers are infinite in float32
_LARGEST = 2**32  # of whole numbers: no setting needs more, and larger ones overflow somewhere
_JSON_BYTES = 1 << 26
_JSON_DEPTH = 64
_JSON_DIGITS = 40


def parse_json(text: str | bytes) -> Any:
    """Return the value of JSON of at most 64 MiB, 64 levels and 40 digits a number.

    Raises ConfigError with a clause such as "is not JSON" for other text, and for values that no
    file of ours has: NaN, infinite numbers, halves of a Unicode pair, and a name twice in one
    object. All readers of JSON use it.
    """
    if len(text) > _JSON_BYTES:
        raise ConfigError(f"has {len(text):,} bytes of JSON, more than {_JSON_BYTES:,}")

    try:
        if isinstance(text, bytes):
            text = text.decode("utf-8")
        value = json.loads(
            text,
            object_pairs_hook=_distinct,
            parse_int=functools.partial(_number, kind=int),
            parse_float=_number,
            # NaN and Infinity, which Python's JSON has and `_number` refuses
            parse_constant=_number,
        )
        # Python's own parser gives up at a depth that depends on the stack.
        if _depth(value) > _JSON_DEPTH:
            raise RecursionError
        # Half of a Unicode pair is a text for Python, and cannot be written to any file.
        json.dumps(value, ensure_ascii=False).encode()
    except RecursionError:
        raise ConfigError(f"has more than {_JSON_DEPTH} levels of JSON") from None
    except UnicodeEncodeError:
        raise ConfigError("has half of a Unicode pair in a text") from None
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"is not JSON ({str(error)[:200]})") from None
    return value


def _number(digits: str, kind: type[int] | type[float] = float) -> float:
    if len(digits) > _JSON_DIGITS:
        raise ConfigError(f"has a number of {len(digits)} digits")
    value = kind(digits)
    if not math.isfinite(value):
        raise ConfigError(f"has the number {digits}, which is out of range")
    return value


def _distinct(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    names = [name for name, _ in pairs]
    value = dict(pairs)
    if len(value) < len(pairs):
        raise ConfigError(f"has {max(names, key=names.count)!r} twice in one object")
    return value


def _depth(value: Any) -> int:
    """Return the levels of lists and objects in a JSON value."""
    if isinstance(value, dict):
        inner = list(value.values())
    elif isinstance(value, list):
        inner = value
    else:
        return 0
    return 1 + max(map(_depth, inner), default=0)


def check(settings: Any, prefix: str = "") -> None:
    """Raise ConfigError for a field of a dataclass outside its range or its choices (Literal).

    `prefix` is its section on the command line. None is always in a range. NaN and numbers that are
    infinite in float32 never are. Every entry of a tuple is checked.
    """
    kind: Any = type(settings)
    for name, (hint, has_choices, bounds) in _rules(kind).items():
        value = getattr(settings, name)
        where = name
        if prefix:
            where = f"{prefix}{name.replace('_', '-')}"
        if has_choices:
            read_value(hint, value, where)
        for low, high, words in bounds:
            for number in _numbers(value):
                if not (low <= number <= high and abs(number) < _FLOAT32):
                    raise ConfigError(f"{where} must be {words}, not {str(number)[:40]}")
                if isinstance(number, int) and number > _LARGEST:
                    raise ConfigError(f"{where} must be at most {_LARGEST}, not {str(number)[:40]}")


def _numbers(value: Any) -> Iterator[float]:
    """Yield the numbers in a value, which may be a tuple of numbers, texts and tuples of them."""
    if isinstance(value, tuple):
        for one in value:
            yield from _numbers(one)
    elif isinstance(value, int | float):
        yield value


@functools.cache
def _rules(kind: type) -> dict[str, tuple[Any, bool, list[Range]]]:
    """Return for each field of a dataclass its annotation, whether it has choices, its ranges."""

    def has_choices(hint: Any) -> bool:
        return typing.get_origin(hint) is Literal or any(map(has_choices, typing.get_args(hint)))

    annotated = typing.get_type_hints(kind, include_extras=True)
    rules = {}
    for name, hint in typing.get_type_hints(kind).items():
        marks = getattr(annotated[name], "__metadata__", ())
        ranges = [mark for mark in marks if isinstance(mark, Range)]
        rules[name] = (hint, has_choices(hint), ranges)
    return rules


def read_value(kind: Any, value: Any, where: str) -> Any:
    """Return `value` (from JSON) as an instance of the annotation `kind`.

    `where` is its name in errors. Raises ConfigError.
    """
    origin = typing.get_origin(kind)
    args = typing.get_args(kind)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return _read_record(kind, value, where)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in args:
            return None
        (inner,) = [arg for arg in args if arg is not type(None)]
        return read_value(inner, value, where)
    if origin is Literal:
        if value not in args:
            raise ConfigError(f"{where} must be one of {', '.join(map(str, args))}, not {value!r}")
        return value
    if origin is tuple:
        return _read_tuple(args, value, where)
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    # a bool is an int in Python
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ConfigError(f"{where} must be {kind.__name__}, not {value!r}")
    return value


def _read_record(kind: type, value: Any, where: str) -> Any:
    """Return an object of JSON as the dataclass `kind`, see `read_value`."""
    if not isinstance(value, dict):
        raise ConfigError(f"{where} must be an object, not {value!r}")
    hints = typing.get_type_hints(kind)
    if unknown := sorted(set(value) - set(hints)):
        raise ConfigError(
            f"{where} has no setting called {', '.join(unknown)}. Choose from {', '.join(hints)}."
        )
    needed = [
        field.name
        for field in dataclasses.fields(kind)
        if field.default is field.default_factory is dataclasses.MISSING
    ]
    if missing := [name for name in needed if name not in value]:
        raise ConfigError(f"{where} has no {', '.join(missing)}")
    settings = {
        name: read_value(hints[name], item, f"{where}.{name}") for name, item in value.items()
    }
    return kind(**settings)


def _read_tuple(args: tuple[Any, ...], value: Any, where: str) -> tuple[Any, ...]:
    """Return a list of JSON as a tuple of the types `args`, see `read_value`."""
    if not isinstance(value, list | tuple):
        raise ConfigError(f"{where} must be a list, not {value!r}")
    kinds = [args[0]] * len(value) if args[-1] is Ellipsis else list(args)
    if len(kinds) != len(value):
        raise ConfigError(f"{where} must have {len(kinds)} entries, not {len(value)}")
    pairs = zip(kinds, value, strict=True)
    return tuple(read_value(k, v, f"{where}[{i}]") for i, (k, v) in enumerate(pairs))
