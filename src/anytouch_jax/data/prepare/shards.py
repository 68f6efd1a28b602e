"""Millions of small files as a few Parquet shards with the encoded bytes inside, and a manifest that points into them.

OUT/manifest.parquet     the manifest, rows in their old order; its paths are `touch/00000.parquet/17`
OUT/touch/00000.parquet  image {bytes, path} and the columns of the manifest, by sequence and frame
OUT/shared/, OUT/field/  image {bytes, path}: photographs and backgrounds, field files; each stored once
OUT/SHA256SUMS           for `sha256sum -c`; README.md: a data card that the Hub and `datasets` understand
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet

from anytouch_jax.data.loading.threads import bounded_map
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.files import (
    SHARD_INDEX,
    Files,
    ShardError,
    close_shards,
    distinct_files,
    read_file,
    read_shard_index,
    split_shard_path,
)
from anytouch_jax.data.manifest.manifest import Manifest, with_distinct_keys
from anytouch_jax.data.manifest.schema import PATHS
from anytouch_jax.data.prepare.licences import card
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, atomic_write, lock

_PICTURES = tuple(name for name in PATHS if name not in ("path", "field_path"))
GROUPS = {"touch": ("path",), "shared": _PICTURES, "field": ("field_path",)}
SHARD_BYTES = 256 << 20
_GROUP_ROWS, _GROUP_BYTES = 64, 8 << 20  # of a row group: what a viewer reads at once
_VERSION = 1
_FEATURES = {pa.string(): "string", pa.bool_(): "bool"}
_FEATURES |= {kind: str(kind) for kind in (pa.int8(), pa.int16(), pa.int32(), pa.int64())}
_FEATURES |= {pa.float32(): "float32", pa.float64(): "float64"}


class PackError(UserError):
    """A manifest that cannot be packed as asked."""


class _Piece(NamedTuple):
    """A file on its way into a shard."""

    file: int
    data: bytes


def pack(
    manifest: Manifest,
    out: str | Path,
    *,
    shard_bytes: int = SHARD_BYTES,
    threads: int = 4,
    log: Callable[[str], None] | None = None,
) -> Path:
    """Store all files of a manifest in shards of about `shard_bytes` under the folder `out`; gives back its manifest.

    The encoded bytes are stored as they are and each file once, so a loader reads the same batches. After a kill the
    same call goes on behind the last whole shard; a finished pack is left alone. Memory holds a few files a thread.
    Raises PackError, which names the row, for a file that is missing or empty, and when `out` holds something else.
    """
    folder = Path(out).expanduser().resolve()
    if shard_bytes < 1:
        raise PackError(f"a shard has at least 1 byte, not {shard_bytes}")
    target = folder / "manifest.parquet"
    files = distinct_files(manifest)
    finished = target.is_file() and (folder / "README.md").is_file()
    plan = {"version": _VERSION, "manifest": manifest.content_hash, "shard_bytes": shard_bytes}
    try:
        stamp = _stamp(manifest, files)
    except PackError:
        if not finished:
            raise  # before hours of packing the others
        stamp = None
    _is_ours(folder, plan, stamp, finished)  # before a lock is left in a folder of something else
    if finished:
        if log:
            log(f"{folder} was finished before: left as it is")
        return target
    folder.mkdir(parents=True, exist_ok=True)
    with lock(folder / ".lock") as mine:
        if not mine:
            raise PackError(f"another process packs into {folder}: wait for it, or choose another folder")
        if not _is_ours(folder, plan, stamp, finished):
            atomic_write(folder / "pack.json", json.dumps(plan | {"files": stamp}))
        _pack(manifest, files, folder, shard_bytes, threads, log)
        (folder / ".lock").unlink(missing_ok=True)
    return target


def _pack(
    manifest: Manifest, files: Files, folder: Path, shard_bytes: int, threads: int, log: Callable[[str], None] | None
) -> None:
    """Write the shards, the manifest and, last, the card."""
    target, orders = folder / "manifest.parquet", _orders(manifest, files)
    sums: dict[str, str] = _read_sums(folder)
    shard_of, row_of = np.empty(len(files), np.int64), np.empty(len(files), np.int64)
    names: list[str] = []
    for group, ids in orders.items():
        writer = _Group(manifest, files, group, folder, sums)
        done = 0
        for name, rows in writer.shards(ids, shard_bytes, threads):
            here = ids[done : done + rows]
            shard_of[here], row_of[here] = len(names), np.arange(rows)
            names.append(name)
            done += rows
            if log:
                log(f"{name}: {done} of {len(ids)} files")
    close_shards()
    packed = _repoint(manifest, target, files, names, shard_of, row_of)
    manifests.write(packed, target)
    atomic_write(folder / "README.md", card(packed, orders))


def _stamp(manifest: Manifest, files: Files) -> str:
    """A digest of where the files are, their sizes and times: equal manifests may show other pictures. Raises PackError
    for the first that is not there."""
    digest = hashlib.sha256()
    for row, column in zip(files.row, files.column, strict=True):
        try:
            path = manifest.file(row, column)
            about = os.stat((split_shard_path(path) or (path,))[0])
        except FileNotFoundError:
            raise _cannot(manifest, int(row), str(column), "the file is missing") from None
        except (OSError, UserError) as error:
            raise _cannot(manifest, int(row), str(column), str(error)) from None
        digest.update(f"{path}\0{about.st_size}\0{about.st_mtime_ns}\n".encode(errors="surrogateescape"))
    return digest.hexdigest()


def _cannot(manifest: Manifest, row: int, column: str, reason: str) -> PackError:
    return PackError(
        f"{manifest.where(row)}, column {column!r}: {manifest.value(row, column)!r} cannot be packed: {reason}; "
        "run anytouch verify with --repair first"
    )


def _is_ours(folder: Path, plan: dict[str, object], stamp: str | None, finished: bool) -> bool:
    """Whether the folder is this plan's from an earlier run; False where it may be taken, as after another plan that
    failed before its first shard. Raises PackError otherwise."""
    mark = folder / "pack.json"
    if mark.is_file():
        try:
            old = dict(json.loads(mark.read_text(encoding="utf-8")))
        except (ValueError, TypeError):
            raise PackError(f"{mark} is not of a pack; choose another folder") from None
        files = old.pop("files", None)
        if old == plan and (files in (stamp, None) or (finished and stamp is None)):
            return True
        if any(folder.rglob("*.parquet")):
            if old != plan:
                raise PackError(f"{folder} holds a pack of another manifest or shard size; choose another folder")
            raise PackError(f"the files of the manifest are others than when {folder} was begun; choose another folder")
    elif folder.exists() and (not folder.is_dir() or any(entry.name[0] != "." for entry in folder.iterdir())):
        raise PackError(f"{folder} is not an empty folder; choose another one")
    return False


def _orders(manifest: Manifest, files: Files) -> dict[str, np.ndarray]:
    """For every group that has files, their ids in the order of storing: by sequence and frame."""
    frame, sequence = np.asarray(manifest.table["frame_index"]), manifest.codes("sequence")
    rank = np.empty(len(manifest), np.int64)
    rank[np.lexsort((frame, sequence, manifest.source))] = np.arange(len(manifest))
    orders = {}
    for group, members in GROUPS.items():
        ids = np.flatnonzero(np.isin(files.column, members))
        if ids.size:
            orders[group] = ids[np.argsort(rank[files.row[ids]], kind="stable")]
    return orders


class _Group:
    """Writes the shards of one group of files."""

    def __init__(self, manifest: Manifest, files: Files, group: str, folder: Path, sums: dict[str, str]) -> None:
        self.manifest, self.files, self.group, self.folder, self.sums = manifest, files, group, folder, sums
        table = manifest.table
        schema = table.schema if group == "touch" else ()
        self.extra = kept = [c.name for c in schema if c.type in _FEATURES and c.name not in (*PATHS, "image")]
        features = {"image": {"_type": "Image"}} if group != "field" else {}
        features |= {name: {"dtype": _FEATURES[table.schema.field(name).type], "_type": "Value"} for name in kept}
        about = {"huggingface": json.dumps({"info": {"features": features}})} if group != "field" else None
        first = "field" if group == "field" else "image"
        image = pa.field(first, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))
        self.schema = pa.schema([image, *(table.schema.field(name) for name in kept)], about)

    def shards(self, ids: np.ndarray, shard_bytes: int, threads: int) -> Iterator[tuple[str, int]]:
        """(name, rows) of every shard in order: those that are there, then the new ones as they are finished."""
        (self.folder / self.group).mkdir(exist_ok=True)
        number = done = 0
        while (rows := self._finished(number)) is not None:
            yield self._name(number), rows
            number, done = number + 1, done + rows
        with closing(bounded_map(self._fetch, ids[done:].tolist(), threads)) as pieces:
            ahead = next(pieces, None)
            while ahead is not None:
                rows, ahead = self._write(number, ahead, pieces, shard_bytes)
                yield self._name(number), rows
                number += 1

    def _name(self, number: int) -> str:
        return f"{self.group}/{number:05d}.parquet"

    def _finished(self, number: int) -> int | None:
        """Rows of a shard that is whole: its index is written last."""
        shard = self.folder / self._name(number)
        index = shard.with_suffix(".index")
        try:
            return len(read_shard_index(index)) if shard.is_file() else None
        except ShardError:
            return None

    def _fetch(self, file: int) -> _Piece:
        row, name = int(self.files.row[file]), str(self.files.column[file])
        try:
            data = read_file(self.manifest.file(row, name))
        except FileNotFoundError:
            reason = "the file is missing"
        except (UserError, OSError, ValueError) as error:
            reason = str(error)
        else:
            if data:
                return _Piece(file, data)
            reason = "the file is empty"
        raise _cannot(self.manifest, row, name, reason)

    def _write(
        self, number: int, first: _Piece, pieces: Iterator[_Piece], shard_bytes: int
    ) -> tuple[int, _Piece | None]:
        """One shard and then its index: (rows, the piece that begins the next shard)."""
        path = self.folder / self._name(number)
        left: list[_Piece] = []
        with atomic_path(path, part=path.with_suffix(".part")) as part, part.open("w+b") as file:
            index, digest = self._fill(file, _until(first, pieces, shard_bytes, left))
        self.sums[self._name(number)] = digest
        atomic_write(self.folder / "SHA256SUMS", "".join(f"{d}  {n}\n" for n, d in sorted(self.sums.items())))
        stream = io.BytesIO()
        np.save(stream, index)
        atomic_write(path.with_suffix(".index"), stream.getvalue())
        return len(index), left[0] if left else None

    def _fill(self, file: BinaryIO, pieces: Iterable[_Piece]) -> tuple[np.ndarray, str]:
        """Write pieces as row groups: (index, SHA-256 of the file)."""
        sink, entries = _Sink(file), []
        options = {"compression": "NONE", "use_dictionary": self.extra, "write_statistics": self.extra}
        with pa.parquet.ParquetWriter(pa.PythonFile(sink, "w"), self.schema, **options) as writer:
            for batch in _batches(pieces):
                start = sink.tell()
                writer.write_table(self._table(batch))
                entries.append(_locate(file, start, sink.tell(), batch))
        return np.concatenate(entries), sink.digest.hexdigest()

    def _table(self, batch: list[_Piece]) -> pa.Table:
        rows = self.files.row[[piece.file for piece in batch]]
        cells = [self.manifest.value(row, str(self.files.column[p.file])) for row, p in zip(rows, batch, strict=True)]
        data = pa.array([piece.data for piece in batch], pa.binary())
        image = pa.StructArray.from_arrays([data, pa.array(cells, pa.string())], ["bytes", "path"])
        extra = [c.combine_chunks() for c in self.manifest.table.select(self.extra).take(pa.array(rows)).columns]
        return pa.table([image, *extra], schema=self.schema)


class _Sink:
    """A file that hashes what is written to it."""

    closed = False

    def __init__(self, file: BinaryIO) -> None:
        self._file, self.digest = file, hashlib.sha256()

    def write(self, data: bytes) -> int:
        self.digest.update(data)
        return self._file.write(data)

    def tell(self) -> int:
        return self._file.tell()

    def flush(self) -> None:
        self._file.flush()

    def close(self) -> None:
        self.closed = True


def _until(first: _Piece, pieces: Iterator[_Piece], most: int, left: list[_Piece]) -> Iterator[_Piece]:
    """`first` and more pieces while they fit into `most` bytes; the one that does not goes to `left`."""
    total = len(first.data)
    yield first
    for piece in pieces:
        total += len(piece.data)
        if total > most:
            left.append(piece)
            return
        yield piece


def _batches(pieces: Iterable[_Piece]) -> Iterator[list[_Piece]]:
    batch: list[_Piece] = []
    for piece in pieces:
        batch.append(piece)
        if len(batch) >= _GROUP_ROWS or sum(len(p.data) for p in batch) >= _GROUP_BYTES:
            yield batch
            batch = []
    if batch:
        yield batch


def _locate(file: BinaryIO, start: int, stop: int, batch: list[_Piece]) -> np.ndarray:
    """Where the bytes of a row group lie in the file: plain Parquet stores each value whole, after its length."""
    file.seek(start)
    region = file.read(stop - start)
    file.seek(stop)
    index, at = np.zeros(len(batch), SHARD_INDEX), 0
    for entry, piece in zip(index, batch, strict=True):
        at = region.find(len(piece.data).to_bytes(4, "little") + piece.data, at)
        if at < 0:
            raise RuntimeError("this version of pyarrow does not store plain values; packing needs another one")
        entry["offset"], entry["size"] = start + at + 4, len(piece.data)
        entry["sha256"] = np.frombuffer(hashlib.sha256(piece.data).digest(), np.uint8)
        at += 4 + len(piece.data)
    return index


def _repoint(
    manifest: Manifest, target: Path, files: Files, names: list[str], shard_of: np.ndarray, row_of: np.ndarray
) -> Manifest:
    """The manifest at `target` with cells that point into the shards."""
    shard = pa.array(names).take(pa.array(shard_of))
    cell = pc.binary_join_element_wise(shard, pa.array(row_of).cast(pa.string()), "/")
    table = manifest.table
    for name, code in files.code.items():
        place = table.column_names.index(name)
        table = table.set_column(place, name, cell.take(pa.array(code, mask=code < 0)))
    table = with_distinct_keys(manifest, table)
    return Manifest(table, (target,), np.zeros(len(manifest), np.int32), np.arange(len(manifest)))


def _read_sums(folder: Path) -> dict[str, str]:
    path = folder / "SHA256SUMS"
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return {name: digest for digest, _, name in (line.partition("  ") for line in lines)}
