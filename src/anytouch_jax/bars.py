"""Progress bars with the time left, on a terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")
WAIT = 3.0  # seconds without a bar: shorter work shows none


@contextmanager
def bar(total: int | None, words: str) -> Iterator[Callable[[int], None]]:
    """Give a function for the number of items that are done. It moves a bar once the work has taken 3 s.

    `words` names the items. Nothing is shown where the error stream is no terminal. Without a `total` there is no time
    left.
    """
    if not sys.stderr.isatty():
        yield lambda done: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    progress, begun = Progress(*columns, console=Console(stderr=True)), time.monotonic()
    task = progress.add_task(words, total=total)

    def advance(done: int) -> None:
        if not progress.live.is_started and time.monotonic() - begun >= WAIT:
            progress.start()
        progress.update(task, completed=done)

    try:
        yield advance
    finally:
        progress.stop()


def tracked(items: Iterable[Item], total: int | None, words: str) -> Iterator[Item]:
    """Yield items, and show how many are done and the time left, as `bar` does."""
    with bar(total, words) as advance:
        for done, item in enumerate(items, 1):
            yield item
            advance(done)
