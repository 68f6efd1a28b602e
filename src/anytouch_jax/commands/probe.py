"""`anytouch probe`: heads on frozen features, for a label, for tasks of the battery, or as a public benchmark."""

from __future__ import annotations

from rich.console import Console
from rich.markdown import Markdown

from anytouch_jax.commands.words import say
from anytouch_jax.options import Probe


def run(options: Probe) -> int:
    """Probe frozen features on a label column or on tasks, print a table, write JSON when asked."""
    if options.tasks or options.benchmark:
        from anytouch_jax.evaluate import battery_command

        battery = battery_command.run_battery(options, say)
        table, record = battery_command.to_table(battery), battery_command.to_json(battery)
    else:
        from anytouch_jax.evaluate import results
        from anytouch_jax.evaluate.probe_command import run_probes

        found = run_probes(options, say)
        table, record = results.to_table(found), results.to_json(found)
    Console().print(Markdown(table)) if Console().is_terminal else print(table)
    if options.out is not None:
        from anytouch_jax.train.record import write_atomic

        options.out.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(options.out, record)
    return 0
