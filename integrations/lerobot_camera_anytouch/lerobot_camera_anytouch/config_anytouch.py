"""Settings of the tactile camera, registered as the type `anytouch`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lerobot.cameras.configs import CameraConfig


@CameraConfig.register_subclass("anytouch")
@dataclass(kw_only=True)
class AnyTouchCameraConfig(CameraConfig):
    """Settings of a tactile camera.

    `width` and `height` are those of the oriented image. `rotate` turns clockwise by degrees,
    then `flip` mirrors. `background` is an image of the untouched gel in the camera's own
    orientation. `encoder` and `sensor` are for features and fields. With `depth`, images show the
    depth in grey: 0 is none, and 255 is `white_mm` mm or more. `width_mm` is what the image's
    width shows, for a sensor that the encoder does not know. `index_or_path` may be a video, which
    plays again and again.
    """

    index_or_path: int | Path
    rotate: int = 0
    flip: str = "none"
    subtract: bool = True
    background: Path | None = None
    encoder: str = "anytouch-tiny"
    sensor: str = "universal"
    depth: bool = False
    white_mm: float = 2.0
    width_mm: float | None = None

    def __post_init__(self) -> None:
        if self.rotate not in (0, 90, 180, 270):
            raise ValueError(f"rotate is 0, 90, 180 or 270, not {self.rotate}")
        if self.flip not in ("none", "across", "down"):
            raise ValueError(f"flip is none, across or down, not {self.flip!r}")
        if not self.white_mm > 0:
            raise ValueError(
                f"white_mm is the depth in mm that is white, above 0, not {self.white_mm}"
            )
