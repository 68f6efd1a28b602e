"""`anytouch probe`: linear and kNN probes of frozen features."""

from __future__ import annotations

from rich.console import Console
from rich.markdown import Markdown

from anytouch_jax.commands.words import say
from anytouch_jax.options import Probe


def run(options: Probe) -> int:
    """Probe frozen features on a label column, print a table, write JSON when asked."""
    from anytouch_jax.evaluate import results
    from anytouch_jax.evaluate.probe_command import run_probes

    found = run_probes(options, say)
    Console().print(Markdown(results.to_table(found))) if Console().is_terminal else print(results.to_table(found))
    if options.out is not None:
        from anytouch_jax.train.record import write_atomic

        options.out.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(options.out, results.to_json(found))
    return 0
