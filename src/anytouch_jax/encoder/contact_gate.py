"""Contact of live frames, by their difference from the untouched gel."""

from __future__ import annotations

import numpy as np

from anytouch_jax.data.background.contact import DEFAULT_THRESHOLD, THRESHOLDS
from anytouch_jax.data.background.estimate import UntouchedBackground
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.encoder.interface import Preprocess
from anytouch_jax.errors import UserError


class ContactGate:
    """Contact of frames of one sensor, by the difference from `background`.

    That is an image, a `Preprocess`, whose background may be an estimate that improves, or None.
    """

    def __init__(self, background: Array | Preprocess | None, sensor: str) -> None:
        self._source = background
        self._image: Array | None = None
        self._gel: UntouchedBackground | None = None
        self.threshold = THRESHOLDS.get(sensor, DEFAULT_THRESHOLD)

    def __call__(self, frame: Array) -> float:
        """Return 1 (contact), 0 (none) or NaN (unknown) of a frame RGB u8 (h, w, 3)."""
        source = self._source
        # An image stays, and what prepares live frames may have a better one by now.
        image: Array | None = getattr(source, "background", source)  # type: ignore[arg-type]
        if image is not self._image:
            self._image = image
            self._gel = None if image is None else UntouchedBackground(image)
        if self._gel is None:
            return np.nan
        try:
            return float(self._gel.score(frame) > self.threshold)
        except ValueError as error:
            raise UserError(
                f"Contact cannot be decided: {error}. Give a --background of this camera."
            ) from None
