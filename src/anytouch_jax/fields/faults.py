"""Faults of a frame that a sensor in order does not give: turned, mirrored, grey, recoloured."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from anytouch_jax.data.background.estimate import holds_press
from anytouch_jax.data.background.layout import UnitFrames, check_layout, known_backgrounds
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.errors import UserError

# Differences of the logarithm of height over width: that of a turned or cropped image, and that
# between a frame and its own background, which should have none.
SHAPE_LIMIT = 0.1
_SAME_SHAPE = 0.03
_GREY = 2  # levels by which colours of a grey image differ
_SIDE = 40  # pixels of an image's width, when compared with its background
# A turned image must fit its background better by this factor, and by a level more. Of simulated
# presses, 4 % look exchanged by a factor of up to 1.17, because a press covers a part of an image.
_FACTOR = 1.2
_LEVEL = 1


def faults_of(
    frame: Array, background: Array | None, sensor: str, shape: float | None
) -> tuple[str, ...]:
    """Return sentences on a frame that a sensor in order does not give.

    Args:
        frame: RGB u8 (h, w, 3).
        background: the image of its untouched gel.
        sensor: its name.
        shape: the height of its images over their width, None if nobody knows it.

    Raises:
        UserError: frame and background show different parts of the gel.
    """
    height, width = frame.shape[:2]
    if background is not None:
        other_height, other_width = background.shape[:2]
        differs = np.log(other_height * width / (other_width * height))
        if abs(differs) > _SAME_SHAPE:
            raise UserError(
                f"the frame has {width} x {height} pixels and its background {other_width} x "
                f"{other_height}: they show different parts of the gel. Take both with one "
                "setting of the camera."
            )
    faults = list[str]()
    if shape is not None and abs(np.log(height / (width * shape))) > SHAPE_LIMIT:
        faults.append(
            f"an image of {sensor} has a height of {shape:.3g} widths, and this one has {width} x "
            f"{height} pixels. Turn it, or name the width that it shows (width_mm)."
        )
    few = frame[::4, ::4].astype(np.int16)
    if np.abs(few - few[..., :1]).max() <= _GREY:
        # The other checks compare colours.
        faults.append("the image is grey, and colours show the slopes. Read it in colour.")
        return tuple(faults)
    if background is not None:
        turned = _unlike(frame, background)
        if turned:
            faults.append(
                f"it looks {turned} when compared with its background. Read both in the same way."
            )
        if not turned and holds_press(background, frame):
            faults.append(
                "its background shows a press. Record that again, with nothing on the gel."
            )
    # A device may be built another way round than the few known ones, and half of the simulated
    # instances that the network has learned from are mirrored. With the background of the same
    # device it reads an example and its mirror images alike (depth within 0.05 mm RMS, force within
    # 17 %), and 20 presses each of a real DIGIT and GelSight turned in any way (the deepest point
    # changes by 2 to 8 %). So a turn counts only without a background.
    check = check_layout(
        UnitFrames(sensor, "", [[frame]], background),
        known_backgrounds(sensor),
        may_be_turned=background is not None,
    )
    if check.ok is False:
        faults.append(f"unlike other units of {sensor} it looks {check.value}. {check.advice}")
    return tuple(faults)


EXCHANGED = "as with red and blue exchanged"


def _unlike(frame: Array, background: Array) -> str:
    """Return how a frame was turned or recoloured against its background, "" if it was not."""
    size = (_SIDE, max(1, round(_SIDE * frame.shape[0] / frame.shape[1])))

    def small(image: Array) -> Array:
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)

    own = small(frame)
    gel = small(background)

    def differs(other: Array) -> float:
        # Medians, because a press covers the smaller part of an image, and without what changes
        # everywhere, because light drifts.
        change = other - gel
        return float(np.median(np.abs(change - np.median(change, axis=(0, 1))).max(2)))

    ways: dict[str, Callable[[Array], Array]] = {
        "mirrored left to right": lambda image: image[:, ::-1],
        "mirrored top to bottom": lambda image: image[::-1],
        "upside down": lambda image: image[::-1, ::-1],
        EXCHANGED: lambda image: image[..., ::-1],
    }
    others = {name: differs(way(own)) for name, way in ways.items()}
    nearest = min(others, key=lambda name: others[name])
    least = others[nearest]
    # A gel that looks nearly alike in the mirror cannot tell: drift of the light may undo what the
    # mirror would change, so it must change more than it leaves. Exchanged colours leave much, but
    # drift hardly undoes them.
    is_mirrored = nearest != EXCHANGED
    told = not is_mirrored or least + _LEVEL < differs(ways[nearest](gel))
    if told and _FACTOR * least + _LEVEL < differs(own):
        return nearest
    return ""
