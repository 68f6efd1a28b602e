"""Images and videos as RGB uint8 arrays; broken, unsafe or too large files are refused."""

from __future__ import annotations

import contextlib
import ctypes
import io
import math
import os
import re
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from PIL import (
    BmpImagePlugin,
    ImageFile,
    JpegImagePlugin,
    PngImagePlugin,
    TiffImagePlugin,
    WebPImagePlugin,
)

from anytouch_jax.data.manifest.files import read_file, unpack_npy
from anytouch_jax.data.manifest.schema import is_manifest
from anytouch_jax.data.names import frame_order
from anytouch_jax.errors import UserError
from anytouch_jax.files import placeholder

MAX_PIXELS = 1 << 26  # a small file can declare an image that would fill the memory
MAX_CODED = 16 * MAX_PIXELS  # pixels times scans of a JPEG: each scan goes over the whole picture
MAX_PARTS = 1 << 12  # chunks or segments of a header, which Pillow reads one by one
MAX_PADDING = 1 << 16  # bytes between the segments of a JPEG, which Pillow reads one by one
MAX_ASPECT = 100  # a longer strip would fill the memory when its short side is resized
SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".npy")
# names of images in a recording that are not frames
BACKGROUND = "background"
PHOTO = "photo"

# Since OpenCV 4.11. Orientation tags are obeyed by `_upright`, as versions of OpenCV do it for
# other formats.
_JPEG_RGB: int = cv2.IMREAD_UNCHANGED
if hasattr(cv2, "IMREAD_COLOR_RGB"):
    _JPEG_RGB = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
_TIFF = (b"II*\0", b"MM\0*")
# Pillow's classes for the headers. Image.open adds a search over all formats, 40 of the 390 us that
# a JPEG takes.
_HEADERS: dict[bytes, type[ImageFile.ImageFile]] = {
    _PNG: PngImagePlugin.PngImageFile,
    _JPEG: JpegImagePlugin.JpegImageFile,
    b"BM": BmpImagePlugin.BmpImageFile,
    b"RIFF": WebPImagePlugin.WebPImageFile,
}
_ORIENTATION = 274  # a tag of EXIF and of a TIFF
# tags of a TIFF; _ALPHA is 2 for unassociated alpha
_WIDTH = 256
_HEIGHT = 257
_BITS = 258
_ALPHA = 338

_MARKER = re.compile(rb"\xff([^\0\xff\xd0-\xd7])")  # of a JPEG, not inside its coded data
_SCAN = b"\xda"
_END = b"\xd9"
_DECODED_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")

cv2.setNumThreads(1)  # the loader has threads already
if (
    "OPENCV_LOG_LEVEL" not in os.environ
):  # our errors say what is wrong; OpenCV's log would hide them
    # OpenCV 4, or 5
    (cv2.setLogLevel if hasattr(cv2, "setLogLevel") else cv2.utils.logging.setLogLevel)(0)
warnings.filterwarnings("ignore", module=r"PIL\.TiffImagePlugin")


# nothing; OpenCV reads it when a first video is opened
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")


class _Quiet:
    """A context in which the C library's `stderr`, where libjpeg and libpng print, is /dev/null.

    Python writes to descriptor 2, which does not change: no thread loses a sentence. Threads may be
    inside together. A C library in which `stderr` is no variable is left alone.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._inside = 0
        self._own = 0
        self._stream = None
        if "CS_GNU_LIBC_VERSION" in getattr(os, "confstr_names", ()):
            library = ctypes.CDLL(None)
            library.fopen.restype = ctypes.c_size_t
            self._null = library.fopen(os.devnull.encode(), b"w")
            self._stream = ctypes.c_size_t.in_dll(library, "stderr") if self._null else None

    def __enter__(self) -> None:
        if self._stream is not None:
            with self._lock:
                if not self._inside:
                    self._own = self._stream.value
                    self._stream.value = self._null
                self._inside += 1

    def __exit__(self, *_: object) -> None:
        if self._stream is not None:
            with self._lock:
                self._inside -= 1
                if not self._inside:
                    self._stream.value = self._own


QUIET = _Quiet()


class ImageError(UserError):
    """An image or a video that cannot be used; the message names the file."""


def decode(path: str | Path) -> np.ndarray:
    """Return the image in `path`, a file or a row of a shard (`manifest.files`), as RGB u8 (h, w,
    3).

    Grey becomes RGB, an alpha channel is dropped, 16 bits are scaled to 8, and floats are taken as
    0..1. Reads PNG, JPEG, TIFF, BMP, WebP and .npy, and obeys orientation tags, as for a video.
    Raises ImageError for a missing, broken or too large file, and for pixels that are NaN or
    outside 0..1.
    """
    # copying a Path takes as long as reading the file
    path = path if isinstance(path, Path) else Path(path)
    try:
        data = read_file(path)
    except FileNotFoundError:
        raise ImageError(f"there is no file {path}") from None
    except (OSError, ValueError, MemoryError) as error:
        raise ImageError(f"{path} cannot be read: {error}") from None
    return decode_bytes(data, path)


def decode_bytes(data: bytes, name: str | Path, *, as_stored: bool = False) -> np.ndarray:
    """Return the image in `data` as `decode` does, or its pixels before any scaling; `name` is for
    errors.
    """
    try:
        pixels = _unpack(data)
    except (ValueError, EOFError, MemoryError) as error:
        raise ImageError(f"{name} cannot be read: {error}") from None
    if as_stored:
        return pixels
    return to_rgb(pixels, name)


def encode(picture: np.ndarray, suffix: str = ".png", *settings: int) -> bytes:
    """Return a picture RGB u8 (h, w, 3) as PNG or JPEG; `settings` are those of cv2.imencode."""
    return cv2.imencode(suffix, cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), settings)[1].tobytes()


def to_rgb(pixels: np.ndarray, path: str | Path) -> np.ndarray:
    """Return pixels as RGB u8 (h, w, 3) by the rules of `decode`; `path` is for errors.

    Raises ImageError.
    """
    if pixels.ndim == 2:
        pixels = pixels[..., None]
    if pixels.ndim != 3 or pixels.shape[2] not in (1, 3, 4) or 0 in pixels.shape:
        raise ImageError(
            f"{path} has shape {pixels.shape}; an image is (height, width) with 1, 3 or 4 channels"
        )
    height, width = pixels.shape[:2]
    if height * width > MAX_PIXELS:
        raise ImageError(
            f"{path} has {width} x {height} pixels, more than the limit of {MAX_PIXELS}"
        )
    if max(height, width) > MAX_ASPECT * min(height, width):
        raise ImageError(f"{path} has {width} x {height} pixels: that is a strip, not a picture")
    pixels = pixels[..., :3].astype(pixels.dtype.newbyteorder("="), copy=False)
    if pixels.dtype == np.uint16:
        pixels = ((pixels.astype(np.uint32) + 128) // 257).astype(np.uint8)
    elif np.issubdtype(pixels.dtype, np.floating):
        low = float(pixels.min())
        high = float(pixels.max())
        if np.isnan(low):
            raise ImageError(f"{path} has NaN pixels")
        if low < 0 or high > 1:
            advice = "divide them by 255" if low >= 0 and high <= 255 else "scale them first"
            raise ImageError(
                f"{path} has float pixels in {low:g}..{high:g}; floats must lie in 0..1: {advice}"
            )
        pixels = np.rint(pixels.astype(np.float32) * 255).astype(np.uint8)
    elif pixels.dtype != np.uint8:
        raise ImageError(
            f"{path} has pixels of type {pixels.dtype}; use uint8, uint16 or floats in 0..1, for a "
            "list "
            "np.asarray(frame, np.uint8)"
        )
    if pixels.shape[2] == 1:
        pixels = np.repeat(pixels, 3, axis=2)
    return np.ascontiguousarray(pixels)


def _unpack(data: bytes) -> np.ndarray:
    if data[:6] == b"\x93NUMPY":
        return unpack_npy(data)
    chunks = _decoded_chunks(data) if data.startswith(_PNG) else data
    orientation = _check_header(data)
    # 8 bits; the decoder itself writes RGB
    jpeg = data.startswith(_JPEG) and _JPEG_RGB != cv2.IMREAD_UNCHANGED
    try:
        with QUIET:
            pixels = cv2.imdecode(
                np.frombuffer(chunks, np.uint8), _JPEG_RGB if jpeg else cv2.IMREAD_UNCHANGED
            )
    except cv2.error as error:
        raise ValueError(error.err) from None
    if pixels is None:
        raise ValueError("the picture is corrupt or cut short")
    if not jpeg and pixels.ndim == 3 and pixels.shape[2] in (3, 4):
        if pixels.dtype not in (
            np.uint8,
            np.uint16,
            np.float32,
        ):  # of a TIFF; cvtColor refuses these types
            return pixels[..., 2::-1]
        pixels = cv2.cvtColor(
            pixels, cv2.COLOR_BGR2RGB if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGB
        )
    return _upright(pixels, orientation)


def _upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Return stored pixels (h, w) or (h, w, c) turned upright; EXIF's orientations are 1 to 8."""
    if orientation > 4:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        return pixels[:, ::-1]
    return pixels


def _check_header(data: bytes) -> int:
    """Return the EXIF orientation (1 for a TIFF).

    Raises ValueError unless OpenCV unpacks `data` whole and safely.
    """
    header = next((header for start, header in _HEADERS.items() if data.startswith(start)), None)
    if header is None and not data.startswith(_TIFF):
        if kind := placeholder(data):
            raise ValueError(f"it is {kind}")
        raise ValueError("it is not a PNG, JPEG, TIFF, BMP, WebP or .npy picture")
    if data.startswith(_JPEG):
        _check_segments(data)
    stream = io.BytesIO(data)
    image = None
    try:
        image = header(stream) if header is not None else None
        width, height = image.size if image is not None else _tiff_size(stream)
    except ValueError:
        raise
    except (
        Exception
    ) as error:  # Pillow raises many types for a corrupt header, and its own for a bomb
        reason = (
            "the file is cut short"
            if "truncated" in str(error).lower()
            else "its header is corrupt"
        )
        raise ValueError(f"{reason} ({error})") from None
    if width * height > MAX_PIXELS:
        raise ValueError(
            f"it declares {width} x {height} pixels, more than the limit of {MAX_PIXELS}"
        )
    if data.startswith(_JPEG):
        # OpenCV fills the lost part of some cut JPEG files with grey. The stream is now behind the
        # last header.
        if data.find(b"\xff\xd9", stream.tell()) < 0:
            raise ValueError("the file is cut short")
        _check_scans(data, max(width * height, 1 << 16))
    if image is not None and "exif" in image.info:
        return _orientation(image)
    return 1


def _orientation(image: ImageFile.ImageFile) -> int:
    try:
        value = image.getexif().get(_ORIENTATION, 1)
    except Exception:  # a corrupt tag; the picture itself may be whole
        return 1
    if value in range(1, 9):
        return value
    return 1


def _decoded_chunks(data: bytes) -> bytes:
    """Return a PNG without needless chunks, walked first: OpenCV allocates what a chunk declares,
    up to 4 GB.
    """
    at = 8
    kind = b""
    headers = 0
    count = 0
    parts = [data[:8]]
    while kind != b"IEND":
        length = int.from_bytes(data[at : at + 4])
        kind = data[at + 4 : at + 8]
        if at + 12 + length > len(data):
            raise ValueError("the picture is corrupt or cut short")
        if kind in _DECODED_CHUNKS:
            parts.append(data[at : at + 12 + length])
        at += 12 + length
        headers += kind == b"IHDR"
        if (count := count + 1) > MAX_PARTS + at // 256:
            raise ValueError(f"it has more than {MAX_PARTS} chunks of a few bytes")
    if headers != 1 or data[12:16] != b"IHDR":
        raise ValueError("the picture is corrupt")
    if len(parts) <= count:
        return b"".join(parts)
    return data


def _segments(data: bytes) -> Iterator[tuple[bytes, int]]:
    """Yield (kind, bytes skipped before it) of the segments of a JPEG up to its end, as decoders
    walk them.
    """
    at = 2
    while (marker := _MARKER.search(data, at)) and marker[1] != _END:
        yield marker[1], marker.start() - at
        at = marker.end() + max(2, int.from_bytes(data[marker.end() : marker.end() + 2]))


def _check_segments(data: bytes) -> None:
    """Bound the header of a JPEG."""
    padding = 0
    for count, (kind, skipped) in enumerate(_segments(data)):
        padding += skipped
        if padding > MAX_PADDING or count > MAX_PARTS:
            raise ValueError(
                f"its header has more than {MAX_PADDING} bytes of padding or {MAX_PARTS} segments"
            )
        if kind == _SCAN:
            return


def _check_scans(data: bytes, pixels: int) -> None:
    """Bound the time to decode a JPEG; a count of bytes, which may stand elsewhere too, is enough
    for most.
    """
    most = MAX_CODED // pixels
    if data.count(b"\xff" + _SCAN) > most:
        scans = 0
        for count, (kind, _) in enumerate(_segments(data)):
            scans += kind == _SCAN
            if scans > most or count > 16 * MAX_PARTS:
                raise ValueError(
                    f"it has more than {most} scans, which would take minutes; save it as a plain "
                    "JPEG"
                )


def _tiff_size(stream: io.BytesIO) -> tuple[int, int]:
    """Return (width, height).

    Pillow's image class knows no float colours, so only its directory reader is used.

    Raises ValueError for a stack of pictures, of which OpenCV reads the first only, and for 8-bit
    colours with unassociated alpha, by which OpenCV multiplies them.
    """
    data = stream.getvalue()
    order: Literal["little", "big"] = "little" if data[:2] == b"II" else "big"
    tags = TiffImagePlugin.ImageFileDirectory_v2(stream.read(8))
    start = tags.next
    count = int.from_bytes(data[start : start + 2], order)
    entries = [data[at : at + 2] for at in range(start + 2, start + 2 + 12 * count, 12)]
    if len(set(entries)) < count:  # decoders take the first or the last
        raise ValueError("the picture is corrupt: it has a tag twice")
    stream.seek(start)
    tags.load(stream)
    if tags.next:
        raise ValueError("it holds several pictures; write a file for each")
    if tags.get(_ALPHA) in (2, (2,)) and tags.get(_BITS, (0,))[0] == 8:
        raise ValueError(
            "it has an alpha channel by which its colours would be multiplied; write it without "
            "alpha"
        )
    return tags[_WIDTH], tags[_HEIGHT]


def frames_from_video(path: str | Path) -> Iterator[np.ndarray]:
    """Yield the frames of a video as RGB u8 (h, w, 3).

    Raises ImageError if it cannot be read or has no frame.
    """
    return (frame for _, frame in timed_frames(path))


def timed_frames(path: str | Path) -> Iterator[tuple[float, np.ndarray]]:
    """Yield (time stamp in seconds, RGB u8 (h, w, 3)) of the frames of a video.

    Raises ImageError as above.
    """
    path = Path(path)
    if not path.is_file():
        raise ImageError(f"there is no video {path}; give another path")
    video = open_video(path)
    number = 0
    last = -1.0
    try:
        while True:
            try:
                with QUIET:
                    whole, frame = video.read()
            except cv2.error as error:
                reason = " ".join(str(error).split())
                raise ImageError(f"frame {number} of {path} cannot be decoded: {reason}") from None
            if not whole or frame is None:
                break
            last = frame_time(video, number, last)
            yield last, np.ascontiguousarray(to_rgb(frame, path)[..., ::-1])
            number += 1
    finally:
        video.release()
    if not number:
        raise ImageError(f"{path} is not a video that can be read, or has no frame")


def frame_time(video: Any, number: int, last: float) -> float:
    """Return the seconds of frame `number` of a cv2.VideoCapture, later than `last`, by its stamp
    or the frame rate.
    """
    seconds = video.get(cv2.CAP_PROP_POS_MSEC) / 1000
    if math.isfinite(seconds) and seconds > last:
        return seconds
    rate = video.get(cv2.CAP_PROP_FPS)
    return max(last, number / rate if math.isfinite(rate) and rate > 0 else float(number))


def count_frames(path: str | Path) -> int:
    """Return the number of frames of a picture, a folder or a film's header, 0 if that has none."""
    if (files := picture_files(Path(path))) is not None:
        return len(files)
    video = open_video(path)
    try:
        return max(0, int(video.get(cv2.CAP_PROP_FRAME_COUNT)))
    finally:
        video.release()


def open_video(path: str | Path) -> cv2.VideoCapture | PyAvFilm:
    """Open a video, by PyAV if OpenCV cannot decode it.

    Raises ImageError for no film, and for an unknown codec.
    """
    if Path(path).is_file() and (kind := placeholder(path)):
        raise ImageError(f"{path} is {kind}")
    # FFmpeg takes the part of a relative name before a colon for a protocol
    place = os.path.abspath(path)
    with QUIET:
        video = cv2.VideoCapture(place)
        if not video.isOpened():
            return video
        if video.grab():
            return cv2.VideoCapture(place)  # some formats cannot go back
    codec = (
        int(video.get(cv2.CAP_PROP_FOURCC))
        .to_bytes(4, "little")
        .decode("ascii", "replace")
        .strip("\0 ")
    )
    try:
        film = PyAvFilm(place)
        if film.grab() and film.open(place):
            return film
    except ImportError:
        raise ImageError(
            f"OpenCV cannot decode {path}, a video of the codec {codec}: pip install "
            "'anytouch_jax[lerobot]' to read "
            "it, or convert it with ffmpeg -i IN -c:v libx264 OUT.mp4"
        ) from None
    except OSError:
        pass
    return video


class PyAvFilm:
    """A film such as AV1, BGR u8 (h, w, 3), with the methods of cv2.VideoCapture.

    Raises ImportError and OSError.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._frame = None
        self._container: Any = None
        self._frames: Iterator[Any] = iter(())
        self.open(path)

    def open(self, path: str) -> bool:
        """Start again at the first frame."""
        import av

        self.release()
        try:
            self._container = av.open(path)
            self._frames = self._container.decode(video=0)
        except (
            av.FFmpegError,
            ValueError,
            IndexError,
        ) as error:  # IndexError: a file without a film
            raise OSError(str(error)) from None
        self._frame = None
        self._number = 0
        return True

    def isOpened(self) -> bool:
        """Return whether frames can be read."""
        return self._container is not None

    def grab(self) -> bool:
        """Go to the next frame. A film that is damaged from there on ends."""
        self._frame = None
        # all errors of PyAV are of these types
        with contextlib.suppress(OSError, ValueError):
            self._frame = next(self._frames, None)
        self._number += self._frame is not None
        return self._frame is not None

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        """Return the frame of the last grab."""
        return self._frame is not None, None if self._frame is None else self._frame.to_ndarray(
            format="bgr24"
        )

    def read(self) -> tuple[bool, np.ndarray | None]:
        """Return the next frame."""
        self.grab()
        return self.retrieve()

    def get(self, name: int) -> float:
        """Return a property by OpenCV's number, 0 for one that is not known."""
        stream = self._container.streams.video[0]
        rate = float(stream.average_rate or 0)
        if name == cv2.CAP_PROP_FRAME_COUNT:
            return stream.frames or round((self._container.duration or 0) / 1e6 * rate)
        time = None if self._frame is None else self._frame.time
        known = {
            cv2.CAP_PROP_FPS: rate,
            cv2.CAP_PROP_POS_MSEC: 1000 * (time or 0),
            cv2.CAP_PROP_POS_FRAMES: self._number,
            cv2.CAP_PROP_FRAME_WIDTH: stream.width,
            cv2.CAP_PROP_FRAME_HEIGHT: stream.height,
        }
        return float(known.get(name, 0))

    def set(self, name: int, value: float) -> bool:
        """Go to a frame by its number; another property cannot be set."""
        if name != cv2.CAP_PROP_POS_FRAMES:
            return False
        if value < self._number:
            self.open(self._path)
        while self._number < value and self.grab():
            pass
        return self._number == value

    def release(self) -> None:
        """Close the film."""
        if self._container is not None:
            self._container.close()
            self._container = None


def list_images(folder: str | Path) -> tuple[list[Path], dict[str, Path]]:
    """Return the frames of a folder in order (`frame_order`), and its BACKGROUND and PHOTO images
    by name.

    Arrays (.npy) count as frames only if there are no pictures. Warns if the names show no order.
    Raises ImageError if there are no frames.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise ImageError(f"there is no folder {folder}; give another path")
    files = [
        file
        for file in folder.iterdir()
        if file.suffix.lower() in SUFFIXES and not file.name.startswith(".")
    ]
    named = {file.stem.lower(): file for file in files if file.stem.lower() in (BACKGROUND, PHOTO)}
    files = [file for file in files if file.stem.lower() not in named]
    files = [file for file in files if file.suffix.lower() != ".npy"] or files
    if not files:
        raise ImageError(f"{folder} has no pictures ({', '.join(SUFFIXES)}){_suggestion(folder)}")
    names, is_clear = frame_order([file.name for file in files])
    if not is_clear:
        warnings.warn(
            f"the names in {folder} show no order of its pictures: they come by name", stacklevel=2
        )
    return [folder / name for name in names], named


def picture_files(path: Path) -> list[Path] | None:
    """Return the picture at `path`, or the frames of a folder in order; None for a film.

    Raises ImageError.
    """
    if path.is_dir():
        return list_images(path)[0]
    if path.suffix.lower() in SUFFIXES:
        return [path]
    return None


def _suggestion(folder: Path) -> str:
    """Suggest what to use instead of a folder without pictures: its manifest, or `anytouch data
    index`.
    """
    entries = sorted(folder.iterdir())
    for file in entries:
        if file.suffix.lower() in (".csv", ".parquet") and is_manifest(file):
            return f"; give its manifest {file}"
    below = (
        file
        for one in entries
        if one.is_dir() and not one.name.startswith(".")
        for file in one.rglob("*")
    )
    if any(file.suffix.lower() in SUFFIXES for file in below):
        command = f"anytouch data index recordings {folder} --sensor NAME"
        return f"; they lie in its sub-folders: {command} makes a manifest of them"
    return ""
