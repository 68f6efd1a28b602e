"""Judging of hostile inputs: a command must answer each with a sentence, soon, in little memory, and never wrongly."""

from __future__ import annotations

import faulthandler
import os
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from anytouch_jax.cli.app import guarded, main

SECONDS = 60  # of one command
MEMORY = 1 << 30  # bytes that a command may take more
_LIMIT = 6 << 30  # bytes of address space that it gets, so that a bomb hurts nobody
_TICK = 2  # seconds from one look at a command to the next
LETTERS, LINES = 600, 60  # of one line of a message, of a message
_ANSWERS = {0, 1, 2}
# How `info` and `contact` report what they could not use, with status 0.
_DAMAGE = re.compile("cannot be used|cannot embed|cannot be read|frames can be read|is damaged")
_RULE = re.compile(r"[-|: ]*[╭╰─╮╯│]")  # the option parser draws boxes


class Case(NamedTuple):
    """A hostile input: what was done, the command that reads it, and whether its status may be 0.

    `words` is an argv, or a function to call as a command does. `check` returns what is wrong with an accepted input.
    """

    name: str
    words: tuple[object, ...] | Callable[[], int]
    corrupt: bool = False
    check: Callable[[Outcome], str | None] | None = None


class Outcome(NamedTuple):
    """What a command did. `status` is None after a hang; `trace` is a traceback or ""."""

    status: int | None
    out: str
    err: str
    trace: str
    seconds: float
    memory: int


Make = Callable[[np.random.Generator, Path, Any], Case]


class _HangError(BaseException):
    """A command that takes longer than `SECONDS`."""


def total() -> int:
    """The number of inputs of all kinds in a long run."""
    return int(os.environ.get("FUZZ_INPUTS", 5000))


def try_all(make: Make, count: int, folder: Path, things: Any) -> list[str]:
    """Try `count` inputs of a kind and return a line for each fault; FUZZ_FIRST is the number of the first input."""
    first, lines = int(os.environ.get("FUZZ_FIRST", 0)), []
    for number in range(first, first + count):
        place = folder / str(number)
        place.mkdir()
        case = make(generator(make, number), place, things)
        found = faults(case)
        if found:
            words = case.words if callable(case.words) else " ".join(str(word)[:150] for word in case.words)
            lines += [f"{number} ({case.name}): {fault}\n    {words}" for fault in found]
            for line in lines[-len(found) :]:
                print(line, flush=True)
        shutil.rmtree(place, ignore_errors=True)
    return lines


def generator(make: Make, number: int) -> np.random.Generator:
    """The random numbers of one input, which are its own: input 7 is the same in a run of 10 and of 1000."""
    return np.random.default_rng([zlib.crc32(make.__module__.rpartition(".")[2].encode()), number])


def faults(case: Case) -> list[str]:
    """Run the command of a case and return its faults."""
    done = run(case.words)
    found = []
    if done.status is None:
        found.append(f"no answer within {SECONDS} s")
    if done.trace or "Traceback (most recent" in done.err:
        found.append("traceback: " + " / ".join((done.trace or done.err).strip().splitlines()[-5:]))
    elif done.status is not None and done.status not in _ANSWERS:
        found.append(f"status {done.status}")
    if done.memory > MEMORY:
        found.append(f"{done.memory >> 20} MB of memory")
    if "not enough memory" in done.err:
        found.append("it asked for more memory than there is")
    lines = [line for text in (done.err, done.out) for line in text.splitlines() if not _RULE.match(line)]
    long = [line for line in lines if len(line) > LETTERS]
    if long:
        found.append(f"a line of {len(long[0])} letters: {long[0][:160]}")
    if len(lines) > LINES:
        found.append(f"{len(lines)} lines: {lines[-1][:160]}")
    if done.status == 2 and not done.err.strip():
        found.append("status 2 without a sentence")
    if done.status == 0 and case.corrupt and not _DAMAGE.search(done.out):
        found.append("accepted: " + (done.out.strip().splitlines() or [""])[-1][:160])
    if done.status == 0 and not case.corrupt and case.check is not None and (wrong := case.check(done)):
        found.append(wrong)
    return found


def run(words: tuple[object, ...] | Callable[[], int]) -> Outcome:
    """Run a command in this process as `anytouch` does, with its output caught at the level of file descriptors."""
    status, trace, start = None, "", time.monotonic()
    before = _memory("VmRSS")
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")  # forget the largest memory so far
    with _caught() as texts, warnings.catch_warnings(), _bounded():
        warnings.simplefilter("default")  # as in a command; pytest makes errors of warnings
        try:
            status = guarded("anytouch", words) if callable(words) else main([str(word) for word in words])
        except _HangError:
            pass
        except BaseException as error:
            status, trace = -1, "".join(traceback.format_exception(error))
    return Outcome(status, *texts, trace, time.monotonic() - start, max(0, _memory("VmHWM") - before))


def _memory(name: str) -> int:
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))
    return int(line.split()[1]) << 10


def _waits() -> dict[str, float]:
    """Return the seconds that each thread has waited for a processor."""
    waits = {}
    for file in Path("/proc/self/task").glob("*/schedstat"):
        with suppress(OSError, ValueError, IndexError):
            waits[file.parent.name] = int(file.read_text().split()[1]) / 1e9
    return waits


@contextmanager
def _bounded() -> Iterator[None]:
    """Raise `_HangError` after `SECONDS`, end the process long after that, and limit its memory."""

    start, waited, before_tick = time.monotonic(), 0.0, _waits()

    def stop(*_: Any) -> None:
        nonlocal waited, before_tick
        waits = _waits()  # a busy machine is no fault of the command, nor of the threads that it starts one by one
        waited += max((wait - before_tick.get(thread, 0.0) for thread, wait in waits.items()), default=0.0)
        before_tick = waits
        if time.monotonic() - start - waited >= SECONDS:
            raise _HangError

    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_memory("VmSize") + _LIMIT, before[1]))
    handler = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, _TICK, _TICK)
    faulthandler.dump_traceback_later(20 * SECONDS, exit=True, file=sys.__stderr__)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        faulthandler.cancel_dump_traceback_later()
        signal.signal(signal.SIGALRM, handler)
        resource.setrlimit(resource.RLIMIT_AS, before)


@contextmanager
def _caught() -> Iterator[list[str]]:
    """Give a list that gets what was written to descriptors 1 and 2 and to `sys.stdout` and `sys.stderr`."""
    texts: list[str] = []
    streams, copies = (sys.stdout, sys.stderr), (os.dup(1), os.dup(2))
    files = [tempfile.TemporaryFile("w+b") for _ in streams]  # noqa: SIM115
    try:
        for number, file in enumerate(files, 1):
            os.dup2(file.fileno(), number)
        sys.stdout, sys.stderr = (open(n, "w", encoding="utf-8", buffering=1, closefd=False) for n in (1, 2))  # noqa: SIM115
        yield texts
    finally:
        for stream in (sys.stdout, sys.stderr):
            with suppress(ValueError, OSError):
                stream.flush()
        sys.stdout, sys.stderr = streams
        for number, (copy, file) in enumerate(zip(copies, files, strict=True), 1):
            os.dup2(copy, number)
            os.close(copy)
            file.seek(0)
            texts.append(file.read(1 << 24).decode("utf-8", "replace"))
            file.close()


def pick(rng: np.random.Generator, choices: Any) -> Any:
    """One of the choices, which may be words with commas between them."""
    choices = choices.split(", ") if isinstance(choices, str) else list(choices)
    return choices[int(rng.integers(len(choices)))]


def flipped(rng: np.random.Generator, data: bytes, start: int = 0, stop: int | None = None, count: int = 1) -> bytes:
    """The same bytes, of which `count` between `start` and `stop` differ."""
    changed = bytearray(data)
    for at in rng.integers(start, len(data) if stop is None else stop, count):
        changed[at] ^= int(rng.integers(1, 256))
    return bytes(changed)


def cut(rng: np.random.Generator, data: bytes, start: int = 0, keep: int = 1) -> bytes:
    """The first bytes, at least `start` of them and without the last `keep`."""
    return data[: int(rng.integers(start, max(start + 1, len(data) - keep)))]
