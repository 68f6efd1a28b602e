"""Files of a manifest: their bytes, loose, in a shard, or in an object store with a local cache.

* `touch/00000.zip/17` is file 17 of a shard of `pack`: a ZIP file without compression, so a random
  file costs one read.
* `data-000000.tar/17` is regular file 17 of a tar without compression, as WebDataset writes it.
* `train-00000.parquet/image/17` is the cell of row 17 in a column of bytes, or of images of
  Hugging Face.
* `press.h5/demo_0/tactile/17` is frame 17 of an array in HDF5, zarr, .npz or .npy
  (`data.containers`).
* `touch/00000.parquet/17` is a shard of version 1 with its index next to it.
* `s3://bucket/train-00000.parquet/image/17` is in an object store. A shard is copied whole on its
  first use, and the copies that were not used for the longest leave first. `ANYTOUCH_CACHE` names
  the folder of the copies, and `ANYTOUCH_CACHE_GB` their largest size (20).
"""

from __future__ import annotations

import hashlib
import io
import math
import os
import shutil
import stat
import tarfile
import threading
import zipfile
import zlib
from functools import lru_cache
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from anytouch_jax.data import containers
from anytouch_jax.data.manifest.schema import ManifestError, shown
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, cache_folder

MAX_BYTES = 1 << 29  # of one file: an image of images.MAX_PIXELS with four channels of 16 bits
SHARD_INDEX = np.dtype([("offset", "<i8"), ("size", "<i8"), ("crc", "<u4")])
_PARQUET_INDEX = np.dtype([("offset", "<i8"), ("size", "<i8"), ("sha256", "u1", (32,))])
_NPY_HEADER_1 = np.lib.format.read_array_header_1_0
_NPY_HEADER_2 = np.lib.format.read_array_header_2_0
_TAR_INDEX = np.dtype([("offset", "<i8"), ("size", "<i8")])
_OPEN = 64  # open shards at once: a process may have 1,024 files open
_HELD = 256 << 20  # bytes of a Parquet column in memory
# a .npy header is Python text, and the parser of 3.11 can fail in two threads
_NPY_LOCK = threading.Lock()


class ShardError(ValueError):
    """A file that cannot be read from a shard."""


def read_file(path: Path) -> bytes:
    """Return the bytes of a file, loose or packed.

    Raises OSError, or ValueError (ShardError) if it is unfit.
    """
    place = split_shard_path(path)
    if place is None:
        return _read_loose(path)
    inside = containers.split_row(path)
    if inside is not None:
        return containers.read_row(*inside)
    shard, row = place
    if path.parent == shard:
        return _shard(shard).read(row)
    return _column(shard, path.parent.name).read(row)


def split_shard_path(path: Path) -> tuple[Path, int] | None:
    """Return (shard, row) of a path into a shard, None for a loose file."""
    if path.name.isascii() and path.name.isdecimal():
        if path.parent.suffix in (".zip", ".parquet", ".tar"):
            return path.parent, int(path.name)
        if path.parent.parent.suffix == ".parquet":
            return path.parent.parent, int(path.name)
        inside = containers.split_row(path)
        if inside is not None:
            return inside[0], inside[2]
    return None


def close_shards() -> None:
    """Close all open shards, after they were rewritten."""
    _shard.cache_clear()
    _column.cache_clear()
    _cached_index.cache_clear()
    containers.close_containers()


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
        # One byte more than the size, so that a single call tells that this is all.
        first = os.read(file, status.st_size + 1)
        if len(first) == status.st_size:
            return first
        # It grew, or the read was interrupted.
        parts = [first]
        while True:
            part = os.read(file, status.st_size + 1)
            if not part:
                return b"".join(parts)
            parts.append(part)
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
            raise ShardError(
                f"there is no shard {path}; copy it from where the data were packed"
            ) from None

    def __del__(self) -> None:
        if self._file >= 0:
            os.close(self._file)

    def read(self, row: int) -> bytes:
        if row >= len(self._index):
            raise ShardError(
                f"the shard has {len(self._index)} rows, no row {row}; pack the data again"
            )
        entry = self._index[row]
        size = int(entry["size"])
        data = self._bytes(int(entry["offset"]), size)
        if not _is_valid(data, entry, size):
            is_short = len(data) < size
            fault = "cut short" if is_short else "damaged (its checksum does not match)"
            raise ShardError(
                f"row {row} of the shard is {fault}; copy the shard again from where the data were "
                "packed"
            )
        return data

    def _bytes(self, offset: int, size: int) -> bytes:
        """Return the bytes at a place of the shard, fewer if it ends before."""
        parts = []
        length = 0
        while length < size:
            # `pread` has no position of its own, so threads share the file
            part = os.pread(self._file, size - length, offset + length)
            if not part:
                break
            parts.append(part)
            length += len(part)
        if len(parts) == 1:
            return parts[0]
        return b"".join(parts)


def _is_valid(data: bytes, entry: np.void, size: int) -> bool:
    """Return whether the bytes of a file are those that the index of its shard promises.

    A ZIP file has a CRC-32 of each file, a shard of version 1 a SHA-256, and a tar its size only.
    """
    fields = entry.dtype.names or ()
    if "crc" in fields:
        return bool(zlib.crc32(data) == entry["crc"])
    if "sha256" in fields:
        return bool(hashlib.sha256(data).digest() == entry["sha256"].tobytes())
    return len(data) == size


def read_shard_index(path: Path) -> np.ndarray:
    """Return where the files of a shard lie in it, SHARD_INDEX (n,).

    Raises ShardError if it cannot be read.
    """
    if path.suffix == ".parquet":
        return _parquet_index(path.with_suffix(".index"))
    if path.suffix == ".tar":
        return np.array([member[1:] for member in tar_members(path)], _TAR_INDEX)
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except FileNotFoundError:
        raise ShardError(
            f"there is no shard {path}; copy it from where the data were packed"
        ) from None
    except (zipfile.BadZipFile, ValueError, NotImplementedError, OSError) as error:
        raise ShardError(
            f"{path} is damaged: {error}; copy it again from where the data were packed"
        ) from None
    for entry in entries:
        if entry.compress_type != zipfile.ZIP_STORED or entry.file_size > MAX_BYTES:
            raise ShardError(f"{path} is not a shard made by anytouch data pack")
    # `pack` writes ASCII names and no extra fields, so a local header is 30 bytes and the name.
    places = [
        (entry.header_offset + 30 + len(entry.filename), entry.file_size, entry.CRC)
        for entry in entries
    ]
    return np.array(places, SHARD_INDEX)


def tar_members(path: Path, file: BinaryIO | None = None) -> list[tuple[str, int, int]]:
    """Return (name, offset, size) of the files in a plain tar, or in `file`, by its headers.

    Raises ShardError.
    """
    try:
        with tarfile.open(path, "r:", fileobj=file) as archive:
            members = [
                (member.name, member.offset_data, member.size)
                for member in archive
                if member.isreg()
            ]
    except FileNotFoundError:
        raise ShardError(f"there is no shard {path}; copy it from where the data are") from None
    except (tarfile.TarError, ValueError, OSError, OverflowError) as error:
        raise ShardError(
            f"{path} is no whole tar without compression: {error}; download it again"
        ) from None
    if any(size > MAX_BYTES for *_, size in members):
        raise ShardError(f"{path} has a file of more than {MAX_BYTES} bytes")
    return members


class _Column:
    """A column of files in a Parquet file.

    The row groups that were read last stay in memory, up to _HELD bytes.
    """

    def __init__(self, path: Path, name: str) -> None:
        try:
            self._file = pa.parquet.ParquetFile(path)
            self._name = name
        except FileNotFoundError:
            raise ShardError(f"there is no shard {path}; copy it from where the data are") from None
        except (pa.ArrowException, OSError) as error:
            raise ShardError(
                f"{path} is no whole Parquet file: {error}; download it again"
            ) from None
        if name not in self._file.schema_arrow.names:
            raise ShardError(f"{path} has no column {name!r}; index the data again")
        groups = self._file.metadata
        sizes = [groups.row_group(i).num_rows for i in range(groups.num_row_groups)]
        self._starts = np.cumsum([0, *sizes])
        self._lock = threading.Lock()
        self._held = dict[int, pa.ChunkedArray]()

    def read(self, row: int) -> bytes:
        if row >= self._starts[-1]:
            raise ShardError(
                f"the shard has {self._starts[-1]} rows, no row {row}; index the data again"
            )
        group = int(np.searchsorted(self._starts, row, "right")) - 1
        # One thread reads at a time, because a ParquetFile has one position.
        with self._lock:
            if group not in self._held:
                self._hold(group)
            cells = self._held[group]
        value = cells[row - int(self._starts[group])].as_py()
        if isinstance(value, dict):  # Hugging Face's images are pairs of bytes and path
            value = value.get("bytes")
        if not isinstance(value, bytes):
            raise ShardError(f"row {row} of the shard has no bytes in column {self._name!r}")
        return value

    def _hold(self, group: int) -> None:
        """Read a row group into memory, in place of those that came first if there is no room."""
        try:
            table = self._file.read_row_group(group, [self._name], use_threads=False)
        except (pa.ArrowException, OSError) as error:
            raise ShardError(
                f"row group {group} of the shard is damaged: {error}; download it again"
            ) from None
        while self._held:
            held = sum(cells.nbytes for cells in self._held.values())
            if held + table.nbytes <= _HELD:
                break
            self._held.pop(next(iter(self._held)))
        self._held[group] = table[self._name]


def _parquet_index(path: Path) -> np.ndarray:
    """Return the index of a shard of version 1, a Parquet file with its index next to it."""
    try:
        index = unpack_npy(_read_loose(path))
    except FileNotFoundError:
        raise ShardError(
            f"there is no {path}, the shard's index; copy it from where the data were packed"
        ) from None
    except (OSError, ValueError) as error:
        raise ShardError(f"{path}, the index of the shard, is damaged: {error}") from None
    is_index = index.dtype == _PARQUET_INDEX and index.ndim == 1
    if not is_index or (index["size"] > MAX_BYTES).any() or (index["offset"] < 0).any():
        raise ShardError(f"{path} is not the index of a shard")
    return index


def unpack_npy(data: bytes) -> np.ndarray:
    """Return a .npy as a view of its bytes, so that it cannot declare more than there is.

    Raises ValueError.
    """
    stream = io.BytesIO(data)
    try:
        is_old = np.lib.format.read_magic(stream) == (1, 0)
        read_header = _NPY_HEADER_1 if is_old else _NPY_HEADER_2
        with _NPY_LOCK:
            shape, fortran, dtype = read_header(stream)
    except Exception:  # a corrupt header fails in the tokenizer, the parser or in NumPy
        raise ValueError("the file is cut short, or its header is corrupt") from None
    if dtype.hasobject:
        raise ValueError("it holds Python objects")
    count = math.prod(shape)
    start = stream.tell()
    if start + count * dtype.itemsize > len(data):
        raise ValueError("the file is cut short")
    values = np.frombuffer(data, dtype, count, start)
    return values.reshape(shape, order="F" if fortran else "C")


# All indexes are kept: 20 bytes a file, and parsing takes about 5 us a file.
_cached_index = lru_cache(None)(read_shard_index)
_column = lru_cache(16)(_Column)
# the least recently used one closes when its last reader is done
_shard = lru_cache(_OPEN)(_Shard)


PROTOCOLS = ("s3", "gs", "az", "hf", "http", "https", "memory")
CONTAINERS = (".parquet", ".tar", ".zip")
_LOCKS = tuple(threading.Lock() for _ in range(64))
_EVICTION = threading.Lock()


def is_remote(path: str) -> bool:
    """Return whether a path is an address of an object store."""
    return "://" in path


def local_copy(address: str) -> Path:
    """Return the local path of an address or of an entry of a shard, copied if needed.

    Raises UserError.
    """
    file, entry = _split(address)
    name = file.rpartition("/")[2]
    target = _folder() / hashlib.sha256(file.encode()).hexdigest()[:24] / name
    try:
        os.utime(target)  # the newest use
    except OSError:
        # One thread copies, and the others wait for it. A lock for each address would grow without
        # end; of 64 two addresses rarely share one.
        with _LOCKS[hash(target) % len(_LOCKS)]:
            if not target.exists():
                _fetch(file, target)
    if entry:
        return target / entry
    return target


def _split(address: str) -> tuple[str, str]:
    """Return the file of an address and the entry in it, "" for a file itself."""
    protocol = address.partition("://")[0]
    if protocol not in PROTOCOLS or "\\" in address or ".." in address.split("/"):
        raise ManifestError(f"the address {shown(address)} is none of {', '.join(PROTOCOLS)}://...")
    for suffix in CONTAINERS:
        head, found, entry = address.rpartition(f"{suffix}/")
        if found:
            return head + suffix, entry
    return address, ""


def open_store(address: str) -> tuple[Any, str]:
    """Return the file system of fsspec for an address, and the path in it.

    Raises UserError.
    """
    try:
        import fsspec

        system, path = fsspec.core.url_to_fs(address)
    except (ImportError, ValueError) as error:
        raise UserError(
            f"{address} cannot be read: {error}; install the package for it (s3fs for s3)"
        ) from None
    return system, path


def _fetch(file: str, target: Path) -> None:
    system, path = open_store(file)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        size = int(system.size(path) or 0)
        _make_room(size, target)
        with (
            atomic_path(target) as part,
            system.open(path, "rb") as source,
            part.open("wb") as copy,
        ):
            shutil.copyfileobj(source, copy, 1 << 20)
    except FileNotFoundError:
        raise UserError(
            f"there is no {file}; correct the manifest, or put the file there"
        ) from None
    except Exception as error:  # each store has its own kinds, as of httpx and botocore
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise UserError(
            f"{file} cannot be copied to {target.parent}: {reason}; check access and free space, "
            "or name another folder in ANYTOUCH_CACHE"
        ) from None


def _make_room(size: int, target: Path) -> None:
    """Remove the copies that were not used for the longest until `size` more bytes fit."""
    limit = int(float(os.environ.get("ANYTOUCH_CACHE_GB", "20")) * 1e9)
    with _EVICTION:
        copies = [
            (file.stat(), file)
            for file in _folder().glob("*/*")
            if file.is_file() and file != target
        ]
        total = sum(state.st_size for state, _ in copies) + size
        for state, file in sorted(copies, key=lambda copy: copy[0].st_mtime_ns):
            if total <= limit:
                return
            file.unlink(missing_ok=True)  # a reader that has it open still reads it
            total -= state.st_size


def _folder() -> Path:
    given = os.environ.get("ANYTOUCH_CACHE")
    if given:
        return Path(given).expanduser()
    return cache_folder() / "shards"
