"""The `anytouch` command: its subcommands, its help and its exit statuses.

0 is success, 1 a failed check, 2 a user's mistake, 130 Ctrl-C and 141 a closed pipe.
"""

from __future__ import annotations

import errno
import inspect
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from difflib import get_close_matches
from functools import partial
from typing import Any, NamedTuple

from anytouch_jax import __version__
from anytouch_jax.cli import (
    data,
    embed,
    export,
    info,
    measure,
    probe,
    retrieve,
    sensor,
    stream,
    train,
)
from anytouch_jax.cli.arguments import RENAMED, parse_options
from anytouch_jax.errors import CheckError, UserError, shorten


class Command(NamedTuple):
    """A subcommand: the record of its options, what it runs, and how its arguments are parsed."""

    options: type
    run: Callable[[Any], int]
    parse: Callable[..., Any] = parse_options

    @property
    def summary(self) -> str:
        """The first line of its help."""
        return (inspect.getdoc(self.options) or "").splitlines()[0]


GROUPS = {
    "data": "Prepare a manifest of tactile frames.",
    "sensor": "Simulate your own sensor.",
    "probe": "Probe frozen features with simple heads.",
}
COMMANDS = {
    "data simulate": Command(data.SimulateOptions, data.run_simulate),
    "data index": Command(data.DatasetOptions, data.run_index),
    "data contact": Command(data.ContactOptions, data.run_contact),
    "data verify": Command(data.VerifyOptions, data.run_verify),
    "data annotate": Command(data.AnnotateOptions, data.run_annotate),
    "data pack": Command(data.PackOptions, data.run_pack),
    "train": Command(train.TrainOptions, train.run, train.parse),
    "embed": Command(embed.EmbedOptions, embed.run),
    "measure": Command(measure.MeasureOptions, measure.run),
    "stream": Command(stream.StreamOptions, stream.run_stream),
    "probe label": Command(probe.LabelOptions, probe.run_label),
    "probe tasks": Command(probe.TasksOptions, probe.run_tasks),
    "probe benchmark": Command(probe.BenchmarkOptions, probe.run_benchmark),
    "retrieve": Command(retrieve.RetrieveOptions, retrieve.run_retrieve),
    "sensor fit": Command(sensor.FitOptions, sensor.run_fit),
    "report": Command(retrieve.ReportOptions, retrieve.run_report),
    "adapt": Command(sensor.AdaptOptions, sensor.run_adapt),
    "export": Command(export.ExportOptions, export.run),
    "info": Command(info.InfoOptions, info.run),
    "view": Command(stream.ViewOptions, stream.run_view),
}


def console() -> int:
    """Run the `anytouch` command.

    This silences XLA's C++ log: jaxlib 0.10.1 logs a spurious error for each program that it reads
    from the cache. Set TF_CPP_MIN_LOG_LEVEL to see it.
    """
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    return main()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    return guarded("anytouch", lambda: _main(argv))


def _main(argv: Sequence[str] | None) -> int:
    args = list(sys.argv[1:] if argv is None else argv)
    if args[:1] == ["--version"]:
        print(__version__)
        return 0
    group = args[0] if args and args[0] in GROUPS else ""
    words = args[1:] if group else args
    if not words or words[0] in ("-h", "--help"):
        print(_usage(group))
        if words:
            return 0
        return 2
    name = f"{group} {words[0]}".strip()
    if name not in COMMANDS:
        print(_unknown(name, group), file=sys.stderr)
        return 2
    command = COMMANDS[name]
    return guarded(
        f"anytouch {name}", lambda: command.run(command.parse(command.options, name, words[1:]))
    )


def guarded(program: str, run: Callable[[], int]) -> int:
    """Call `run` and return its exit status.

    `program` begins the sentence of an error; a bug keeps its traceback.
    """
    status = 2
    try:
        with warnings.catch_warnings():
            warnings.showwarning = partial(_show_warning, warnings.showwarning)
            try:
                status = run()
            except Exception as error:
                if missing := _missing_devices():
                    raise missing from error
                raise
        sys.stdout.flush()
        return status
    except SystemExit as stop:  # the parser's, after --help or a usage error
        if isinstance(stop.code, int):
            return stop.code
        return int(stop.code is not None)
    except UserError as error:
        sentence = str(error)
        status = 1 if isinstance(error, CheckError) else 2
    except BrokenPipeError:  # the reader of our output closed it (| head)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except OSError as error:
        advice = ". Free some space." if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
        sentence = f"{error.filename or 'a file'}: {error.strerror or error}{advice}"
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(
            error
        ):  # XLA's is a RuntimeError
            raise
        less = "Use a smaller --batch, --size, --gallery or --preset, or --model.remat in training."
        sentence = f"there is not enough memory. {less}"
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    print(f"{program}: {shorten(sentence)}", file=sys.stderr)
    return status


def _missing_devices() -> UserError | None:
    """Return the error of a JAX_PLATFORMS that jax cannot use, which it raises as one of many
    types; None otherwise.
    """
    platforms = os.environ.get("JAX_PLATFORMS", "")
    jax = sys.modules.get("jax")
    if platforms in ("", "cpu") or jax is None:
        return None
    try:
        jax.devices()
    except Exception:
        return UserError(
            f"JAX_PLATFORMS is {platforms!r}, which jax cannot use here: unset it, or install jax "
            "for it"
        )
    return None


def _show_warning(
    default: Callable[..., None], message: Warning | str, category: type[Warning], *where: Any
) -> None:
    """Print a UserWarning of the library as a sentence, without the line of code that Python
    shows.
    """
    if category is UserWarning:
        print(shorten(str(message)), file=sys.stderr)
    else:
        default(message, category, *where)


def _usage(group: str = "") -> str:
    """Return the help that lists the commands of a group, or all of them."""
    shown = {
        name: command
        for name, command in COMMANDS.items()
        if not group or name.startswith(f"{group} ")
    }
    width = max(map(len, shown))
    lines = "\n".join(f"  {name:{width}}  {command.summary}" for name, command in shown.items())
    about = GROUPS.get(group, "One representation of touch for many camera-based tactile sensors.")
    example = next(iter(shown)) if group else "embed"
    return f"""usage: anytouch {group + " " if group else ""}COMMAND [options]

{about}

{lines}

Example: anytouch {example} --help

Every command explains its options and gives an example with --help."""


def _unknown(name: str, group: str) -> str:
    """Return the sentence that answers a command that does not exist."""
    if name in RENAMED:
        return f"anytouch: {name} has a new name: use {RENAMED[name]}."
    if group and name.partition(" ")[2].startswith("-"):
        choices = " or ".join(one for one in COMMANDS if one.startswith(f"{group} "))
        return f"anytouch: {group} needs a subcommand: {choices}."
    near = get_close_matches(name, [*COMMANDS, *GROUPS], 1)
    hint = f" Did you mean {near[0]}?" if near else ""
    return f"anytouch: there is no command {name!r}.{hint} See anytouch --help."
