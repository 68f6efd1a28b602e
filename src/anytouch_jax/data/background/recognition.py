"""Recognition of a sensor instance by its background, among those of a head or an index."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from anytouch_jax.data.background.estimate import DIFFERENT, UntouchedBackground

Array = npt.NDArray[Any]
# grey levels: frames of one unit differ by less in most places, units of one product by more
TINT = 8.0
_SAME_SHAPE = 0.05  # relative difference of the proportions of one camera's images


def same_unit(
    known: Mapping[str, Array], image: Array, *, untouched: bool = False
) -> tuple[Array | None, str]:
    """Return the known image that looks most like `image`, and how it differs.

    Args:
        known: Backgrounds by the name of their sensor instance, u8 (h, w, 3).
        image: The background of the camera at hand.
        untouched: Nothing presses in `image` for sure. Then it must not count as pressed when the
            known image is subtracted, which two instances of one tint can look like.

    Returns:
        The image, None without any of these proportions, and why the camera is another instance:
        "" if it is the same one, else words such as "in size".
    """
    shape = image.shape[1] / image.shape[0]
    fitting = {}
    for name, gel in known.items():
        ratio = gel.shape[1] / gel.shape[0] / shape
        if abs(ratio - 1) < _SAME_SHAPE:
            fitting[name] = gel
    if not fitting:
        return None, "in size" if known else ""
    # A median over places: a press, or a speck, is in the smaller part of the image.
    own = _thumbnail(image)
    tints = {
        name: float(np.median(np.abs(_thumbnail(gel) - own), axis=(0, 1)).max())
        for name, gel in fitting.items()
    }
    name = min(tints, key=lambda one: tints[one])
    gel = fitting[name]
    if tints[name] > TINT:
        return gel, f"in tint, by {tints[name]:.0f} grey levels"
    if untouched:
        # proportions that differ by a few pixels cannot be compared, and say nothing
        with suppress(ValueError):
            score = UntouchedBackground(gel).score(image)
            if score >= DIFFERENT:
                return gel, f"as much as a touch does, by a contact score of {score:.0f}"
    return gel, ""


def _thumbnail(image: Array) -> Array:
    return cv2.resize(image, (32, 24), interpolation=cv2.INTER_AREA).astype(np.float32)


class Recognised(NamedTuple):
    """What the known images of a head or an index say about a camera.

    Attributes:
        image: The one that is subtracted, None if the camera's own counts.
        what: What it is, in words for the report.
        warning: A sentence, "" if all is well.
    """

    image: Array | None
    what: str
    warning: str


def recognise(
    known: Mapping[str, Array],
    own: Array,
    *,
    is_background: bool,
    untouched: bool = False,
    of: str = "the head was fitted with",
) -> Recognised:
    """Return which of the known images counts for a camera.

    Args:
        known: Backgrounds by the name of their sensor instance.
        own: What the camera shows.
        is_background: Whether `own` can be subtracted. A few frames show the press itself. That
            changes the tint by up to 17 grey levels on real sensors, as much as another instance
            does, so they cannot tell the two apart. Then the nearest image is better than none.
        untouched: Nothing presses in `own` for sure.
        of: What the known images belong to, in words.
    """
    gel, why = same_unit(known, own, untouched=untouched)
    if gel is not None and not why:
        return Recognised(gel, f"the image that {of}", "")
    if is_background:
        return Recognised(None, "", other_unit(why) if why else "")
    if gel is None:
        return Recognised(None, "", "")
    return Recognised(
        gel,
        f"the nearest image that {of}. So few frames do not tell whether it is the same sensor: "
        "name its own image with --background if it is another",
        "",
    )


def other_unit(why: str) -> str:
    """Return the warning about a camera that differs from all that something was fitted with."""
    return (
        f"The image differs {why} from every unit that the head or index was fitted with. Its "
        "own untouched gel is subtracted. Do not trust the result before you have checked it."
    )
