"""What a checkpoint folder says of itself: `checkpoint.json`, with the size and checksum of every file beside it.

A folder is read only after its files have been compared with that record, so that a truncated or altered file is one
clear sentence that names it, never a wrong number.
"""

from __future__ import annotations

import json
import os
import re
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from anytouch_jax.errors import UserError

RECORD = "checkpoint.json"
FORMAT = "anytouch_jax.checkpoint.1"
_CHUNK = 1 << 22
_STEP = re.compile(r"\d{8,}")


class CheckpointError(UserError):
    """A checkpoint that cannot be written or read; the message is one sentence that names the path."""


def write_record(folder: Path, content: Mapping[str, Any]) -> None:
    """Write `content` (JSON values) and every file's size and CRC-32: the last file of a save."""
    files = {
        path.relative_to(folder).as_posix(): [path.stat().st_size, _checksum(path)]
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name != RECORD
    }
    plain = json.loads(json.dumps({"format": FORMAT, **content, "files": files}, allow_nan=False))
    body = json.dumps(plain, sort_keys=True)
    with open(folder / RECORD, "w", encoding="utf-8") as file:
        file.write(f'{{"checksum": {zlib.crc32(body.encode())}, "record": {body}}}\n')
        file.flush()
        os.fsync(file.fileno())


def read_record(folder: Path) -> dict[str, Any]:
    """The record of a checkpoint folder. Raises CheckpointError when it is absent, foreign or damaged."""
    path = folder / RECORD
    if not path.is_file():
        raise CheckpointError(f"{folder} is not a checkpoint of this program: it has no {RECORD}")
    try:
        outer = json.loads(path.read_text(encoding="utf-8"))
        record = outer["record"]
        body = json.dumps(record, sort_keys=True)
        whole = outer["checksum"] == zlib.crc32(body.encode())
    except (ValueError, KeyError, TypeError):  # UnicodeDecodeError and JSONDecodeError are ValueErrors
        raise CheckpointError(f"checkpoint {folder} is damaged: {RECORD} cannot be read") from None
    if not whole:
        raise CheckpointError(f"checkpoint {folder} is damaged: {RECORD} was altered")
    if record.get("format") != FORMAT:
        raise CheckpointError(f"checkpoint {folder} has format {record.get('format')!r}; this program reads {FORMAT!r}")
    return record


def verify(folder: Path, record: Mapping[str, Any]) -> None:
    """Compare the files of a checkpoint with its record. Raises CheckpointError that names the first bad one."""
    for name, (size, checksum) in record["files"].items():
        path = folder / name
        if not path.is_file():
            raise CheckpointError(f"checkpoint {folder} is damaged: its file {name} is missing")
        if path.stat().st_size != size:
            raise CheckpointError(
                f"checkpoint {folder} is damaged: its file {name} has {path.stat().st_size} bytes instead of {size}"
            )
        if _checksum(path) != checksum:
            raise CheckpointError(f"checkpoint {folder} is damaged: its file {name} was altered")


def steps(folder: str | Path) -> list[int]:
    """The complete steps in a folder of checkpoints, in ascending order; half-written ones are not counted."""
    folder = Path(folder)
    if not folder.is_dir():
        return []
    return sorted(int(entry.name) for entry in folder.iterdir() if _STEP.fullmatch(entry.name) and entry.is_dir())


def resolve(folder: Path, step: int | None) -> Path:
    """The folder of one checkpoint, from a run, a folder of checkpoints or that folder itself."""
    folder = folder.absolute()
    if (folder / "checkpoints").is_dir():
        folder = folder / "checkpoints"
    elif _STEP.fullmatch(folder.name) and folder.is_dir() and not steps(folder):
        if step is not None and step != int(folder.name):
            raise CheckpointError(f"{folder} is the checkpoint of step {int(folder.name)}, not of step {step}")
        return folder
    if folder.is_file():
        raise CheckpointError(f"{folder} is a file; give the folder of a run, which has checkpoints")
    present = steps(folder)
    if not present:
        raise CheckpointError(f"there is no complete checkpoint in {folder}; train first, or give another folder")
    if step is not None and step not in present:
        listed = ", ".join(str(one) for one in present[-10:])
        raise CheckpointError(f"there is no checkpoint of step {step} in {folder}; it has {listed}")
    return folder / f"{present[-1] if step is None else step:08d}"


def checked(folder: Path) -> dict[str, Any]:
    """The record of a checkpoint whose files are whole; an error says which older step is."""
    try:
        record = read_record(folder)
        verify(folder, record)
    except CheckpointError as error:
        older = [step for step in reversed(steps(folder.parent)) if step < int(folder.name)]
        intact = next((step for step in older if _intact(folder.parent / f"{step:08d}")), None)
        advice = (
            "there is no intact older checkpoint beside it"
            if intact is None
            else f"step {intact} beside it is intact, remove {folder.name} to go on from there"
        )
        raise CheckpointError(f"{error}; {advice}") from None
    return record


def _intact(folder: Path) -> bool:
    try:
        verify(folder, read_record(folder))
    except CheckpointError:
        return False
    return True


def _checksum(path: Path) -> int:
    value = 0
    with open(path, "rb") as file:
        while chunk := file.read(_CHUNK):
            value = zlib.crc32(chunk, value)
    return value
