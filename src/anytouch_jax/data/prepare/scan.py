"""Every file of a manifest looked at once: is it there, does it decode whole, its size, its hash, its colours."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.data.images import ImageError, decode_bytes
from anytouch_jax.data.loading.threads import bounded_map
from anytouch_jax.data.manifest.files import Files, distinct_files, read_file, split_shard_path
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.errors import UserError

STATES = ("ok", "missing", "outside", "empty", "truncated", "unreadable")
OK = STATES.index("ok")
SIDE = 4  # the colours of a picture: means of 4 x 4 fields
_REASONS = 1000  # sentences kept, so that a million broken files do not fill the memory


class Scan(NamedTuple):
    """What is known of every distinct file i (n in all).

    `state` u8 (n,) a number in STATES; `size` i32 (n, 2) width and height, 0 where not decoded; `digest` S32 (n,) the
    first half of its SHA-256 in hex; `colours` u8 (n, 48); `reasons` why the first thousand bad ones are bad.
    """

    files: Files
    state: np.ndarray
    size: np.ndarray
    digest: np.ndarray
    colours: np.ndarray
    reasons: dict[int, str]

    def states(self, column: str) -> np.ndarray:
        """The state of the file in every cell of a column, u8 (rows,); OK where the cell is null."""
        code = self.files.code[column]
        return np.where(code < 0, OK, self.state[code])


class _Look(NamedTuple):
    state: str
    size: tuple[int, int] = (0, 0)
    digest: bytes = b""
    colours: np.ndarray | None = None
    reason: str = ""


def scan(
    manifest: Manifest, *, decode: bool = True, threads: int = 4, log: Callable[[str], None] | None = None
) -> Scan:
    """Look at every distinct file; without `decode` only whether it is there and not empty.

    Memory: some 100 bytes a file and the pictures that are under way.
    """
    files = distinct_files(manifest)
    count = len(files)
    found = Scan(
        files, np.zeros(count, np.uint8), np.zeros((count, 2), np.int32), np.zeros(count, "S32"),
        np.zeros((count, 3 * SIDE * SIDE), np.uint8), {},
    )  # fmt: skip

    def look(file: int) -> _Look:
        row, column = int(files.row[file]), str(files.column[file])
        try:
            path = manifest.file(row, column)
        except UserError as error:
            return _Look("outside", reason=str(error))
        field = column == "field_path" or (column == "path" and manifest.value(row, "sensor") in FIELD_SENSORS)
        return (_look if decode or split_shard_path(path) else _glance)(path, decode and not field)

    with closing(bounded_map(look, range(count), threads, 8 * max(threads, 1))) as looks:
        for file, one in enumerate(looks):
            found.state[file] = STATES.index(one.state)
            found.size[file], found.digest[file] = one.size, one.digest
            if one.colours is not None:
                found.colours[file] = one.colours
            if one.reason and len(found.reasons) < _REASONS:
                found.reasons[file] = one.reason
            if log and (file + 1) % 100_000 == 0:
                log(f"{file + 1} of {count} files")
    return found


def _glance(path: Path, _: bool) -> _Look:
    try:
        size = os.stat(path).st_size
    except FileNotFoundError:
        return _Look("missing", reason="there is no such file")
    except OSError as error:
        return _Look("unreadable", reason=str(error.strerror))
    return _Look("ok") if size else _Look("empty", reason="the file has no bytes")


def _look(path: Path, is_picture: bool) -> _Look:
    try:
        data = read_file(path)
    except FileNotFoundError:
        return _Look("missing", reason="there is no such file")
    except (OSError, ValueError, MemoryError) as error:
        return _Look("unreadable", reason=str(getattr(error, "strerror", None) or error))
    if not data:
        return _Look("empty", reason="the file has no bytes")
    digest = hashlib.sha256(data).hexdigest()[:32].encode()
    if not is_picture:
        return _Look("ok", digest=digest)
    try:
        pixels = decode_bytes(data, path)
    except ImageError as error:
        reason = str(error).removeprefix(f"{path} ").removeprefix("cannot be read: ")
        return _Look("truncated" if "cut short" in reason else "unreadable", digest=digest, reason=reason)
    height, width = pixels.shape[:2]
    colours = cv2.resize(pixels, (SIDE, SIDE), interpolation=cv2.INTER_AREA).reshape(-1)
    return _Look("ok", (width, height), digest, colours)
