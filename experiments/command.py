"""Run an experiment's script from the shell: options by tyro, a user's mistake as one sentence."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import tyro

from anytouch_jax.errors import UserError


def main(options: type, run: Callable[[Any], int], *, positional: bool = False) -> int:
    """Parse the command line into `options` and call `run`. Returns the exit status, 1 for a user's mistake."""
    config: list[Any] = [tyro.conf.AvoidSubcommands]
    if positional:
        config.append(tyro.conf.PositionalRequiredArgs)
    try:
        return run(tyro.cli(options, config=config))
    except UserError as error:
        print(error, file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
