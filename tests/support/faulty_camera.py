"""A stand-in for cv2.VideoCapture that fails at one frame, as real tactile sensors do, and a video
with odd times.
"""

import time
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

KINDS = ("grab", "retrieve", "none", "raise", "grey", "smaller")  # faults of a single read


class FaultyCamera:
    """A camera of `frames` frames of 32 x 40 pixels that then delivers nothing.

    `kind` is a fault of read `fails_at` (KINDS), or lasts from there on: "resized", "black" or
    "frozen".
    """

    def __init__(self, kind: str = "ok", fails_at: int = 3, frames: int = 12) -> None:
        self.kind = kind
        self.fails_at = fails_at
        self.frames = frames
        self.count = -1
        self.released = False

    def isOpened(self) -> bool:
        return True

    def set(self, *arguments: object) -> bool:
        return True

    def grab(self) -> bool:
        time.sleep(0.002)
        self.count += 1
        if self.kind == "raise" and self.count == self.fails_at:
            raise cv2.error("device lost")
        return self.count < self.frames and not (
            self.kind == "grab" and self.count == self.fails_at
        )

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        now = self.count == self.fails_at
        later = self.count >= self.fails_at
        if now and self.kind in ("retrieve", "none"):
            return self.kind == "none", None
        size = (
            (16, 20)
            if (self.kind == "smaller" and now) or (self.kind == "resized" and later)
            else (32, 40)
        )
        shape = size if self.kind == "grey" and now else (*size, 3)
        lasting = {"black": 0, "frozen": 90}.get(self.kind) if later else None
        return True, np.full(shape, 90 + self.count if lasting is None else lasting, np.uint8)

    def release(self) -> None:
        self.released = True


class Video:
    """A video of given frames BGR u8 (n, h, w, 3), without the errors of a codec."""

    def __init__(self, frames: Iterable[np.ndarray]) -> None:
        self.frames = iter(frames)

    def grab(self) -> bool:
        self.frame = next(self.frames, None)
        return self.frame is not None

    def retrieve(self) -> tuple[bool, np.ndarray | None]:
        return True, self.frame

    def get(self, name: int) -> float:
        return 0.0

    def release(self) -> None:
        pass


def write_uneven_video(path: Path, milliseconds: list[int]) -> Path:
    """Write a Matroska video whose frame i has the time stamp milliseconds[i]; its header says 10
    frames a second.
    """
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"FFV1"), 10, (40, 32))
    for number in range(len(milliseconds)):
        writer.write(np.full((32, 40, 3), 8 * number, np.uint8))
    writer.release()
    data = bytearray(path.read_bytes())
    start = 0
    # of a block: track 1, i16 time, whether it is a key frame
    for number, time_stamp in enumerate(milliseconds):
        is_key = b"\0" if number % 12 else b"\x80"
        start = data.index(b"\x81" + (100 * number).to_bytes(2, "big") + is_key, start)
        data[start + 1 : start + 3] = time_stamp.to_bytes(2, "big")
        start += 3
    path.write_bytes(data)
    return path
