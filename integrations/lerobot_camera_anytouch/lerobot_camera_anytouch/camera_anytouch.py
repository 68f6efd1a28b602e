"""The tactile camera: LeRobot's OpenCV camera, whose pictures are oriented and background-subtracted."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
from lerobot.cameras.camera import Camera
from lerobot.cameras.opencv import OpenCVCamera, OpenCVCameraConfig

from anytouch_jax import load_encoder
from anytouch_jax.data.gels import RunningGel
from anytouch_jax.data.images import decode
from anytouch_jax.data.transforms import orient_frame, subtract_background
from lerobot_camera_anytouch.config_anytouch import AnyTouchCameraConfig


class AnyTouchCamera(Camera):
    """A camera behind a gel. Pictures are RGB u8 (height, width, 3)."""

    def __init__(self, config: AnyTouchCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        sides = (config.width, config.height)
        width, height = reversed(sides) if config.rotate in (90, 270) else sides
        inner = OpenCVCameraConfig(index_or_path=config.index_or_path, fps=config.fps, width=width, height=height)
        self._camera = OpenCVCamera(inner)
        self._gel = RunningGel()

    @property
    def is_connected(self) -> bool:
        """Whether the camera is open."""
        return bool(self._camera.is_connected)

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """Return the cameras of the computer, as LeRobot's OpenCV camera lists them."""
        return [camera | {"type": "anytouch"} for camera in OpenCVCamera.find_cameras()]

    def connect(self, warmup: bool = True) -> None:
        """Open the camera and read the picture of the untouched gel. Without one it is estimated from the frames."""
        self._camera.connect(warmup=warmup)
        self.width, self.height = self._camera.width, self._camera.height
        if self.config.rotate in (90, 270):
            self.width, self.height = self.height, self.width
        self.fps = self._camera.fps
        self._gel = RunningGel()
        if self.config.background:
            self._gel.picture, self._gel.settled = decode(self.config.background), True
        self._gel.add(np.array(self._camera.read()))

    def disconnect(self) -> None:
        """Close the camera."""
        self._camera.disconnect()

    def read(self, *settings: Any) -> np.ndarray:
        """Return the next picture."""
        return self._prepared(self._new(self._camera.read(*settings)))

    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        """Return the newest picture that was not read yet. Raises TimeoutError."""
        return self._prepared(self._new(self._camera.async_read(timeout_ms=timeout_ms)))

    def read_latest(self, max_age_ms: int = 500) -> np.ndarray:
        """Return the newest picture at once. Raises TimeoutError if it is older."""
        return self._prepared(self._camera.read_latest(max_age_ms=max_age_ms))

    def features(self, max_age_ms: int = 500) -> np.ndarray:
        """Return the features f32 (E,) of the newest picture. The encoder is loaded at the first call."""
        frame = self._oriented(self._camera.read_latest(max_age_ms=max_age_ms))
        gel = self._untouched() if self._encoder.subtracts else None
        return np.asarray(self._encoder.encode_touch(self._encoder.preprocess(frame, gel), self.config.sensor)[0])

    @cached_property
    def _encoder(self) -> Any:
        return load_encoder(self.config.encoder)

    def _oriented(self, frame: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(orient_frame(frame, self.config.rotate, self.config.flip))  # type: ignore[arg-type]

    def _new(self, frame: np.ndarray) -> np.ndarray:
        self._gel.add(frame)
        return frame

    def _untouched(self) -> np.ndarray:
        assert self._gel.picture is not None
        return self._oriented(self._gel.picture)

    def _prepared(self, frame: np.ndarray) -> np.ndarray:
        upright = self._oriented(frame)
        return subtract_background([upright], self._untouched())[0] if self.config.subtract else upright
