"""Old names of the public interface. They work until version 0.4, with a DeprecationWarning.

Everything that keeps an old name alive is here, so that all of it can be deleted together: names of
the package, keywords of functions, values of options, and paths of modules.
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any, TypeVar

T = TypeVar("T")

# Names of the package: old -> new.
NAMES = {
    "untouched_gel": "estimate_background",
}
# Values of options: old -> new.
PROTOCOLS = {"honest": "grouped", "published": "released"}
# Options of the command line: old -> new. No command has an option with one of the old names.
OPTIONS = {
    "--join": "--aggregation",
    "--film": "--video",
    "--films": "--videos",
    "--no-films": "--no-videos",
    "--picture": "--image",
    "--share": "--fraction",
    "--data.clip-share": "--data.clip-fraction",
}
# What modules of the package had under another name: old -> new.
ATTRIBUTES = {
    "RunningGel": "RunningBackground",
    "UnitGels": "Backgrounds",
    "gel_arrays": "background_arrays",
    "gels_of_arrays": "backgrounds_of_arrays",
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
        today = ATTRIBUTES.get(name, name)
        for home in MODULES[path]:
            module = import_module(f"anytouch_jax.{home}")
            if hasattr(module, today):
                warn(f"{old}.{name}", f"anytouch_jax.{home}.{today}")
                return getattr(module, today)
        raise AttributeError(f"module {old!r} has no attribute {name!r}")

    return find


def keywords(
    values: Mapping[str, Mapping[str, str]] | None = None, **names: str
) -> Callable[[T], T]:
    """Return a decorator that takes old keywords of a function for new ones, old="new".

    Args:
        values: old values of keywords, by the keyword's new name.
        names: the new name of each old keyword.
    """

    def decorate(function: Any) -> Any:
        @functools.wraps(function)
        def call(*args: Any, **options: Any) -> Any:
            for old, new in names.items():
                if old in options:
                    warn(f"{function.__qualname__}({old}=)", f"{new}=")
                    options[new] = options.pop(old)
            for option, known in (values or {}).items():
                if isinstance(options.get(option), str):
                    options[option] = value(options[option], known, option)
            return function(*args, **options)

        return call

    return decorate


def fields(**names: str) -> Callable[[T], T]:
    """Return a decorator of a dataclass whose fields had other names, old="new"."""

    def decorate(kind: Any) -> Any:
        kind.__init__ = keywords(None, **names)(kind.__init__)
        for old, new in names.items():
            setattr(kind, old, property(functools.partial(_old_field, old, new)))
        return kind

    return decorate


def _old_field(old: str, new: str, record: Any) -> Any:
    """Return a field of a record by its old name."""
    warn(f"{type(record).__name__}.{old}", f".{new}")
    return getattr(record, new)


def value(given: str, names: Mapping[str, str], what: str) -> str:
    """Return the new name of a value of an option, such as a protocol."""
    if given in names:
        warn(f"{what} {given!r}", repr(names[given]))
        return names[given]
    return given


def words(args: Sequence[str], tell: Callable[[str], object]) -> list[str]:
    """Return words of the command line with today's options and values.

    Args:
        args: the words as they were typed.
        tell: is given a sentence for each old word, since warnings are hidden in a command.
    """
    today = []
    before = ""
    for arg in args:
        option, equals, given = arg.partition("=")
        spelled = option.replace("_", "-") if option.startswith("--") else option
        new = OPTIONS.get(spelled, option) + equals + given
        if spelled == "--protocol" and given in PROTOCOLS:
            new = option + equals + PROTOCOLS[given]
        if before == "--protocol":
            new = PROTOCOLS.get(arg, arg)
        if new != arg:
            tell(f"{arg} is called {new} now; the old name leaves in version 0.4")
        today.append(new)
        before = arg
    return today
