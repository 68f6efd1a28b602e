"""Preprocessing of camera frames for an encoder: orientation, background subtraction, size."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from anytouch_jax.data.images import to_rgb
from anytouch_jax.data.transforms import Flip, orient_frame

if TYPE_CHECKING:
    from anytouch_jax.encoder.encoder import Encoder


class Preprocess:
    """Frames of one sensor in the form that an encoder was trained on.

    They are turned by `rotate` degrees, mirrored by `flip` (`data.transforms.orient_frame`) and resized. For an encoder
    that `subtracts`, the `background` (a frame of the untouched gel) is subtracted first. Without a background an
    encoder that needs one takes the first frame, and another takes frames without subtraction.

    >>> preprocess = Preprocess(encoder, background=camera.read())
    >>> features = encoder.encode_touch(preprocess(camera.read()), "digit")
    """

    def __init__(
        self, encoder: Encoder, background: npt.ArrayLike | None = None, *, rotate: int = 0, flip: Flip = "none"
    ) -> None:
        self._prepare = encoder.prepare
        self._subtracts = encoder.needs_background or (encoder.subtracts and background is not None)
        self._orient = partial(orient_frame, rotate=rotate, flip=flip)
        self._background = None
        if background is not None:
            self._background = self._orient(to_rgb(np.asarray(background), "the background"))

    def __call__(self, frame: npt.ArrayLike) -> np.ndarray:
        """Return a frame as RGB u8 (size, size, 3), or as an encoder of another family reads it.

        `frame` is RGB u8 (h, w, 3), or grey, RGBA, u16 or floats in 0..1. Raises ImageError for any other.
        """
        frame = np.ascontiguousarray(self._orient(to_rgb(np.asarray(frame), "the frame")))
        if self._subtracts:
            self._background = frame if self._background is None else self._background
            return self._prepare(frame, self._background)
        return self._prepare(frame)
