"""The built-in recording: presses of the package's examples, as if they came from a camera.

It lets people watch depth, and teach, without a sensor.
"""

from __future__ import annotations

import time

import cv2
import numpy as np

from anytouch_jax.data.images import decode
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.encoder.encoder import FOLDER

EXAMPLE = "built-in recording"  # its name, in the place of a camera's
SENSOR = "gelsight_mini"
_PRESSES = ("dots", "ring")
_RATE = 25.0  # frames a second
_FREE = 1.5  # seconds between presses
_RISE = 0.3  # seconds in which a press comes and goes
_HELD = 4.0  # seconds of a press: long enough to hold a button
_NOISE = 1.5  # grey levels, without which the camera would be reported as frozen
_SHIFT = 3.0  # pixels by which a press moves


class ExampleCamera:
    """A camera that is pressed by one example after the other, again and again."""

    def __init__(self) -> None:
        backgrounds = [_image(f"{name}-{SENSOR}-background") for name in _PRESSES]
        self._free = backgrounds[0]
        # The presses are of several gels. What a press changes is shown on one of them, because a
        # camera has one background.
        self._changes = [
            _image(f"{name}-{SENSOR}") - free
            for name, free in zip(_PRESSES, backgrounds, strict=True)
        ]
        noise = np.random.default_rng(0).standard_normal((8, *self._free.shape), np.float32)
        self._noise = _NOISE * noise
        self._count = 0
        self._due = 0.0

    def grab(self) -> bool:
        """Wait for the next frame."""
        now = time.perf_counter()
        self._due = max(self._due + 1 / _RATE, now - 1 / _RATE)
        time.sleep(max(0.0, self._due - now))
        self._count += 1
        return True

    def retrieve(self) -> tuple[bool, Array]:
        return True, np.ascontiguousarray(self.frame(self._count / _RATE)[..., ::-1])

    def frame(self, seconds: float) -> Array:
        """Return the image RGB u8 (h, w, 3) at a time."""
        turn, at = divmod(seconds, _FREE + _HELD)
        # It rises at the end of the free time, and falls at the end of the press.
        height = np.clip(min(at - (_FREE - _RISE), _FREE + _HELD - at) / _RISE, 0.0, 1.0)
        change = self._changes[int(turn) % len(self._changes)]
        across = _SHIFT * np.sin(2 * np.pi * at / _HELD)
        rows, columns = change.shape[:2]
        shift = np.array([[1, 0, across], [0, 1, 0]], np.float32)
        moved = cv2.warpAffine(change, shift, (columns, rows))
        noise = self._noise[int(seconds * _RATE) % len(self._noise)]
        return np.clip(self._free + height * moved + noise, 0, 255).astype(np.uint8)

    def get(self, name: int) -> float:
        return _RATE if name == cv2.CAP_PROP_FPS else 0.0

    def release(self) -> None:
        pass


def _image(name: str) -> Array:
    return decode(FOLDER / f"{name}.jpg").astype(np.float32)
