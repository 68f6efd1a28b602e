"""Results of a study as one JSON-lines file: a line a run, named by its `key`, in the order of the
keys.
"""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any

from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write

Record = dict[str, Any]


def read_records(path: Path) -> dict[str, Record]:
    """Return {key: record} of a file of results, {} for a missing file.

    Raises UserError for a line that is no record.
    """
    if not path.exists():
        return {}
    state = path.stat()
    return dict(_parsed(path, state.st_ino, state.st_size, state.st_mtime_ns))


@lru_cache(maxsize=4)
def _parsed(path: Path, *state: int) -> dict[str, Record]:
    """Return the records of a file; `state` tells one version of the file from the next."""
    records = {}
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            record = json.loads(line)
            records[str(record.pop("key"))] = record
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise UserError(
                f"{path}, line {number}: not a result ({error!r}). Remove the line and run again."
            ) from None
    return records


def check_alike(path: Path, several: Iterable[Mapping[str, Any]]) -> None:
    """Raise UserError for records of `path` whose values of one name differ: they make no table
    together.
    """
    if wrong := differences(several):
        raise UserError(f"{path}: runs differ ({wrong}). Make them again in one file.")


def differences(several: Iterable[Mapping[str, Any]]) -> str:
    """Return in words the values that differ under one name, empty for none.

    A name that is missing is no value.
    """
    values: dict[str, set[str]] = {}
    for one in several:
        for name, value in one.items():
            values.setdefault(name, set()).add(str(value))
    return "; ".join(
        f"{name} {' and '.join(sorted(some))}" for name, some in values.items() if len(some) > 1
    )


def write_record(path: Path, key: str, record: Mapping[str, Any]) -> None:
    """Add a run to a file of results, or replace the run of the same key.

    The file is rewritten as a whole, under a lock, so several processes may write to it. Raises
    OSError.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with _locked(path.parent):
        records = read_records(path) | {key: dict(record)}
        lines = [
            json.dumps({"key": name, **records[name]}, allow_nan=False) for name in sorted(records)
        ]
        atomic_write(path, "\n".join(lines) + "\n")


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder.

    It ends with the block or with the process, and leaves no file behind.
    """
    import fcntl

    handle = os.open(folder, os.O_RDONLY)
    try:
        # a disk without locks
        with contextlib.suppress(OSError):
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)
