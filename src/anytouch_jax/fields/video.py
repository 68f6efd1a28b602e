"""A video of measured frames, which is whole or not there."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from anytouch_jax.data.videos import name_for_opencv
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, part_path

RATE = 30.0  # frames a second of what has no rate of its own
_FULL = 1 << 16  # bytes: a disk with less is full


class Video:
    """A video of images RGB u8 of one size, that of the first: others are scaled to it.

    It is written to a hidden file beside its place, and `finish` moves it there.

    Args:
        path: its place, .mp4 or .avi.
        rate: frames a second.
    """

    def __init__(self, path: Path, rate: float = RATE) -> None:
        hidden = part_path(path)
        # OpenCV takes the container from the ending.
        self._part = hidden.with_name(f"{hidden.name}{path.suffix}")
        self._path = path
        self._rate = rate
        self._size = (0, 0)
        self._count = 0
        self._writer: Any = None

    def add(self, image: np.ndarray) -> None:
        """Write an image. Raises UserError if this computer cannot write such a video."""
        if self._writer is None:
            self._open(image)
        if image.shape[1::-1] != self._size:
            image = cv2.resize(image, self._size)
        self._writer.write(image[..., ::-1])
        self._count += 1

    def _open(self, image: np.ndarray) -> None:
        code = "MJPG" if self._path.suffix == ".avi" else "mp4v"
        self._size = (image.shape[1], image.shape[0])
        fourcc = cv2.VideoWriter.fourcc(*code)
        with name_for_opencv(self._part) as name:
            self._writer = cv2.VideoWriter(name, fourcc, self._rate, self._size)
        if not self._writer.isOpened():
            raise UserError(
                f"{self._path} cannot be written as a video on this computer. Name an .avi file."
            )

    def finish(self, path: Path | None = None) -> None:
        """Move the video to its place, or to another `path`.

        Raises OSError for a full disk, and UserError if it is not whole for another reason.
        """
        if self._writer is None:
            return
        self._writer.release()
        self._writer = None
        path = self._path if path is None else path
        # OpenCV does not report a write that failed.
        if not self._is_whole():
            if shutil.disk_usage(self._part.parent).free < _FULL:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
            raise UserError(f"{path} could not be written whole. Name an .avi file.")
        with atomic_path(path, part=self._part):
            pass  # it is written already

    def _is_whole(self) -> bool:
        """Whether the written video opens, and has its last frame."""
        with name_for_opencv(self._part) as name:
            video = cv2.VideoCapture(name)
        try:
            if not video.isOpened() or video.get(cv2.CAP_PROP_FRAME_COUNT) < self._count:
                return False
            video.set(cv2.CAP_PROP_POS_FRAMES, self._count - 1)
            return bool(video.read()[0])
        finally:
            video.release()

    def close(self) -> None:
        """Remove what was not finished."""
        if self._writer is not None:
            self._writer.release()
            self._writer = None
        with contextlib.suppress(OSError):
            self._part.unlink()
