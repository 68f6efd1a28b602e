"""Short `repr` of records and objects: arrays by their type and shape, trees of arrays by their
size.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

T = TypeVar("T")
# of a value
_LETTERS = 80
_ITEMS = 12


def shown_short(kind: type[T]) -> type[T]:
    """Give a dataclass or a NamedTuple a short `repr`: Name(field=value, ...), without fields at
    their default.
    """
    kind.__repr__ = _repr  # type: ignore[method-assign]
    return kind


def described(title: str, **lines: str) -> str:
    """Return a title, and below it an indented line for each of the others that is not empty."""
    width = max(map(len, lines))
    return "\n".join(
        [_cut(title), *(f"  {name:{width}}  {text}" for name, text in lines.items() if text)]
    )


def count_of(number: int) -> str:
    """Return a number of parameters: 2.7 M."""
    if number >= 1e5:
        return f"{number / 1e6:.1f} M"
    return f"{number:,}"


def leaves(tree: Any) -> Iterator[Any]:
    """Yield the arrays of nested mappings and tuples."""
    if isinstance(tree, Mapping | tuple | list):
        for one in tree.values() if isinstance(tree, Mapping) else tree:
            yield from leaves(one)
    elif hasattr(tree, "shape"):
        yield tree


def _repr(record: Any) -> str:
    defaults = getattr(record, "_field_defaults", {})
    names = getattr(record, "_fields", ())
    if dataclasses.is_dataclass(record):
        shown = [field for field in dataclasses.fields(record) if field.repr]
        made = ((field.default_factory, field) for field in shown)
        defaults = {
            one.name: one.default if make is dataclasses.MISSING else make() for make, one in made
        }
        names = tuple(defaults)
    values = ((name, getattr(record, name)) for name in names)
    fields = (
        f"{name}={_short(value)}"
        for name, value in values
        if not _is(value, defaults.get(name, ...))
    )
    return f"{type(record).__name__}({', '.join(fields)})"


def _is(value: Any, default: Any) -> bool:
    return value is default or (
        type(value) is type(default) and not hasattr(value, "shape") and bool(value == default)
    )


def _short(value: Any) -> str:
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{value.dtype}[{', '.join(map(str, value.shape))}]"
    if getattr(type(value), "__repr__", None) is _repr:
        return repr(value)
    arrays = list(leaves(value))
    if len(arrays) > 1 or (isinstance(value, Mapping) and arrays):
        return (
            f"<{len(arrays)} arrays, {count_of(sum(math.prod(one.shape) for one in arrays))} "
            "numbers>"
        )
    if isinstance(value, tuple | list | Mapping) and len(value) > _ITEMS:
        return f"<{len(value)} entries>"
    if type(value) in (tuple, list):
        inner = ", ".join(map(_short, value)) + "," * (type(value) is tuple and len(value) == 1)
        if isinstance(value, tuple):
            return f"({inner})"
        return f"[{inner}]"
    return _cut(repr(value))


def _cut(text: str) -> str:
    if len(text) <= _LETTERS:
        return text
    return f"{text[:50]} ... {text[-25:]}"
