"""What the subcommands of `anytouch` do, given their parsed options: one module a command, `run` in each.

Each `run` returns an exit status. Heavy imports wait until a command runs.
"""

from anytouch_jax.commands import convert, embed, parity, probe, train

__all__ = ["convert", "embed", "parity", "probe", "train"]
