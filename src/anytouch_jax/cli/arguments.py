"""Command-line arguments: from argv to one frozen record of options."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

from anytouch_jax.errors import UserError

RENAMED_COMMANDS = {
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
}
# Each applies to a command without an option of the old name.
RENAMED_OPTIONS = {
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


def parse_options(kind: Any, name: str, args: Sequence[str], default: Any = None, *, add_help: bool = True) -> Any:
    """Return the record `kind` of the options in `args`.

    Raises UserError for a renamed or repeated option, and SystemExit after --help and tyro's own errors.
    """
    import tyro

    args = [expand_home(arg) for arg in args]
    _refuse_renamed(kind, args)
    _refuse_repeated(kind, args)
    extra = {} if default is None else {"default": default}
    return tyro.cli(
        kind, prog=f"anytouch {name}", args=args, config=[tyro.conf.AvoidSubcommands], add_help=add_help, **extra
    )


def expand_home(arg: str) -> str:
    """Return `arg` with the home folder for the ~ of --out=~/x, which shells leave alone."""
    name, equals, value = arg.partition("=")
    return name + equals + os.path.expanduser(value) if name.startswith("--") else arg


def option_of(arg: str) -> str:
    """Return the name of an option as it is documented: --save-every for --save_every=5."""
    return arg.partition("=")[0].replace("_", "-")


def _refuse_renamed(kind: Any, args: Sequence[str]) -> None:
    known = {f"--{name.replace('_', '-')}" for name in get_type_hints(kind)}
    for option in map(option_of, args):
        section = option.partition(".")[0]
        for old in (option, section):
            if old in RENAMED_OPTIONS and old not in known:
                rest = option.removeprefix(old) if RENAMED_OPTIONS[old].startswith("--") else ""
                raise UserError(f"{option} has a new name: use {RENAMED_OPTIONS[old]}{rest}")


def _refuse_repeated(kind: Any, args: Sequence[str]) -> None:
    """Raise UserError for an option of several values that is repeated: the first values would be lost."""
    options = [option_of(arg) for arg in args]
    for name in _options_of_several(kind):
        option = f"--{name.replace('_', '-')}"
        if options.count(option) > 1:
            raise UserError(f"{option} is given twice. Write it once, followed by all its values.")


def _options_of_several(kind: Any) -> Iterator[str]:
    """Yield the options that take several values, those of a section as section.name."""
    for name, hint in get_type_hints(kind).items():
        if is_dataclass(hint):
            yield from (f"{name}.{inner}" for inner in _options_of_several(hint))
        elif tuple in (get_origin(hint), *map(get_origin, get_args(hint))):
            yield name
