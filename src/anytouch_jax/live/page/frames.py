"""Live frames as they are read: turned, prepared, and kept with their background."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, NamedTuple

from anytouch_jax.data.background.contact import DEFAULT_THRESHOLD, THRESHOLDS
from anytouch_jax.data.background.rule import RunningBackground, other_unit, same_unit
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.encoder.sensor_words import resolve_sensor
from anytouch_jax.live.page.layers import LAYERS, touch_layer
from anytouch_jax.live.page.setup import Setup, make_setup, measure_last

if TYPE_CHECKING:
    from anytouch_jax.data.transforms import Flip
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.encoder.linear_head import Head
    from anytouch_jax.encoder.measured import Fields

_LAST = 8  # frames that are kept: a clip, and those that are read while it is embedded


class Kept(NamedTuple):
    """One of the last frames: its number, its image as read, turned and prepared, and how."""

    number: int
    raw: Array
    turned: Array
    prepared: Array
    setup: Setup


class FrameReader:
    """Prepares live frames for the encoder, and keeps the last ones.

    Args:
        encoder: a loaded encoder.
        sensor: its name, that of the universal tokens, or the folder of a fitted one.
        head: returns the head in use, whose backgrounds are looked at first.
        log: gets a sentence about a background of another sensor instance.
    """

    def __init__(
        self,
        encoder: Encoder,
        sensor: str,
        head: Callable[[], Head | None],
        log: Callable[[str], None],
    ) -> None:
        word = resolve_sensor(sensor)
        self.threshold = THRESHOLDS.get(word.family or word.name, DEFAULT_THRESHOLD)
        self._encoder = encoder
        self._sensor = sensor
        self._head = head
        self._log = log
        self._looker = ThreadPoolExecutor(1)
        self._looking: Future[None] | None = None
        self._lock = threading.Lock()  # both the page and the camera set up
        self._setup = make_setup(encoder, sensor, 0, "none", None, log=log)
        self._kept: deque[Kept] = deque(maxlen=_LAST)
        self._count = 0

    @property
    def setup(self) -> Setup:
        """How the next frame is read."""
        return self._setup

    def last(self, number: int) -> list[Kept]:
        """Return the kept frames up to one, [] if that is gone."""
        kept = [one for one in tuple(self._kept) if one.number <= number]
        if not kept or kept[-1].number != number:
            return []
        return kept

    def score(self, one: Kept) -> float:
        """Return the contact score of a frame, NaN if its background is not known."""
        return touch_layer(one.turned, one.setup.small, self.threshold, LAYERS[0])[1]

    def warm_up(self, row: int) -> None:
        """Compile what measures sensor `row`, and forget what it saw of an empty image."""
        setup = self._setup
        if setup.measure is not None:
            blank = self._encoder.blank
            measure_last(self._encoder, setup.measure, row, blank, [blank])
            self.set_background(setup.gel)

    def measured(self, kept: list[Kept], row: int) -> Fields | None:
        """Return the fields of the last of some frames of sensor `row`, if they can be measured."""
        last = kept[-1]
        if last.setup.measure is None:
            return None
        # What came before the image was turned is no motion.
        clip = [one.prepared for one in kept if one.setup.is_turned_as(last.setup)]
        return measure_last(self._encoder, last.setup.measure, row, last.turned, clip)

    def orient(self, rotate: int, flip: Flip) -> None:
        """Turn the frames clockwise by `rotate` degrees, then mirror them.

        The background is estimated again.
        """
        with self._lock:
            self._setup = make_setup(self._encoder, self._sensor, rotate, flip, None, log=self._log)

    def capture_background(self) -> None:
        """Take the newest frame as the background."""
        if self._kept:
            self.set_background(self._setup.turned(self._kept[-1].raw))

    def set_background(self, image: Array | None) -> None:
        """Take an image RGB u8 (h, w, 3) as the background, or None to estimate it again."""
        with self._lock:
            now = self._setup
            self._setup = make_setup(
                self._encoder, self._sensor, now.rotate, now.flip, image, log=self._log
            )

    def __call__(self, image: Array) -> Array:
        """Keep the image of a frame, and return it for the encoder.

        Frames come here one by one, from 0, so that they can be counted.
        """
        setup = self._setup
        turned = setup.turned(image)
        setup = self._find_gel(setup, turned)
        prepared = setup.preprocess(turned)
        self._kept.append(Kept(self._count, image, turned, prepared, setup))
        self._count += 1
        return prepared

    def _find_gel(self, setup: Setup, image: Array) -> Setup:
        """Look for the background by the rule of `data.background`.

        It is that of the head's sensor instance, or a running estimate.
        """
        running = setup.running
        if running is None:
            return setup
        head = self._head()
        if not self._count and head is not None and head.backgrounds:
            known = _known_gel(head.backgrounds, image, self._log)
            if known is not None:
                return self._replace(setup, known, None)
        # An estimate takes longer than a frame may be old, so another thread makes it.
        if self._looking is None or self._looking.done():
            self._looking = self._looker.submit(running.add, image)
            if running.image is None:
                self._looking.result()
        if running.image is setup.gel:
            return setup
        return self._replace(setup, running.image, running)

    def _replace(self, setup: Setup, gel: Array | None, running: RunningBackground | None) -> Setup:
        """Return a setup with another background.

        It is used unless the page has asked for another meanwhile.
        """
        new = make_setup(
            self._encoder, self._sensor, setup.rotate, setup.flip, gel, running, log=self._log
        )
        with self._lock:
            if self._setup is setup:
                self._setup = new
        return new


def _known_gel(
    backgrounds: Mapping[str, Array], image: Array, log: Callable[[str], None]
) -> Array | None:
    """Return the background of the sensor instance that an image is of, if it is one of
    `backgrounds`.

    `log` gets a sentence if the image is of another instance.
    """
    known, why = same_unit(backgrounds, image)
    if known is not None and not why:
        return known
    log(other_unit(why))
    return None
