"""Images as RGB uint8 arrays; broken, unsafe or too large files are refused.

Videos and folders have modules of their own, and their names can be imported from here too.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from anytouch_jax.data.folders import BACKGROUND, PHOTO, SUFFIXES, image_files, list_images
from anytouch_jax.data.image_headers import JPEG, PNG, check_header, decoded_chunks
from anytouch_jax.data.manifest.files import read_file, unpack_npy
from anytouch_jax.data.opencv import QUIET
from anytouch_jax.data.pixels import MAX_ASPECT, MAX_PIXELS, ImageError, to_rgb
from anytouch_jax.data.videos import (
    VideoFile,
    count_frames,
    frame_time,
    frames_from_video,
    open_video,
    timed_frames,
)

__all__ = [
    "BACKGROUND",
    "MAX_ASPECT",
    "MAX_PIXELS",
    "PHOTO",
    "QUIET",
    "SUFFIXES",
    "ImageError",
    "VideoFile",
    "count_frames",
    "decode",
    "decode_bytes",
    "encode",
    "frame_time",
    "frames_from_video",
    "image_files",
    "list_images",
    "open_video",
    "timed_frames",
    "to_rgb",
]

_NPY = b"\x93NUMPY"
# How a JPEG is read. Since OpenCV 4.11 the decoder itself writes RGB, which spares a pass over the
# pixels. Orientation tags are obeyed by `_upright`, because versions of OpenCV differ in what they
# do for other formats.
_JPEG_RGB: int = cv2.IMREAD_UNCHANGED
if hasattr(cv2, "IMREAD_COLOR_RGB"):
    _JPEG_RGB = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
_CONVERTED = (np.uint8, np.uint16, np.float32)  # types that cvtColor knows


def decode(path: str | Path) -> np.ndarray:
    """Return the image in `path` as RGB u8 (h, w, 3).

    `path` is a file or a row of a shard (`manifest.files`). Reads PNG, JPEG, TIFF, BMP, WebP and
    .npy, and obeys orientation tags, as for a video. Pixels become 8 bits as in `to_rgb`.

    Raises:
        ImageError: For a missing, broken or too large file, and for pixels that are NaN or outside
            0..1.
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
    """Return the image in `data` as `decode` does.

    Args:
        data: The bytes of a file.
        name: What errors call it.
        as_stored: Return its pixels before any scaling, (h, w) or (h, w, c) of the stored type.
    """
    try:
        pixels = _unpack(data)
    except (ValueError, EOFError, MemoryError) as error:
        raise ImageError(f"{name} cannot be read: {error}") from None
    if as_stored:
        return pixels
    return to_rgb(pixels, name)


def encode(image: np.ndarray, suffix: str = ".png", *settings: int) -> bytes:
    """Return an image RGB u8 (h, w, 3) as PNG or JPEG; `settings` are those of cv2.imencode."""
    return cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), settings)[1].tobytes()


def _unpack(data: bytes) -> np.ndarray:
    """Return the pixels of a file as stored, RGB and upright. Raises ValueError."""
    if data.startswith(_NPY):
        return unpack_npy(data)
    chunks = decoded_chunks(data) if data.startswith(PNG) else data
    orientation = check_header(data)
    flags: int = cv2.IMREAD_UNCHANGED
    if data.startswith(JPEG):
        flags = _JPEG_RGB
    try:
        with QUIET:
            pixels = cv2.imdecode(np.frombuffer(chunks, np.uint8), flags)
    except cv2.error as error:
        raise ValueError(error.err) from None
    if pixels is None:
        raise ValueError("the image is corrupt or cut short")
    if flags == cv2.IMREAD_UNCHANGED and pixels.ndim == 3 and pixels.shape[2] in (3, 4):
        if pixels.dtype not in _CONVERTED:  # of a TIFF
            return pixels[..., 2::-1]
        has_alpha = pixels.shape[2] == 4
        order = cv2.COLOR_BGRA2RGB if has_alpha else cv2.COLOR_BGR2RGB
        pixels = cv2.cvtColor(pixels, order)
    return _upright(pixels, orientation)


def _upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Return stored pixels (h, w) or (h, w, c) turned upright.

    EXIF's orientations are 1 to 8: 1 is upright, 3 upside down, 6 and 8 turned by a quarter, and
    2, 4, 5 and 7 are mirrored.
    """
    if orientation > 4:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = pixels[::-1]
    if orientation in (2, 3, 6, 7):
        return pixels[:, ::-1]
    return pixels
