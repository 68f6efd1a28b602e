"""Command-line arguments: from argv to one frozen record of options."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Annotated, Any, get_type_hints

from anytouch_jax.cli.words import check_words, option_of, options_of
from anytouch_jax.config.parsing import check
from anytouch_jax.errors import UserError

DEFAULT = "anytouch-tiny"  # the encoder of commands without --model; `weights.registry` has its files

# Old names of commands, and of options: each applies to a command without an option of the old name.
RENAMED = {
    "simulate": "anytouch data simulate",
    "index": "anytouch data index",
    "contact": "anytouch data contact",
    "verify": "anytouch data verify",
    "annotate": "anytouch data annotate",
    "pack": "anytouch data pack",
    "convert": "anytouch export --to safetensors, or --to release",
    "pour": "make pouring",
    "translate": "make translation",
    "bench": "make bench",
    "parity": "make parity",
    "--run": "--model",
    "--input": "--data",
    "--stream": "the command `anytouch stream`",
    "--clip": "--clip-weights",
    "--tasks": "the command `anytouch probe tasks`",
    "--benchmark": "the command `anytouch probe benchmark`",
    "--names": "--to safetensors or --to release",
    "--loader": "--data",
    "--loop": "--run",
    "--optim.clip-norm": "--optim.grad-clip",
    "--objective.centre": "--objective.center-embeddings",
}


def parse_options(
    kind: Any, name: str, args: Sequence[str], default: Any = None, *, add_help: bool = True,
    others: Mapping[str, str] | None = None,
) -> Any:  # fmt: skip
    """Return the record `kind` of the options in `args`.

    `others` are options of the command that are parsed elsewhere. Raises UserError for words that are no options, for
    values of another type or out of their range, and SystemExit after --help.
    """
    import tyro

    args = [expand_home(arg) for arg in args]
    _refuse_renamed(kind, args)
    if not (add_help and {"-h", "--help"} & {*args}):
        check_words(name.partition(" [")[0], [*options_of(kind, default)], args, others or {})
    # The text of an option explains a default that is None or empty.
    hint = tyro.conf.arg(help_behavior_hint=lambda value: "" if value in ("None", "") else f"(default: {value})")
    kept = get_type_hints(kind, include_extras=True)
    marks = {field.name: (hint, *[tyro.conf.DisallowNone] * (field.default is None)) for field in fields(kind)}
    hints = {name: Annotated[kept[name], *more] for name, more in marks.items()}
    shown = type(
        kind.__name__, (kind,), {"__doc__": kind.__doc__, "__module__": kind.__module__, "__annotations__": hints}
    )
    extra = {} if default is None else {"default": default}
    options = tyro.cli(
        shown, prog=f"anytouch {name}", args=args, config=[tyro.conf.AvoidSubcommands], add_help=add_help, **extra
    )
    check(options, "--")
    return options


def expand_home(arg: str) -> str:
    """Return `arg` with the home folder for the ~ of --out=~/x, which shells leave alone."""
    name, equals, value = arg.partition("=")
    return name + equals + os.path.expanduser(value) if name.startswith("--") else arg


def spelled(field: str) -> str:
    """Return the option of a field: --save-every for save_every."""
    return f"--{field.replace('_', '-')}"


def _refuse_renamed(kind: Any, args: Sequence[str]) -> None:
    known = set(map(spelled, get_type_hints(kind)))
    for option in map(option_of, args):
        for old in (option, option.partition(".")[0]):
            if old.startswith("--") and old in RENAMED and old not in known:
                rest = option.removeprefix(old) if RENAMED[old].startswith("--") else ""
                raise UserError(f"{option} has a new name: use {RENAMED[old]}{rest}")
