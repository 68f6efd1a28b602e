"""The `anytouch` command: the only reader of argv. Heavy imports wait until a subcommand needs them."""

from __future__ import annotations

import errno
import inspect
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import is_dataclass, make_dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from anytouch_jax import __version__
from anytouch_jax.cli.options import Convert, Embed, Probe, Report, Retrieve, Sections, Simulate, Train
from anytouch_jax.cli.options_data import Annotate, Contact, Index, Pack, Verify
from anytouch_jax.cli.options_use import Adapt, Export, Info
from anytouch_jax.config import Config, baselines, preset
from anytouch_jax.errors import UserError

_COMMANDS: dict[str, tuple[type, str]] = {
    "simulate": (Simulate, "touch scenes by several sensors, with photographs, captions and forces"),
    "info": (Info, "what a run, weights, a manifest or features are"),
    "index": (Index, "a downloaded dataset becomes a manifest"),
    "contact": (Contact, "which frames are touched"),
    "verify": (Verify, "check a manifest and its files; repair; rows for commercial use"),
    "annotate": (Annotate, "captions from a vision-language model"),
    "pack": (Pack, "millions of small files as a few shards"),
    "train": (Train, "pre-train stage 1 or stage 2, or go on with a run"),
    "embed": (Embed, "features of a manifest, a folder, a video or a camera"),
    "adapt": (Adapt, "tokens for a sensor never seen, from a few of its frames"),
    "export": (Export, "a trained encoder as one file that needs jax alone"),
    "probe": (Probe, "linear and kNN probes of frozen features"),
    "retrieve": (Retrieve, "the same touch by another sensor, among similar touches"),
    "report": (Report, "what two runs learned, as Markdown with figures"),
    "convert": (Convert, "weights in and out"),
}
_SMALLER = "ask for less at once (--batch, --size, --gallery ...), a smaller --preset, or --model.remat in training"
# What these require is given by place, not by name.
_POSITIONAL = (Index, Contact, Verify, Annotate, Pack, Convert, Info)


def console() -> int:
    """The `anytouch` command in a process of its own: `main`.

    XLA's own log is off, but for who sets its level: jaxlib 0.10.1 takes two of its tuning flags for features that the
    machine lacks, an error for each program read from the cache. What really fails is raised in Python.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    return main()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status: 0, 1 (a user's mistake or a failed check), 2 (usage), 130."""
    try:
        status = _main(argv)
        sys.stdout.flush()
        return status
    except BrokenPipeError:  # the reader of our output went away (| head): nobody is left to be told
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141


def _main(argv: Sequence[str] | None) -> int:
    args = [_at_home(arg) for arg in (sys.argv[1:] if argv is None else argv)]
    if not args or args[0] in ("-h", "--help"):
        print(_usage())
        return 0 if args else 2
    if args[0] == "--version":
        print(__version__)
        return 0
    if args[0] not in _COMMANDS:
        from difflib import get_close_matches

        near = get_close_matches(args[0], _COMMANDS, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        print(f"anytouch: no command {args[0]!r}{hint} See anytouch --help", file=sys.stderr)
        return 2
    try:
        with warnings.catch_warnings():
            warnings.showwarning = partial(_tell, warnings.showwarning)
            return _run(args[0], args[1:])
    except UserError as error:
        print(f"anytouch {args[0]}: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        raise
    except OSError as error:  # a disk, a folder, a name: never a programming error
        advice = "; free some space" if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
        print(f"anytouch {args[0]}: {error.filename or 'a file'}: {error.strerror or error}{advice}", file=sys.stderr)
        return 1
    except (MemoryError, RuntimeError) as error:  # XLA's is a RuntimeError
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        print(f"anytouch {args[0]}: there is not enough memory for this; {_SMALLER}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


def _at_home(arg: str) -> str:
    """--out=~/x as it is meant: shells put the home folder in place of a ~ only where a word begins with it."""
    name, equals, value = arg.partition("=")
    return name + equals + os.path.expanduser(value) if name.startswith("--") else arg


def _tell(otherwise: Callable[..., None], message: Warning | str, category: type[Warning], *where: Any) -> None:
    """What the library warns of is a sentence for the user, without the line of code that Python shows."""
    if category is UserWarning:
        print(message, file=sys.stderr)
    else:
        otherwise(message, category, *where)


def _usage() -> str:
    width = max(map(len, _COMMANDS))
    lines = "\n".join(f"  {name:{width}}  {text}" for name, (_, text) in _COMMANDS.items())
    return f"""usage: anytouch COMMAND [options]

One representation of touch for many camera-based tactile sensors.

{lines}

anytouch COMMAND --help explains a command and gives an example."""


def _run(name: str, args: list[str]) -> int:
    run: Callable[..., int] = import_module(f"anytouch_jax.cli.{name}").run
    if name == "train":
        return run(*_parse_train(args))
    return run(_parse(_COMMANDS[name][0], name, args))


def _parse(kind: Any, name: str, args: list[str], default: Any = None, closing: str = "") -> Any:
    """The options of a command; `closing`, which takes --help away, stands below a mistake instead of a hint to it."""
    import tyro

    _refuse_twice(kind, args)
    extra = {} if default is None else {"default": default}
    config: list[Any] = [tyro.conf.AvoidSubcommands]
    if kind in _POSITIONAL:
        config.append(tyro.conf.PositionalRequiredArgs)
    try:
        return tyro.cli(kind, prog=f"anytouch {name}", args=args, config=config, add_help=not closing, **extra)
    except SystemExit:
        if closing:
            print(closing, file=sys.stderr)
        raise


def _refuse_twice(kind: Any, args: list[str]) -> None:
    """Raise UserError for an option of several values that comes again: its first values would be lost."""
    several = [name.replace("_", "-") for name in _several(kind)]
    given = [arg.split("=")[0].replace("_", "-") for arg in args]
    for option in (f"--{name}" for name in several):
        if given.count(option) > 1:
            raise UserError(f"{option} is given twice; write it once, with all its values behind it")


def _several(kind: Any) -> Iterator[str]:
    """The options that take several values, those of a section as section.name."""
    for name, hint in get_type_hints(kind).items():
        if is_dataclass(hint):
            yield from (f"{name}.{inner}" for inner in _several(hint))
        elif tuple in (get_origin(hint), *map(get_origin, get_args(hint))):
            yield name


def _parse_train(args: list[str]) -> tuple[Train, Config]:
    """The options of `train`, and the configuration after the preset, the short flags and the long ones."""
    if "--help" in args or "-h" in args:
        return _parse(Train, "train", args)
    sections = [a for a in args if a.startswith(("--model.", "--objective.", "--optim.", "--loader.", "--loop."))]
    if not sections and "--help-all" not in args:
        _suggest_section(args)
        options = _parse(Train, "train", args)
        return options, _configure(options)

    asked = "--help-all" in args
    first, rest = _split_sections([arg for arg in args if arg != "--help-all"])
    _suggest_section(first)
    options = _parse(Train, "train", first, Train((), Path("runs/stage1")) if asked else None)
    config = _configure(options)
    closing = "For every field of the configuration, run anytouch train --help-all"
    if asked:
        rest, closing = ["--help"], ""
    default = Sections(config.model, config.objective, config.optim, config.data, config.run)
    s = _parse(_told() if asked else Sections, "train [the options of --help]", rest, default, closing)
    return options, replace(config, model=s.model, objective=s.objective, optim=s.optim, data=s.loader, run=s.loop)


def _suggest_section(args: Sequence[str]) -> None:
    """Raise UserError for an option that only a section has, under the section's name (--optim.learning-rate)."""
    usual = set(get_type_hints(Train))
    homes = {name: home for home, kind in get_type_hints(Sections).items() for name in get_type_hints(kind)}
    for arg in args:
        name = arg.split("=")[0].removeprefix("--").replace("-", "_")
        if arg.startswith("--") and name in homes and name not in usual:
            raise UserError(f"there is no --{(spelled := name.replace('_', '-'))}; use --{homes[name]}.{spelled}")


def _told() -> type[Sections]:
    """`Sections`, of which --help shows what the docstring of each class says of its fields."""
    import tyro

    hints = get_type_hints(Sections)
    kinds = {name: Annotated[kind, tyro.conf.arg(help=inspect.cleandoc(kind.__doc__))] for name, kind in hints.items()}
    about = {"__doc__": Sections.__doc__}
    return make_dataclass("Sections", kinds.items(), bases=(Sections,), frozen=True, namespace=about)


def _split_sections(args: list[str]) -> tuple[list[str], list[str]]:
    """Cut argv in plain options and those of a section (--model.patch 16), each with the values that follow it."""
    plain: list[str] = []
    section: list[str] = []
    target = plain
    for arg in args:
        if arg.startswith("-") and not arg.lstrip("-").replace(".", "", 1).isdigit():
            target = section if "." in arg.split("=")[0] else plain
        target.append(arg)
    return plain, section


def _configure(options: Train) -> Config:
    """The preset and recipe of `options`, with its short flags in place."""
    config = preset(options.preset, stage=options.stage, recipe=options.recipe, towers=options.towers)
    data = replace(
        config.data,
        manifests=tuple(str(path) for path in options.data),
        on_bad_sample=options.on_bad_sample,
        batch_size=config.data.batch_size if options.batch is None else options.batch,
    )
    run = replace(
        config.run,
        seed=options.seed,
        steps=config.run.steps if options.steps is None else options.steps,
        save_every=config.run.save_every if options.save_every is None else options.save_every,
        tensorboard=options.tensorboard,
    )
    return baselines.apply(options.baseline, replace(config, data=data, run=run))
