"""Atomic writes, file locks, .npz files read with limits, and lines of CSV files."""

from __future__ import annotations

import contextlib
import csv
import errno
import math
import os
import shutil
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


@contextlib.contextmanager
def atomic_path(path: str | Path, *, sync: bool = True, part: Path | None = None) -> Iterator[Path]:
    """Give a path to write to, and move that file to `path` when the block ends.

    After an error or a kill, `path` is unchanged. Its folder is created. With `sync` the bytes are
    on the disk before the name is; leave it out for thousands of files that another file vouches
    for. `part` is the path to write to, for a single process: a leftover of a killed one is
    overwritten. Raises OSError with the file's name.
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
        if error.filename not in (None, str(part), part):
            raise
        raise OSError(error.errno or errno.EIO, error.strerror or str(error), str(path)) from error
    finally:
        # the folder may not exist
        with contextlib.suppress(OSError):
            part.unlink()


def atomic_write(
    path: str | Path, data: bytes | str, *, sync: bool = True, part: Path | None = None
) -> None:
    """Write a whole file or none, text as UTF-8, see `atomic_path`.

    Raises OSError with the file's name.
    """
    with atomic_path(path, sync=sync, part=part) as target:
        target.write_bytes(data.encode("utf-8") if isinstance(data, str) else data)


@contextlib.contextmanager
def atomic_folder(path: Path) -> Iterator[Path]:
    """Give a folder to fill, and move it to `path` (missing or empty) when the block ends; remove
    it on an error.
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


def placeholder(file: str | Path | bytes) -> str | None:
    """Return what takes the place of data in a file, or in its bytes, and what to do; None for any
    other content.
    """
    if not isinstance(file, bytes):
        with open(file, "rb") as opened:
            file = opened.read(512)
    start = file[:512].removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if start.startswith((b"<!doctype html", b"<html", b"<?xml")):
        return "a web page, not the data that its name promises; download the file itself"
    if start.startswith(b"version https://git-lfs"):
        return "a Git LFS pointer, not the data that its name promises; run `git lfs pull`"
    return None


def csv_lines(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the first line, from 1, and the cells of each row of a CSV file.

    Raises csv.Error for a quote left open.
    """
    with path.open(encoding="utf-8-sig", newline="") as file:
        line = 1
        rows = csv.reader(file, strict=True)
        try:
            for cells in rows:
                if cells:
                    yield line, cells
                line = rows.line_num + 1
        except csv.Error:
            limit = csv.field_size_limit()
            raise csv.Error(
                f"the quote in line {line} is not closed, or its cell is longer than {limit:,}"
            ) from None


def read_arrays(
    file: str | Path | IO[bytes], *, only: Callable[[str], bool] = lambda _: True
) -> dict[str, np.ndarray]:
    """Return the arrays of an .npz file by name.

    Raises OSError, or ValueError for a file that is not one.

    Every header is read before any array. Pickled objects, sizes that the file does not have, and
    more than 1 GiB in a file a quarter as large are refused. Arrays whose names are not `only` are
    zeros of their shape that take no memory.
    """
    import numpy as np

    if isinstance(file, str | Path) and (kind := placeholder(file)):
        raise ValueError(f"it is {kind}")
    try:
        with zipfile.ZipFile(file) as archive:
            members = [(info, info.filename.removesuffix(".npy")) for info in archive.infolist()]
            if len({name for _, name in members}) < len(members):
                raise ValueError("two of its arrays have one name")
            arrays = {}
            for info, name in members:
                with archive.open(info) as member:
                    arrays[name] = _check_header(member, info.file_size, name)
            total = sum(array.nbytes for name, array in arrays.items() if only(name))
            stored = sum(info.compress_size for info, _ in members)
            if total > max(1 << 30, 4 * stored):
                raise ValueError(f"its arrays take {total:,} bytes in a file of {stored:,}")
            for info, name in members:
                if only(name):
                    with archive.open(info) as member:
                        arrays[name] = np.lib.format.read_array(member, allow_pickle=False)
            return arrays
    except (OSError, ValueError):
        raise
    except Exception as error:  # damaged bytes raise any type of error
        raise ValueError(
            f"it is damaged or not an .npz file ({type(error).__name__}: {str(error)[:200]})"
        ) from error


def _check_header(file: IO[bytes], file_size: int, name: str) -> np.ndarray:
    """Return zeros of the form of an array.

    Raises ValueError if it does not have the bytes that its header gives.
    """
    import numpy as np

    version = np.lib.format.read_magic(file)
    read = {
        (1, 0): np.lib.format.read_array_header_1_0,
        (2, 0): np.lib.format.read_array_header_2_0,
    }.get(version)
    if read is None:
        raise ValueError(f"its array {name[:80]} has an unknown form")
    shape, _, dtype = read(file)
    size = math.prod(shape) * dtype.itemsize
    if dtype.hasobject or min(shape, default=0) < 0 or size != file_size - file.tell():
        raise ValueError(
            f"its array {name[:80]} of shape {shape} has other bytes than its header says"
        )
    return np.broadcast_to(np.zeros((), dtype), shape)


def check_array(name: str, array: np.ndarray, shape: tuple[int, ...], kinds: str = "f") -> None:
    """Raise ValueError unless an array has a shape and a kind of type in `kinds`, and finite
    values.
    """
    import numpy as np

    if array.shape != shape or array.dtype.kind not in kinds:
        raise ValueError(f"its {name} is {array.dtype} {array.shape}, not of shape {shape}")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"its {name} has values that are not finite")


def cache_folder() -> Path:
    """Return the user's folder of what can be made again: anytouch_jax under $XDG_CACHE_HOME or
    ~/.cache.
    """
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "anytouch_jax"


def remove_old(folder: Path, pattern: str, days: float = 60) -> None:
    """Remove the files of a folder that match a pattern and were not written or touched for so many
    days.
    """
    old = time.time() - days * 86400
    for file in folder.glob(pattern):
        # another process may remove it, or own it
        with contextlib.suppress(OSError):
            if file.stat().st_mtime < old:
                file.unlink()


def part_path(path: Path) -> Path:
    """Return a hidden name next to `path` for what is not whole yet, of this process and thread."""
    return path.with_name(f".{path.name}.{os.getpid()}-{threading.get_ident()}")


@contextlib.contextmanager
def lock(path: str | Path) -> Iterator[bool]:
    """Lock a file until the block or the process ends; give whether it was free.

    The file is created if needed.

    The lock belongs to the file, not to its name: a file that replaces it is not locked. Where the
    system or the disk has no locks, the file is always free.
    """
    try:
        import fcntl
    except ImportError:
        yield True
        return
    free = True
    try:  # for writing, as a network disk locks no other file
        opened = open(path, "r+b" if os.path.exists(path) else "ab")  # noqa: SIM115
    except OSError:
        opened = open(path, "rb")  # noqa: SIM115
    with opened as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            free = False
        except OSError:  # a disk without locks
            pass
        yield free
