"""Atomic writes and file locks."""

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
    """Give a path to write to, and move that file to `path` when the block ends.

    After an error or a kill, `path` is unchanged. Its folder is created. With `sync` the bytes are on the disk before
    the name is; leave it out for thousands of files that another file vouches for. `part` is the path to write to, for
    a single process: a leftover of a killed one is overwritten. Raises OSError with the file's name.
    """
    path = Path(path)
    part = part or _part(path)
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
        with contextlib.suppress(OSError):  # the folder may not exist
            part.unlink()


def atomic_write(path: str | Path, data: bytes | str, *, sync: bool = True, part: Path | None = None) -> None:
    """Write a whole file or none, text as UTF-8, see `atomic_path`. Raises OSError with the file's name."""
    with atomic_path(path, sync=sync, part=part) as target:
        target.write_bytes(data.encode("utf-8") if isinstance(data, str) else data)


@contextlib.contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Give a folder to fill, and move it to `path` (missing or empty) when the block ends; remove it on an error."""
    part = _part(path)
    try:
        part.mkdir(parents=True)
        yield part
        if path.is_dir():
            path.rmdir()
        os.replace(part, path)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _part(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}")


def _open_for_lock(path: str | Path) -> IO[bytes]:
    """Open a file for writing, as a network disk locks no other; for reading if writing is not allowed."""
    try:
        return open(path, "ab" if not os.path.exists(path) else "r+b")
    except OSError:
        return open(path, "rb")


@contextlib.contextmanager
def lock(path: str | Path) -> Iterator[bool]:
    """Lock a file until the block or the process ends; give whether it was free. The file is created if needed.

    The lock belongs to the file, not to its name: a file that replaces it is not locked. Where the system or the disk
    has no locks, the file is always free.
    """
    try:
        import fcntl
    except ImportError:
        yield True
        return
    free = True
    with _open_for_lock(path) as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            free = False
        except OSError:  # a disk without locks
            pass
        yield free
