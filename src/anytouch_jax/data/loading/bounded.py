"""A map over many items by threads with bounded work ahead: results in order, nothing left behind."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


def bounded_map(
    function: Callable[[Item], Result], items: Iterable[Item], threads: int, ahead: int | None = None
) -> Generator[Result, None, None]:
    """`function` of every item, in order, by `threads` threads that are at most `ahead` (4 a thread) items ahead.

    The first error raises in the caller; when the iterator ends, fails or is closed, its threads have ended too.
    """
    if threads < 1:
        yield from map(function, items)
        return
    waiting: deque[Future[Result]] = deque()
    left = iter(items)
    executor = ThreadPoolExecutor(threads, thread_name_prefix="anytouch-files")
    try:
        for item in left:
            waiting.append(executor.submit(function, item))
            if len(waiting) >= (ahead or 4 * threads):
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        executor.shutdown(wait=True, cancel_futures=True)
