"""Videos on disk."""

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np


def write_video(
    path: str | Path, frames: Iterable[np.ndarray], rate: float = 10, code: str = ""
) -> Path:
    """Write frames BGR u8 (H, W, 3) to a video in the codec `code`, or in that of its ending."""
    path = Path(path)
    frames = list(frames)
    path.parent.mkdir(parents=True, exist_ok=True)
    code = code or ("MJPG" if path.suffix == ".avi" else "mp4v")
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), rate, frames[0].shape[1::-1])
    for frame in frames:
        writer.write(np.ascontiguousarray(frame))
    writer.release()
    return path
