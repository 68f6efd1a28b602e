"""Files of a manifest: their bytes, loose or in a shard, and the distinct files of all path columns.

* `touch/00000.zip/17` is file 17 of a shard of `pack`: a ZIP file without compression, so a random file costs one read.
* `data-000000.tar/17` is regular file 17 of a tar without compression, as WebDataset writes it.
* `train-00000.parquet/image/17` is the cell of row 17 in a column of bytes, or of pictures of Hugging Face.
* `touch/00000.parquet/17` is a shard of version 1 with its index next to it.
"""

from __future__ import annotations

import hashlib
import io
import math
import os
import stat
import tarfile
import threading
import zipfile
import zlib
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet

from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.manifest.schema import PATHS

MAX_BYTES = 1 << 29  # of one file: an image of images.MAX_PIXELS with four channels of 16 bits
SHARD_INDEX = np.dtype([("offset", "<i8"), ("size", "<i8"), ("crc", "<u4")])
_PARQUET_INDEX = np.dtype([("offset", "<i8"), ("size", "<i8"), ("sha256", "u1", (32,))])
_NPY_HEADER_1, _NPY_HEADER_2 = np.lib.format.read_array_header_1_0, np.lib.format.read_array_header_2_0
_TAR_INDEX = np.dtype([("offset", "<i8"), ("size", "<i8")])
_OPEN = 64  # open shards at once
_HELD = 256 << 20  # bytes of a Parquet column in memory
_NPY_LOCK = threading.Lock()  # a .npy header is Python text, and the parser of 3.11 can fail in two threads


class ShardError(ValueError):
    """A file that cannot be read from a shard."""


def read_file(path: Path) -> bytes:
    """Return the bytes of a file, loose or packed.

    Raises OSError, or ValueError (ShardError for a shard) if it is no regular file, is larger than MAX_BYTES, is in a
    damaged shard, or is missing in its shard.
    """
    place = split_shard_path(path)
    if place is None:
        return _read_loose(path)
    return (_column(place[0], path.parent.name) if path.parent != place[0] else _shard(place[0])).read(place[1])


def split_shard_path(path: Path) -> tuple[Path, int] | None:
    """Return (shard, row) of a path into a shard, None for a loose file."""
    if path.name.isascii() and path.name.isdecimal():
        if path.parent.suffix in (".zip", ".parquet", ".tar"):
            return path.parent, int(path.name)
        if path.parent.parent.suffix == ".parquet":
            return path.parent.parent, int(path.name)
    return None


def close_shards() -> None:
    """Close all open shards, after they were rewritten."""
    _shard.cache_clear()
    _column.cache_clear()
    _cached_index.cache_clear()


def _read_loose(path: Path) -> bytes:
    # Without O_NONBLOCK, opening a named pipe waits forever.
    file = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        status = os.fstat(file)
        if stat.S_ISDIR(status.st_mode):
            raise IsADirectoryError("it is a folder")
        if not stat.S_ISREG(status.st_mode):
            raise ValueError("it is not a regular file")
        if status.st_size > MAX_BYTES:
            raise ValueError(f"it has {status.st_size} bytes, more than the limit of {MAX_BYTES}")
        parts = [os.read(file, status.st_size + 1)]
        if len(parts[0]) != status.st_size:  # it grew, or the read was interrupted
            while part := os.read(file, status.st_size + 1):
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
        if "crc" not in entry.dtype.names and "sha256" not in entry.dtype.names:
            valid = length == size
        elif "crc" in entry.dtype.names:
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
    if path.suffix == ".tar":
        return np.array([member[1:] for member in tar_members(path)], _TAR_INDEX)
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


def tar_members(path: Path, file: BinaryIO | None = None) -> list[tuple[str, int, int]]:
    """Return (name, offset, size) of the regular files in a tar without compression, in its order. Raises ShardError.

    Only headers are read. `file` is the opened tar, if it lies elsewhere.
    """
    try:
        with tarfile.open(path, "r:", fileobj=file) as archive:
            members = [(member.name, member.offset_data, member.size) for member in archive if member.isreg()]
    except FileNotFoundError:
        raise ShardError(f"there is no shard {path}; copy it from where the data are") from None
    except (tarfile.TarError, ValueError, OSError, OverflowError) as error:
        raise ShardError(f"{path} is no whole tar without compression: {error}; download it again") from None
    if any(size > MAX_BYTES for *_, size in members):
        raise ShardError(f"{path} has a file of more than {MAX_BYTES} bytes")
    return members


class _Column:
    """A column of files in a Parquet file. The row groups that were read last stay in memory, up to _HELD bytes."""

    def __init__(self, path: Path, name: str) -> None:
        try:
            self._file, self._name = pa.parquet.ParquetFile(path), name
        except FileNotFoundError:
            raise ShardError(f"there is no shard {path}; copy it from where the data are") from None
        except (pa.ArrowException, OSError) as error:
            raise ShardError(f"{path} is no whole Parquet file: {error}; download it again") from None
        if name not in self._file.schema_arrow.names:
            raise ShardError(f"{path} has no column {name!r}; index the data again")
        groups = self._file.metadata
        self._starts = np.cumsum([0, *(groups.row_group(i).num_rows for i in range(groups.num_row_groups))])
        self._lock, self._held = threading.Lock(), dict[int, pa.ChunkedArray]()

    def read(self, row: int) -> bytes:
        if row >= self._starts[-1]:
            raise ShardError(f"the shard has {self._starts[-1]} rows, no row {row}; index the data again")
        group = int(np.searchsorted(self._starts, row, "right")) - 1
        with self._lock:
            if group not in self._held:
                try:
                    table = self._file.read_row_group(group, [self._name], use_threads=False)
                except (pa.ArrowException, OSError) as error:
                    raise ShardError(f"row group {group} of the shard is damaged: {error}; download it again") from None
                while self._held and sum(held.nbytes for held in self._held.values()) + table.nbytes > _HELD:
                    self._held.pop(next(iter(self._held)))
                self._held[group] = table[self._name]
            cells = self._held[group]
        value = cells[row - int(self._starts[group])].as_py()
        value = value.get("bytes") if isinstance(value, dict) else value
        if not isinstance(value, bytes):
            raise ShardError(f"row {row} of the shard has no bytes in column {self._name!r}")
        return value


def _parquet_index(path: Path) -> np.ndarray:
    """Return the index of a shard of version 1, a Parquet file with its index next to it."""
    try:
        index = unpack_npy(_read_loose(path))
    except FileNotFoundError:
        raise ShardError(f"there is no {path}, the shard's index; copy it from where the data were packed") from None
    except (OSError, ValueError) as error:
        raise ShardError(f"{path}, the index of the shard, is damaged: {error}") from None
    is_index = index.dtype == _PARQUET_INDEX and index.ndim == 1
    if not is_index or (index["size"] > MAX_BYTES).any() or (index["offset"] < 0).any():
        raise ShardError(f"{path} is not the index of a shard")
    return index


def unpack_npy(data: bytes) -> np.ndarray:
    """Return a .npy as a view of its bytes, so that it cannot declare more than there is. Raises ValueError."""
    stream = io.BytesIO(data)
    try:
        is_old = np.lib.format.read_magic(stream) == (1, 0)
        with _NPY_LOCK:
            shape, fortran, dtype = (_NPY_HEADER_1 if is_old else _NPY_HEADER_2)(stream)
    except Exception:  # a corrupt header fails in the tokenizer, the parser or in NumPy
        raise ValueError("the file is cut short, or its header is corrupt") from None
    if dtype.hasobject:
        raise ValueError("it holds Python objects")
    if stream.tell() + math.prod(shape) * dtype.itemsize > len(data):
        raise ValueError("the file is cut short")
    return np.frombuffer(data, dtype, math.prod(shape), stream.tell()).reshape(shape, order="F" if fortran else "C")


_cached_index = lru_cache(None)(read_shard_index)  # 20 bytes a file; parsing takes about 5 us a file
_column = lru_cache(16)(_Column)
_shard = lru_cache(_OPEN)(_Shard)  # the least recently used one closes when its last reader is done


class Files(NamedTuple):
    """Distinct files i = 0 .. n - 1 of a manifest.

    `code[column]` i64 (rows,) is the file of each cell, -1 for null. `row` i64 (n,) and `column` (n,) are the first
    cell with the file, `path` before the other columns.
    """

    code: dict[str, np.ndarray]
    row: np.ndarray
    column: np.ndarray

    def __len__(self) -> int:
        return len(self.row)


def distinct_files(manifest: Manifest, columns: Sequence[str] = PATHS) -> Files:
    """Return the files of the path columns `columns`, each once (by its written path and its manifest)."""
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
