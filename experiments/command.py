"""Command lines of the experiment scripts: options by tyro, a user's mistake as one sentence."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from typing import Any

from anytouch_jax.errors import UserError


def run_script(options: type, run: Callable[[Any], int], args: Sequence[str] | None = None) -> int:
    """Parse `args`, or the command line, into `options` and call `run`.

    Return the exit status: that of `run`, 2 for a user's mistake and 130 after Ctrl-C.
    """
    import tyro

    config: list[Any] = [tyro.conf.AvoidSubcommands, tyro.conf.PositionalRequiredArgs]
    return with_status(lambda: run(tyro.cli(options, args=args, description=options.__doc__, config=config)))


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
