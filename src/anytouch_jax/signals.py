"""Signals: handlers for the time of a block, and the exception that SIGTERM becomes."""

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

Handler = Callable[[int, FrameType | None], Any]


class Terminated(BaseException):
    """SIGTERM outside a training step.

    It is no Exception, so that `except Exception` around a sample or a file does not swallow it.
    """


@contextlib.contextmanager
def handled(handler: Handler, *names: signal.Signals) -> Iterator[None]:
    """Let signals call `handler` while the block runs, and restore the earlier handlers after it.

    Python sets handlers in the main thread only. In another one the block runs without.
    """
    before: dict[signal.Signals, Any] = {}
    is_main = threading.current_thread() is threading.main_thread()
    try:
        if is_main:
            for name in names:
                before[name] = signal.signal(name, handler)
        yield
    finally:
        for name, earlier in before.items():
            signal.signal(name, earlier)
