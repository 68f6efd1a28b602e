"""Options that would do nothing are a mistake, not a silence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

from anytouch_jax.errors import UserError


def refuse(options: Any, names: Sequence[str], where: str, otherwise: str = "") -> None:
    """Raise UserError for those of the options `names` that differ from their defaults: they do nothing `where`.

    `options` is the record of a subcommand; `otherwise` ends the sentence with another way out.
    """
    usual = {field.name: field.default for field in fields(options)}
    given = [f"--{name.replace('_', '-')}" for name in names if getattr(options, name) != usual[name]]
    if given:
        verb, them = ("does", "it") if len(given) == 1 else ("do", "them")
        raise UserError(f"{', '.join(given)} {verb} nothing {where}; leave {them} out{otherwise}")


def refuse_join(options: Any, segment: int) -> None:
    """Raise UserError for a way to join segments where touches of `frames` are a single one, of `segment` at most."""
    if (options.frames or 1) <= segment:
        refuse(options, ("join",), f"without clips of more than {segment} frames, which alone have several segments")
