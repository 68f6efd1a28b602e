"""The interface of LeRobot's cameras, as its documentation and its code state it, without its
dependencies.

Source: github.com/huggingface/lerobot, `cameras/camera.py`, `cameras/configs.py`,
`utils/import_utils.py`.
"""

import abc
import sys
from dataclasses import dataclass
from types import ModuleType
from typing import Any, ClassVar

import numpy as np


@dataclass(kw_only=True)
class CameraConfig(abc.ABC):  # noqa: B024
    fps: int | None = None
    width: int | None = None
    height: int | None = None
    known: ClassVar[dict[str, type]] = {}

    @classmethod
    def register_subclass(cls, name: str) -> Any:
        def add(kind: type) -> type:
            cls.known[name] = kind
            return kind

        return add


class Camera(abc.ABC):
    def __init__(self, config: CameraConfig) -> None:
        self.fps = config.fps
        self.width = config.width
        self.height = config.height

    @property
    @abc.abstractmethod
    def is_connected(self) -> bool: ...

    @staticmethod
    @abc.abstractmethod
    def find_cameras() -> list[dict[str, Any]]: ...

    @abc.abstractmethod
    def connect(self, warmup: bool = True) -> None: ...

    @abc.abstractmethod
    def read(self) -> np.ndarray: ...

    @abc.abstractmethod
    def async_read(self, timeout_ms: float = 200) -> np.ndarray: ...

    @abc.abstractmethod
    def read_latest(self, max_age_ms: int = 500) -> np.ndarray: ...

    @abc.abstractmethod
    def disconnect(self) -> None: ...


@dataclass(kw_only=True)
class OpenCVCameraConfig(CameraConfig):
    index_or_path: Any


class VideoCamera(Camera):
    """In the place of LeRobot's OpenCV camera: its images come from `frames`, one after the
    other.
    """

    frames: ClassVar[list[np.ndarray]] = []

    def __init__(self, config: OpenCVCameraConfig) -> None:
        super().__init__(config)
        self.config = config
        self._next = None

    @property
    def is_connected(self) -> bool:
        return self._next is not None

    @staticmethod
    def find_cameras() -> list[dict[str, Any]]:
        return [{"name": "video", "type": "OpenCV", "id": 0}]

    def connect(self, warmup: bool = True) -> None:
        self._next = 0
        self.fps = 30
        self.height, self.width = self.frames[0].shape[:2]

    def read(self) -> np.ndarray:
        frame = self.frames[self._next]
        self._next += 1
        return frame

    def async_read(self, timeout_ms: float = 200) -> np.ndarray:
        if self._next >= len(self.frames):
            raise TimeoutError
        return self.read()

    def read_latest(self, max_age_ms: int = 500) -> np.ndarray:
        return self.frames[self._next - 1]

    def disconnect(self) -> None:
        self._next = None


def modules() -> dict[str, ModuleType]:
    """The modules of LeRobot that a camera plugin imports."""
    content = {
        "lerobot": {},
        "lerobot.cameras": {},
        "lerobot.cameras.camera": {"Camera": Camera},
        "lerobot.cameras.configs": {"CameraConfig": CameraConfig},
        "lerobot.cameras.opencv": {
            "OpenCVCamera": VideoCamera,
            "OpenCVCameraConfig": OpenCVCameraConfig,
        },
    }
    made = {name: ModuleType(name) for name in content}
    for name, names in content.items():
        vars(made[name]).update(names)
    return made


def device_class(config: Any) -> type:
    """Return the class of a device by LeRobot's rule: that of the settings without "Config", in the
    parent module.
    """
    kind = type(config)
    parent = kind.__module__.rpartition(".")[0]
    return getattr(sys.modules[parent], kind.__name__.removesuffix("Config"))
