"""What the environment asks of a page: switches, numbers and names, with one sentence where one makes no sense.

A mistake of the user's ends a page that is run as a script with that sentence, as Ctrl-C does; in a notebook it is an
exception.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Collection
from pathlib import Path
from types import TracebackType

from anytouch_jax.errors import UserError


def switch(name: str) -> bool:
    """Whether `name` is set, and not to 0."""
    return os.environ.get(name, "") not in ("", "0")


def number(name: str, usual: int, *, least: int = 1) -> int:
    """A whole number of `least` or more. Raises UserError."""
    return _whole(name, os.environ.get(name) or str(usual), least)


def numbers(name: str, usual: str) -> list[int]:
    """Whole numbers of 0 or more with commas between, as seeds are. Raises UserError."""
    return [_whole(name, word, 0) for word in (os.environ.get(name) or usual).split(",")]


def names(name: str, usual: str, known: Collection[str]) -> list[str]:
    """Names with commas between, each of them `known`. Raises UserError."""
    result = (os.environ.get(name) or usual).split(",")
    if wrong := [word for word in result if word not in known]:
        raise UserError(f"{name}={','.join(result)}: there is no {wrong[0]!r}; choose among {', '.join(known)}")
    return result


def path(name: str, usual: str | Path) -> Path:
    """A file or folder, as given or as usual."""
    return Path(os.environ.get(name) or usual)


def runs() -> dict[str, list[str]]:
    """`RUNS`: encoders by the names that they have in a table, name=path with blanks between; name=a,b,c gives seeds 0,
    1, 2 an encoder of their own. Raises UserError for one that is not there."""
    words = os.environ.get("RUNS", "").split()
    if wrong := [word for word in words if "=" not in word]:
        raise UserError(f"RUNS: name=path for every run, not {wrong[0]!r}")
    result = {name: paths.split(",") for name, paths in (word.split("=", 1) for word in words)}
    if lost := [path for paths in result.values() for path in paths if not Path(path).exists()]:
        raise UserError(f"RUNS: there is no run {lost[0]}")
    return result


def _whole(name: str, word: str, least: int) -> int:
    try:
        value = int(word)
    except ValueError:
        value = least - 1
    if value < least:
        raise UserError(f"{name} must be a whole number of {least} or more, not {word!r}")
    return value


def _plainly(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    name = Path(sys.argv[0]).name
    if issubclass(kind, UserError):
        print(f"{name}: {error}", file=sys.stderr)
    elif issubclass(kind, KeyboardInterrupt):
        print(f"{name}: interrupted; the same command goes on", file=sys.stderr)
    else:
        _before(kind, error, trace)


_before, sys.excepthook = sys.excepthook, _plainly
