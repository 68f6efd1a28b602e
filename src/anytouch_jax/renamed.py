"""Old names of the public interface. They work until version 0.4, with a DeprecationWarning.

Everything that keeps an old name alive is here, so that all of it can be deleted together: names of
the package, keywords of functions, values of options, and paths of modules.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, TypeVar

T = TypeVar("T")

# Names of the package: old -> new.
NAMES = {
    "untouched_gel": "estimate_background",
}
# Paths of modules that examples and scripts import: old -> the modules that have its names today.
MODULES: dict[str, tuple[str, ...]] = {
    "data.gels": ("data.background.rule",),
    "encoder.fields": ("fields.measure", "fields.outputs"),
    "encoder.health": ("live.health", "data.background.layout"),
    "encoder.stream": ("live.stream", "live.cameras"),
    "view.live": ("live.page.live",),
    "view.server": ("live.page.server",),
}


def warn(old: str, new: str, stacklevel: int = 3) -> None:
    """Warn that a name has another one now."""
    warnings.warn(
        f"{old} is called {new} now; the old name leaves in version 0.4",
        DeprecationWarning,
        stacklevel=stacklevel,
    )


def moved(old: str) -> Callable[[str], Any]:
    """Return the `__getattr__` of a module that stands where another one was."""
    path = old.removeprefix("anytouch_jax.")

    def find(name: str) -> Any:
        if name.startswith("__"):  # what the import system itself asks for
            raise AttributeError(name)
        for home in MODULES[path]:
            module = import_module(f"anytouch_jax.{home}")
            if hasattr(module, name):
                warn(f"{old}.{name}", f"anytouch_jax.{home}.{name}")
                return getattr(module, name)
        raise AttributeError(f"module {old!r} has no attribute {name!r}")

    return find


def keywords(**names: str) -> Callable[[T], T]:
    """Return a decorator that takes old keywords of a function for new ones, old="new"."""

    def decorate(function: Any) -> Any:
        @functools.wraps(function)
        def call(*args: Any, **options: Any) -> Any:
            for old, new in names.items():
                if old in options:
                    warn(f"{function.__qualname__}({old}=)", f"{new}=")
                    options[new] = options.pop(old)
            return function(*args, **options)

        return call

    return decorate


def value(given: str, names: Mapping[str, str], what: str) -> str:
    """Return the new name of a value of an option, such as a protocol."""
    if given in names:
        warn(f"{what} {given}", names[given])
        return names[given]
    return given
