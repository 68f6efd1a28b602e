"""Example touches: simulated presses in the package, to try an encoder without data."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from anytouch_jax.data.images import decode

FOLDER = Path(__file__).parent / "examples"  # PRESS-SENSOR.jpg, and PRESS-SENSOR-background.jpg of the untouched gel


class ExampleTouch(NamedTuple):
    """A touch by one sensor: `frame` and `background` are RGB u8 (h, w, 3), `press` names the touched place."""

    press: str
    sensor: str
    frame: np.ndarray
    background: np.ndarray


def example_touches() -> list[ExampleTouch]:
    """Return simulated touches: each of a few presses by several sensors. They are in the public domain (CC0)."""
    files = sorted(file for file in FOLDER.glob("*.jpg") if not file.stem.endswith("-background"))
    touches = []
    for file in files:
        press, sensor = file.stem.split("-")
        touches.append(ExampleTouch(press, sensor, decode(file), decode(file.with_stem(f"{file.stem}-background"))))
    return touches
