"""Short `repr` of records: arrays by their type and shape, trees of arrays by their size."""

import dataclasses
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, TypeVar

T = TypeVar("T")
# of a value
_LETTERS = 80
_ITEMS = 12


def shown_short(kind: type[T]) -> type[T]:
    """Give a dataclass or a NamedTuple a short `repr`: Name(field=value, ...).

    Fields at their default are left out, because a config has a hundred of them.
    """
    kind.__repr__ = _repr  # type: ignore[method-assign]
    return kind


def described(title: str, **lines: str) -> str:
    """Return a title, and below it an indented line for each of the others that is not empty."""
    width = max(map(len, lines))
    below = [f"  {name:{width}}  {text}" for name, text in lines.items() if text]
    return "\n".join([_cut(title), *below])


def count_of(number: int) -> str:
    """Return a number of parameters: 2.7 M."""
    if number >= 1e5:
        return f"{number / 1e6:.1f} M"
    return f"{number:,}"


def leaves(tree: Any) -> Iterator[Any]:
    """Yield the arrays of nested mappings and tuples, numpy or jax.

    `jax.tree.leaves` does the same, but this module is for those who do not load jax.
    """
    children: Iterable[Any] = ()
    if isinstance(tree, Mapping):
        children = tree.values()
    elif isinstance(tree, tuple | list):
        children = tree
    elif hasattr(tree, "shape"):
        yield tree
    for child in children:
        yield from leaves(child)


def _repr(record: Any) -> str:
    names, defaults = _fields_of(record)
    fields = []
    for name in names:
        value = getattr(record, name)
        # an Ellipsis is no field's value, so a field without a default is shown
        if not _is(value, defaults.get(name, ...)):
            fields.append(f"{name}={_short(value)}")
    return f"{type(record).__name__}({', '.join(fields)})"


def _fields_of(record: Any) -> tuple[tuple[str, ...], Mapping[str, Any]]:
    """Return the names of the fields of a dataclass or a NamedTuple, and their defaults by name."""
    if not dataclasses.is_dataclass(record):
        return getattr(record, "_fields", ()), getattr(record, "_field_defaults", {})
    defaults: dict[str, Any] = {}
    for field in dataclasses.fields(record):
        if not field.repr:
            continue
        if field.default_factory is not dataclasses.MISSING:
            defaults[field.name] = field.default_factory()
        else:
            defaults[field.name] = field.default  # MISSING, which is no value either
    return tuple(defaults), defaults


def _is(value: Any, default: Any) -> bool:
    """Return whether a value is its default. Arrays are compared by identity alone."""
    if value is default:
        return True
    if type(value) is not type(default) or hasattr(value, "shape"):
        return False
    return bool(value == default)


def _short(value: Any) -> str:
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{value.dtype}[{', '.join(map(str, value.shape))}]"
    if getattr(type(value), "__repr__", None) is _repr:
        return repr(value)
    arrays = list(leaves(value))
    if len(arrays) > 1 or (isinstance(value, Mapping) and arrays):
        numbers = sum(math.prod(one.shape) for one in arrays)
        return f"<{len(arrays)} arrays, {count_of(numbers)} numbers>"
    if isinstance(value, tuple | list | Mapping) and len(value) > _ITEMS:
        return f"<{len(value)} entries>"
    # Not `isinstance`: a NamedTuple has a repr of its own.
    if type(value) is list:
        return f"[{', '.join(map(_short, value))}]"
    if type(value) is tuple:
        comma = "," if len(value) == 1 else ""
        return f"({', '.join(map(_short, value))}{comma})"
    return _cut(repr(value))


def _cut(text: str) -> str:
    if len(text) <= _LETTERS:
        return text
    return f"{text[:50]} ... {text[-25:]}"
