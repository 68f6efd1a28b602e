"""Layout of a camera's image: is it turned, mirrored, or with red and blue exchanged?

A background is compared with those of real sensor instances of the same family. `backgrounds.npz`
has some of these, at 30 x 40 pixels. The simulator draws with the same images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib.resources import files
from itertools import product
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from anytouch_jax.data.background.estimate import close_dots, has_dots, scale_image
from anytouch_jax.files import read_arrays

Array = npt.NDArray[Any]
SIDE = 16  # of the layout of an image
# An image must fit better by so much another way round before it is called turned. Layouts have
# norm 1, so this is a difference of correlations.
ORIENTATION = 0.10
_LIKE = 0.6  # least correlation with the family
_MOST_ALIKE = 3  # references whose median counts: one odd reference decides nothing
_SAME_SHAPE = 0.2  # difference of logarithms of proportions


class Turn(NamedTuple):
    """A mirror image left to right, if `mirrored`, and then quarters of a turn to the left."""

    quarters: int
    mirrored: bool


_UPRIGHT = Turn(0, False)
_TURNS = (
    _UPRIGHT,
    Turn(1, False),
    Turn(2, False),
    Turn(3, False),
    Turn(0, True),
    Turn(1, True),
    Turn(2, True),
    Turn(3, True),
)
# What was done to an image, in words, and the option that undoes it.
_NAMES = {
    Turn(1, False): "turned by 90 degrees",
    Turn(2, False): "upside down",
    Turn(3, False): "turned by 270 degrees",
    Turn(0, True): "mirrored left to right",
    Turn(2, True): "mirrored top to bottom",
    Turn(1, True): "mirrored and turned",
    Turn(3, True): "mirrored and turned",
}
_OPTIONS = {
    Turn(1, False): "--rotate 90",
    Turn(2, False): "--rotate 180",
    Turn(3, False): "--rotate 270",
    Turn(0, True): "--flip across",
    Turn(2, True): "--flip down",
}


@dataclass(frozen=True)
class Check:
    """The result of a check of a sensor instance.

    Attributes:
        name: What is checked.
        ok: None if it cannot be decided.
        value: What was measured, in words.
        advice: What to do if it failed.
    """

    name: str
    ok: bool | None
    value: str
    advice: str = ""


@dataclass(frozen=True, eq=False)
class UnitFrames:
    """Frames of one sensor instance.

    Attributes:
        sensor: Its family.
        unit: Its name.
        recordings: Lists of images RGB u8 (h, w, 3), in order, all of one size.
        background: Its untouched gel.
        steps: (n,), distances of neighbouring frame numbers.
        rows: Number of all its frames, read or not.
    """

    sensor: str
    unit: str
    recordings: Sequence[Sequence[Array]]
    background: Array | None = None
    steps: Array = field(default_factory=lambda: np.ones(0))
    rows: int = 0

    @property
    def frames(self) -> list[Array]:
        """All images that were read."""
        return [frame for recording in self.recordings for frame in recording]

    @cached_property
    def small(self) -> list[Array]:
        """The images of each recording at 160 pixels, u8 (n, h, w, 3)."""
        return [
            np.stack([scale_image(frame) for frame in recording]) for recording in self.recordings
        ]

    @cached_property
    def middles(self) -> list[Array]:
        """The median image of each recording at 160 pixels."""
        return [np.median(small, axis=0).astype(np.uint8) for small in self.small]

    @cached_property
    def usual(self) -> Array:
        """The median of all recordings at 160 pixels: what never moves."""
        return np.median(np.stack(self.middles), axis=0).astype(np.uint8)

    def untouched(self) -> Array:
        """Return the background, or the usual image without one."""
        if self.background is None:
            return self.usual
        return self.background


@lru_cache
def known_backgrounds(sensor: str) -> list[Array]:
    """Return backgrounds RGB u8 (30, 40, 3) of real instances of a sensor family.

    There are none of an unknown family, and of those whose look the simulator invents.
    """
    with (files("anytouch_jax.data.background") / "backgrounds.npz").open("rb") as file:
        backgrounds = read_arrays(file, only=sensor.__eq__)
    return list(backgrounds.get(sensor, ()))


def check_layout(
    unit: UnitFrames, references: Sequence[Array], *, may_be_turned: bool = False
) -> Check:
    """Compare with the references: which turn and order of colours fits them best?

    A near symmetry is no fault: where an image fits another way round by little more, nothing is
    said.

    Args:
        unit: Its background, or else its usual image, is compared.
        references: Backgrounds u8 (h, w, 3) of the same family.
        may_be_turned: No turn is a fault, and no mirror image; exchanged colours still are.
    """
    name = "orientation and colours"
    if not references:
        return Check(name, None, "no reference of this sensor")
    scores = _scores(unit.untouched(), references)
    most = max(scores.values(), default=0.0)
    if most < _LIKE:
        return Check(name, None, f"unlike its family ({most:.2f})")
    as_it_is = scores.pop((_UPRIGHT, False), -1.0)
    if may_be_turned:
        turned = [scores.pop((turn, False), -1.0) for turn in _TURNS]
        as_it_is = max(as_it_is, *turned)
    best = max(scores, key=lambda key: scores[key])
    margin = scores[best] - as_it_is
    if margin <= ORIENTATION:
        return Check(name, True, f"fits ({as_it_is:.2f})")
    turn, is_exchanged = best
    done = _inverse(turn)
    exchanged = ["red and blue exchanged"] if is_exchanged else []
    what = [_NAMES[done]] if done in _NAMES else []
    cure = []
    if done != _UPRIGHT:
        cure = [_OPTIONS.get(done, "a turn and a mirror")]
    value = f"{' and '.join(what + exchanged)} ({margin:+.2f})"
    return Check(name, False, value, f"Read it with {' and '.join(cure + exchanged)}.")


def _scores(image: Array, references: Sequence[Array]) -> dict[tuple[Turn, bool], float]:
    """Return how well an image fits the references, for each turn and order of its colours.

    Turns that give it other proportions are left out.
    """
    known = np.stack([_layout(reference) for reference in references])
    own = _layout(image)
    shapes = np.log([reference.shape[1] / reference.shape[0] for reference in references])
    shape = np.log(image.shape[1] / image.shape[0])
    scores = {}
    for turn, is_exchanged in product(_TURNS, (False, True)):
        turned_shape = -shape if turn.quarters % 2 else shape
        if abs(turned_shape - np.median(shapes)) > _SAME_SHAPE:
            continue
        correlations = (known * _turned(own, turn, is_exchanged)).sum((1, 2, 3))
        scores[turn, is_exchanged] = float(np.median(np.sort(correlations)[-_MOST_ALIKE:]))
    return scores


def _inverse(turn: Turn) -> Turn:
    """Return what was done to an image that `turn` makes fit.

    A mirror image that is turned is its own inverse.
    """
    if turn.mirrored:
        return turn
    return Turn(-turn.quarters % 4, False)


def _layout(image: Array) -> Array:
    """Return where an image has which colour, f32 (SIDE, SIDE, 3) of norm 1.

    Brightness and contrast are gone, because exposure and gain change them.
    """
    small = small_look(np.ascontiguousarray(image)).reshape(SIDE, SIDE, 3)
    small = small - small.mean()
    return np.asarray(small / max(float(np.linalg.norm(small)), 1e-6))


def _turned(layout: Array, turn: Turn, is_exchanged: bool) -> Array:
    if turn.mirrored:
        layout = layout[:, ::-1]
    layout = np.rot90(layout, turn.quarters)
    if is_exchanged:
        return layout[..., ::-1]
    return layout


def small_look(image: Array) -> Array:
    """Return an image without its dots at SIDE pixels, f32 (SIDE * SIDE * 3,)."""
    small = scale_image(image)
    if has_dots(small):
        small = close_dots(small)
    return cv2.resize(small, (SIDE, SIDE), interpolation=cv2.INTER_AREA).astype(np.float32).ravel()
