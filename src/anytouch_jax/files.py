"""Files that are written whole or not at all (to a name beside their own, then moved over it), and locks on them."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO


@contextlib.contextmanager
def atomic_path(path: str | Path, *, sync: bool = True, part: Path | None = None) -> Iterator[Path]:
    """The path of a file to write, which takes the place of `path` in one move when the block ends.

    On any error, and when the process is killed, `path` stays as it was. Its folder is made. The bytes are on the disk
    before the name is (`sync`; not worth its time for thousands of files that another file vouches for). `part`: where
    it is written, by one process alone: what a killed one leaves is written over by the next. Raises OSError, with the
    file's name.
    """
    path = Path(path)
    part = part or path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        if sync:
            with open(part, "r+b") as file:
                os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        if error.filename not in (None, str(part), part):
            raise
        raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from error
    finally:
        with contextlib.suppress(OSError):  # there may be no such folder
            part.unlink()


def atomic_write(path: str | Path, data: bytes | str, *, sync: bool = True, part: Path | None = None) -> None:
    """Write a file whole or not at all, text as UTF-8. Raises OSError, with the file's name (see `replacing`)."""
    with atomic_path(path, sync=sync, part=part) as target:
        target.write_bytes(data.encode("utf-8") if isinstance(data, str) else data)


@contextlib.contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """A folder to fill, which becomes `path`, that is empty or not there, when the block ends; on an error nothing
    stays."""
    part = path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}")
    try:
        part.mkdir(parents=True)
        yield part
        if path.is_dir():
            path.rmdir()
        os.replace(part, path)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _opened(path: str | Path) -> IO[bytes]:
    """A file to be locked: to be written, since a network disk locks no other; else, where that may not be, read."""
    try:
        return open(path, "ab" if not os.path.exists(path) else "r+b")
    except OSError:
        return open(path, "rb")


@contextlib.contextmanager
def lock(path: str | Path) -> Iterator[bool]:
    """A lock on a file, which is made if need be, that ends with the block or the process; whether it was free.

    The lock is of the file, not of its name: one that takes its place is another. Where the system or the disk knows
    no locks it always is free.
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
