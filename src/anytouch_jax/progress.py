"""Progress bars with the time left, on a terminal."""

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import Any, TypeVar

Item = TypeVar("Item")
WAIT = 3.0  # seconds without a bar: shorter work shows none
_display: Any = None  # of the outermost bar that is open


@contextmanager
def bar(total: int | None, words: str) -> Iterator[Callable[[int], None]]:
    """Give a function for the number of items that are done.

    It moves a bar once the work has taken 3 s.

    `words` names the items. Nothing is shown where the error stream is no terminal. Without a
    `total` there is no time left. A bar inside another one is shown below it.
    """
    global _display
    if not sys.stderr.isatty():
        yield lambda done: None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    display = outer = _display
    if display is None:
        columns = (
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
        )
        display = _display = Progress(
            *columns, console=Console(stderr=True), redirect_stdout=sys.stdout.isatty()
        )
    begun = time.monotonic()
    task = display.add_task(words, total=total, visible=False)

    def advance(done: int | None = None) -> None:
        if is_long := time.monotonic() - begun >= WAIT:
            display.start()
        display.update(task, completed=done, visible=is_long)

    timer = threading.Timer(WAIT, advance)  # the first item may take long
    timer.daemon = True
    timer.start()
    try:
        yield advance
    finally:
        timer.cancel()
        timer.join()
        if outer is None:
            display.stop()
            _display = None
        else:
            display.remove_task(task)


def tracked(items: Iterable[Item], words: str, total: int | None = None) -> Iterator[Item]:
    """Yield items, and show how many are done and the time left, as `bar` does.

    `total` is the length of a sequence.
    """
    with bar(len(items) if isinstance(items, Sized) else total, words) as advance:
        for done, item in enumerate(items, 1):
            yield item
            advance(done)
