"""What the subcommands of `anytouch` do, given their parsed options: one module a command, `run` in each.

Each `run` returns an exit status. Heavy imports wait until a command runs.
"""

from anytouch_jax.commands import (  # noqa: F401
    adapt,
    annotate,
    bench,
    contact,
    convert,
    embed,
    export,
    index,
    info,
    pack,
    parity,
    pour,
    probe,
    report,
    retrieve,
    simulate,
    train,
    translate,
    verify,
)
