"""Packets of the live stream: what the page shows of a frame, as JSON and a JPEG."""

from __future__ import annotations

import json
import struct
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2

from anytouch_jax.data.background.estimate import UntouchedBackground
from anytouch_jax.data.images import encode
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.live.page.layers import (
    LAYERS,
    MEASURED,
    SIDE,
    field_numbers,
    measured_layer,
    scale_down,
    touch_layer,
)

if TYPE_CHECKING:
    from anytouch_jax.encoder.measured import Fields

_QUALITY = 85  # of JPEG


class Shown(NamedTuple):
    """What the page shows of a frame.

    Attributes:
        number: of the packet, from 1. 0 is nothing yet.
        about: what is known of the frame.
        image: RGB u8 (h, w, 3), turned.
        gel: the background, scaled down, and ready to be compared.
        fields: what was measured.
    """

    number: int = 0
    about: Mapping[str, Any] = {}
    image: Array | None = None
    gel: tuple[Array, UntouchedBackground] | None = None
    fields: Fields | None = None


def layers_of(measures: bool) -> list[str]:
    """Return the layers of live touch, by an encoder that measures or does not."""
    return [name for name in LAYERS if measures or name not in MEASURED]


def describe_touch(score: float, threshold: float, fields: Fields | None) -> dict[str, Any]:
    """Return contact, its curve, and what was measured of a frame.

    Args:
        score: contact score, NaN if the background is not known.
        threshold: above it there is contact.
        fields: what was measured.
    """
    is_known = score == score
    curves = {}
    if is_known:
        curves["contact"] = round(score, 2)
    measured = None
    if fields is not None:
        measured = field_numbers(fields)
        curves |= measured["curves"]
    return {
        "contact": bool(score > threshold) if is_known else None,
        "threshold": threshold,
        "curves": curves,
        "fields": measured,
    }


def packet(shown: Shown, layer: str, side: int = SIDE) -> bytes:
    """Return a frame for the page: length u32, JSON, length u32, JPEG, little endian.

    The long side of the image has at most `side` pixels: as many as the page shows, because the
    browser has to decode each of them.
    """
    about = {"layer": layer, "sent": 1e3 * time.time(), **shown.about}
    jpeg = b""
    if shown.image is not None:
        view, about["layer"] = _view(shown.image, shown, layer)
        jpeg = encode(scale_down(view, side), ".jpg", cv2.IMWRITE_JPEG_QUALITY, _QUALITY)
    text = json.dumps(about).encode()
    return struct.pack("<I", len(text)) + text + struct.pack("<I", len(jpeg)) + jpeg


def _view(image: Array, shown: Shown, layer: str) -> tuple[Array, str]:
    """Return a layer of a frame, and its name. Without a background it is the frame itself.

    The contact score is known already, so only a layer that shows the difference compares the
    frame with its background again.
    """
    frame = scale_down(image)
    if layer == LAYERS[0] or (layer in MEASURED and shown.fields is None):
        return frame, LAYERS[0]
    if shown.fields is not None and layer in MEASURED:
        return measured_layer(frame, shown.fields, layer), layer
    view, score = touch_layer(image, shown.gel, shown.about["threshold"], layer)
    return view, layer if score == score else LAYERS[0]
