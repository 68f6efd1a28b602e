"""Progress bars with the time left, on a terminal."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:  # rich takes 0.1 s to import, and short work shows no bar
    from rich.progress import Progress

Item = TypeVar("Item")
WAIT = 3.0  # seconds without a bar: shorter work shows none
# Of the outermost bar that is open. rich allows one live display, so an inner bar joins it.
_display: Progress | None = None


@contextmanager
def bar(total: int | None, words: str) -> Iterator[Callable[..., None]]:
    """Give a function for the number of items that are done, which moves a bar.

    It may be given other words, too, such as a score.

    The bar appears once the work has taken WAIT seconds. Nothing is shown where the error stream
    is no terminal. A bar inside another one is shown below it.

    Args:
        total: Number of items, None if it is unknown. Then no time left is shown.
        words: Names the items, as in "frames written".
    """
    global _display
    if not sys.stderr.isatty():
        yield lambda done, words=None: None
        return
    outer = _display
    display = _new_display() if outer is None else outer
    _display = display
    begun = time.monotonic()
    task = display.add_task(words, total=total, visible=False)

    def advance(done: int | None = None, words: str | None = None) -> None:
        is_long = time.monotonic() - begun >= WAIT
        if is_long:
            display.start()
        display.update(task, completed=done, description=words, visible=is_long)

    # The first item alone may take longer than WAIT.
    timer = threading.Timer(WAIT, advance)
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


def _new_display() -> Progress:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        # Lines that are printed meanwhile go above the bar, unless they go to a file.
        redirect_stdout=sys.stdout.isatty(),
    )


def tracked(items: Iterable[Item], words: str, total: int | None = None) -> Iterator[Item]:
    """Yield items, and show how many are done and the time left, as `bar` does.

    Args:
        items: What to go through.
        words: Names the items.
        total: Their number, for items without a length.
    """
    if isinstance(items, Sized):
        total = len(items)
    with bar(total, words) as advance:
        for done, item in enumerate(items, 1):
            yield item
            advance(done)
