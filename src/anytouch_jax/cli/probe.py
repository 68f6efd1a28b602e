"""`anytouch probe`: heads on frozen features, for a label, for tasks of the battery, or as a public benchmark."""

from __future__ import annotations

from typing import Any

from rich.console import Console
from rich.markdown import Markdown

from anytouch_jax.cli.options import Probe
from anytouch_jax.cli.output import check_apart, check_folder, check_home
from anytouch_jax.cli.unused import refuse
from anytouch_jax.cli.words import log
from anytouch_jax.config.parsing import COUNT, NOT_NEGATIVE, in_range
from anytouch_jax.errors import UserError

_OF_LABEL = ("label", "group", "leave_out", "where", "sensor", "save")
_OF_SPLITS = ("group", "seeds", "protocol", "save")  # of a label; --leave-out has folds instead
_OF_BATTERY = (
    "join", "heads", "order", "train_sensors", "test_sensors", "train_units", "test_units", "max_rows", "cache",
)  # fmt: skip
_SIDES = ("train_sensors", "test_sensors", "train_units", "test_units")
_OF_TASKS = ("frames", "pooling", "join", "heads", "protocol")  # a benchmark has the authors'


def run(options: Probe) -> int:
    """Probe frozen features on a label column or on tasks, print a table, write JSON when asked."""
    from anytouch_jax.train.mesh import enable_compilation_cache

    check_options(options)
    if options.out is not None:
        own = (run / name for run in options.run for name in ("config.json", "metrics.jsonl", "tokenizer.json"))
        check_folder(options.out, read=(*options.data, *options.run, *options.features, *own))
    if options.save is not None:
        check_folder(options.save, "--save", read=(*options.data, *options.run, *options.features))
        if options.save.suffix.lower() != ".npz":
            raise UserError(f"{options.save}: a head is written as .npz; name such a file with --save")
    check_apart(out=options.out, save=options.save)
    if options.cache is not None:
        check_home(options.cache, "--cache")
    enable_compilation_cache()
    from anytouch_jax.evaluate import probing
    from anytouch_jax.evaluate.probe_results import probe_table, task_table

    shared: dict[str, Any] = {name: getattr(options, name) for name in ("features", "seeds", "controls", "out")}
    sides = {name: _names(getattr(options, name)) for name in _SIDES} | {"max_rows": options.max_rows}
    if options.tasks and options.benchmark:
        raise UserError("give --benchmark, which has its own settings, or --tasks, not both")
    if options.benchmark:
        shared |= sides | {"cache": options.cache, "log": log}
        table = task_table(probing.probe_benchmark(options.run, options.data, options.benchmark, **shared))
    elif options.tasks:
        names: tuple[str, ...] = ("protocol", "frames", "pooling", "join", "order", "cache")
        shared |= sides | {name: getattr(options, name) for name in names} | {"log": log}
        tasks = "all" if options.tasks == "all" else _names(options.tasks)
        heads = _names(options.heads)
        table = task_table(probing.probe_tasks(options.run, options.data, tasks, heads=heads, **shared))
    else:
        names = ("group", "leave_out", "where", "sensor", "pooling", "protocol", "save")
        shared |= {name: getattr(options, name) for name in names} | {"frames": options.frames or 1, "log": log}
        table = probe_table(probing.probe_label(options.run, options.data, options.label, **shared))
    Console().print(Markdown(table)) if Console().is_terminal else print(table)
    return 0


def _names(text: str) -> Any:
    return tuple(name.strip() for name in text.split(",") if name.strip())


def check_options(options: Probe) -> None:
    """Refuse what differs from its default and would do nothing. Raises UserError that names it and says why."""
    in_range("--", options, frames=COUNT, max_rows=COUNT, seeds=NOT_NEGATIVE)
    if options.save is not None and len(options.run) != 1:
        raise UserError(f"--save keeps the linear head of one encoder: give one --run, not {len(options.run)}")
    if options.tasks or options.benchmark:
        refuse(options, _OF_LABEL, "beside --tasks or --benchmark, which have labels and groups of their own")
        if options.frames == 1 or (options.benchmark and not options.tasks):
            refuse(options, ("order",), "for stills")
        if options.benchmark and not options.tasks:
            refuse(options, _OF_TASKS, "beside --benchmark, which has the authors' settings")
        elif options.frames is None:
            refuse(options, ("join",), "without --frames: tasks are of stills and of single segments")
        return
    refuse(options, _OF_BATTERY, "without --tasks or --benchmark", "; or name tasks: --tasks all")
    if options.leave_out is not None:
        refuse(options, _OF_SPLITS, "beside --leave-out, which groups by its own column and needs no split")
