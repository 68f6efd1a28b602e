"""Fresh frames of a camera: how many a second, and how old they are when they are read.

A driver may give the same image again, and a camera may be slower than it says: less light makes
its exposure longer, and a crowded bus or a busy machine loses frames. Nobody sees that in images.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import cv2
import numpy as np

from anytouch_jax.data.images import QUIET

ENOUGH = 0.8  # of the nominal rate: with fewer fresh frames something is wrong
WINDOW = 3.0  # seconds over which the rate of a stream is judged
_OLDEST = 10.0  # seconds: a driver's clock that differs by more is not ours
_FIRST = 5  # frames that are not counted: a camera needs some until it is at its rate


class Rate(NamedTuple):
    """What a camera gives.

    Attributes:
        fresh: frames a second whose bytes differ from those of the frame before.
        nominal: what it says, NaN if it says nothing.
        repeated: fraction of frames that are the same as the one before.
        age: median seconds from a frame's capture to its reading, NaN if the driver does not tell.
    """

    fresh: float
    nominal: float = float("nan")
    repeated: float = 0.0
    age: float = float("nan")

    def __str__(self) -> str:
        words = f"{self.fresh:.1f} fresh frames/s"
        if self.nominal > 0:
            words += f" of {self.nominal:g}"
        if self.repeated > 0:
            words += f", {self.repeated:.0%} of frames repeat the one before"
        if self.age == self.age:
            words += f", a frame is {1e3 * self.age:.0f} ms old when it is read"
        return words

    def warning(self) -> str:
        """Return a sentence on a camera that is too slow, "" for one that is not."""
        # NaN: without a nominal rate there is nothing to compare with.
        if not self.fresh < ENOUGH * self.nominal:
            return ""
        return (
            f"the camera gives {self.fresh:.1f} fresh frames/s, and not {self.nominal:g} as it "
            "says. Look for a long exposure in little light, a crowded USB bus, or a busy machine. "
            "Another --camera-format may be faster."
        )


def nominal_rate(source: Any) -> float:
    """Return the frames a second that a source says it gives, NaN if it says nothing."""
    get = getattr(source, "get", None)
    if get is None:
        return float("nan")
    rate = float(get(cv2.CAP_PROP_FPS))
    return rate if rate > 0 else float("nan")


def capture_age(source: Any) -> float:
    """Return the seconds since the grabbed frame of a camera was captured, NaN if unknown.

    V4L2 stamps buffers with the clock that starts with the machine. Another source gives another
    number here, such as the position in a video, which is too far away to be taken for it.
    """
    get = getattr(source, "get", None)
    if get is None:
        return float("nan")
    age = time.monotonic() - float(get(cv2.CAP_PROP_POS_MSEC)) / 1e3
    return age if 0 <= age < _OLDEST else float("nan")


def measure_rate(source: Any, seconds: float = 1.0) -> Rate:
    """Return what an open camera gives within some seconds. It is read as fast as it can be."""
    last = None
    count = 0
    repeated = 0
    ages = list[float]()
    start = time.perf_counter()
    now = start
    # A camera that gives nothing at all must not hold the caller.
    give_up = start + 2 * seconds + 3.0
    while now < give_up and (count == 0 or now - start < seconds):
        with QUIET:
            whole, pixels = source.retrieve() if source.grab() else (False, None)
        now = time.perf_counter()
        if not whole or pixels is None:
            time.sleep(0.01)
            continue
        ages.append(capture_age(source))
        if last is None or len(ages) <= _FIRST:
            start = now
        else:
            count += 1
            repeated += np.array_equal(pixels, last)
        last = pixels
    if not count:
        return Rate(0.0, nominal_rate(source))
    age = float("nan")
    known = [one for one in ages if one == one]
    if known:
        age = float(np.median(known))
    return Rate((count - repeated) / (now - start), nominal_rate(source), repeated / count, age)
