"""Layers of a tactile image as the page shows them: difference, contact, depth, surface."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from anytouch_jax.data.background.estimate import (
    UntouchedBackground,
    contact_score,
    scale_image,
    without_islands,
)
from anytouch_jax.data.transforms import subtract_background
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    from anytouch_jax.encoder.measured import Fields

# of a touch, by which the page shows it
LAYERS = ("frame", "difference", "contact", "depth", "surface")
MEASURED = LAYERS[3:]  # those that an encoder measures
SIDE = 640  # pixels of the long side of an image on the page
_SHARP = 480  # pixels of the long side of an image with arrows, at least
# What is known of a device, as the page says it.
_CASES = {
    "calibrated": "a calibrated gel",
    "family": "a sensor of a known kind, not calibrated",
    "unknown": "a sensor of an unknown kind",
}
_SIDE = 72  # cells of a surface along the long side of the image
# Colours of contact: red and green of a pixel are halved and raised, blue only halved.
_TINTED = (np.arange(256)[None, :, None] / 2 + (127, 60, 0)).astype(np.uint8)


def scale_down(image: Array, side: int = SIDE) -> Array:
    """Return an image whose long side has at most `side` pixels."""
    if max(image.shape[:2]) <= side:
        return image
    return scale_image(image, side)


def touch_layer(
    frame: Array, gel: tuple[Array, UntouchedBackground] | None, limit: float, name: str
) -> tuple[Array, float]:
    """Return one of LAYERS as an image RGB u8 (h, w, 3), and the contact score.

    Without a background of the same proportions it is the frame, and the score is NaN. For the
    layers MEASURED it is the frame, too.

    Args:
        frame: RGB u8 (h, w, 3).
        gel: the background, scaled down, and ready to be compared.
        limit: grey levels of change from which a place is in contact.
        name: one of LAYERS.

    Raises:
        UserError: another name.
    """
    if name not in LAYERS:
        raise UserError(f"A touch has the layers {', '.join(LAYERS)}, not {name[:20]}.")
    view = scale_down(frame)
    height, width = view.shape[:2]
    if gel is None:
        return view, float("nan")
    background, untouched = gel
    try:
        change = untouched.difference(frame)
    except ValueError:
        # The background was taken before the image was turned.
        return view, float("nan")
    if name == "difference":
        if background.shape != view.shape:
            background = cv2.resize(background, (width, height))
        (view,) = subtract_background([view], background)
    elif name == "contact":
        mask = without_islands((cv2.resize(change, (width, height)) > limit).astype(np.uint8))
        tinted = cv2.LUT(view, _TINTED)
        view = cv2.convertScaleAbs(view, alpha=1 / 3, beta=40)
        cv2.copyTo(tinted, mask, view)
    return view, contact_score(change)


def last_clip(frames: Sequence[Array], length: int) -> Array:
    """Return the last frames as a clip (length, h, w, 3).

    Before the first of them nothing moved.
    """
    same = [frame for frame in frames[-length:] if frame.shape == frames[-1].shape]
    return np.stack([same[0]] * (length - len(same)) + same)


def measured_layer(frame: Array, measured: Fields, name: str) -> Array:
    """Return what was measured of a frame as an image u8 (h, w, 3).

    It is "depth" drawn on the frame, or a "surface" whose grey is the depth.
    """
    from anytouch_jax.fields.measure import depth_levels, overlay

    if name == "depth":
        # Lines on few pixels would be thick.
        larger = max(1.0, _SHARP / max(frame.shape[:2]))
        return overlay(cv2.resize(frame, None, fx=larger, fy=larger), measured, text=False)
    scale = _SIDE / max(1.0, measured.shape)
    small = cv2.resize(measured.depth[0], (round(scale), round(scale * measured.shape)))
    return cv2.cvtColor(depth_levels(small, measured.width_mm)[0], cv2.COLOR_GRAY2RGB)


def field_numbers(measured: Fields) -> dict[str, Any]:
    """Return what the page writes of a frame.

    `scale` is the depth of the lightest colour, in the unit of the depth. `high` is the same in
    widths of the image.
    """
    from anytouch_jax.fields.measure import depth_levels

    about = measured.summary()
    unit = "widths" if measured.width_mm is None else "mm"
    curves = {"force, N": about["force_z"], f"depth, {unit}": about["depth"]}
    slip = about["slip"]
    if measured.area[0] > 0 and slip is not None:
        # Where nothing touches, nothing slips, and there is no number.
        curves["slip, %"] = 100 * slip
    _, high = depth_levels(measured.depth[0], measured.width_mm)
    return {
        "curves": {name: round(value, 4) for name, value in curves.items() if value is not None},
        "force": None if measured.force is None else [about[f"force_{axis}"] for axis in "xyz"],
        "force_std": about["force_z_std"],
        "force_low": about["force_low"],
        "force_high": about["force_high"],
        "case": _CASES[measured.case],
        "calibrated": measured.case == "calibrated",
        "sideways_std": about["force_x_std"],
        "depth": about["depth"],
        "depth_std": about["depth_std"],
        "area": about["area"],
        "unit": unit,
        "faults": measured.faults,
        "scale": high,
        "high": high / (measured.width_mm or 1.0),
    }
