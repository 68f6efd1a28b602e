"""Command-line arguments: from argv to one frozen record of options, and one sentence for a mistake
in them.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import sys
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from anytouch_jax.config.parsing import check
from anytouch_jax.errors import UserError

# the encoder of commands without --model; `weights.registry` has its files
DEFAULT = "anytouch-tiny"

# Old names of commands, and of options: each applies to a command without an option of the old
# name.
RENAMED = {
    **{
        name: f"anytouch data {name}"
        for name in ("simulate", "index", "contact", "verify", "annotate", "pack")
    },
    "convert": "anytouch export --to safetensors, or --to release",
    "pour": "make pouring",
    "translate": "make translation",
    "bench": "make bench",
    "parity": "make parity",
    "--run": "--model",
    "--input": "--data",
    "--clip": "--clip-weights",
    "--loader": "--data",
    "--loop": "--run",
    "--stream": "the command `anytouch stream`",
    "--tasks": "the command `anytouch probe tasks`",
    "--benchmark": "the command `anytouch probe benchmark`",
    "--names": "--to safetensors or --to release",
    "--optim.clip-norm": "--optim.grad-clip",
    "--objective.centre": "--objective.center-embeddings",
}

_TAKES = {int: "a whole number", float: "a number"}


def parse_options(
    kind: Any,
    name: str,
    args: Sequence[str],
    default: Any = None,
    *,
    add_help: bool = True,
    others: Mapping[str, str] | None = None,
) -> Any:
    """Return the record `kind` of the options in `args`.

    `others` are options of the command that are parsed elsewhere. Raises UserError for words that
    are no options, for values of another type or out of their range, and SystemExit after --help.
    """
    import tyro

    args = [expand_home(arg) for arg in args]
    _refuse_renamed(kind, args)
    if not (add_help and {"-h", "--help"} & {*args}):
        check_words(name.partition(" [")[0], [*options_of(kind, default)], args, others or {})
    # The text of an option explains a default that is None or empty.
    hint = tyro.conf.arg(
        help_behavior_hint=lambda value: "" if value in ("None", "") else f"(default: {value})"
    )
    kept = get_type_hints(kind, include_extras=True)
    marks = {
        field.name: (hint, *[tyro.conf.DisallowNone] * (field.default is None))
        for field in fields(kind)
    }
    hints = {name: Annotated[kept[name], *more] for name, more in marks.items()}
    about = {"__doc__": kind.__doc__, "__module__": kind.__module__, "__annotations__": hints}
    shown = type(kind.__name__, (kind,), about)
    extra = {} if default is None else {"default": default}
    printed = io.StringIO()
    try:
        with contextlib.redirect_stderr(printed):
            options = tyro.cli(
                shown,
                prog=f"anytouch {name}",
                args=args,
                config=[tyro.conf.AvoidSubcommands],
                add_help=add_help,
                **extra,
            )
    except SystemExit as stop:
        error: BaseException | None = stop
        # a record that refuses its values: tyro draws a box around the error
        while error is not None:
            if isinstance(error, UserError):
                raise error from None
            error = error.__context__
        sys.stderr.write(printed.getvalue())
        raise
    check(options, "--")
    return options


def expand_home(arg: str) -> str:
    """Return `arg` with the home folder for the ~ of --out=~/x, which shells leave alone."""
    name, equals, value = arg.partition("=")
    if name.startswith("--"):
        return name + equals + os.path.expanduser(value)
    return arg


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


class Option(NamedTuple):
    """An option `--name`, or a positional NAME, with values of the types `kinds`, again and again
    if it is a list.
    """

    name: str
    kinds: tuple[Any, ...]
    is_list: bool
    is_positional: bool
    is_required: bool
    may_be_none: bool
    may_be_empty: bool

    @property
    def is_flag(self) -> bool:
        """Whether it takes no value."""
        return self.kinds == (bool,)

    @property
    def takes_several(self) -> bool:
        """Whether it takes more than one value."""
        return self.is_list or len(self.kinds) > 1


def option_of(arg: str) -> str:
    """Return the name of an option as documented: --save-every for --save_every=5."""
    return arg.partition("=")[0].replace("_", "-")


def options_of(kind: Any, default: Any = None, prefix: str = "") -> Iterator[Option]:
    """Yield the options of a record, of a section as section.name; a part that `default` lacks has
    none.
    """
    from tyro.conf import Positional

    hints = get_type_hints(kind, include_extras=True)
    for field in fields(kind):
        hint = hints[field.name]
        marks = tuple[Any, ...]()
        if get_origin(hint) is Annotated:
            hint, *rest = get_args(hint)
            marks = tuple(rest)
        choices = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
        (inner,) = [one for one in choices if one is not type(None)]
        value = getattr(default, field.name, None)
        if is_dataclass(inner):
            if default is None or value is not None:
                yield from options_of(inner, value, f"{prefix}{field.name.replace('_', '-')}.")
            continue
        is_list = get_origin(inner) is tuple and get_args(inner)[-1] is Ellipsis
        inner = get_args(inner)[0] if is_list else inner
        kinds = get_args(inner) if get_origin(inner) is tuple else (inner,)
        is_required = default is None and field.default is field.default_factory is MISSING
        is_positional = Positional in marks
        name = field.name.upper() if is_positional else f"--{prefix}{field.name.replace('_', '-')}"
        may_be_none = type(None) in choices and bool(prefix or field.default is not None)
        yield Option(name, kinds, is_list, is_positional, is_required, may_be_none, bool(prefix))


def check_words(
    command: str,
    options: Sequence[Option],
    args: Sequence[str],
    others: Mapping[str, str] = types.MappingProxyType({}),
) -> None:
    """Raise UserError for words `args` that are no options (`others` are elsewhere), and for values
    that are unfit.
    """
    advice = f"see anytouch {command} --help"
    named = {option.name: option for option in options if not option.is_positional}
    for option in options:
        if option.is_flag:
            *section, last = option.name.removeprefix("--").split(".")
            named["--" + ".".join([*section, f"no-{last}"])] = option
    positional = [option for option in options if option.is_positional]
    given: list[tuple[Option, str, list[str]]] = []
    room = 0
    only_values = False
    for arg in args:
        if arg == "--" and not only_values:
            only_values = True
        elif is_option(arg) and not only_values:
            name = option_of(arg)
            equals = "=" in arg
            value = arg.partition("=")[2]
            if name not in named:
                raise UserError(_unknown(name, {**others, **{one: one for one in named}}, advice))
            option = named[name]
            values = [value] if equals else []
            if option.is_flag and equals:
                raise UserError(f"{name} takes no value: {advice}")
            given.append((option, name, values))
            room = (
                0 if option.is_flag else -1 if option.is_list else len(option.kinds) - len(values)
            )
        elif room:
            given[-1][2].append(arg)
            room -= 1
        elif positional:
            option = positional.pop(0)
            given.append((option, option.name, [arg]))
            room = -1 if option.is_list else len(option.kinds) - 1
        else:
            missing = next(
                (
                    one.name
                    for one in options
                    if one.is_required and one not in [g[0] for g in given]
                ),
                "",
            )
            guess = f"did you mean {missing} {arg}?" if missing else advice
            raise UserError(f"{arg!r} belongs to no option: {guess}")
    for option, name, values in given:
        _check_values(option, name, values, advice)
    present = [option for option, _, _ in given]
    if missing_names := [
        option.name for option in options if option.is_required and option not in present
    ]:
        listed = (
            f"{', '.join(missing_names[:-1])} and {missing_names[-1]}"
            if missing_names[1:]
            else missing_names[0]
        )
        raise UserError(f"{listed} {'are' if missing_names[1:] else 'is'} missing: {advice}")
    for option, name, _ in given:
        if option.takes_several and [one[0] for one in given].count(option) > 1:
            raise UserError(f"{name} is given twice. Write it once, followed by all its values.")


def is_option(arg: str) -> bool:
    """Return whether a word is an option, and not a number such as -1."""
    return (
        arg.startswith("-")
        and arg.lstrip("-")[:1].isalpha()
        and arg.lstrip("-").lower() not in ("inf", "nan")
    )


def _unknown(name: str, known: Mapping[str, str], advice: str) -> str:
    near = get_close_matches(name, known, 1)
    return f"there is no option {name[:60]}: " + (
        f"did you mean {known[near[0]]}?" if near else advice
    )


def _check_values(option: Option, name: str, values: Sequence[str], advice: str) -> None:
    """Raise UserError for a number of values or a value that the option does not take."""
    if (
        option.is_flag
        or (option.may_be_none and list(values) == ["None"])
        or (option.may_be_empty and not values)
    ):
        return
    if option.takes_several and (right := _without_commas(option, values)):
        shown = " ".join(right) if option.is_positional else f"{name} {' '.join(right)}"
        raise UserError(f"{name} takes values separated by blanks: write {shown}")
    count = len(option.kinds)
    if not values:
        what = f"{count} values" if count > 1 else _TAKES.get(option.kinds[0], "a value")
        raise UserError(f"{name} needs {what}: {advice}")
    if len(values) % count or (not option.is_list and len(values) != count):
        groups = f"groups of {count} values" if option.is_list else f"{count} values"
        raise UserError(f"{name} takes {groups}, not {len(values)}: {advice}")
    for number, value in enumerate(values):
        kind = option.kinds[number % count]
        if get_origin(kind) is Literal:
            choices = [str(one) for one in get_args(kind)]
            if value not in choices:
                near = get_close_matches(value, choices, 1)
                hint = f": did you mean {near[0]}?" if near else ""
                raise UserError(
                    f"{name} takes {', '.join(choices[:-1])} or {choices[-1]}, not "
                    f"{value[:60]!r}{hint}"
                )
        elif kind in _TAKES:
            try:
                kind(value)
            except ValueError:
                raise UserError(f"{name} takes {_TAKES[kind]}, not {value[:60]!r}") from None


def _without_commas(option: Option, values: Sequence[str]) -> list[str]:
    """Return the values that were separated by commas instead of blanks, [] if there are none."""
    marks = ","
    if len(option.kinds) > 1:  # 640x480, digit=5
        marks += "=" if str in option.kinds else "x"
    if not any(mark in value for value in values for mark in marks) or any(
        Path(value).exists() for value in values
    ):
        return []
    right = [
        word
        for value in values
        for word in re.split(rf"[{marks}\s]+", value.strip("[]() "))
        if word
    ]
    # a text may hold a comma
    fits = not option.is_list and len(values) == len(option.kinds)
    if fits and str in option.kinds:
        return []
    return right
