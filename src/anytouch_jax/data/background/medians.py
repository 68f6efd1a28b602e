"""Medians of frames: backgrounds of cameras that press now and then, and of live sources."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
import numpy.typing as npt

from anytouch_jax.data.background.estimate import EDGE, free_frames, scale_image
from anytouch_jax.data.pixels import to_rgb
from anytouch_jax.errors import UserError

Array = npt.NDArray[Any]
Item = TypeVar("Item")
FRAMES = 100  # frames of a median: 10 of them to all of them score alike
FEWEST = 5  # frames of a median, of as many sequences: fewer show the press itself
SIDE = 320  # pixels of the long side of a median
SETTLED = 512  # frames, a power of two, after which a running estimate stays
_ESTIMATED = 24  # frames of one recording among which the free ones are looked for


class Spread(Generic[Item]):
    """`make` of at most FRAMES evenly spaced items of a sequence of unknown length.

    It keeps every item until FRAMES are there, then every second one, then every fourth. So a
    source that never ends takes little memory, and what is kept is spread over all of it.
    """

    def __init__(self, make: Callable[[Item], Array]) -> None:
        self.items = list[Array]()
        self.count = 0
        self._make = make
        self._step = 1

    def add(self, item: Item) -> None:
        """Count one item more, and keep it if its turn has come."""
        if self.count % self._step == 0 and len(self.items) == FRAMES:
            self.items = self.items[::2]
            self._step = 2 * self._step
        if self.count % self._step == 0:
            self.items.append(self._make(item))
        self.count += 1


def estimate_background(frames: Iterable[npt.ArrayLike]) -> Array:
    """Return the background u8 (h, w, 3) of a camera: the median of its frames (h, w, 3).

    The frames may be pressed, at changing places. At most FRAMES of them are used, evenly spread.

    Raises UserError for fewer than FEWEST frames, and for frames of several sizes.
    """
    spread: Spread[npt.ArrayLike] = Spread(lambda frame: to_rgb(np.asarray(frame), "a frame"))
    for frame in frames:
        spread.add(frame)
    if spread.count < FEWEST:
        raise UserError(
            f"{spread.count} frames are too few for an image of the untouched gel. Give {FEWEST} "
            "or more."
        )
    shapes = {frame.shape for frame in spread.items}
    if len(shapes) > 1:
        raise UserError(f"the frames have {len(shapes)} sizes. Give frames of one camera.")
    return median(spread.items)


def median(frames: Sequence[Array]) -> Array:
    """Return the per-pixel median u8 (h, w, 3) of frames of one size.

    Of an even number it is the lower middle, which is a value that was seen.
    """
    middle = (len(frames) - 1) // 2
    return np.partition(np.stack(frames), middle, axis=0)[middle]


def evenly(count: int, most: int) -> Array:
    """Return at most `most` evenly spread numbers of 0 to `count` - 1, i64, without repeats."""
    return np.unique(np.linspace(0, count - 1, most).astype(int))


def estimate(frames: Sequence[Array]) -> Array:
    """Return the background of one recording.

    It is the median of the recording's free frames if these stand out, else of all frames. A touch
    that is held for most of a recording would be in the median of all.
    """
    some = [frames[i] for i in evenly(len(frames), _ESTIMATED)]
    small = [scale_image(frame) for frame in some]
    # the score leaves out a border of EDGE pixels
    is_large_enough = min(small[0].shape[:2]) > 2 * EDGE + 2
    if len(some) < FEWEST or not is_large_enough:
        return median(frames)
    group, _ = free_frames(small)
    if group is None:
        return median(frames)
    return median([some[i] for i in group])


def reduced(frame: Array) -> Array:
    """Return a copy of a frame, whose long side has at most SIDE pixels."""
    if max(frame.shape[:2]) <= SIDE:
        return frame.copy()
    return scale_image(frame, SIDE)


def recording_gel(frames: Iterable[Array]) -> tuple[Array, int]:
    """Return the background of the frames of a folder or a video, and how many of them count.

    With fewer than FEWEST it shows the press itself.
    """
    spread: Spread[Array] = Spread(reduced)
    for frame in frames:
        spread.add(frame)
    if not spread.items:
        raise UserError("no frame can be read, so the untouched gel is unknown. Check the images.")
    usual = alike(spread.items)
    return estimate(usual), len(usual)


def alike(frames: Sequence[Array]) -> list[Array]:
    """Return the frames of the commonest size."""
    sizes = Counter(frame.shape for frame in frames)
    return [frame for frame in frames if frame.shape == sizes.most_common(1)[0][0]]


class RunningBackground:
    """The background of a live source: `image`, None before its first frame.

    A thread estimates it from the frames so far whenever their number has doubled. The result
    counts when the number has doubled again, not when the thread is done. So no frame waits for it,
    and the same frames have the same images on a slow machine and on a fast one. It is `settled`
    after SETTLED frames.
    """

    def __init__(self) -> None:
        self.image: Array | None = None
        self.settled = False
        self._spread: Spread[Array] = Spread(reduced)
        self._thread: threading.Thread | None = None
        self._found = list[Array]()

    def __getstate__(self) -> dict[str, Any]:  # a copy does without the estimate at work
        return self.__dict__ | {"_thread": None}

    def add(self, frame: Array) -> None:
        """Take one frame more, RGB u8 (h, w, 3)."""
        if self.settled:
            return
        self._spread.add(frame)
        count = self._spread.count
        is_power_of_two = count.bit_count() == 1
        if not is_power_of_two:
            return
        if self._thread is not None:
            self._thread.join()
        frames = alike(self._spread.items)
        self.settled = count >= SETTLED
        if self._found:
            self.image = self._found.pop()
        elif self.image is None:
            self.image = frames[0]
        if not self.settled:
            self._thread = threading.Thread(
                target=lambda: self._found.append(estimate(frames)), daemon=True
            )
            self._thread.start()
