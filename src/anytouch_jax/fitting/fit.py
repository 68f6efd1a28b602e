"""`fit_sensor`: from a few pictures of a sensor to a folder NAME.sensor that the simulator takes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from anytouch_jax.config import FIELD_SENSORS, OWN_SENSOR, SENSORS, check_spelling
from anytouch_jax.errors import UserError
from anytouch_jax.fitting import colour, look
from anytouch_jax.fitting.colour import Colour
from anytouch_jax.fitting.look import Seen
from anytouch_jax.sim.sensing import own
from anytouch_jax.sim.sensing.own import MM, OwnSensor
from anytouch_jax.sim.sensing.sensors import Markers

NOT_FLAT = ("allsight", "tactip", "taclink", "digit360", "digit_360", "omnitact", "insight")


class Fitted(NamedTuple):
    """A fitted sensor: its folder, its numbers, what the pictures show, and the colour change."""

    folder: Path
    numbers: OwnSensor
    seen: Seen
    colour: Colour


def check_name(name: str) -> None:
    """Raise UserError for a name that another sensor has, or that belongs to a sensor which cannot be fitted."""
    word = name.lower().replace("-", "_").replace(" ", "_")
    if word in FIELD_SENSORS:
        raise UserError(f"{name} measures a field and has no camera; a sensor with a camera can be fitted")
    if word in NOT_FLAT:
        raise UserError(f"{name} is not flat; a flat gel that fills the picture can be fitted")
    if word in SENSORS:
        raise UserError(f"{name} is a sensor of the table; give yours another name, such as my_{word}")
    if not word.isidentifier() and not word.replace("_", "").isalnum():
        raise UserError(f"the name {name!r} must be letters, digits and _")
    check_spelling(name)


def fit_sensor(
    pictures: Sequence[np.ndarray], name: str, width_mm: float, out: str | Path, *,
    background: np.ndarray | None = None, ball_mm: float | None = None,
) -> Fitted:  # fmt: skip
    """Fit pictures RGB u8 (h, w, 3) of one unit, whose width shows `width_mm`, and write the folder `out`.

    All presses are of a ball of `ball_mm`, if that is given. Raises UserError for pictures that cannot be fitted.
    """
    check_name(name)
    if Path(out).suffix != OWN_SENSOR:
        raise UserError(f"{out} must end in {OWN_SENSOR}; choose another --out")
    height, width = pictures[0].shape[:2]
    height_mm = width_mm * height / width
    if not all(MM.low <= side <= MM.high for side in (width_mm, height_mm)):
        raise UserError(
            f"a picture of {width} x {height} pixels that is {width_mm:g} mm wide shows {width_mm:g} x {height_mm:.3g} "
            f"mm; the sides of a gel are {MM.words}. Check --width-mm."
        )
    if ball_mm is not None and not 1 <= ball_mm <= 40:
        raise UserError(f"a ball of {ball_mm:g} mm cannot be used; take one of 3 to 12 mm")
    seen = look.see(pictures, background)
    if ball_mm is None:
        found = colour.fit_presses(seen.change, seen.clear)
    else:
        found = colour.fit_balls(seen.change, seen.clear, width_mm, ball_mm)
    pixel, dots = width_mm / seen.gel.shape[1], seen.dots
    markers = None
    if dots is not None:
        ink: Any = tuple(round(float(value), 3) for value in dots.ink)
        step, radius = round(dots.pitch * pixel, 4), round(dots.radius * pixel, 4)
        markers = Markers(step, radius, round(dots.aspect, 3), 1.0, ink, round(dots.bend, 4))
    sure = {
        "pictures": f"{len(pictures)}, of which {int(seen.pressed.sum())} show a press",
        "untouched gel": f"{seen.source}; its lights and vignette are in it",
        "dots": "none seen" if dots is None else f"steps from dot to dot {dots.spread:.1%} around the lattice",
        "noise": f"{seen.noise_spread:.0%} from picture to picture",
        "colour": f"explains {found.explained:.0%} of the change, from {found.source}",
        "size": "as given",
        "thickness_mm, halo_mm": "not seen" if ball_mm is None else "the best of a few",
        "modulus_kpa, skin_mm": "not seen in pictures: usual values, edit what you know",
    }
    numbers = OwnSensor(
        name, float(width_mm), round(height_mm, 4), (height, width), round(seen.noise, 3), markers,
        thickness_mm=found.thickness, halo_mm=found.halo, sure=sure,
    )  # fmt: skip
    return Fitted(own.write_sensor(out, numbers, look.without_dots(seen)[None], found.look), numbers, seen, found)
