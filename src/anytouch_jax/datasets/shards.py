"""Shards: millions of small files as a few uncompressed ZIP files, and a manifest that points into
them.

* OUT/manifest.parquet: the manifest with paths such as `touch/00000.zip/17` (entry 17)
* OUT/touch/00000.zip: touch images by sequence and frame
* OUT/shared/: RGB images and backgrounds, each stored once
* OUT/field/: field files
* OUT/SHA256SUMS: checksums for `sha256sum -c`
* OUT/README.md: the licences
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import zipfile
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pyarrow as pa

from anytouch_jax.config.parsing import parse_json
from anytouch_jax.data.loading.threads import bounded_map
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.files import (
    ShardError,
    close_shards,
    read_file,
    read_shard_index,
    split_shard_path,
)
from anytouch_jax.data.manifest.manifest import (
    Files,
    Manifest,
    distinct_files,
    replace_column,
    with_distinct_keys,
)
from anytouch_jax.data.manifest.schema import PATHS
from anytouch_jax.datasets.verify import licences
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, atomic_write, lock
from anytouch_jax.progress import tracked

_SHARED = tuple(name for name in PATHS if name not in ("path", "field_path"))
_GROUPS = {"touch": ("path",), "shared": _SHARED, "field": ("field_path",)}
SHARD_BYTES = 256 << 20
_VERSION = 2  # version 1 stored the files in Parquet; read_file still reads it


class PackError(UserError):
    """A manifest that cannot be packed as requested."""


def pack(
    manifest: Manifest,
    out: str | Path,
    *,
    shard_bytes: int = SHARD_BYTES,
    threads: int = 4,
    log: Callable[[str], None] = lambda _: None,
) -> Path:
    """Store all files of a manifest in shards of about `shard_bytes` in the folder `out`, and
    return its manifest.

    Files are stored unchanged and once each, so a loader reads the same batches. The same call
    continues after an interruption, and a finished pack is not changed. Raises PackError for a
    missing or empty file, and for a folder `out` with other contents.

    Args:
        manifest: the frames.
        out: the folder.
        shard_bytes: bytes of a shard, about.
        threads: that read files.
        log: takes a sentence on the progress.
    """
    folder = Path(out).expanduser().resolve()
    if shard_bytes < 1:
        raise PackError(f"a shard has at least 1 byte, not {shard_bytes}")
    target = folder / "manifest.parquet"
    files = distinct_files(manifest)
    finished = target.is_file() and (folder / "README.md").is_file()
    plan = {"version": _VERSION, "manifest": manifest.content_hash, "shard_bytes": shard_bytes}
    try:
        fingerprint = _fingerprint(manifest, files)
    except PackError:
        if not finished:
            raise  # now, rather than after hours of packing the others
        fingerprint = None
    # before a lock is made in a foreign folder
    _is_same_pack(folder, plan, fingerprint, finished)
    if finished:
        log(f"{folder} is already packed; it was not changed")
        return target
    folder.mkdir(parents=True, exist_ok=True)
    with lock(folder / ".lock") as free:
        if not free:
            raise PackError(
                f"another process packs into {folder}: wait for it, or choose another folder"
            )
        if not _is_same_pack(folder, plan, fingerprint, finished):
            atomic_write(folder / "pack.json", json.dumps(plan | {"files": fingerprint}))
        _pack(manifest, files, folder, shard_bytes, threads, log)
        (folder / ".lock").unlink(missing_ok=True)
    return target


def _pack(
    manifest: Manifest,
    files: Files,
    folder: Path,
    shard_bytes: int,
    threads: int,
    log: Callable[[str], None],
) -> None:
    """Write the shards, the manifest and, last, the README."""
    # where each file lies, as the manifest names it
    cells = np.empty(len(files), object)
    sums: dict[str, str] = {}
    for group, ids in _group_files(manifest, files).items():
        done = 0
        for number, rows in enumerate(
            _write_shards(manifest, files, ids, folder / group, shard_bytes, threads)
        ):
            name = f"{group}/{number:05d}.zip"
            cells[ids[done : done + rows]] = [f"{name}/{row}" for row in range(rows)]
            with (folder / name).open("rb") as file:
                sums[name] = hashlib.file_digest(file, "sha256").hexdigest()
            done += rows
            log(f"{name}: {done} of {len(ids)} files")
    close_shards()
    atomic_write(
        folder / "SHA256SUMS",
        "".join(f"{digest}  {name}\n" for name, digest in sorted(sums.items())),
    )
    target = folder / "manifest.parquet"
    packed = manifest
    for name, code in files.code.items():
        packed = replace_column(
            packed, name, pa.array(cells, pa.string()).take(pa.array(code, mask=code < 0))
        )
    table = with_distinct_keys(manifest, packed.table)
    packed = Manifest(table, (target,), np.zeros(len(manifest), np.int32), np.arange(len(manifest)))
    manifests.write(packed, target)
    atomic_write(folder / "README.md", _readme(packed))


def _fingerprint(manifest: Manifest, files: Files) -> str:
    """Return a digest of the paths, sizes and times of all files.

    Raises PackError for the first missing one.
    """
    digest = hashlib.sha256()
    for row, column in zip(files.row, files.column, strict=True):
        try:
            path = manifest.file(row, column)
            status = os.stat((split_shard_path(path) or (path,))[0])
        except FileNotFoundError:
            raise _cannot_pack(manifest, int(row), str(column), "the file is missing") from None
        except (OSError, UserError) as error:
            raise _cannot_pack(manifest, int(row), str(column), str(error)) from None
        digest.update(
            f"{path}\0{status.st_size}\0{status.st_mtime_ns}\n".encode(errors="surrogateescape")
        )
    return digest.hexdigest()


def _cannot_pack(manifest: Manifest, row: int, column: str, reason: str) -> PackError:
    return PackError(
        f"{manifest.where(row)}, column {column!r}: {manifest.value(row, column)!r} cannot be "
        f"packed: {reason}; run anytouch data verify with --repair first"
    )


def _is_same_pack(
    folder: Path, plan: dict[str, object], fingerprint: str | None, finished: bool
) -> bool:
    """Return whether the folder holds this pack, finished or not.

    Raises PackError if it cannot be taken for it.
    """
    record = folder / "pack.json"
    if record.is_file():
        try:
            old = dict(parse_json(record.read_bytes()))
        except (ValueError, TypeError):
            raise PackError(f"{record} is not of a pack; choose another folder") from None
        files = old.pop("files", None)
        if finished:
            # a finished pack of version 1 stays in use
            old["version"] = plan["version"]
        if old == plan and (files in (fingerprint, None) or (finished and fingerprint is None)):
            return True
        if any([*folder.rglob("*.zip"), *folder.rglob("*.parquet")]):
            if old != plan:
                raise PackError(
                    f"{folder} holds a pack of another manifest or shard size; choose another "
                    "folder"
                )
            raise PackError(
                f"the files of the manifest have changed since {folder} was begun; choose another "
                "folder"
            )
    elif folder.exists() and (
        not folder.is_dir() or any(entry.name[0] != "." for entry in folder.iterdir())
    ):
        raise PackError(f"{folder} is not an empty folder; choose another one")
    return False


def _group_files(manifest: Manifest, files: Files) -> dict[str, np.ndarray]:
    """Return the file ids of every group that has files, ordered by sequence and frame."""
    frame = np.asarray(manifest.table["frame_index"])
    sequence = manifest.codes("sequence")
    rank = np.empty(len(manifest), np.int64)
    rank[np.lexsort((frame, sequence, manifest.source))] = np.arange(len(manifest))
    by_group = {
        group: np.flatnonzero(np.isin(files.column, members)) for group, members in _GROUPS.items()
    }
    return {
        group: ids[np.argsort(rank[files.row[ids]], kind="stable")]
        for group, ids in by_group.items()
        if ids.size
    }


def _write_shards(
    manifest: Manifest, files: Files, ids: np.ndarray, folder: Path, shard_bytes: int, threads: int
) -> Iterator[int]:
    """Yield the number of files of each shard in order: first the existing ones, then each new one
    when it is whole.
    """
    number = done = 0
    while (path := folder / f"{number:05d}.zip").is_file():
        try:
            rows = len(read_shard_index(path))
        except ShardError:
            break  # damaged: it is written again
        yield rows
        number = number + 1
        done = done + rows

    def fetch(file: int) -> tuple[str, bytes]:  # the ending of its name, its content
        row = int(files.row[file])
        column = str(files.column[file])
        try:
            data = read_file(manifest.file(row, column))
        except FileNotFoundError:
            raise _cannot_pack(manifest, row, column, "the file is missing") from None
        except (OSError, ValueError) as error:
            raise _cannot_pack(manifest, row, column, str(error)) from None
        if not data:
            raise _cannot_pack(manifest, row, column, "the file is empty")
        suffix = re.search(r"\.[a-zA-Z0-9]{1,8}$", manifest.value(row, column))
        return suffix.group() if suffix else "", data

    with closing(bounded_map(fetch, ids[done:].tolist(), threads)) as every:
        pieces = tracked(every, "files packed", len(ids) - done)
        piece = next(pieces, None)
        while piece is not None:
            path = folder / f"{number:05d}.zip"
            rows = 0
            size = 0
            with (
                atomic_path(path, part=path.with_suffix(".part")) as part,
                zipfile.ZipFile(part, "w") as archive,
            ):
                while piece is not None and (not rows or size + len(piece[1]) <= shard_bytes):
                    # A fixed date makes equal packs equal to the byte.
                    archive.writestr(zipfile.ZipInfo(f"{rows:06d}{piece[0]}"), piece[1])
                    rows = rows + 1
                    size = size + len(piece[1])
                    piece = next(pieces, None)
            yield rows
            number += 1


def _readme(packed: Manifest) -> str:
    terms = "".join(
        f"| {licence.name or 'none given'} | {licence.rows} | {', '.join(licence.datasets)} |\n"
        for licence in licences(packed)
    )
    return (
        f"{len(packed)} tactile frames, content {packed.content_hash}.\n\n"
        "`manifest.parquet` is the manifest for `anytouch`. Its paths name a ZIP file and the "
        "number of an entry.\n"
        "The ZIP files are not compressed. Any tool can read them.\n\n"
        f"| licence | rows | datasets |\n|---|---|---|\n{terms}"
    )
