"""Headers of image files, checked before OpenCV unpacks them.

A small hostile or damaged file can declare an image of gigabytes, hide hours of work in a JPEG of
thousands of scans, or be cut so that OpenCV fills its lost part with grey. So the header of each
file is walked here first, with limits. `tests/data/test_hostile_pictures.py` has such files.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator
from typing import Literal

from PIL import (
    BmpImagePlugin,
    ImageFile,
    JpegImagePlugin,
    PngImagePlugin,
    TiffImagePlugin,
    WebPImagePlugin,
)

from anytouch_jax.data.pixels import MAX_PIXELS
from anytouch_jax.files import placeholder

MAX_CODED = 16 * MAX_PIXELS  # pixels times scans of a JPEG: each scan goes over the whole image
MAX_PARTS = 1 << 12  # chunks or segments of a header, which Pillow reads one by one
MAX_PADDING = 1 << 16  # bytes between the segments of a JPEG, which Pillow reads one by one

PNG = b"\x89PNG\r\n\x1a\n"
JPEG = b"\xff\xd8"
_TIFF = (b"II*\0", b"MM\0*")
# Pillow's classes for the headers. Image.open adds a search over all formats, 40 of the 390 us that
# a JPEG takes.
_HEADERS: dict[bytes, type[ImageFile.ImageFile]] = {
    PNG: PngImagePlugin.PngImageFile,
    JPEG: JpegImagePlugin.JpegImageFile,
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
_JPEG_END = b"\xff" + _END
# Chunks of a PNG that its pixels need: header, palette, transparency, data, end.
_DECODED_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")


def check_header(data: bytes) -> int:
    """Return the EXIF orientation of an image file, 1 to 8 (1 for a TIFF).

    Raises:
        ValueError: Unless OpenCV unpacks `data` whole and safely.
    """
    header = next((kind for start, kind in _HEADERS.items() if data.startswith(start)), None)
    if header is None and not data.startswith(_TIFF):
        kind = placeholder(data)
        if kind:
            raise ValueError(f"it is {kind}")
        raise ValueError("it is not a PNG, JPEG, TIFF, BMP, WebP or .npy image")
    is_jpeg = data.startswith(JPEG)
    if is_jpeg:
        _check_segments(data)
    stream = io.BytesIO(data)
    image: ImageFile.ImageFile | None = None
    try:
        if header is None:
            width, height = _tiff_size(stream)
        else:
            image = header(stream)
            width, height = image.size
    except ValueError:
        raise
    # Pillow raises many types for a corrupt header, and its own for a bomb.
    except Exception as error:
        is_short = "truncated" in str(error).lower()
        reason = "the file is cut short" if is_short else "its header is corrupt"
        raise ValueError(f"{reason} ({error})") from None
    if width * height > MAX_PIXELS:
        raise ValueError(
            f"it declares {width} x {height} pixels, more than the limit of {MAX_PIXELS}"
        )
    if is_jpeg:
        # OpenCV fills the lost part of some cut JPEG files with grey. The stream is now behind the
        # last header.
        if data.find(_JPEG_END, stream.tell()) < 0:
            raise ValueError("the file is cut short")
        _check_scans(data, max(width * height, 1 << 16))
    if image is not None and "exif" in image.info:
        return _orientation(image)
    return 1


def _orientation(image: ImageFile.ImageFile) -> int:
    _ignore_warnings_of_tags()
    try:
        value = image.getexif().get(_ORIENTATION, 1)
    except Exception:  # a corrupt tag; the image itself may be whole
        return 1
    if value in range(1, 9):
        return value
    return 1


def _ignore_warnings_of_tags() -> None:
    """Let Pillow not warn of damaged tags, which say nothing about the pixels.

    It is set at each use, because a user's `warnings.catch_warnings` may have dropped it since.
    """
    warnings.filterwarnings("ignore", module=r"PIL\.TiffImagePlugin")


def decoded_chunks(data: bytes) -> bytes:
    """Return a PNG without the chunks that its pixels do not need, with each length checked.

    OpenCV allocates what a chunk declares, up to 4 GB, before it reads the chunk.

    Raises:
        ValueError: If the file is cut short, or is no chain of chunks.
    """
    at = len(PNG)
    kind = b""
    headers = 0
    count = 0
    parts = [data[:at]]
    while kind != b"IEND":
        length = int.from_bytes(data[at : at + 4])
        kind = data[at + 4 : at + 8]
        end = at + 12 + length  # length, kind, content, checksum
        if end > len(data):
            raise ValueError("the image is corrupt or cut short")
        if kind in _DECODED_CHUNKS:
            parts.append(data[at:end])
        at = end
        headers += kind == b"IHDR"
        count += 1
        if count > MAX_PARTS + at // 256:
            raise ValueError(f"it has more than {MAX_PARTS} chunks of a few bytes")
    if headers != 1 or data[12:16] != b"IHDR":
        raise ValueError("the image is corrupt")
    if len(parts) <= count:
        return b"".join(parts)
    return data


def _segments(data: bytes) -> Iterator[tuple[bytes, int]]:
    """Yield (kind, bytes skipped before it) of the segments of a JPEG, as decoders walk them."""
    at = 2
    while True:
        marker = _MARKER.search(data, at)
        if marker is None or marker[1] == _END:
            return
        yield marker[1], marker.start() - at
        # The length counts its own two bytes. One below 2 would not move on.
        length = int.from_bytes(data[marker.end() : marker.end() + 2])
        at = marker.end() + max(2, length)


def _check_segments(data: bytes) -> None:
    """Bound the header of a JPEG, so that a walk over it ends soon."""
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
    """Bound the time to decode a JPEG of so many pixels."""
    most = MAX_CODED // pixels
    # The two bytes of a scan's marker may stand elsewhere too, so their count is an upper bound. It
    # is enough for most files, and a hundred times faster than a walk.
    if data.count(b"\xff" + _SCAN) <= most:
        return
    scans = 0
    for count, (kind, _) in enumerate(_segments(data)):
        scans += kind == _SCAN
        if scans > most or count > 16 * MAX_PARTS:
            raise ValueError(
                f"it has more than {most} scans, which would take minutes; save it as a plain JPEG"
            )


def _tiff_size(stream: io.BytesIO) -> tuple[int, int]:
    """Return (width, height) of a TIFF.

    Pillow's image class knows no float colours, so only its directory reader is used.

    Raises:
        ValueError: For a stack of images, of which OpenCV reads the first only, and for 8-bit
            colours with unassociated alpha, by which OpenCV multiplies them.
    """
    _ignore_warnings_of_tags()
    data = stream.getvalue()
    order: Literal["little", "big"] = "little" if data[:2] == b"II" else "big"
    tags = TiffImagePlugin.ImageFileDirectory_v2(stream.read(8))
    start = tags.next
    count = int.from_bytes(data[start : start + 2], order)
    entries = [data[at : at + 2] for at in range(start + 2, start + 2 + 12 * count, 12)]
    if len(set(entries)) < count:  # decoders take the first or the last
        raise ValueError("the image is corrupt: it has a tag twice")
    stream.seek(start)
    tags.load(stream)
    if tags.next:
        raise ValueError("it holds several images; write a file for each")
    if tags.get(_ALPHA) in (2, (2,)) and tags.get(_BITS, (0,))[0] == 8:
        raise ValueError(
            "it has an alpha channel by which its colours would be multiplied; write it without "
            "alpha"
        )
    return tags[_WIDTH], tags[_HEIGHT]
