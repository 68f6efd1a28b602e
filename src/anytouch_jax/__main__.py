"""`python -m anytouch_jax`: the `anytouch` command."""

import sys


def run_command() -> int:
    """Run the command. A Ctrl-C that comes while its parts are imported is no fault either."""
    try:
        from anytouch_jax.cli.app import console
    except KeyboardInterrupt:
        sys.stderr.write("interrupted\n")
        return 130
    return console()


if __name__ == "__main__":
    sys.exit(run_command())
