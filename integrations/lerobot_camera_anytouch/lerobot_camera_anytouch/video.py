"""A video in the place of LeRobot's OpenCV camera.

LeRobot's own reads a video as fast as it can, and ends with it.
"""

from __future__ import annotations

import time
from pathlib import Path

import cv2
import numpy as np

from anytouch_jax.live.cameras import LoopedVideo


class VideoCamera:
    """A video at its frame rate, again and again, with the methods of a camera of LeRobot.

    Images are RGB.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._at = 0.0
        self._video: LoopedVideo | None = None
        self._latest: np.ndarray | None = None
        self.width = self.height = self.fps = 0

    @property
    def is_connected(self) -> bool:
        return self._video is not None

    def connect(self, warmup: bool = True) -> None:
        self._video = LoopedVideo(self._path)
        self.fps = round(self._video.get(cv2.CAP_PROP_FPS)) or 30
        self.height, self.width = self.read().shape[:2]

    def disconnect(self) -> None:
        if self._video is not None:
            self._video.release()
        self._video = self._latest = None

    def read(self, *settings: object) -> np.ndarray:
        if self._video is None:
            raise ConnectionError(f"the video {self._path} is not connected")
        whole, image = self._video.retrieve() if self._video.grab() else (False, None)
        if not whole or image is None:
            raise RuntimeError(f"the video {self._path} cannot be read")
        self._latest = np.ascontiguousarray(image[..., ::-1])
        self._at = time.perf_counter()
        return self._latest

    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        return self.read()

    def read_latest(self, max_age_ms: int = 500) -> np.ndarray:
        is_new = self._latest is not None and time.perf_counter() - self._at < 1 / max(self.fps, 1)
        if is_new and self._latest is not None:
            return self._latest
        return self.read()
