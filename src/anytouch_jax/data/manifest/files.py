"""The distinct files that a manifest names."""

from __future__ import annotations

import hashlib
import os
import stat
import threading
import zipfile
import zlib
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.manifest.schema import PATHS

MAX_BYTES = 1 << 29  # of one file: a picture of images.MAX_PIXELS with four channels of 16 bits
SHARD_INDEX = np.dtype([("offset", "<i8"), ("size", "<i8"), ("crc", "<u4")])
_PARQUET_INDEX = np.dtype([("offset", "<i8"), ("size", "<i8"), ("sha256", "u1", (32,))])
_OPEN = 64  # shards held open at once
NPY_HEADER_LOCK = threading.Lock()  # a .npy header is Python text, and the parser of 3.11 fails at times in two threads


class ShardError(ValueError):
    """A file that cannot be had from a shard."""


def read_file(path: Path) -> bytes:
    """The bytes of a file, loose or packed.

    Raises OSError, or ValueError (ShardError for a shard) where the file is no regular file, is larger than
    MAX_BYTES, lies in a shard that is damaged, or is not in it.
    """
    place = split_shard_path(path)
    return _read_loose(path) if place is None else _shard(place[0]).read(place[1])


def split_shard_path(path: Path) -> tuple[Path, int] | None:
    """(shard, row) of a path into a shard; None for the path of a loose file."""
    if path.name.isascii() and path.name.isdecimal() and path.parent.suffix in (".zip", ".parquet"):
        return path.parent, int(path.name)
    return None


def close_shards() -> None:
    """Close all shards that are held open (after they were written anew)."""
    _shard.cache_clear()
    _cached_index.cache_clear()


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
    """An open shard and its index. Reading is safe from many threads."""

    def __init__(self, path: Path) -> None:
        self._file = -1
        self._index = _cached_index(path)
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
        parts, length = [], 0
        while length < size and (part := os.pread(self._file, size - length, offset + length)):
            parts.append(part)
            length += len(part)
        data = parts[0] if len(parts) == 1 else b"".join(parts)
        if "crc" in entry.dtype.names:
            valid = zlib.crc32(data) == entry["crc"]
        else:
            valid = hashlib.sha256(data).digest() == entry["sha256"].tobytes()
        if not valid:
            reason = "cut short" if length < size else "damaged (its checksum does not match)"
            raise ShardError(
                f"row {row} of the shard is {reason}; copy the shard again from where the data were packed"
            )
        return data


def read_shard_index(path: Path) -> np.ndarray:
    """Return where the files of a shard lie in it, SHARD_INDEX (n,). Raises ShardError if it cannot be read."""
    if path.suffix == ".parquet":
        return _parquet_index(path.with_suffix(".index"))
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except FileNotFoundError:
        raise ShardError(f"there is no shard {path}; copy it from where the data were packed") from None
    except (zipfile.BadZipFile, ValueError, NotImplementedError, OSError) as error:
        raise ShardError(f"{path} is damaged: {error}; copy it again from where the data were packed") from None
    if any(entry.compress_type != zipfile.ZIP_STORED or entry.file_size > MAX_BYTES for entry in entries):
        raise ShardError(f"{path} is not a shard made by anytouch data pack")
    # `pack` writes ASCII names and no extra fields, so a local header is 30 bytes and the name.
    places = [(entry.header_offset + 30 + len(entry.filename), entry.file_size, entry.CRC) for entry in entries]
    return np.array(places, SHARD_INDEX)


def _parquet_index(path: Path) -> np.ndarray:
    """Return the index of a shard of version 1, a Parquet file with its index next to it."""
    try:
        with NPY_HEADER_LOCK:
            index = np.load(path, allow_pickle=False)
    except FileNotFoundError:
        raise ShardError(f"there is no {path}, the shard's index; copy it from where the data were packed") from None
    except (ValueError, EOFError, SyntaxError) as error:
        raise ShardError(f"{path}, the index of the shard, is damaged: {str(error).splitlines()[0]}") from None
    if index.dtype != _PARQUET_INDEX or index.ndim != 1:
        raise ShardError(f"{path} is not the index of a shard")
    if (index["size"] > MAX_BYTES).any() or (index["offset"] < 0).any():
        raise ShardError(f"{path} is not the index of a shard")
    return index


_cached_index = lru_cache(None)(read_shard_index)  # 20 bytes a file; parsing takes some 5 us a file
_shard = lru_cache(_OPEN)(_Shard)  # the least recently used one is closed when its last reader is done with it


class Files(NamedTuple):
    """Distinct files i = 0 .. n - 1 of a manifest: `code[column]` i64 (rows,) which one a cell names, -1 for null.

    `row` i64 (n,) and `column` (n,) a cell that names the file: the first one, `path` before the other columns.
    """

    code: dict[str, np.ndarray]
    row: np.ndarray
    column: np.ndarray

    def __len__(self) -> int:
        return len(self.row)


def distinct_files(manifest: Manifest, columns: Sequence[str] = PATHS) -> Files:
    """The files of the path columns `columns`, each one once (by its path as it is written, and its manifest)."""
    columns = [name for name in columns if name in manifest.table.column_names]
    rows = len(manifest)
    cells = pa.chunked_array([chunk for name in columns for chunk in manifest.table[name].chunks], pa.string())
    encoded = cells.dictionary_encode().unify_dictionaries()
    number = np.concatenate([np.asarray(pc.fill_null(chunk.indices, -1)) for chunk in encoded.chunks]).astype(np.int64)
    key = number * len(manifest.files) + np.tile(manifest.source.astype(np.int64), len(columns))
    known = np.flatnonzero(number >= 0)
    _, first, code = np.unique(key[known], return_index=True, return_inverse=True)
    full = np.full(len(number), -1, np.int64)
    full[known] = code
    first = known[first]
    code_of = {name: full[i * rows : (i + 1) * rows] for i, name in enumerate(columns)}
    return Files(code_of, first % rows, np.array(columns)[first // rows])
