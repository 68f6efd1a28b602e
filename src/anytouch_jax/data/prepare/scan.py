"""File scan: existence, decoding, size, hash and colours of every file of a manifest, each read once."""

from __future__ import annotations

import hashlib
import os
import zlib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np

from anytouch_jax.bars import tracked
from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.data.images import ImageError, decode_bytes, to_rgb
from anytouch_jax.data.loading.threads import bounded_map
from anytouch_jax.data.manifest.files import Files, distinct_files, read_file, split_shard_path
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.manifest.schema import shown
from anytouch_jax.errors import UserError

STATES = ("ok", "missing", "outside", "empty", "truncated", "unreadable")
OK = STATES.index("ok")
EXAMPLES = 5  # sentences of a finding
FIELDS = 4  # colours are the means of 4 x 4 fields
SPREAD, BOTTOM, BORDER, CHROMA, NOISE = range(5)  # columns of Scan.looks
_CROP = 128  # side of the middle of a picture where noise is measured
_MAX_REASONS = 1000  # a million broken files must not fill the memory


class Scan(NamedTuple):
    """The state of every distinct file i of n.

    `state` u8 (n,) indexes STATES. `size` i32 (n, 2) is width and height, 0 if not decoded. `digest` S32 (n,) is the
    first half of the SHA-256 in hex. `colours` is u8 (n, 48). `looks` f32 (n, 5) are the measures of `_looks`, and
    `pixels` u32 (n,) is a checksum of the pixels. `bits` u8 (n,) are those that a picture of 16 bits uses, else 0.
    `reasons` explains the first thousand bad files.
    """

    files: Files
    state: np.ndarray
    size: np.ndarray
    digest: np.ndarray
    colours: np.ndarray
    looks: np.ndarray
    pixels: np.ndarray
    bits: np.ndarray
    reasons: dict[int, str]

    def states(self, column: str) -> np.ndarray:
        """Return the state of the file in every cell of a column, u8 (rows,). A null cell is OK."""
        code = self.files.code[column]
        return np.where(code < 0, OK, self.state[code])

    @property
    def decoded(self) -> np.ndarray:
        """Whether each file is a whole picture that was decoded, bool (n,)."""
        return (self.state == OK) & (self.size[:, 0] > 0)


Level = Literal["error", "warning", "info"]


class Finding(NamedTuple):
    """One kind of fault: the row ids i64 that it concerns, sentences about the first few, and the first files."""

    kind: str
    level: Level
    sentence: str
    rows: np.ndarray
    examples: tuple[str, ...] = ()
    column: str | None = None
    files: tuple[str, ...] = ()


def finding(
    manifest: Manifest, kind: str, level: Level, rows: np.ndarray, words: str, *columns: str, column: str | None = None
) -> Iterator[Finding]:
    """Yield a finding of `rows` if there are any: their number and `words`, with their values in `columns`."""
    if rows.size:
        examples = (
            f"{manifest.where(row)}: {', '.join(shown(manifest.value(row, name)) for name in columns)}"
            for row in rows[:EXAMPLES]
        )
        yield Finding(kind, level, f"{rows.size} {words}", rows, tuple(examples), column or columns[0])


class _FileState(NamedTuple):
    state: str
    size: tuple[int, int] = (0, 0)
    digest: bytes = b""
    colours: np.ndarray | None = None
    looks: np.ndarray | None = None
    pixels: int = 0
    bits: int = 0
    reason: str = ""


def scan(manifest: Manifest, *, decode: bool = True, threads: int = 4) -> Scan:
    """Read every distinct file. Without `decode`, check only that it exists and is not empty.

    Memory holds some 100 bytes for each file and the images being decoded.
    """
    files = distinct_files(manifest)
    count = len(files)
    result = Scan(
        files, np.zeros(count, np.uint8), np.zeros((count, 2), np.int32), np.zeros(count, "S32"),
        np.zeros((count, 3 * FIELDS * FIELDS), np.uint8), np.zeros((count, 5), np.float32),
        np.zeros(count, np.uint32), np.zeros(count, np.uint8), {},
    )  # fmt: skip

    def inspect(file: int) -> _FileState:
        row, column = int(files.row[file]), str(files.column[file])
        is_field = column == "field_path" or (column == "path" and manifest.value(row, "sensor") in FIELD_SENSORS)
        try:
            path = manifest.file(row, column)
        except UserError as error:
            return _FileState("outside", reason=str(error))
        try:
            if not decode and not split_shard_path(path):
                return _FileState("ok" if os.stat(path).st_size else "empty")
            data = read_file(path)
        except FileNotFoundError:
            return _FileState("missing")
        except (OSError, ValueError, MemoryError) as error:
            return _FileState("unreadable", reason=str(getattr(error, "strerror", None) or error))
        return _judge(data, path, decode and not is_field) if data else _FileState("empty")

    with closing(bounded_map(inspect, range(count), threads, 8 * max(threads, 1))) as states:
        for file, state in enumerate(tracked(states, "files checked", count)):
            result.state[file] = STATES.index(state.state)
            result.size[file], result.digest[file] = state.size, state.digest
            if state.colours is not None:
                result.colours[file], result.looks[file] = state.colours, state.looks
                result.pixels[file], result.bits[file] = state.pixels, state.bits
            if state.reason and len(result.reasons) < _MAX_REASONS:
                result.reasons[file] = state.reason
    return result


def _judge(data: bytes, path: Path, is_image: bool) -> _FileState:
    digest = hashlib.sha256(data).hexdigest()[:32].encode()
    if not is_image:
        return _FileState("ok", digest=digest)
    try:
        stored = decode_bytes(data, path, as_stored=True)
        pixels = to_rgb(stored, path)
    except ImageError as error:
        reason = str(error).removeprefix(f"{path} ").removeprefix("cannot be read: ")
        return _FileState("truncated" if "cut short" in reason else "unreadable", digest=digest, reason=reason)
    height, width = pixels.shape[:2]
    colour = stored[..., :3] if stored.ndim == 3 else stored  # alpha is full
    bits = int(colour.max()).bit_length() if stored.dtype.kind == "u" and stored.itemsize == 2 else 0
    colours = cv2.resize(pixels, (FIELDS, FIELDS), interpolation=cv2.INTER_AREA).reshape(-1)
    return _FileState("ok", (width, height), digest, colours, _looks(pixels), zlib.crc32(pixels.data), bits)


def _looks(pixels: np.ndarray) -> np.ndarray:
    """Return measures of RGB u8 (h, w, 3) as f32 (5,).

    In order: the standard deviation, and the share of rows at the bottom of one colour other than black. The share of
    the largest black border. The mean range of a pixel's channels. The share of the variance that is noise from pixel
    to pixel.
    """
    # OpenCV needs a tenth of NumPy's time for these.
    rows, columns = (cv2.reduce(pixels, dim, cv2.REDUCE_MAX).reshape(-1, 3) for dim in (1, 0))
    black = [
        _leading(side) for most in (rows, columns) for dark in [most.max(axis=1) <= 16] for side in (dark, dark[::-1])
    ]
    least = cv2.reduce(pixels, 1, cv2.REDUCE_MIN).reshape(-1, 3)
    # A cut JPEG is filled with exactly one grey.
    same = ((rows == pixels[-1, 0]) & (least == pixels[-1, 0])).all(axis=1)
    bottom = 0.0 if black[1] else _leading(same[::-1])
    height, width = pixels.shape[:2]
    top, left = max(0, (height - _CROP) // 2), max(0, (width - _CROP) // 2)
    grey = cv2.cvtColor(pixels[top : top + _CROP, left : left + _CROP], cv2.COLOR_RGB2GRAY).astype(np.float32)
    variance = float(grey.var())
    noise = 0.0
    if variance > 100 and min(grey.shape) > 1:
        noise = min(float((np.diff(grey, axis=axis) ** 2).mean()) / (2 * variance) for axis in (0, 1))
    spread = float(cv2.meanStdDev(pixels)[1].max())
    red, green, blue = cv2.split(pixels)
    ranges = cv2.subtract(cv2.max(cv2.max(red, green), blue), cv2.min(cv2.min(red, green), blue))
    chroma = float(cv2.mean(ranges)[0])
    return np.array([spread, bottom, max(black), chroma, noise], np.float32)


def _leading(flags: np.ndarray) -> float:
    """Return the share of flags bool (n,) before the first that is false, 0 if none is false."""
    return float(np.argmin(flags)) / len(flags)
