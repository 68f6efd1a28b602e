"""Errors that a user can mend.

Their message is one sentence that says what is wrong, where, and what to do. The command line
prints it without a traceback.
"""

from importlib import import_module
from typing import Any

from anytouch_jax.signals import Terminated, handled
from anytouch_jax.text import edit_distance, shorten

__all__ = [
    "CheckError",
    "ConfigError",
    "Terminated",
    "UserError",
    "edit_distance",
    "handled",
    "shorten",
]


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


def __getattr__(name: str) -> Any:
    """Return `refuse_forked`, which is asked for here too.

    It raises UserError, so `forks` imports this module, and this one cannot import `forks` first.
    """
    if name == "refuse_forked":
        return import_module("anytouch_jax.forks").refuse_forked
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
