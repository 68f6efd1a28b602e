"""Camera-based tactile sensors as a camera of LeRobot. LeRobot imports this package by its name."""

from lerobot_camera_anytouch.camera_anytouch import AnyTouchCamera
from lerobot_camera_anytouch.config_anytouch import AnyTouchCameraConfig

__all__ = ["AnyTouchCamera", "AnyTouchCameraConfig"]
