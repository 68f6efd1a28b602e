"""Faults of sensor units, made from good ones by simple operations on their images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from anytouch_jax.live.health import UnitFrames

Fault = Callable[[UnitFrames, UnitFrames | None, np.random.Generator], UnitFrames]


def each(
    unit: UnitFrames, change: Callable[[np.ndarray], np.ndarray], *, background: bool = True
) -> UnitFrames:
    """Return the unit with every image changed, that of the untouched gel too if `background`."""
    recordings = [
        [np.ascontiguousarray(change(frame)) for frame in recording]
        for recording in unit.recordings
    ]
    gel = unit.background
    if background and gel is not None:
        gel = np.ascontiguousarray(change(gel))
    return replace(unit, recordings=recordings, background=gel)


def _tint(unit: UnitFrames, other: Any, rng: np.random.Generator) -> UnitFrames:
    """Red grows by half from the first recording to the last."""
    count = max(1, len(unit.recordings) - 1)

    def tinted(frame: np.ndarray, place: int) -> np.ndarray:
        return np.clip(frame * np.array([1 + 0.5 * place / count, 1, 1]), 0, 255).astype(np.uint8)

    return replace(
        unit, recordings=[[tinted(f, i) for f in r] for i, r in enumerate(unit.recordings)]
    )


def _scratch(unit: UnitFrames, other: Any, rng: np.random.Generator) -> UnitFrames:
    """Three bright lines that the background does not have."""
    height, width = unit.frames[0].shape[:2]
    ends = rng.uniform(0.1, 0.9, (3, 2, 2)) * (width, height)
    ends[:, 1] = ends[:, 0] + (0.4 * width, 0.1 * height) * np.sign(
        (width / 2, height / 2) - ends[:, 0]
    )

    def scratched(frame: np.ndarray) -> np.ndarray:
        for start, end in ends.astype(int).tolist():
            frame = cv2.line(
                frame.copy(), start, end, (235, 235, 235), max(2, width // 110), cv2.LINE_AA
            )
        return frame

    return each(unit, scratched, background=False)


def _dead(unit: UnitFrames, other: Any, rng: np.random.Generator) -> UnitFrames:
    height, width = unit.frames[0].shape[:2]
    places = rng.integers(4, (height - 4, width - 4), (6, 2))

    def spotted(frame: np.ndarray) -> np.ndarray:
        frame = frame.copy()
        frame[places[:, 0], places[:, 1]] = (255, 255, 255)
        return frame

    return each(unit, spotted)


def _press(unit: UnitFrames, other: Any, rng: np.random.Generator) -> UnitFrames:
    """The background has a broad bright dent."""
    gel = unit.untouched()
    height, width = gel.shape[:2]
    y, x = np.mgrid[:height, :width]
    middle = rng.uniform(0.35, 0.65, 2) * (height, width)
    dent = np.exp(-(((y - middle[0]) ** 2 + (x - middle[1]) ** 2) / (2 * (0.12 * height) ** 2)))
    pressed = np.clip(gel + dent[..., None] * (70, -40, 50), 0, 255).astype(np.uint8)
    return replace(unit, background=pressed)


def _held(unit: UnitFrames, other: Any, rng: np.random.Generator) -> UnitFrames:
    """One touch that never ends: every frame is one frame of contact with a little noise."""
    frame = _press(unit, other, rng).background
    assert frame is not None
    noisy = [
        [np.clip(frame + rng.normal(0, 2, frame.shape), 0, 255).astype(np.uint8) for _ in r]
        for r in unit.recordings
    ]
    return replace(unit, recordings=noisy)


def _mixed(unit: UnitFrames, other: UnitFrames | None, rng: np.random.Generator) -> UnitFrames:
    """A third of the recordings are of the other unit."""
    assert other is not None
    return replace(
        unit,
        recordings=[
            (other if i % 3 == 2 else unit).recordings[i % len(other.recordings)]
            if i % 3 == 2
            else r
            for i, r in enumerate(unit.recordings)
        ],
    )


def _of(change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    return lambda unit, other, rng: each(unit, change)


def _gain(factor: float) -> Fault:
    return _of(lambda frame: np.clip(frame * factor, 0, 255).astype(np.uint8))


LAYOUT = "orientation and colours"
# name -> the check that must report it, and how it is made
FAULTS: dict[str, tuple[str, Fault]] = {
    "upside down": (LAYOUT, _of(lambda frame: frame[::-1, ::-1])),
    "turned by 90 degrees": (LAYOUT, _of(np.rot90)),
    "mirrored left to right": (LAYOUT, _of(lambda frame: frame[:, ::-1])),
    "mirrored top to bottom": (LAYOUT, _of(lambda frame: frame[::-1])),
    "red and blue exchanged": (LAYOUT, _of(lambda frame: frame[..., ::-1])),
    "blurred": (
        "focus",
        _of(lambda frame: cv2.GaussianBlur(frame, (0, 0), max(frame.shape) / 130)),
    ),
    "too bright": ("exposure", _gain(3.5)),
    "too dark": ("exposure", _gain(0.12)),
    "frozen": (
        "frozen frames",
        lambda unit, other, rng: replace(
            unit,
            recordings=[
                [r[0]] * len(r) if i % 3 == 0 else r for i, r in enumerate(unit.recordings)
            ],
        ),
    ),
    "dropped": (
        "dropped frames",
        lambda unit, other, rng: replace(
            unit, steps=np.where(rng.random(len(unit.steps)) < 0.08, 2.0, unit.steps)
        ),
    ),
    "tint drifts": ("tint drift", _tint),
    "dead pixels": ("dead pixels", _dead),
    "scratched": ("worn gel", _scratch),
    "background pressed": ("background", _press),
    "touch never ends": ("contact", _held),
    "two units mixed": ("one unit", _mixed),
}


def most_different(unit: UnitFrames, units: Sequence[UnitFrames]) -> UnitFrames | None:
    """Return the other unit of the same sensor and size whose usual image differs most, None
    without one.
    """
    negatives = [
        other
        for other in units
        if other is not unit
        and other.sensor == unit.sensor
        and other.frames[0].shape == unit.frames[0].shape
    ]
    return max(
        negatives,
        key=lambda other: float(cv2.absdiff(other.usual, unit.usual).mean()),
        default=None,
    )
