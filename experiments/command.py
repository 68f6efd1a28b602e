"""Command lines of the experiment scripts: options by tyro, a user's mistake as one sentence."""

from __future__ import annotations

import sys
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

from anytouch_jax.config.parsing import check
from anytouch_jax.errors import UserError


def run_script(options: type, run: Callable[[Any], int], args: Sequence[str] | None = None) -> int:
    """Parse `args`, or the command line, into `options` and call `run`.

    Return the exit status: that of `run`, 2 for a user's mistake (a number outside the range of its
    field, too) and 130 after Ctrl-C.
    """
    import tyro

    config: list[Any] = [tyro.conf.AvoidSubcommands, tyro.conf.PositionalRequiredArgs]

    def parsed() -> int:
        given = tyro.cli(options, args=args, description=options.__doc__, config=config)
        check(given, "--")
        return run(given)

    return with_status(parsed)


def runs_by_name(words: Sequence[str], known: Collection[str] = ()) -> dict[str, list[str]]:
    """Return encoders by the names that they have in a table, from NAME=PATH or NAME=A,B,C for one
    a seed.

    Raises UserError for a path that is not there, and for a name that is not `known`, if names are.
    """
    result = {name: paths.split(",") for name, _, paths in (word.partition("=") for word in words)}
    if wrong := sorted(name for name in result if known and name not in known):
        raise UserError(f"--runs names {', '.join(known)}, not {wrong[0]}.")
    every = [path for paths in result.values() for path in paths]
    if lost := [path or "without a path" for path in every if not path or not Path(path).exists()]:
        raise UserError(f"--runs NAME=PATH: there is no run {lost[0]}.")
    return result


def with_status(run: Callable[[], int]) -> int:
    """Return the exit status of `run`: its own, 2 for a user's mistake and 130 after Ctrl-C."""
    try:
        return run()
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted; the same command continues", file=sys.stderr)
        return 130
