"""Threads that fill batches: bounded work ahead, results in order, nothing left behind."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Generic, TypeVar

Batch = TypeVar("Batch")
Item = TypeVar("Item")
Result = TypeVar("Result")
_CHUNK = 4  # jobs handed over at once: long enough to hide the hand-over, short enough to stop soon


@dataclass
class Work(Generic[Batch]):
    """A batch to be filled: every job writes its own slot and gives back how many bad samples it skipped."""

    batch: Batch
    jobs: Sequence[Callable[[], int]]
    info: dict[str, int] = field(default_factory=dict)

    def finish(self, skipped: int) -> tuple[Batch, dict[str, int]]:
        """The filled batch and its info, the count of skipped samples in it."""
        return self.batch, {"skipped_samples": skipped, **self.info}


def do(work: Work[Batch]) -> tuple[Batch, dict[str, int]]:
    """Fill one batch in this thread: (batch, info)."""
    return work.finish(_run(work.jobs))


def pump(
    plan: Callable[[int], Work[Batch]], steps: Iterable[int], threads: int, prefetch: int
) -> Iterator[tuple[int, Batch, dict[str, int]]]:
    """(step, batch, info) of every step in order, filled by `threads` threads, at most `prefetch` batches ahead.

    What is written does not depend on the number of threads; 0 threads work in the caller. The first failing job of a
    step raises in the caller. When the iterator ends, fails or is closed, its threads have ended too.
    """
    if threads < 1:
        for step in steps:
            yield (step, *do(plan(step)))
        return
    ahead: deque[tuple[int, Work[Batch], list[Future[int]]]] = deque()
    left = iter(steps)
    executor = ThreadPoolExecutor(threads, thread_name_prefix="anytouch-data")

    def fill() -> None:
        while len(ahead) < max(1, prefetch) and (step := next(left, None)) is not None:
            work = plan(step)
            chunks = [work.jobs[at : at + _CHUNK] for at in range(0, len(work.jobs), _CHUNK)]
            ahead.append((step, work, [executor.submit(_run, chunk) for chunk in chunks]))

    try:
        fill()
        while ahead:
            step, work, futures = ahead.popleft()
            fill()
            yield (step, *work.finish(sum(future.result() for future in futures)))
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


def _run(jobs: Sequence[Callable[[], int]]) -> int:
    return sum(job() for job in jobs)


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
