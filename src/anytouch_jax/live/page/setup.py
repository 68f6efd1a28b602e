"""How live frames are read: their orientation, their background, and what measures them."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from anytouch_jax.data.background.estimate import UntouchedBackground
from anytouch_jax.data.background.rule import RunningBackground
from anytouch_jax.data.transforms import Flip, orient_frame
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.encoder.base import Preprocess
from anytouch_jax.errors import UserError
from anytouch_jax.live.page.layers import last_clip, scale_down

if TYPE_CHECKING:
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.encoder.measured import Fields, Measure


class Setup(NamedTuple):
    """How frames are read. A frame is read by one setup, whatever the page asks for meanwhile.

    Attributes:
        rotate: degrees clockwise.
        flip: after the rotation.
        running: the estimate of the background, None if an image of it was given.
        gel: the background RGB u8 (h, w, 3), turned as frames are.
        small: the background, scaled down, and ready to be compared.
        preprocess: makes the encoder's input of a turned frame.
        measure: measures depth and force, None if the encoder does not.
        note: a sentence on a background that does not fit a calibrated sensor, or "".
    """

    rotate: int
    flip: Flip
    running: RunningBackground | None
    gel: Array | None
    small: tuple[Array, UntouchedBackground] | None
    preprocess: Preprocess
    measure: Measure | None
    note: str = ""

    def turned(self, image: Array) -> Array:
        """Return an image as read, turned."""
        return np.ascontiguousarray(orient_frame(image, self.rotate, self.flip))

    def is_turned_as(self, other: Setup) -> bool:
        """Return whether images of both are turned in one way."""
        return (self.rotate, self.flip) == (other.rotate, other.flip)


def make_setup(
    encoder: Encoder,
    sensor: str,
    rotate: int,
    flip: Flip,
    gel: Array | None,
    running: RunningBackground | None = None,
    *,
    log: Callable[[str], None] = print,
) -> Setup:
    """Return a setup with a background.

    A background that does not fit a calibrated sensor is logged, and is the setup's note. If it is
    of another gel, deviations are wider. If it is of another device, nothing is measured.

    Args:
        encoder: what frames are prepared for.
        sensor: its name, that of the universal tokens, or the folder of a fitted one.
        rotate: degrees clockwise.
        flip: after the rotation.
        gel: the background RGB u8 (h, w, 3), turned as frames are, None to estimate it.
        running: the estimate that `gel` comes from, if it was not given by hand.
        log: gets that sentence.
    """
    if gel is None and running is None:
        running = RunningBackground()
    small = None
    if gel is not None:
        small = scale_down(gel), UntouchedBackground(gel)
    measure = None
    said = list[str]()
    if encoder.measures:
        try:
            measure = encoder.measure_of(sensor, gel, log=said.append)
        except UserError as error:
            said.append(str(error))
    # What `measure` says later is of a frame, and stands in its fields.
    note = " ".join(said)
    if note:
        log(note)
    # Frames are turned before, so the encoder's preprocessing does not.
    return Setup(rotate, flip, running, gel, small, Preprocess(encoder, gel), measure, note)


def measure_last(
    encoder: Encoder, measure: Measure, row: int, image: Array, prepared: list[Array]
) -> Fields:
    """Return the fields of an image.

    Args:
        encoder: the one that `measure` is of.
        measure: turns its raw fields into mm and N.
        row: of its table of sensors.
        image: RGB u8 (h, w, 3), turned.
        prepared: the encoder's input of some frames u8 (H, W, 3), of which it is the last.
    """
    clip = last_clip(prepared, encoder.config.model.frames)
    rows = np.array([row], np.int32)
    aspect = np.log([image.shape[0] / image.shape[1]]).astype(np.float32)
    raw = encoder.encode_and_measure(clip[None], rows, aspect)[1]
    return measure(raw, [image])
