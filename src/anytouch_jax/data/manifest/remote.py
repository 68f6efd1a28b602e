"""Files in an object store, by addresses such as s3://bucket/train-00000.parquet/image/17, with a local cache.

A shard is copied whole on its first use. The copies that were not used for the longest are removed first.
`ANYTOUCH_CACHE` names the folder of the copies and `ANYTOUCH_CACHE_GB` their largest size (20).
"""

from __future__ import annotations

import hashlib
import os
import shutil
import threading
from pathlib import Path
from typing import Any

from anytouch_jax.data.manifest.schema import ManifestError, shown
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path

PROTOCOLS = ("s3", "gs", "az", "hf", "http", "https", "memory")
CONTAINERS = (".parquet", ".tar", ".zip")
_LOCKS = tuple(threading.Lock() for _ in range(64))
_EVICTION = threading.Lock()


def is_remote(path: str) -> bool:
    """Return whether a path is an address of an object store."""
    return "://" in path


def local_copy(address: str) -> Path:
    """Return the local path of an address: a file, or an entry of a shard. The file is copied if it is not there.

    Raises ManifestError for an unknown protocol, UserError for a file that cannot be copied.
    """
    file, entry = _split(address)
    name = file.rpartition("/")[2]
    target = _folder() / hashlib.sha256(file.encode()).hexdigest()[:24] / name
    try:
        os.utime(target)  # the newest use
    except OSError:
        with _LOCKS[hash(target) % len(_LOCKS)]:
            if not target.exists():
                _fetch(file, target)
    return target / entry if entry else target


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
    """Return the file system of fsspec for an address, and the path in it. Raises UserError."""
    try:
        import fsspec

        system, path = fsspec.core.url_to_fs(address)
    except (ImportError, ValueError) as error:
        raise UserError(f"{address} cannot be read: {error}; install the package for it (s3fs for s3)") from None
    return system, path


def _fetch(file: str, target: Path) -> None:
    system, path = open_store(file)
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        size = int(system.size(path) or 0)
        _make_room(size, target)
        with atomic_path(target) as part, system.open(path, "rb") as source, part.open("wb") as copy:
            shutil.copyfileobj(source, copy, 1 << 20)
    except FileNotFoundError:
        raise UserError(f"there is no {file}; correct the manifest, or put the file there") from None
    except Exception as error:  # each store has its own kinds, as of httpx and botocore
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise UserError(f"{file} cannot be copied to {target.parent}: {reason}; check access and free space") from None


def _make_room(size: int, target: Path) -> None:
    """Remove the copies that were not used for the longest until `size` more bytes fit."""
    limit = int(float(os.environ.get("ANYTOUCH_CACHE_GB", "20")) * 1e9)
    with _EVICTION:
        copies = [(file.stat(), file) for file in _folder().glob("*/*") if file.is_file() and file != target]
        total = sum(state.st_size for state, _ in copies) + size
        for state, file in sorted(copies, key=lambda copy: copy[0].st_mtime_ns):
            if total <= limit:
                return
            file.unlink(missing_ok=True)  # a reader that has it open still reads it
            total -= state.st_size


def _folder() -> Path:
    home = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(os.environ.get("ANYTOUCH_CACHE") or f"{home}/anytouch_jax/shards").expanduser()
