"""Films that OpenCV cannot decode, such as AV1, read by PyAV with the methods of cv2.VideoCapture."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np


class PyAvFilm:
    """A film whose frames are BGR u8 (h, w, 3). Raises ImportError without PyAV, OSError for a file it cannot open."""

    def __init__(self, path: str) -> None:
        self._path, self._frame = path, None
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
        except (av.FFmpegError, ValueError, IndexError) as error:  # IndexError: a file without a film
            raise OSError(str(error)) from None
        self._frame, self._number = None, 0
        return True

    def isOpened(self) -> bool:
        """Return whether frames can be read."""
        return self._container is not None

    def grab(self) -> bool:
        """Go to the next frame. A film that is damaged from there on ends."""
        self._frame = None
        with contextlib.suppress(OSError, ValueError):  # all errors of PyAV are of these types
            self._frame = next(self._frames, None)
        self._number += self._frame is not None
        return self._frame is not None

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        """Return the frame of the last grab."""
        return self._frame is not None, None if self._frame is None else self._frame.to_ndarray(format="bgr24")

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
            cv2.CAP_PROP_FPS: rate, cv2.CAP_PROP_POS_MSEC: 1000 * (time or 0), cv2.CAP_PROP_POS_FRAMES: self._number,
            cv2.CAP_PROP_FRAME_WIDTH: stream.width, cv2.CAP_PROP_FRAME_HEIGHT: stream.height,
        }  # fmt: skip
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
