"""Locks on files, for processes that share a folder."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import IO


@contextlib.contextmanager
def lock(path: str | Path) -> Iterator[bool]:
    """Lock a file until the block or the process ends; give whether it was free.

    The file is created if needed. The lock belongs to the file, not to its name: a file that
    replaces it is not locked. Where the system or the disk has no locks, the file is always free.
    """
    try:
        import fcntl
    except ImportError:
        yield True
        return
    free = True
    with _opened(path) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            free = False
        except OSError:  # a disk without locks
            pass
        yield free


def _opened(path: str | Path) -> IO[bytes]:
    """Open a file for writing, as a network disk locks no other; for reading if that is forbidden.

    Its content stays. A missing file is made.
    """
    mode = "r+b" if os.path.exists(path) else "ab"
    try:
        return open(path, mode)
    except OSError:
        return open(path, "rb")
