"""A run and its user: the progress bar on a terminal, a line now and then elsewhere, and the signals that end a run."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

Log = Callable[[str], None]
_WORTH_TELLING = 0.05  # share of its time that a run may wait for data before the user hears of it


@dataclass(frozen=True)
class Bar:
    """Where the user sees the run: `say` a sentence, `advance` by one step with its line of metrics."""

    log: Log
    advance: Callable[[Mapping[str, Any]], None]


def to_stderr(sentence: str) -> None:
    """Say a sentence on the error stream, which keeps the output free for results."""
    sys.stderr.write(sentence + "\n")
    sys.stderr.flush()


def silent(sentence: str) -> None:
    """Say nothing."""


@contextlib.contextmanager
def progress(start: int, stop: int, log: Log) -> Iterator[Bar]:
    """A bar from step `start` to `stop` on a terminal, else some twenty lines through `say`."""
    if log is silent or not sys.stderr.isatty():
        every = max(1, (stop - start) // 20)

        def line(row: Mapping[str, Any]) -> None:
            done = row["step"] + 1
            if done == start + 1 or done == stop or (done - start) % every == 0:
                log(f"step {done}/{stop}  {summary(row)}")

        yield Bar(log, line)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("compiling", total=stop, completed=start)
        yield Bar(
            log,
            lambda row: bar.update(task, completed=row["step"] + 1, description=summary(row)),
        )


def summary(row: Mapping[str, Any]) -> str:
    """The few numbers of a line of metrics that a user watches."""
    loss = "not finite" if row["loss"] is None else f"{row['loss']:.4f}"
    skipped = f"  skipped {row['skipped_batches']}" if row["skipped_batches"] else ""
    replaced = row.get("skipped_samples", 0)
    skipped += f"  {replaced:.0f} samples could not be read and were replaced" if replaced else ""
    waits = f"  waits for data {row['wait_share']:.0%}" if row.get("wait_share", 0) >= _WORTH_TELLING else ""
    return f"loss {loss}  {row['samples_per_second']:.0f} samples/s{skipped}{waits}"


@contextlib.contextmanager
def signals() -> Iterator[list[signal.Signals]]:
    """A list that SIGTERM or Ctrl-C is put in instead of ending the process; a second Ctrl-C interrupts at once.

    The handlers of before are restored in the end. Outside the main thread, where Python has no handlers, it stays
    empty.
    """
    seen: list[signal.Signals] = []
    if threading.current_thread() is not threading.main_thread():
        yield seen
        return

    def note(number: int, frame: Any) -> None:
        seen.append(signal.Signals(number))
        if number == signal.SIGINT:
            signal.signal(signal.SIGINT, before[signal.SIGINT])

    before: dict[signal.Signals, Any] = {}
    try:
        for name in (signal.SIGTERM, signal.SIGINT):
            before[name] = signal.signal(name, note)
        yield seen
    finally:
        for name, handler in before.items():
            signal.signal(name, handler)


class Terminated(BaseException):
    """SIGTERM while no step is under way."""


@contextlib.contextmanager
def terminating() -> Iterator[None]:
    """Let SIGTERM raise `Terminated` while the block runs, so that it is left as after any error: nothing half written.

    Inside `signals` that one decides. The handler of before is restored in the end; outside the main thread, where
    Python has no handlers, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: Any) -> None:
        raise Terminated

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
