"""The tactile camera: LeRobot's OpenCV camera, with oriented and subtracted images, or depth."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from lerobot.cameras.camera import Camera
from lerobot.cameras.opencv import OpenCVCamera, OpenCVCameraConfig

from anytouch_jax import Encoder, load_encoder
from anytouch_jax.data.background.rule import RunningBackground
from anytouch_jax.data.images import decode
from anytouch_jax.data.transforms import orient_frame, subtract_background
from anytouch_jax.encoder.measured import Fields, Measure
from lerobot_camera_anytouch.config_anytouch import AnyTouchCameraConfig
from lerobot_camera_anytouch.video import VideoCamera


class AnyTouchCamera(Camera):
    """A camera behind a gel. Images are RGB u8 (height, width, 3)."""

    def __init__(self, config: AnyTouchCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        width = config.width
        height = config.height
        if config.rotate in (90, 270):
            # The configuration names the sides of the image that one gets.
            width, height = height, width
        self._camera: Any
        if Path(str(config.index_or_path)).is_file():
            self._camera = VideoCamera(Path(str(config.index_or_path)))
        else:
            inner = OpenCVCameraConfig(
                index_or_path=config.index_or_path, fps=config.fps, width=width, height=height
            )
            self._camera = OpenCVCamera(inner)
        self._gel = RunningBackground()

    @property
    def is_connected(self) -> bool:
        """Whether the camera is open."""
        return bool(self._camera.is_connected)

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        """Return the cameras of the computer, as LeRobot's OpenCV camera lists them."""
        return [camera | {"type": "anytouch"} for camera in OpenCVCamera.find_cameras()]

    def connect(self, warmup: bool = True) -> None:
        """Open the camera and read the image of the untouched gel.

        Without one it is estimated from the frames.
        """
        self._camera.connect(warmup=warmup)
        self.width = self._camera.width
        self.height = self._camera.height
        if self.config.rotate in (90, 270):
            self.width, self.height = self.height, self.width
        self.fps = self._camera.fps
        self._gel = RunningBackground()
        if self.config.background:
            self._gel.image = decode(self.config.background)
            self._gel.settled = True
        self._gel.add(np.array(self._camera.read()))
        self.__dict__.pop("_measure", None)  # that of an earlier connection has its gel
        if self.config.depth:
            # What cannot be measured fails here, and the encoder is ready for the first image.
            self.fields()

    def disconnect(self) -> None:
        """Close the camera."""
        self._camera.disconnect()

    def read(self, *settings: Any) -> np.ndarray:
        """Return the next image."""
        return self._prepared(self._new(self._camera.read(*settings)))

    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        """Return the newest image that was not read yet. Raises TimeoutError."""
        return self._prepared(self._new(self._camera.async_read(timeout_ms=timeout_ms)))

    def read_latest(self, max_age_ms: int = 500) -> np.ndarray:
        """Return the newest image at once. Raises TimeoutError if it is older."""
        return self._prepared(self._camera.read_latest(max_age_ms=max_age_ms))

    def features(self, max_age_ms: int = 500) -> np.ndarray:
        """Return the features f32 (E,) of the newest image.

        The encoder is loaded at the first call.
        """
        frame = self._newest(max_age_ms)
        return np.asarray(self._encoder.encode_touch(self._ready(frame), self.config.sensor)[0])

    def fields(self, max_age_ms: int = 500) -> Fields:
        """Return depth, shear, contact and force of the newest image, as `Encoder.measure`."""
        return self._measured(self._newest(max_age_ms))

    def _newest(self, max_age_ms: int) -> np.ndarray:
        return self._oriented(self._camera.read_latest(max_age_ms=max_age_ms))

    def _ready(self, frame: np.ndarray) -> np.ndarray:
        gel = self._untouched() if self._encoder.subtracts else None
        return self._encoder.preprocess(frame, gel)

    def _measured(self, frame: np.ndarray) -> Fields:
        measure, row = self._measure
        aspect = np.full(1, np.log(frame.shape[0] / frame.shape[1]), np.float32)
        clip = self._ready(frame)[None, None]
        return measure(self._encoder.encode_and_measure(clip, row, aspect)[1], [frame])

    @cached_property
    def _measure(self) -> tuple[Measure, np.ndarray]:
        encoder = self._encoder
        config = self.config
        measure = encoder.measure_of(config.sensor, self._untouched(), config.width_mm)
        if measure.width_mm is None:
            raise ValueError(
                f"nobody knows the mm that an image of {config.sensor} shows: name width_mm"
            )
        return measure, np.full(1, encoder.sensor_row(config.sensor), np.int32)

    @cached_property
    def _encoder(self) -> Encoder:
        return load_encoder(self.config.encoder)

    def _oriented(self, frame: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(orient_frame(frame, self.config.rotate, self.config.flip))  # type: ignore[arg-type]

    def _new(self, frame: np.ndarray) -> np.ndarray:
        self._gel.add(frame)
        return frame

    def _untouched(self) -> np.ndarray:
        assert self._gel.image is not None
        return self._oriented(self._gel.image)

    def _prepared(self, frame: np.ndarray) -> np.ndarray:
        upright = self._oriented(frame)
        if self.config.depth:
            depth = self._measured(upright).at(*upright.shape[:2]).depth[0]
            grey = np.clip(255 * depth / self.config.white_mm, 0, 255).astype(np.uint8)
            return np.repeat(grey[..., None], 3, axis=2)
        if self.config.subtract:
            return subtract_background([upright], self._untouched())[0]
        return upright
