"""What the subcommands of `anytouch` do, given their parsed options: one module a command, `run` in each.

Each `run` returns an exit status. Heavy imports wait until a command runs.
"""

from anytouch_jax.commands import (
    annotate,
    bench,
    contact,
    convert,
    embed,
    index,
    pack,
    parity,
    probe,
    report,
    retrieve,
    simulate,
    train,
    verify,
)

__all__ = [
    "annotate",
    "bench",
    "contact",
    "convert",
    "embed",
    "index",
    "pack",
    "parity",
    "probe",
    "report",
    "retrieve",
    "simulate",
    "train",
    "verify",
]
