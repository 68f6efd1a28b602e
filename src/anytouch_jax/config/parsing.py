"""Strict reading of JSON and of dataclasses from it, with ranges and choices of their fields."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import re
import types
import typing
from typing import Any, Literal, NamedTuple

from anytouch_jax.errors import ConfigError


class Range(NamedTuple):
    """Numbers from `low` to `high`, both included, and their description in messages."""

    low: float
    high: float
    words: str


COUNT = Range(1, math.inf, "1 or more")
NOT_NEGATIVE = Range(0, math.inf, "0 or more")
ABOVE_0 = Range(math.ulp(0.0), math.inf, "above 0")
FLOAT32 = 3.4e38  # larger numbers are infinite in float32
NORMAL = Range(1.2e-38, math.inf, "1.2e-38 or more (float32)")
SHARE = Range(0, 1, "0 to 1")
SEED = Range(0, 2**32 - 1, "0 to 4294967295")
BELOW_1 = Range(0, math.nextafter(1, 0), "0 or more and below 1")
_HALF_PAIR = re.compile("[\ud800-\udfff]")


_JSON_BYTES, _JSON_DEPTH, _JSON_DIGITS = 1 << 26, 64, 40


def parse_json(text: str | bytes) -> Any:
    """Return the value of JSON of at most 64 MiB, 64 levels and 40 digits a number.

    Raises ConfigError with a clause such as "is not JSON" for other text, and for values that no file of ours has: NaN,
    infinite numbers, and halves of a Unicode pair. All readers of JSON use it.
    """
    if len(text) > _JSON_BYTES:
        raise ConfigError(f"has {len(text):,} bytes of JSON, more than {_JSON_BYTES:,}")

    def number(digits: str, kind: type[int] | type[float] = int) -> float:
        if len(digits) > _JSON_DIGITS:
            raise ConfigError(f"has a number of {len(digits)} digits")
        if not math.isfinite(value := kind(digits)):
            raise ConfigError(f"has the number {digits}, which is out of range")
        return value

    try:
        text = text.decode("utf-8") if isinstance(text, bytes) else text
        numbers: Any = {"parse_int": number, "parse_float": functools.partial(number, kind=float)}
        value = json.loads(text, parse_constant=functools.partial(number, kind=float), **numbers)
    except RecursionError:
        raise ConfigError(f"has more than {_JSON_DEPTH} levels of JSON") from None
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"is not JSON ({str(error)[:200]})") from None
    level = [value]
    for _ in range(_JSON_DEPTH):
        inner: list[Any] = []
        for item in level:
            if isinstance(item, str):
                if not item.isascii() and _HALF_PAIR.search(item):
                    raise ConfigError("has half of a Unicode pair in a text")
            elif isinstance(item, dict):
                inner += [*item, *item.values()]
            elif isinstance(item, list):
                inner += item
        if not inner:
            return value
        level = inner
    raise ConfigError(f"has more than {_JSON_DEPTH} levels of JSON")


def in_range(prefix: str, settings: Any, **ranges: Range) -> None:
    """Raise ConfigError for a field of `settings` outside its range. `prefix` is its section on the command line.

    None is always valid. NaN and numbers that are infinite in float32 never are. Every entry of a tuple is checked.
    """
    for name, (low, high, words) in ranges.items():
        value = getattr(settings, name)
        for number in value if isinstance(value, tuple) else (value,):
            if number is not None and not (low <= number <= high and number < FLOAT32):
                raise ConfigError(f"{_spelled(prefix, name)} must be {words}, not {number}")


def chosen(prefix: str, settings: Any) -> None:
    """Raise ConfigError for a field of `settings` that is not a choice (Literal) of its annotation.

    `prefix` is its section on the command line. Every entry of a tuple is checked.
    """
    kind: Any = type(settings)
    for name, hint in _choices(kind).items():
        read_value(hint, getattr(settings, name), _spelled(prefix, name))


@functools.cache
def _choices(kind: type) -> dict[str, Any]:
    """Return the annotations of those fields of a dataclass that have choices, by name."""

    def has_some(hint: Any) -> bool:
        return typing.get_origin(hint) is Literal or any(map(has_some, typing.get_args(hint)))

    return {name: hint for name, hint in typing.get_type_hints(kind).items() if has_some(hint)}


def _spelled(prefix: str, name: str) -> str:
    return f"{prefix}{name.replace('_', '-')}" if prefix else name


def read_value(kind: Any, value: Any, where: str) -> Any:
    """Return `value` (from JSON) as an instance of the annotation `kind`. `where` is its name in errors."""
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        if not isinstance(value, dict):
            raise ConfigError(f"{where} must be an object, not {value!r}")
        hints = typing.get_type_hints(kind)
        unknown = sorted(set(value) - set(hints))
        if unknown:
            raise ConfigError(f"{where} has no setting called {', '.join(unknown)}. Choose from {', '.join(hints)}.")
        required = [f.name for f in dataclasses.fields(kind) if _required(f)]
        missing = [name for name in required if name not in value]
        if missing:
            raise ConfigError(f"{where} has no {', '.join(missing)}")
        return kind(**{name: read_value(hints[name], item, f"{where}.{name}") for name, item in value.items()})
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
        if not isinstance(value, list | tuple):
            raise ConfigError(f"{where} must be a list, not {value!r}")
        kinds = [args[0]] * len(value) if args[-1] is Ellipsis else list(args)
        if len(kinds) != len(value):
            raise ConfigError(f"{where} must have {len(kinds)} entries, not {len(value)}")
        return tuple(read_value(k, v, f"{where}[{i}]") for i, (k, v) in enumerate(zip(kinds, value, strict=True)))
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if not isinstance(value, kind) or (kind is int and isinstance(value, bool)):
        raise ConfigError(f"{where} must be {kind.__name__}, not {value!r}")
    return value


def _required(entry: dataclasses.Field[Any]) -> bool:
    return entry.default is dataclasses.MISSING and entry.default_factory is dataclasses.MISSING
