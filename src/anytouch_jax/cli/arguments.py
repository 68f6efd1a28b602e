"""Command-line arguments: from argv to one frozen record of options.

A mistake is answered by one sentence that says what is right. tyro draws the help from the same
records, but it does not parse: its errors are boxes of text behind SystemExit(2), from which no
sentence of ours could be made. So words are read once, here.
"""

from __future__ import annotations

import math
import os
import re
import types
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import (
    Annotated,
    Any,
    Literal,
    NamedTuple,
    NoReturn,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from anytouch_jax.config.parsing import check
from anytouch_jax.errors import UserError

# The encoder of commands without --model; `weights.registry` has its files.
DEFAULT = "anytouch-tiny"

# Old names of commands and options. One of an option applies to commands that have no option of
# the old name.
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
    """Return the record of the options in `args`.

    Args:
        kind: the class of the record, a dataclass.
        name: of the command, such as "probe label".
        args: the words after it.
        default: a record that has the values of options that are not given, and the sections.
        add_help: whether --help prints the page of the command.
        others: options of the command that are parsed elsewhere, {as typed: right name}.

    Raises:
        UserError: for words that are no options, and for values of another type or out of their
            range. Nothing else has been done by then.
        SystemExit: after --help.
    """
    args = [expand_home(arg) for arg in args]
    _refuse_renamed(kind, args)
    if add_help and {"-h", "--help"} & {*args}:
        print_help(kind, name, default)
    options = [*options_of(kind, default)]
    advice = f"see anytouch {name.partition(' [')[0]} --help"
    given = read_words(options, args, advice, others or {})
    values: dict[tuple[str, ...], Any] = {}
    for one in given:
        check_values(one, advice)
        values[one.option.path] = one.value()
    check_complete(options, given, advice)
    record = make_record(kind, default, values)
    check(record, "--")
    return record


def print_help(kind: Any, name: str, default: Any = None) -> NoReturn:
    """Print the help of a command and exit."""
    import tyro

    # The text of an option explains a default that is None or empty.
    hint = tyro.conf.arg(
        help_behavior_hint=lambda value: "" if value in ("None", "") else f"(default: {value})"
    )
    hints = {}
    for name_of, annotation in get_type_hints(kind, include_extras=True).items():
        hints[name_of] = Annotated[annotation, hint]
    for one in fields(kind):
        # Without, tyro offers None as a value of every option that may be left out.
        if one.default is None:
            hints[one.name] = Annotated[hints[one.name], tyro.conf.DisallowNone]
    about = {"__doc__": kind.__doc__, "__module__": kind.__module__, "__annotations__": hints}
    shown = type(kind.__name__, (kind,), about)
    extra = {}
    if default is not None:
        extra["default"] = default
    tyro.cli(
        shown,
        prog=f"anytouch {name}",
        args=["--help"],
        config=[tyro.conf.AvoidSubcommands],
        **extra,
    )
    raise SystemExit(0)


def make_record(
    kind: Any, default: Any, values: Mapping[tuple[str, ...], Any], path: tuple[str, ...] = ()
) -> Any:
    """Return a record with `values` by the path of their field, and others as in `default`.

    Args:
        kind: the dataclass.
        default: the record whose other values are kept.
        values: by the path of their field, such as ("data", "batch_size").
        path: of the record itself in the outermost one.
    """
    changes = {}
    for one in fields(kind):
        own = (*path, one.name)
        if own in values:
            changes[one.name] = values[own]
        elif any(key[: len(own)] == own for key in values):
            section = getattr(default, one.name)
            changes[one.name] = make_record(type(section), section, values, own)
    if default is None:
        return kind(**changes)
    return replace(default, **changes)


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
    """Raise UserError for the old name of an option or of its section."""
    known = set(map(spelled, get_type_hints(kind)))
    for option in map(option_of, args):
        section, _, _ = option.partition(".")
        for old in (option, section):
            if not old.startswith("--") or old not in RENAMED or old in known:
                continue
            right = RENAMED[old]
            if right.startswith("--"):
                right += option.removeprefix(old)
            raise UserError(f"{option} has a new name: use {right}")


class Option(NamedTuple):
    """An option `--name`, or a positional NAME.

    Attributes:
        name: as it is typed.
        path: names of the fields that lead to its value, that of its section first.
        kinds: the types of its values, one for each.
        is_list: it takes values of these types again and again.
        is_positional: it has no name on the command line.
        is_required: it has no default.
        may_be_none: "None" is a value.
        may_be_empty: a list without values is a value.
    """

    name: str
    path: tuple[str, ...]
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


@dataclass
class Given:
    """An option with its name and values as they were typed."""

    option: Option
    name: str
    values: list[str] = field(default_factory=list)

    @property
    def is_none(self) -> bool:
        """Whether the word None stands for no value."""
        return self.option.may_be_none and self.values == ["None"]

    def room(self) -> float:
        """Return how many more words belong to it."""
        if self.option.is_flag:
            return 0
        if self.option.is_list:
            return math.inf
        return len(self.option.kinds) - len(self.values)

    def value(self) -> Any:
        """Return the value of the field. The words must have been checked."""
        if self.option.is_flag:
            return self.name == self.option.name  # --no-x is another name of the flag --x
        if self.is_none:
            return None
        kinds = self.option.kinds
        count = len(kinds)
        values = [_convert(kinds[place % count], word) for place, word in enumerate(self.values)]
        if not self.option.is_list:
            return tuple(values) if count > 1 else values[0]
        if count == 1:
            return tuple(values)
        return tuple(tuple(values[i : i + count]) for i in range(0, len(values), count))


def _convert(kind: Any, word: str) -> Any:
    """Return a word as a value of a type or of a Literal."""
    if get_origin(kind) is Literal:
        return next(one for one in get_args(kind) if str(one) == word)
    return kind(word)


def option_of(arg: str) -> str:
    """Return the name of an option as documented: --save-every for --save_every=5."""
    return arg.partition("=")[0].replace("_", "-")


def options_of(kind: Any, default: Any = None, path: tuple[str, ...] = ()) -> Iterator[Option]:
    """Yield the options of a record; those of a section are called section.name.

    A section that `default` lacks has none.
    """
    hints = get_type_hints(kind, include_extras=True)
    for one in fields(kind):
        hint = hints[one.name]
        marks = tuple[Any, ...]()
        if get_origin(hint) is Annotated:
            hint, *rest = get_args(hint)
            marks = tuple(rest)
        choices = (hint,)
        if get_origin(hint) in (Union, types.UnionType):
            choices = get_args(hint)
        (inner,) = [choice for choice in choices if choice is not type(None)]
        own_path = (*path, one.name)
        if is_dataclass(inner):
            section = getattr(default, one.name, None)
            if default is None or section is not None:
                yield from options_of(inner, section, own_path)
            continue
        yield _option(one, own_path, inner, marks, default)._replace(
            may_be_none=type(None) in choices and bool(path or one.default is not None)
        )


def _option(
    one: Field[Any], path: tuple[str, ...], inner: Any, marks: tuple[Any, ...], default: Any
) -> Option:
    """Return the option of a field whose values have the type `inner`."""
    from tyro.conf import Positional

    args = get_args(inner)
    is_list = get_origin(inner) is tuple and args[-1] is Ellipsis
    if is_list:
        inner = args[0]
    kinds = (inner,)
    if get_origin(inner) is tuple:
        kinds = get_args(inner)
    is_positional = Positional in marks
    name = "--" + ".".join(path).replace("_", "-")
    if is_positional:
        name = one.name.upper()
    has_default = one.default is not MISSING or one.default_factory is not MISSING
    in_section = len(path) > 1
    return Option(
        name=name,
        path=path,
        kinds=kinds,
        is_list=is_list,
        is_positional=is_positional,
        is_required=default is None and not has_default,
        may_be_none=False,
        may_be_empty=in_section and is_list,
    )


def read_words(
    options: Sequence[Option], args: Sequence[str], advice: str, others: Mapping[str, str]
) -> list[Given]:
    """Return the options that are given, with their words.

    Words after an option belong to it as far as it takes more, then to the positional ones.

    Args:
        options: of the command.
        args: the words.
        advice: ends a sentence for which nothing better is known.
        others: options that are parsed elsewhere, {as typed: right name}, for guesses.

    Raises:
        UserError: for a word that is no option and belongs to none.
    """
    named = {option.name: option for option in options if not option.is_positional}
    for option in options:
        if option.is_flag:
            *section, last = option.name.removeprefix("--").split(".")
            named["--" + ".".join([*section, f"no-{last}"])] = option
    positional = [option for option in options if option.is_positional]
    given = list[Given]()
    only_values = False
    for arg in args:
        if arg == "--" and not only_values:
            only_values = True
        elif is_option(arg) and not only_values:
            name = option_of(arg)
            if name not in named:
                known = {**others, **{one: one for one in named}}
                raise UserError(_unknown(name, known, advice))
            given.append(Given(named[name], name))
            _, has_value, value = arg.partition("=")
            if has_value:
                if named[name].is_flag:
                    raise UserError(f"{name} takes no value: {advice}")
                given[-1].values.append(value)
        elif given and given[-1].room() > 0:
            given[-1].values.append(arg)
        elif positional:
            option = positional.pop(0)
            given.append(Given(option, option.name, [arg]))
        else:
            raise UserError(_of_no_option(arg, options, given, advice))
    return given


def _of_no_option(arg: str, options: Sequence[Option], given: Sequence[Given], advice: str) -> str:
    """Return the sentence for a word that belongs to no option.

    An option that is required and missing is what most probably was left out before it.
    """
    present = [one.option for one in given]
    for option in options:
        if option.is_required and option not in present:
            return f"{arg!r} belongs to no option: did you mean {option.name} {arg}?"
    return f"{arg!r} belongs to no option: {advice}"


def is_option(arg: str) -> bool:
    """Return whether a word is an option, and not a number such as -1."""
    word = arg.lstrip("-")
    return arg.startswith("-") and word[:1].isalpha() and word.lower() not in ("inf", "nan")


def _unknown(name: str, known: Mapping[str, str], advice: str) -> str:
    near = get_close_matches(name, known, 1)
    hint = f"did you mean {known[near[0]]}?" if near else advice
    return f"there is no option {name[:60]}: {hint}"


def check_complete(options: Sequence[Option], given: Sequence[Given], advice: str) -> None:
    """Raise UserError for a required option that is missing, and for a list that is given twice.

    A list that is given twice would have the second values alone, without a word.
    """
    present = [one.option for one in given]
    missing = [one.name for one in options if one.is_required and one not in present]
    if len(missing) == 1:
        raise UserError(f"{missing[0]} is missing: {advice}")
    if missing:
        raise UserError(f"{', '.join(missing[:-1])} and {missing[-1]} are missing: {advice}")
    for one in given:
        if one.option.takes_several and present.count(one.option) > 1:
            raise UserError(
                f"{one.name} is given twice. Write it once, followed by all its values."
            )


def check_values(given: Given, advice: str) -> None:
    """Raise UserError for a number of values or a value that an option does not take."""
    option = given.option
    name = given.name
    values = given.values
    if option.is_flag or given.is_none or (option.may_be_empty and not values):
        return
    if option.takes_several:
        right = " ".join(_without_commas(option, values))
        if right:
            shown = right if option.is_positional else f"{name} {right}"
            raise UserError(f"{name} takes values separated by blanks: write {shown}")
    count = len(option.kinds)
    if not values:
        what = f"{count} values" if count > 1 else _TAKES.get(option.kinds[0], "a value")
        raise UserError(f"{name} needs {what}: {advice}")
    if option.is_list and len(values) % count:
        raise UserError(f"{name} takes groups of {count} values, not {len(values)}: {advice}")
    if not option.is_list and len(values) != count:
        raise UserError(f"{name} takes {count} values, not {len(values)}: {advice}")
    for place, value in enumerate(values):
        _check_value(name, option.kinds[place % count], value)


def _check_value(name: str, kind: Any, value: str) -> None:
    """Raise UserError for a word that is no value of a type or of a Literal."""
    if get_origin(kind) is Literal:
        choices = [str(one) for one in get_args(kind)]
        if value in choices:
            return
        near = get_close_matches(value, choices, 1)
        hint = f": did you mean {near[0]}?" if near else ""
        raise UserError(
            f"{name} takes {', '.join(choices[:-1])} or {choices[-1]}, not {value[:60]!r}{hint}"
        )
    if kind in _TAKES:
        try:
            kind(value)
        except ValueError:
            raise UserError(f"{name} takes {_TAKES[kind]}, not {value[:60]!r}") from None


def _without_commas(option: Option, values: Sequence[str]) -> list[str]:
    """Return the values that were separated by commas instead of blanks, [] if there are none."""
    marks = ","
    if len(option.kinds) > 1:  # 640x480, digit=5
        marks += "=" if str in option.kinds else "x"
    if not any(mark in value for value in values for mark in marks):
        return []
    if any(Path(value).exists() for value in values):
        return []  # a name may hold a comma
    right = []
    for value in values:
        right += [word for word in re.split(rf"[{marks}\s]+", value.strip("[]() ")) if word]
    # a text may hold a comma
    fits = not option.is_list and len(values) == len(option.kinds)
    if fits and str in option.kinds:
        return []
    return right
