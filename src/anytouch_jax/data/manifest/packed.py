"""Files by their bytes, loose or in a shard: the path `touch/00000.parquet/17` is the file in row 17 of that shard.

A shard is an ordinary Parquet file whose picture bytes are neither compressed nor encoded, and `00000.index` beside
it says where each file lies in it and its SHA-256. So a random file costs one read of its own length. `pack` writes
both.
"""

from __future__ import annotations

import hashlib
import os
import stat
import threading
from functools import lru_cache
from pathlib import Path

import numpy as np

MAX_BYTES = 1 << 29  # of one file: a picture of images.MAX_PIXELS with four channels of 16 bits
INDEX = np.dtype([("offset", "<i8"), ("size", "<i8"), ("sha256", "u1", (32,))])
_OPEN = 64  # shards held open at once
HEADER_LOCK = threading.Lock()  # a .npy header is Python text, and the parser of 3.11 fails at times in two threads


class ShardError(ValueError):
    """A file that cannot be had from a shard."""


def read_file(path: Path) -> bytes:
    """The bytes of a file, loose or packed.

    Raises OSError, or ValueError (ShardError for a shard) where the file is no regular file, is larger than
    MAX_BYTES, lies in a shard that is damaged, or is not in it.
    """
    place = split_packed(path)
    return _read_loose(path) if place is None else _shard(place[0]).read(place[1])


def split_packed(path: Path) -> tuple[Path, int] | None:
    """(shard, row) of a path into a shard; None for the path of a loose file."""
    if path.name.isascii() and path.name.isdecimal() and path.parent.suffix == ".parquet":
        return path.parent, int(path.name)
    return None


def forget() -> None:
    """Close all shards that are held open (after they were written anew)."""
    _shard.cache_clear()


def _read_loose(path: Path) -> bytes:
    # Without O_NONBLOCK the opening of a named pipe waits for ever.
    file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        about = os.fstat(file)
        if stat.S_ISDIR(about.st_mode):
            raise IsADirectoryError("it is a folder")
        if not stat.S_ISREG(about.st_mode):
            raise ValueError("it is not a regular file")
        if about.st_size > MAX_BYTES:
            raise ValueError(f"it has {about.st_size} bytes, more than the limit of {MAX_BYTES}")
        parts = [os.read(file, about.st_size + 1)]
        if len(parts[0]) != about.st_size:  # it grew, or the read was interrupted
            while part := os.read(file, about.st_size + 1):
                parts.append(part)
        return parts[0] if len(parts) == 1 else b"".join(parts)
    finally:
        os.close(file)


class _Shard:
    """An open shard and its index; reading is safe from many threads."""

    def __init__(self, path: Path) -> None:
        self._file = -1
        self._index = read_index(path.with_suffix(".index"))
        try:
            self._file = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except FileNotFoundError:
            raise ShardError(f"there is no shard {path}; copy it from where the data were packed") from None

    def __del__(self) -> None:
        if self._file >= 0:
            os.close(self._file)

    def read(self, row: int) -> bytes:
        if row >= len(self._index):
            raise ShardError(f"the shard has {len(self._index)} rows, no row {row}; pack the data again")
        entry = self._index[row]
        size, offset = int(entry["size"]), int(entry["offset"])
        parts, got = [], 0
        while got < size and (part := os.pread(self._file, size - got, offset + got)):
            parts.append(part)
            got += len(part)
        data = parts[0] if len(parts) == 1 else b"".join(parts)
        if hashlib.sha256(data).digest() != entry["sha256"].tobytes():
            how = "cut short" if got < size else "damaged (its SHA-256 is another)"
            raise ShardError(f"row {row} of the shard is {how}; copy the shard again from where the data were packed")
        return data


def read_index(path: Path) -> np.ndarray:
    """Where the files of a shard lie in it, INDEX (n,). Raises ShardError where none can be read."""
    try:
        with HEADER_LOCK:
            index = np.load(path, allow_pickle=False)
    except FileNotFoundError:
        raise ShardError(f"there is no {path}, the shard's index; copy it from where the data were packed") from None
    except (ValueError, EOFError, SyntaxError) as error:
        raise ShardError(f"{path}, the index of the shard, is damaged: {str(error).splitlines()[0]}") from None
    if index.dtype != INDEX or index.ndim != 1 or (index["size"] > MAX_BYTES).any() or (index["offset"] < 0).any():
        raise ShardError(f"{path} is not the index of a shard")
    return index


_shard = lru_cache(_OPEN)(_Shard)  # the least recently used one is closed when its last reader is done with it
