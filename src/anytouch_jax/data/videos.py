"""Videos as RGB uint8 arrays, read by OpenCV, or by PyAV where OpenCV has no decoder."""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np

from anytouch_jax.data.folders import picture_files
from anytouch_jax.data.opencv import QUIET
from anytouch_jax.data.pixels import ImageError, to_rgb
from anytouch_jax.files import placeholder

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.frame import VideoFrame


class Video(Protocol):
    """What a video gives, in the names of cv2.VideoCapture."""

    def open(self, path: str, /) -> bool:
        """Start again at the first frame."""

    def isOpened(self) -> bool:
        """Return whether frames can be read."""

    def grab(self) -> bool:
        """Go to the next frame."""

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        """Return whether there is one, and the frame of the last grab, BGR u8 (h, w, 3)."""

    def read(self) -> tuple[bool, np.ndarray | None]:
        """Go to the next frame, and return it as `retrieve` does."""

    def get(self, name: int, /) -> float:
        """Return a property by OpenCV's number."""

    def set(self, name: int, value: float, /) -> bool:
        """Set a property by OpenCV's number, and return whether that worked."""

    def release(self) -> None:
        """Close the video."""


def frames_from_video(path: str | Path) -> Iterator[np.ndarray]:
    """Yield the frames of a video as RGB u8 (h, w, 3).

    Raises ImageError if it cannot be read or has no frame.
    """
    return (frame for _, frame in timed_frames(path))


def timed_frames(path: str | Path) -> Iterator[tuple[float, np.ndarray]]:
    """Yield (time stamp in seconds, RGB u8 (h, w, 3)) of the frames of a video.

    Raises ImageError if it cannot be read or has no frame.
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


def frame_time(video: Video, number: int, last: float) -> float:
    """Return the seconds of a frame, by its stamp or the frame rate.

    Args:
        video: Its current frame is the one asked for.
        number: The number of that frame, from 0.
        last: The time of the frame before. Stamps that do not rise are not believed: some
            recorders write 0 for all frames.
    """
    seconds = video.get(cv2.CAP_PROP_POS_MSEC) / 1000
    if math.isfinite(seconds) and seconds > last:
        return seconds
    rate = video.get(cv2.CAP_PROP_FPS)
    if math.isfinite(rate) and rate > 0:
        return max(last, number / rate)
    return max(last, float(number))


def count_frames(path: str | Path) -> int:
    """Return the number of frames of a picture, a folder or a video's header, 0 if unknown."""
    files = picture_files(Path(path))
    if files is not None:
        return len(files)
    video = open_video(path)
    try:
        return max(0, int(video.get(cv2.CAP_PROP_FRAME_COUNT)))
    finally:
        video.release()


def open_video(path: str | Path) -> Video:
    """Open a video, by PyAV if OpenCV cannot decode it.

    A file that neither can read is returned as one that gives no frame.

    Raises:
        ImageError: For a file that stands for a video, and for an unknown codec without PyAV.
    """
    if Path(path).is_file():
        kind = placeholder(path)
        if kind:
            raise ImageError(f"{path} is {kind}")
    # FFmpeg takes the part of a relative name before a colon for a protocol
    place = os.path.abspath(path)
    with QUIET:
        video: Video = cv2.VideoCapture(place)
        if not video.isOpened():
            return video
        if video.grab():
            return cv2.VideoCapture(place)  # some formats cannot go back
    try:
        film = PyAvFilm(place)
        if film.grab() and film.open(place):
            return film
    except ImportError:
        raise ImageError(
            f"OpenCV cannot decode {path}, a video of the codec {_codec(video)}: pip install "
            "'anytouch_jax[lerobot]' to read it, or convert it with ffmpeg -i IN -c:v libx264 "
            "OUT.mp4"
        ) from None
    except OSError:
        pass
    return video


def _codec(video: Video) -> str:
    """Return the four letters of a video's codec, such as AV01."""
    number = int(video.get(cv2.CAP_PROP_FOURCC))
    return number.to_bytes(4, "little").decode("ascii", "replace").strip("\0 ")


class PyAvFilm:
    """A video such as AV1, BGR u8 (h, w, 3), with the methods of cv2.VideoCapture.

    Raises ImportError and OSError.
    """

    def __init__(self, path: str) -> None:
        self._path = path
        self._frame: VideoFrame | None = None
        self._container: InputContainer | None = None
        self._frames: Iterator[VideoFrame] = iter(())
        self.open(path)

    def open(self, path: str, /) -> bool:
        """Start again at the first frame."""
        import av

        self.release()
        try:
            self._container = av.open(path)
            self._frames = self._container.decode(video=0)
        # IndexError: a file without a video
        except (av.FFmpegError, ValueError, IndexError) as error:
            raise OSError(str(error)) from None
        self._frame = None
        self._number = 0
        return True

    def isOpened(self) -> bool:
        """Return whether frames can be read."""
        return self._container is not None

    def grab(self) -> bool:
        """Go to the next frame. A video that is damaged from there on ends."""
        self._frame = None
        # all errors of PyAV are of these types
        with contextlib.suppress(OSError, ValueError):
            self._frame = next(self._frames, None)
        self._number += self._frame is not None
        return self._frame is not None

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        """Return the frame of the last grab."""
        if self._frame is None:
            return False, None
        return True, self._frame.to_ndarray(format="bgr24")

    def read(self) -> tuple[bool, np.ndarray | None]:
        """Return the next frame."""
        self.grab()
        return self.retrieve()

    def get(self, name: int, /) -> float:
        """Return a property by OpenCV's number, 0 for one that is not known."""
        if self._container is None:
            return 0.0
        stream = self._container.streams.video[0]
        rate = float(stream.average_rate or 0)
        if name == cv2.CAP_PROP_FRAME_COUNT:
            microseconds = self._container.duration or 0
            return float(stream.frames or round(microseconds / 1e6 * rate))
        time = None if self._frame is None else self._frame.time
        known = {
            cv2.CAP_PROP_FPS: rate,
            cv2.CAP_PROP_POS_MSEC: 1000 * (time or 0),
            cv2.CAP_PROP_POS_FRAMES: self._number,
            cv2.CAP_PROP_FRAME_WIDTH: stream.width,
            cv2.CAP_PROP_FRAME_HEIGHT: stream.height,
        }
        return float(known.get(name, 0))

    def set(self, name: int, value: float, /) -> bool:
        """Go to a frame by its number; another property cannot be set."""
        if name != cv2.CAP_PROP_POS_FRAMES:
            return False
        if value < self._number:
            self.open(self._path)
        while self._number < value and self.grab():
            pass
        return self._number == value

    def release(self) -> None:
        """Close the video."""
        if self._container is not None:
            self._container.close()
            self._container = None
