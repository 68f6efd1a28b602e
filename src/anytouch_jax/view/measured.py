"""Depth, shear and force on the page: a picture with arrows, a surface to turn, and numbers."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from threading import Lock
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from anytouch_jax.config import UNIVERSAL
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.encoder.fields import Fields, depth_levels, overlay

Array = npt.NDArray[Any]
_ENCODER = "anytouch-tiny"  # measures recordings, by which no encoder is named
_SHARP = 480  # pixels of the long side of a picture with arrows, at least
_SIDE = 72  # cells of a surface along the long side of the picture
_ONE_BY_ONE, _load = Lock(), cache(load_encoder)


def measure_recorded(frames: Sequence[Array], gel: Array | None, sensor: str | None) -> Fields:
    """Measure the last of a recording's frames RGB u8 (h, w, 3), with its untouched gel. The first call takes seconds.

    Raises UserError for a gel of other proportions.
    """
    with _ONE_BY_ONE:
        encoder = _load(_ENCODER)
        clip = last_clip(frames, encoder.config.model.frames)[None]
        return encoder.measure(clip, gel, sensor or UNIVERSAL, log=lambda _: None)


def last_clip(frames: Sequence[Array], length: int) -> Array:
    """Return the last frames as a clip (length, h, w, 3). Before the first of them nothing moved."""
    same = [frame for frame in frames[-length:] if frame.shape == frames[-1].shape]
    return np.stack([same[0]] * (length - len(same)) + same)


def measured_layer(frame: Array, measured: Fields, name: str) -> Array:
    """Return what was measured of a frame as a picture u8 (h, w, 3): "depth" on the frame, or a "surface" in grey."""
    if name == "depth":
        larger = max(1.0, _SHARP / max(frame.shape[:2]))  # lines on few pixels would be thick
        return overlay(cv2.resize(frame, None, fx=larger, fy=larger), measured, text=False)
    scale = _SIDE / max(1.0, measured.shape)
    small = cv2.resize(measured.depth[0], (round(scale), round(scale * measured.shape)))
    return cv2.cvtColor(depth_levels(small, measured.width_mm)[0], cv2.COLOR_GRAY2RGB)


def field_numbers(measured: Fields) -> dict[str, Any]:
    """Return what the page writes of a frame: values with deviations, points of curves, and reasons not to trust them.

    `high` is the depth of a white place of the surface, in widths of the picture.
    """
    about, unit = measured.summary(), "widths" if measured.width_mm is None else "mm"
    curves = {"force, N": about["force_z"], f"depth, {unit}": about["depth"]}
    curves["slip"] = about["slip"] if measured.area[0] > 0 else 0.0
    _, high = depth_levels(measured.depth[0], measured.width_mm)
    return {
        "curves": {name: round(value, 4) for name, value in curves.items() if value is not None},
        "force": None if measured.force is None else [about[f"force_{axis}"] for axis in "xyz"],
        "force_std": about["force_z_std"], "sideways_std": about["force_x_std"], "depth": about["depth"],
        "depth_std": about["depth_std"], "area": about["area"], "unit": unit, "faults": measured.faults,
        "high": high / (measured.width_mm or 1.0),
    }  # fmt: skip
