"""Atomic writes: a file or a folder is there whole, or its earlier content is."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def atomic_path(path: str | Path, *, sync: bool = True, part: Path | None = None) -> Iterator[Path]:
    """Give a path to write to, and move that file to `path` when the block ends.

    After an error or a kill, `path` is unchanged. Its folder is created.

    Args:
        path: The file to be made or replaced.
        sync: Put the bytes on the disk before the name is. Leave it out for thousands of files
            that another file vouches for, because each waits for the disk.
        part: The path to write to, for a single process. A leftover of a killed one is overwritten.
            By default it is hidden, next to `path`, and of this process and thread.

    Raises:
        OSError: With the name of `path`, not that of the part, which the user does not know.
    """
    path = Path(path)
    part = part or part_path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield part
        if sync:
            with open(part, "r+b") as file:
                os.fsync(file.fileno())
        os.replace(part, path)
    except OSError as error:
        is_ours = error.filename in (None, str(part), part)
        if not is_ours:
            raise
        number = error.errno or errno.EIO
        reason = error.strerror or str(error)
        raise OSError(number, reason, str(path)) from error
    finally:
        # the folder may not exist
        with contextlib.suppress(OSError):
            part.unlink()


def atomic_write(
    path: str | Path, data: bytes | str, *, sync: bool = True, part: Path | None = None
) -> None:
    """Write a whole file or none, text as UTF-8.

    Args:
        path: The file to be made or replaced.
        data: Its content.
        sync: As in `atomic_path`.
        part: As in `atomic_path`.

    Raises:
        OSError: With the file's name.
    """
    if isinstance(data, str):
        data = data.encode("utf-8")
    with atomic_path(path, sync=sync, part=part) as target:
        target.write_bytes(data)


@contextlib.contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Give a folder to fill, and move it to `path` when the block ends.

    `path` is missing or empty. After an error nothing is left.
    """
    part = part_path(path)
    try:
        part.mkdir(parents=True)
        yield part
        if path.is_dir():
            path.rmdir()
        os.replace(part, path)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def part_path(path: Path) -> Path:
    """Return a hidden name next to `path` for what is not whole yet, of this process and thread.

    It is next to `path` because a rename is atomic within one disk only.
    """
    return path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}")
