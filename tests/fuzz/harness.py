"""Judging of hostile inputs: a command must answer each with a sentence, soon, in little memory,
and never wrongly.
"""

from __future__ import annotations

import faulthandler
import os
import re
import resource
import shutil
import signal
import sys
import time
import traceback
import warnings
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from anytouch_jax.cli.app import guarded, main

SECONDS = 60  # of one command
MEMORY = 1 << 30  # bytes that a command may take more
_LIMIT = 6 << 30  # bytes of address space that it gets, so that a bomb hurts nobody
_TICK = 2  # seconds from one look at a command to the next
# of one line of a message, of a message
LETTERS = 600
LINES = 60
# How `info` and `contact` report what they could not use, with status 0.
_DAMAGE = re.compile("cannot be used|cannot embed|cannot be read|frames can be read|is damaged")
_RULE = re.compile(r"[-|: ]*[╭╰─╮╯│]")  # the option parser draws boxes


class Case(NamedTuple):
    """A hostile input: what was done, the command that reads it, and whether its status may be 0.

    `words` is an argv, or a function to call as a command does. `check` returns what is wrong with
    an accepted input.
    """

    name: str
    words: tuple[object, ...] | Callable[[], int]
    corrupt: bool = False
    check: Callable[[], str | None] | None = None


Make = Callable[[np.random.Generator, Path, Any], Case]


class _HangError(BaseException):
    """A command that takes longer than `SECONDS`."""


def try_all(kind: str, make: Make, count: int, folder: Path, things: Any, capfd: Any) -> list[str]:
    """Try `count` inputs of a kind and return a line for each fault; FUZZ_FIRST is the number of
    the first input.

    Each input has its own random numbers: input 7 is the same in a run of 10 and of 1000.
    """
    first = int(os.environ.get("FUZZ_FIRST", 0))
    lines = []
    for number in range(first, first + count):
        place = folder / str(number)
        place.mkdir()
        case = make(
            np.random.default_rng([zlib.crc32(f"test_{kind}".encode()), number]), place, things
        )
        if found := faults(case, capfd):
            words = (
                case.words
                if callable(case.words)
                else " ".join(str(word)[:150] for word in case.words)
            )
            lines += [f"{number} ({case.name}): {fault}\n    {words}" for fault in found]
        shutil.rmtree(place, ignore_errors=True)
    return lines


def faults(case: Case, capfd: pytest.CaptureFixture[str]) -> list[str]:
    """Run the command of a case in this process, as `anytouch` does, and return its faults."""
    status = None
    trace = ""
    before = _memory("VmRSS")
    capfd.readouterr()
    with suppress(OSError):
        # forget the largest memory so far
        Path("/proc/self/clear_refs").write_text("5")
    with warnings.catch_warnings(), _bounded():
        # as in a command; pytest makes errors of warnings
        warnings.simplefilter("default")
        try:
            words = case.words
            status = (
                guarded("anytouch", words)
                if callable(words)
                else main([str(word) for word in words])
            )
        except _HangError:
            pass
        except BaseException as error:
            trace = "".join(traceback.format_exception(error))
    memory = _memory("VmHWM") - before
    out, err = capfd.readouterr()
    if trace or "Traceback (most recent" in err:
        return ["traceback: " + " / ".join((trace or err).strip().splitlines()[-5:])]
    lines = [line for text in (err, out) for line in text.splitlines() if not _RULE.match(line)]
    long = max(lines, key=len, default="")
    last = (out.strip().splitlines() or [""])[-1]
    wrong = case.check() if status == 0 and not case.corrupt and case.check is not None else None
    found = [
        (status is None, f"no answer within {SECONDS} s"),
        (status not in (None, 0, 1, 2), f"status {status}"),
        (memory > MEMORY, f"{memory >> 20} MB of memory"),
        (wrong, wrong),
        ("not enough memory" in err, "it asked for more memory than there is"),
        (len(long) > LETTERS, f"a line of {len(long)} letters: {long[:160]}"),
        (len(lines) > LINES, f"{len(lines)} lines: {lines[-1:]}"),
        (status == 2 and not err.strip(), "status 2 without a sentence"),
        (status == 0 and case.corrupt and not _DAMAGE.search(out), f"accepted: {last[:160]}"),
    ]
    return [str(fault) for is_fault, fault in found if is_fault]


def _memory(name: str) -> int:
    line = next(
        line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name)
    )
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

    start = time.monotonic()
    waited = 0.0
    before_tick = _waits()

    def stop(*_: Any) -> None:
        nonlocal waited, before_tick
        # a busy machine is no fault of the command, nor of the threads that it starts one by one
        waits = _waits()
        waited += max(
            (wait - before_tick.get(thread, 0.0) for thread, wait in waits.items()), default=0.0
        )
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


def pick(rng: np.random.Generator, choices: Any) -> Any:
    """One of the choices, which may be words with commas between them."""
    choices = choices.split(", ") if isinstance(choices, str) else list(choices)
    return choices[int(rng.integers(len(choices)))]


def flipped(
    rng: np.random.Generator, data: bytes, start: int = 0, stop: int | None = None, count: int = 1
) -> bytes:
    """The same bytes, of which `count` between `start` and `stop` differ."""
    changed = bytearray(data)
    for at in rng.integers(start, len(data) if stop is None else stop, count):
        changed[at] ^= int(rng.integers(1, 256))
    return bytes(changed)


def cut(rng: np.random.Generator, data: bytes, start: int = 0, keep: int = 1) -> bytes:
    """The first bytes, at least `start` of them and without the last `keep`."""
    return data[: int(rng.integers(start, max(start + 1, len(data) - keep)))]
