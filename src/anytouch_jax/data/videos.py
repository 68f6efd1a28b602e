"""Videos as RGB uint8 arrays, read by OpenCV, or by PyAV where OpenCV has no decoder."""

from __future__ import annotations

import contextlib
import math
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np

from anytouch_jax.data.folders import image_files
from anytouch_jax.data.opencv import QUIET
from anytouch_jax.data.pixels import ImageError, check_shape, to_rgb
from anytouch_jax.files import placeholder

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.frame import VideoFrame


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


def frame_time(video: _Decoder | VideoFile, number: int, last: float) -> float:
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
    """Return the number of frames of an image, a folder or a video's header, 0 if unknown."""
    files = image_files(Path(path))
    if files is not None:
        return len(files)
    video = open_video(path)
    try:
        return max(0, int(video.get(cv2.CAP_PROP_FRAME_COUNT)))
    finally:
        video.release()


def open_video(path: str | Path) -> VideoFile:
    """Open a video, by PyAV if OpenCV cannot decode it.

    A file that neither can read is returned as one that gives no frame.

    Raises:
        ImageError: For a file that stands for a video, and for an unknown codec without PyAV.
    """
    if Path(path).is_file():
        kind = placeholder(path)
        if kind:
            raise ImageError(f"{path} is {kind}")
    return VideoFile(path)


class VideoFile:
    """A video file, with the methods of cv2.VideoCapture. Frames are BGR u8 (h, w, 3).

    All decoders follow one rule, because a data set may have videos of several codecs:

    * Frames are upright. A phone stores how it was held, as a multiple of 90 degrees.
    * Pixels are square. A video of 240 x 240 pixels may be meant to be shown as 320 x 240.
    * Time counts from the start of the video, whatever its first stamp is.
    * Colours have the range and the matrix that the video names, which both decoders see to.

    Rotation and shape of pixels are read by OpenCV in any case. It knows what a file says of a
    video that it cannot decode.
    """

    def __init__(self, path: str | Path) -> None:
        self._decoder: _Decoder = cv2.VideoCapture()
        self._quarters = 0  # of a turn, clockwise, that make frames upright
        self._stretch = 1.0  # width of a pixel over its height
        self._name: str | Path = path
        self.open(path)

    def open(self, path: str | Path) -> bool:
        """Start at the first frame of a file. Raises ImageError for a codec without decoder."""
        self.release()
        self._name = path
        with QUIET, name_for_opencv(path) as name:
            told = cv2.VideoCapture(name)
            self._decoder = told
            if not told.isOpened():
                return False
            self._quarters = round(told.get(cv2.CAP_PROP_ORIENTATION_META) / 90) % 4
            wide = told.get(cv2.CAP_PROP_SAR_NUM)
            high = told.get(cv2.CAP_PROP_SAR_DEN)
            # 0 is unknown, and means square
            self._stretch = wide / high if wide > 0 and high > 0 else 1.0
            if told.grab():
                self._decoder = cv2.VideoCapture(name)  # some formats cannot go back
                self._decoder.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
                return True
        other = _by_pyav(path, _codec(told))
        if other is not None:
            self._decoder = other
        return True

    def isOpened(self) -> bool:
        """Return whether frames can be read."""
        return self._decoder.isOpened()

    def grab(self) -> bool:
        """Go to the next frame."""
        return self._decoder.grab()

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        """Return whether there is one, and the frame of the last grab."""
        whole, frame = self._decoder.retrieve()
        if not whole or frame is None:
            return False, None
        return True, self._shown(frame)

    def read(self) -> tuple[bool, np.ndarray | None]:
        """Go to the next frame, and return it as `retrieve` does."""
        if not self.grab():
            return False, None
        return self.retrieve()

    def get(self, name: int, /) -> float:
        """Return a property by OpenCV's number. Width and height are those of the frames."""
        if name not in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT):
            return self._decoder.get(name)
        width = self._shown_width(round(self._decoder.get(cv2.CAP_PROP_FRAME_WIDTH)))
        height = round(self._decoder.get(cv2.CAP_PROP_FRAME_HEIGHT))
        is_width = name == cv2.CAP_PROP_FRAME_WIDTH
        is_turned = self._quarters % 2 == 1
        return float(width if is_width != is_turned else height)

    def set(self, name: int, value: float, /) -> bool:
        """Set a property by OpenCV's number, and return whether that worked."""
        return self._decoder.set(name, value)

    def release(self) -> None:
        """Close the video."""
        self._decoder.release()

    def _shown_width(self, width: int) -> int:
        return max(1, round(width * self._stretch))

    def _shown(self, frame: np.ndarray) -> np.ndarray:
        """Return a stored frame with square pixels, upright."""
        height, width = frame.shape[:2]
        shown_width = self._shown_width(width)
        if shown_width != width:
            # A damaged header can ask for any shape.
            check_shape((height, shown_width, 3), self._name)
            area = cv2.INTER_AREA if shown_width < width else cv2.INTER_LINEAR
            frame = cv2.resize(frame, (shown_width, height), interpolation=area)
        if self._quarters:
            frame = cv2.rotate(frame, _ROTATIONS[self._quarters])
        return frame


# By quarters of a turn, clockwise.
_ROTATIONS = {
    1: cv2.ROTATE_90_CLOCKWISE,
    2: cv2.ROTATE_180,
    3: cv2.ROTATE_90_COUNTERCLOCKWISE,
}


class _Decoder(Protocol):
    """What decodes a video: cv2.VideoCapture, or what has its methods. Frames are as stored."""

    def isOpened(self) -> bool: ...

    def grab(self) -> bool: ...

    def retrieve(self) -> tuple[bool, np.ndarray | None]: ...

    def get(self, name: int, /) -> float: ...

    def set(self, name: int, value: float, /) -> bool: ...

    def release(self) -> None: ...


def _by_pyav(path: str | Path, codec: str) -> _PyAv | None:
    """Return a decoder before its first frame, None if PyAV finds none in the file either.

    Raises ImageError without PyAV.
    """
    try:
        decoder = _PyAv(path)
        if not decoder.grab():
            return None
        decoder.open()
    except ImportError:
        raise ImageError(
            f"OpenCV cannot decode {path}, a video of the codec {codec}: pip install "
            "'anytouch_jax[lerobot]' to read it, or convert it with ffmpeg -i IN -c:v libx264 "
            "OUT.mp4"
        ) from None
    except OSError:
        return None
    return decoder


@contextlib.contextmanager
def name_for_opencv(path: str | Path) -> Iterator[str]:
    """Give the name of a file that OpenCV can open, to read or to write it.

    It takes UTF-8 only, and ends the process for other names, which ZIP files of Windows and old
    recorders leave. Such a file gets a second name while it is opened.
    """
    # FFmpeg takes the part of a relative name before a colon for a protocol
    name = os.path.abspath(path)
    try:
        name.encode()
    except UnicodeEncodeError:
        pass
    else:
        yield name
        return
    ending = Path(name).suffix
    try:
        folder = tempfile.TemporaryDirectory(prefix="anytouch-")
    except OSError as error:
        raise ImageError(
            f"the name of the video {path} is not UTF-8, and it cannot get another one "
            f"({error.strerror}); rename it"
        ) from None
    with folder as place:
        link = Path(place) / f"video{ending if ending.isascii() else ''}"
        link.symlink_to(name)
        yield str(link)


def _codec(video: _Decoder) -> str:
    """Return the four letters of a video's codec, such as AV01."""
    number = int(video.get(cv2.CAP_PROP_FOURCC))
    return number.to_bytes(4, "little").decode("ascii", "replace").strip("\0 ")


class _PyAv:
    """A decoder of videos such as AV1. Raises ImportError and OSError."""

    def __init__(self, path: str | Path) -> None:
        self._path = os.path.abspath(path)
        self._frame: VideoFrame | None = None
        self._container: InputContainer | None = None
        self._frames: Iterator[VideoFrame] = iter(())
        self.open()

    def open(self) -> None:
        """Start at the first frame."""
        import av

        self.release()
        try:
            self._container = av.open(self._path)
            self._frames = self._container.decode(video=0)
        # IndexError: a file without a video
        except (av.FFmpegError, ValueError, IndexError) as error:
            raise OSError(str(error)) from None
        stream = self._container.streams.video[0]
        # Seconds of the first stamp, as cameras count from when they were switched on.
        self._start = float((stream.start_time or 0) * (stream.time_base or 0))
        self._frame = None
        self._number = 0

    def isOpened(self) -> bool:
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
        if self._frame is None:
            return False, None
        return True, self._frame.to_ndarray(format="bgr24")

    def get(self, name: int, /) -> float:
        """Return a property by OpenCV's number, 0 for one that is not known."""
        if self._container is None:
            return 0.0
        stream = self._container.streams.video[0]
        rate = float(stream.average_rate or 0)
        if name == cv2.CAP_PROP_FRAME_COUNT:
            microseconds = self._container.duration or 0
            return float(stream.frames or round(microseconds / 1e6 * rate))
        seconds = 0.0
        if self._frame is not None and self._frame.time is not None:
            seconds = self._frame.time - self._start
        known = {
            cv2.CAP_PROP_FPS: rate,
            cv2.CAP_PROP_POS_MSEC: 1000 * seconds,
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
            self.open()
        while self._number < value and self.grab():
            pass
        return self._number == value

    def release(self) -> None:
        if self._container is not None:
            self._container.close()
            self._container = None
