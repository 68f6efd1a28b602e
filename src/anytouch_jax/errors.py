"""Errors that a user can mend, and signals."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

_LETTERS = 500  # of a message


def shorten(text: str) -> str:
    """Return a message without its middle if it is long, as one that quotes a damaged file can
    be.
    """
    if len(text) <= _LETTERS:
        return text
    return f"{text[:350]} ... {text[-140:]}"


def letters_apart(one: str, other: str) -> int:
    """Return how many letters must be added, removed, replaced or exchanged with the next to get
    the other word.
    """
    before = list[int]()
    last = list(range(len(other) + 1))
    for i, letter in enumerate(one):
        row = [i + 1]
        for j, wanted in enumerate(other):
            row.append(min(last[j + 1] + 1, row[j] + 1, last[j] + (letter != wanted)))
            if i and j and letter == other[j - 1] and one[i - 1] == wanted:
                row[-1] = min(row[-1], before[j - 1] + 1)
        before = last
        last = row
    return last[-1]


class UserError(ValueError):
    """A user's mistake.

    The message is one sentence that says what is wrong, where, and what to do.
    """

    def __str__(self) -> str:
        return shorten(super().__str__())


class ConfigError(UserError):
    """A configuration that cannot be read or is inconsistent. The message says what to change."""


class CheckError(UserError):
    """A check that failed, such as an export that differs from its model.

    The command line exits with 1.
    """


@contextlib.contextmanager
def handled(handler: Callable[[int, Any], Any], *names: signal.Signals) -> Iterator[None]:
    """Let signals call `handler` while the block runs.

    Outside the main thread Python has no handlers.
    """
    before: dict[signal.Signals, Any] = {}
    try:
        for name in names if threading.current_thread() is threading.main_thread() else ():
            before[name] = signal.signal(name, handler)
        yield
    finally:
        for name, earlier in before.items():
            signal.signal(name, earlier)


class Terminated(BaseException):
    """SIGTERM outside a training step."""


_inherited = False  # whether this process was forked from one whose jax was running


def _look() -> None:
    """After a fork: what jax is asked for would hang, so it raises.

    A change of settings makes it look.
    """
    global _inherited
    # jax has no public question for it
    bridge = sys.modules.get("jax._src.xla_bridge")
    if _inherited or getattr(bridge, "backends_are_initialized", lambda: bridge is not None)():
        _inherited = True
        for setting in ("jax_no_execution", "jax_no_tracing"):
            sys.modules["jax"].config.update(setting, True)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_look)


def refuse_forked() -> None:
    """Raise UserError in a process that was forked after its parent had used jax."""
    if _inherited:
        raise UserError(
            "This process was forked from one that has used jax, so it cannot compute. Start "
            "workers with "
            'multiprocessing.get_context("spawn"), or load the encoder in the workers alone.'
        )
