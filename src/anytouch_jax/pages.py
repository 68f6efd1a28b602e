"""Large pages for large arrays: the arrays of a step come fresh from the system, which hands them out page by page.

A step of preset small asks the system for 4 GB. In pages of 4 KiB the kernel is called a million times for them; with
glibc's `glibc.malloc.hugetlb=1` (since 2.35), which asks for pages of 2 MiB, fifty thousand times. That saves nothing
on a quiet machine and half of the step on a busy one (experiments/results/speed.md). glibc reads it at the start.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

TUNABLE = "glibc.malloc.hugetlb"
_KERNEL = Path("/sys/kernel/mm/transparent_hugepage/enabled")


def restart() -> None:
    """Start this very command once more, in the same process, with large pages, where they can be had.

    Does nothing where the variable GLIBC_TUNABLES names the tunable already (=0 keeps small pages), and without glibc.
    """
    environment = tuned(os.environ.get("GLIBC_TUNABLES", ""))
    if environment is None or not available():
        return
    sys.stdout.flush()
    os.environ["GLIBC_TUNABLES"] = environment
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def tuned(tunables: str) -> str | None:
    """`tunables` (name=value:name=value) with large pages added, or None when they decide on them already."""
    named = [part for part in tunables.split(":") if part]
    if any(part.split("=")[0] == TUNABLE for part in named):
        return None
    return ":".join([*named, f"{TUNABLE}=1"])


def available() -> bool:
    """Whether glibc (2.35 or later) and the kernel know large pages."""
    try:
        library, _, version = (os.confstr("CS_GNU_LIBC_VERSION") or "").partition(" ")
        kernel = _KERNEL.read_text()
    except (AttributeError, ValueError, OSError):  # not Linux, or not glibc
        return False
    return library == "glibc" and _at_least(version, (2, 35)) and "[never]" not in kernel


def _at_least(version: str, least: tuple[int, int]) -> bool:
    numbers = version.split(".")[:2]
    return len(numbers) == 2 and all(n.isdigit() for n in numbers) and (int(numbers[0]), int(numbers[1])) >= least
