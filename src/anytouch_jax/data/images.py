"""Pictures and videos from disk as RGB uint8 arrays, refused when they are broken, odd or too large."""

from __future__ import annotations

import io
import itertools
import math
import os
import re
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

from anytouch_jax.data.manifest.files import NPY_HEADER_LOCK, read_file
from anytouch_jax.data.manifest.schema import is_manifest
from anytouch_jax.errors import UserError

MAX_PIXELS = 1 << 26  # a small PNG can declare a picture that would fill the memory
MAX_ASPECT = (
    100  # a longer side than so many times the shorter one is a strip, which would fill the memory when resized
)
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".npy")
BACKGROUND, PHOTO = "background", "photo"  # pictures beside the frames of a recording that are none

# Since OpenCV 4.11; orientation tags are ignored as for other files.
_JPEG_RGB: int = cv2.IMREAD_UNCHANGED
if hasattr(cv2, "IMREAD_COLOR_RGB"):
    _JPEG_RGB = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
_BITS, _ALPHA = 258, 338  # tags of a TIFF: bits of a sample; what the fourth sample is (2: unassociated alpha)
_HEADER_1, _HEADER_2 = np.lib.format.read_array_header_1_0, np.lib.format.read_array_header_2_0

cv2.setNumThreads(1)  # the loader has its own threads


class ImageError(UserError):
    """A picture or a video that cannot be used; the message names the file."""


def decode(path: str | Path) -> np.ndarray:
    """The picture in `path`, a file or a row of a shard (see packed.py), as RGB u8 (h, w, 3).

    Grey becomes RGB, an alpha channel is dropped, 16 bits are scaled to 8, floats are taken as 0..1. PNG, JPEG, TIFF,
    BMP, WebP and .npy are read; orientation tags are ignored. Raises ImageError for a missing, broken or too large
    file and for pixels that are NaN or outside 0..1.
    """
    path = path if isinstance(path, Path) else Path(path)  # a copy takes as long as the reading
    try:
        data = read_file(path)
    except FileNotFoundError:
        raise ImageError(f"there is no file {path}") from None
    except (OSError, ValueError, MemoryError) as error:
        raise ImageError(f"{path} cannot be read: {error}") from None
    return decode_bytes(data, path)


def decode_bytes(data: bytes, name: str | Path) -> np.ndarray:
    """The picture that `data` is, as `decode` gives it; `name` is for errors."""
    try:
        pixels = _unpack(data)
    except (ValueError, EOFError, MemoryError) as error:
        raise ImageError(f"{name} cannot be read: {error}") from None
    return to_rgb(pixels, name)


def _unpack(data: bytes) -> np.ndarray:
    if data[:6] == b"\x93NUMPY":
        return _array(data)
    size = _declared_size(data)
    if size is None:
        raise ValueError("it is not a PNG, JPEG, TIFF, BMP, WebP or .npy picture")
    if size[0] * size[1] > MAX_PIXELS:
        raise ValueError(f"it declares {size[0]} x {size[1]} pixels, more than the limit of {MAX_PIXELS}")
    # OpenCV fills the lost part of some cut JPEG files with grey.
    if data[:2] == b"\xff\xd8" and data.find(b"\xff\xd9", _jpeg_scan(data)) < 0:
        raise ValueError("the file is cut short")
    jpeg = data[:2] == b"\xff\xd8" and _JPEG_RGB != cv2.IMREAD_UNCHANGED  # 8 bits; the decoder itself writes RGB
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), _JPEG_RGB if jpeg else cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ValueError(error.err) from None
    if pixels is None:
        raise ValueError("the picture is corrupt or cut short")
    if not jpeg and pixels.ndim == 3 and pixels.shape[2] in (3, 4):
        if pixels.dtype not in (np.uint8, np.uint16, np.float32):  # of a TIFF; OpenCV exchanges no channels of these
            return pixels[..., 2::-1]
        pixels = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGB)
    return pixels


def _array(data: bytes) -> np.ndarray:
    """A .npy as a view of its bytes, which cannot declare more than there is."""
    stream = io.BytesIO(data)
    try:
        old = np.lib.format.read_magic(stream) == (1, 0)
        with NPY_HEADER_LOCK:
            shape, fortran, kind = (_HEADER_1 if old else _HEADER_2)(stream)
    except Exception:  # the header is Python text: a spoiled one fails in the tokenizer, the parser or in NumPy
        raise ValueError("the file is cut short, or its header is corrupt") from None
    if kind.hasobject:
        raise ValueError("it holds Python objects")
    if stream.tell() + math.prod(shape) * kind.itemsize > len(data):
        raise ValueError("the file is cut short")
    return np.frombuffer(data, kind, math.prod(shape), stream.tell()).reshape(shape, order="F" if fortran else "C")


def to_rgb(pixels: np.ndarray, path: str | Path) -> np.ndarray:
    """Pixels of a picture as RGB u8 (h, w, 3), by the rules of `decode`; `path` is for errors. Raises ImageError."""
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3, 4) or 0 in pixels.shape:
        raise ImageError(f"{path} has shape {pixels.shape}; a picture is (height, width) with 1, 3 or 4 channels")
    if pixels.shape[0] * pixels.shape[1] > MAX_PIXELS:
        raise ImageError(
            f"{path} has {pixels.shape[1]} x {pixels.shape[0]} pixels, more than the limit of {MAX_PIXELS}"
        )
    if max(pixels.shape[:2]) > MAX_ASPECT * min(pixels.shape[:2]):
        raise ImageError(f"{path} has {pixels.shape[1]} x {pixels.shape[0]} pixels: that is a strip, not a picture")
    pixels = pixels[..., :3].astype(pixels.dtype.newbyteorder("="), copy=False)
    if pixels.dtype == np.uint16:
        pixels = ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
    elif np.issubdtype(pixels.dtype, np.floating):
        low, high = float(pixels.min()), float(pixels.max())
        if np.isnan(low):
            raise ImageError(f"{path} has NaN pixels")
        if low < 0 or high > 1:
            raise ImageError(f"{path} has float pixels in {low:g}..{high:g}; floats must lie in 0..1")
        pixels = np.rint(pixels.astype(np.float32) * 255).astype(np.uint8)
    elif pixels.dtype != np.uint8:
        raise ImageError(f"{path} has pixels of type {pixels.dtype}; use uint8, uint16 or floats in 0..1")
    if pixels.shape[2] == 1:
        pixels = np.repeat(pixels, 3, axis=2)
    return np.ascontiguousarray(pixels)


def _declared_size(data: bytes) -> tuple[int, int] | None:
    """(width, height) that the header declares, before anything is unpacked; None for another kind of file."""
    try:
        if data[:8] == b"\x89PNG\r\n\x1a\n":
            return _png_size(data)
        if data[:2] == b"\xff\xd8":
            return _jpeg_size(data)
        if data[:4] in (b"II*\0", b"MM\0*"):
            return _tiff_size(data)
        if data[:2] == b"BM":
            width, height = struct.unpack("<ii", data[18:26])
            return abs(width), abs(height)
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _webp_size(data)
    except struct.error:
        raise ValueError("the file is cut short") from None
    return None


def _png_size(data: bytes) -> tuple[int, int]:
    """Width and height, after a walk over the chunks: OpenCV fills the memory for one that declares 2 GB."""
    at, kind, kinds = 8, b"", 0
    while kind != b"IEND":
        length, kind = int.from_bytes(data[at : at + 4]), data[at + 4 : at + 8]
        at += 12 + length
        if at > len(data):
            raise ValueError("the picture is corrupt or cut short")
        kinds += kind == b"IHDR"
    if kinds != 1 or data[12:16] != b"IHDR":
        raise ValueError("the picture is corrupt")
    return struct.unpack(">II", data[16:24])


def _jpeg_size(data: bytes) -> tuple[int, int]:
    at = 2
    while True:
        marker, length = struct.unpack(">2sH", data[at : at + 4])
        if marker[0] != 0xFF:
            raise ValueError("the picture is corrupt")
        if marker[1] == 0xFF:  # a fill byte
            at += 1
        elif 0xC0 <= marker[1] <= 0xCF and marker[1] not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            return width, height
        else:
            at += 2 + length


def _jpeg_scan(data: bytes) -> int:
    """Where the first scan begins. No end marker stands in a scan, but one may in what is before it (a thumbnail)."""
    at = 2
    while data[at : at + 2] != b"\xff\xda":
        if at + 4 > len(data) or data[at] != 0xFF:
            raise ValueError("the file is cut short")
        at += 1 if data[at + 1] == 0xFF else 2 + int.from_bytes(data[at + 2 : at + 4])
    return at


def _tiff_size(data: bytes) -> tuple[int, int]:
    """Width and height. Raises ValueError for a stack of pictures, of which OpenCV reads the first alone, and for 8-bit
    colours beside an unassociated alpha, by which OpenCV multiplies them."""
    order = "<" if data[:2] == b"II" else ">"
    (at,) = struct.unpack(order + "I", data[4:8])
    (count,) = struct.unpack(order + "H", data[at : at + 2])
    found: dict[int, int] = {}
    for entry in range(at + 2, at + 2 + 12 * count, 12):
        tag, kind = struct.unpack(order + "HH", data[entry : entry + 4])
        if tag in (256, 257):
            (side,) = struct.unpack(order + ("H2x" if kind == 3 else "I"), data[entry + 8 : entry + 12])
            found[tag] = max(side, found.get(tag, 0))  # decoders go by the first or by the last one
        elif tag in (_BITS, _ALPHA):
            long = struct.unpack(order + "I", data[entry + 4 : entry + 8])[0] > 2  # two of 16 bits fit in place
            where = struct.unpack(order + "I", data[entry + 8 : entry + 12])[0] if long else entry + 8
            (found[tag],) = struct.unpack(order + "H", data[where : where + 2])
    if not {256, 257} <= found.keys():
        raise ValueError("the picture is corrupt")
    if int.from_bytes(data[at + 2 + 12 * count : at + 6 + 12 * count]):
        raise ValueError("it holds several pictures; write a file for each")
    if found.get(_ALPHA) == 2 and found.get(_BITS) == 8:
        raise ValueError("it has an alpha channel by which its colours would be multiplied; write it without alpha")
    return found[256], found[257]


def _webp_size(data: bytes) -> tuple[int, int]:
    if data[12:16] == b"VP8X":
        width, height = (int.from_bytes(data[at : at + 3], "little") + 1 for at in (24, 27))
    elif data[12:16] == b"VP8L":
        (bits,) = struct.unpack("<I", data[21:25])
        width, height = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    else:
        width, height = (side & 0x3FFF for side in struct.unpack("<HH", data[26:30]))
    return width, height


def frames_from_video(path: str | Path) -> Iterator[np.ndarray]:
    """The frames of a video, one by one, as RGB u8 (h, w, 3). Raises ImageError when there is none to be had."""
    path = Path(path)
    if not path.is_file():
        raise ImageError(f"there is no video {path}")
    video = _opened(path)
    try:
        count = 0
        while True:
            there, frame = video.read()
            if not there:
                break
            count += 1
            yield cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
        if not count:
            raise ImageError(f"{path} is not a video that can be read, or has no frame")
    finally:
        video.release()


def _opened(path: str | Path) -> cv2.VideoCapture:
    return cv2.VideoCapture(os.path.abspath(path))  # FFmpeg takes what is before a name's colon for a protocol


def count_frames(path: str | Path) -> int:
    """The number of frames that a video's header tells of, 0 where it tells nothing."""
    video = _opened(path)
    try:
        return max(0, int(video.get(cv2.CAP_PROP_FRAME_COUNT)))
    finally:
        video.release()


def list_images(folder: str | Path) -> tuple[list[Path], dict[str, Path]]:
    """The frames of a folder in order (`frame_sort_key`), arrays only where there is nothing else, and the pictures in
    it that are no frames by name (BACKGROUND, PHOTO). Raises ImageError when there are no frames."""
    folder = Path(folder)
    if not folder.is_dir():
        raise ImageError(f"there is no folder {folder}")
    files = [file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES and not file.name.startswith(".")]
    beside = {file.stem.lower(): file for file in files if file.stem.lower() in (BACKGROUND, PHOTO)}
    files = [file for file in files if file.stem.lower() not in beside]
    files = [file for file in files if file.suffix.lower() != ".npy"] or files
    if not files:
        raise ImageError(f"{folder} has no pictures ({', '.join(SUFFIXES)}){_instead(folder)}")
    return sorted(files, key=lambda file: frame_sort_key(file.name)), beside


def _instead(folder: Path) -> str:
    """What to give in the place of a folder without pictures: the manifest that it holds, or one to be made."""
    inside = sorted(folder.iterdir())
    for file in inside:
        if file.suffix.lower() in (".csv", ".parquet") and is_manifest(file):
            return f"; give its manifest {file}"
    below = (file for one in inside if one.is_dir() and not one.name.startswith(".") for file in one.rglob("*"))
    if any(file.suffix.lower() in SUFFIXES for file in below):
        return (
            f"; they lie in its sub-folders: anytouch index recordings {folder} --sensor NAME makes a manifest of them"
        )
    return ""


def frame_numbers(names: Sequence[str]) -> list[int]:
    """The numbers of frames in order: those at the end of their names where these count frames (a third of the steps or
    more are one), so that a frame left out is a gap; else 0, 1, 2, ... (time stamps, of which two may be one apart)."""
    ends = [re.search(r"(\d{1,18})$", Path(name).stem) for name in names]
    numbers = [int(end[1]) for end in ends if end]
    steps = [b - a for a, b in itertools.pairwise(numbers)]
    counts = len(numbers) == len(names) and min(steps, default=0) == 1 and 3 * steps.count(1) >= len(steps)
    return numbers if counts else list(range(len(names)))


def split_series(names: Sequence[str]) -> dict[str, list[str]]:
    """Names of one folder in order by what stands before their numbers, where two series share a number (left_0 and
    right_0 of two fingers); else all of them under "". Series differ by more than numbers: 12-00-05 is a time."""
    series: dict[str, list[str]] = {}
    numbers: dict[int, set[str]] = {}
    for name in names:
        stem = Path(name).stem
        end = None if re.fullmatch(r"\d+\.\d+", stem) else re.search(r"\d{1,18}$", stem)
        key = stem[: end.start()].rstrip(" ._-") if end else ""
        series.setdefault(key, []).append(name)
        if end:
            numbers.setdefault(int(end[0]), set()).add(re.sub(r"(?<![^\W\d_])(?<!\d)\d+", "", key))
    shared = any(len(of) > 1 for of in numbers.values())
    return series if shared else {"": list(names)}


def frame_sort_key(name: str) -> tuple[int | float, list[tuple[int, str]]]:
    """A sort key of frames: numbers and time stamps as the numbers that they are, then the others, 2 before 10."""
    stem = Path(name).stem
    if re.fullmatch(r"\d+", stem):  # a whole second is often written without its point
        return int(stem), natural(name)
    return (float(stem), []) if re.fullmatch(r"\d+\.\d+", stem) else (math.inf, natural(name))


def natural(name: str) -> list[tuple[int, str]]:
    """A sort key that puts 2 before 10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", name)]
