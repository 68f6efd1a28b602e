"""Threads that fill batches: bounded work ahead, results in order, no thread left behind."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import islice
from typing import Generic, TypeVar

Batch = TypeVar("Batch")
Item = TypeVar("Item")
Result = TypeVar("Result")
_CHUNK = 4  # jobs per future: enough to hide the hand-over, few enough to stop soon
_AHEAD = 4  # items per thread that `bounded_map` works ahead


@dataclass
class BatchJobs(Generic[Batch]):
    """A batch to fill: each job writes its own slot and returns how many bad samples it skipped."""

    batch: Batch
    jobs: Sequence[Callable[[], int]]
    info: dict[str, int] = field(default_factory=dict)

    def finish(self, skipped: int) -> tuple[Batch, dict[str, int]]:
        """Return the filled batch and its info, which includes the number of skipped samples."""
        return self.batch, {"skipped_samples": skipped, **self.info}


def run_jobs(work: BatchJobs[Batch]) -> tuple[Batch, dict[str, int]]:
    """Fill one batch in this thread and return (batch, info)."""
    return work.finish(_run(work.jobs))


def prefetch_batches(
    plan: Callable[[int], BatchJobs[Batch]], steps: Iterable[int], threads: int, prefetch: int
) -> Iterator[tuple[int, Batch, dict[str, int]]]:
    """Yield (step, batch, info) of every step in order.

    The content does not depend on the threads, because each job writes its own slot. The first
    failing job raises in the caller. All threads have ended when the iterator ends.

    Args:
        plan: Returns the empty batch of a step and its jobs.
        steps: The steps.
        threads: That fill batches; 0 is the caller's own.
        prefetch: Batches that are filled ahead, at most.
    """
    if threads < 1:
        for step in steps:
            yield (step, *run_jobs(plan(step)))
        return
    executor = ThreadPoolExecutor(threads, thread_name_prefix="anytouch-data")

    def begin(step: int) -> tuple[int, BatchJobs[Batch], list[Future[int]]]:
        work = plan(step)
        chunks = [work.jobs[at : at + _CHUNK] for at in range(0, len(work.jobs), _CHUNK)]
        return step, work, [executor.submit(_run, chunk) for chunk in chunks]

    try:
        for step, work, futures in _ahead(map(begin, steps), prefetch):
            skipped = sum(future.result() for future in futures)
            yield (step, *work.finish(skipped))
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


def bounded_map(
    function: Callable[[Item], Result],
    items: Iterable[Item],
    threads: int,
    ahead: int | None = None,
) -> Generator[Result, None, None]:
    """Yield `function(item)` in order.

    The first error raises; all threads end.

    Args:
        function: What is done with each item.
        items: They are drawn as they are needed, so there may be any number.
        threads: 0 is the caller's own.
        ahead: Items that are worked on ahead, by default 4 a thread.
    """
    if threads < 1:
        yield from map(function, items)
        return
    executor = ThreadPoolExecutor(threads, thread_name_prefix="anytouch-files")
    futures = (executor.submit(function, item) for item in items)
    try:
        for future in _ahead(futures, ahead or _AHEAD * threads):
            yield future.result()
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


def _ahead(items: Iterator[Item], count: int) -> Iterator[Item]:
    """Yield `items` in order, with `count` of them drawn before they are needed."""
    queue = deque(islice(items, max(1, count)))
    while queue:
        first = queue.popleft()
        queue.extend(islice(items, 1))
        yield first


def _run(jobs: Sequence[Callable[[], int]]) -> int:
    return sum(job() for job in jobs)
