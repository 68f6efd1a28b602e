"""Progress of a run on a terminal or in a log, and the signals that end it."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

Log = Callable[[str], None]
_WAIT_SHARE = 0.05  # a run that waits for data longer than this share of its time reports it


def to_stderr(sentence: str) -> None:
    """Write a sentence to the error stream, which keeps the output free for results."""
    sys.stderr.write(sentence + "\n")
    sys.stderr.flush()


def silent(sentence: str) -> None:
    """Drop a sentence."""


@contextlib.contextmanager
def progress(start: int, stop: int, log: Log, *, curve: bool = False) -> Iterator[Callable[[Mapping[str, Any]], None]]:
    """Give a function for the metrics of each step. It moves a bar on a terminal, else logs about twenty lines.

    With `curve` a terminal also shows the loss of all steps so far.
    """
    if log is silent or not sys.stderr.isatty():
        every = max(1, (stop - start) // 20)

        def line(row: Mapping[str, Any]) -> None:
            done = row["step"] + 1
            if done == start + 1 or done == stop or (done - start) % every == 0:
                log(f"step {done}/{stop}  {summary(row)}")

        yield line
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
    from rich.text import Text

    losses: list[float] = []

    class Bar(Progress):
        """A bar below the curve of the loss."""

        def get_renderables(self) -> Iterator[Any]:
            if curve and losses:
                yield Text(chart(losses))
            yield self.make_tasks_table(self.tasks)

    def advance(row: Mapping[str, Any]) -> None:
        losses.extend(() if row["loss"] is None else (row["loss"],))
        bar.update(task, completed=row["step"] + 1, description=summary(row))

    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Bar(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("compiling", total=stop, completed=start)
        yield advance


def chart(losses: Sequence[float], width: int = 64, height: int = 8) -> str:
    """Draw losses as text: a column is the mean of equally many steps. The scale is written on the left."""
    columns = [float(part.mean()) for part in np.array_split(np.asarray(losses), min(width, len(losses)))]
    low, high = min(columns), max(columns)
    eighths = [1 + round((8 * height - 1) * (value - low) / ((high - low) or 1.0)) for value in columns]
    lines = []
    for line in reversed(range(height)):
        mark = {height - 1: f"{high:9.4f} ", 0: f"{low:9.4f} "}.get(line, " " * 10)
        lines.append(mark + "".join(" ▁▂▃▄▅▆▇█"[min(8, max(0, full - 8 * line))] for full in eighths))
    return "\n".join(lines)


def summary(row: Mapping[str, Any]) -> str:
    """Return the loss, the speed and the problems of a line of metrics."""
    loss = "not finite" if row["loss"] is None else f"{row['loss']:.4f}"
    skipped = f"  skipped {row['skipped_batches']}" if row["skipped_batches"] else ""
    replaced = row.get("skipped_samples", 0)
    skipped += f"  {replaced:.0f} samples could not be read and were replaced" if replaced else ""
    waits = f"  waits for data {row['wait_share']:.0%}" if row.get("wait_share", 0) >= _WAIT_SHARE else ""
    return f"loss {loss}  {row['samples_per_second']:.0f} samples/s{skipped}{waits}"


@contextlib.contextmanager
def _handled(handler: Callable[[int, Any], None], *names: signal.Signals) -> Iterator[None]:
    """Let signals call `handler` while the block runs. Outside the main thread Python has no handlers."""
    before: dict[signal.Signals, Any] = {}
    try:
        for name in names if threading.current_thread() is threading.main_thread() else ():
            before[name] = signal.signal(name, handler)
        yield
    finally:
        for name, earlier in before.items():
            signal.signal(name, earlier)


@contextlib.contextmanager
def signals() -> Iterator[list[signal.Signals]]:
    """Yield a list that collects SIGTERM and Ctrl-C, which then do not end the process. A second Ctrl-C does."""
    received: list[signal.Signals] = []

    def note(number: int, frame: Any) -> None:
        received.append(signal.Signals(number))
        if number == signal.SIGINT:
            signal.signal(signal.SIGINT, earlier)

    earlier = signal.getsignal(signal.SIGINT)
    with _handled(note, signal.SIGTERM, signal.SIGINT):
        yield received


class Terminated(BaseException):
    """SIGTERM outside a training step."""


@contextlib.contextmanager
def terminating() -> Iterator[None]:
    """Let SIGTERM raise `Terminated` while the block runs, so that it cleans up. `signals` takes over inside it."""

    def end(number: int, frame: Any) -> None:
        raise Terminated

    with _handled(end, signal.SIGTERM):
        yield
