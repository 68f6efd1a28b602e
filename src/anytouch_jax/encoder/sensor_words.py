"""Words for a sensor: a name, or a folder NAME.sensor of `anytouch sensor fit`.

Every command and function that takes a sensor resolves its word here, so that a fitted sensor is
taken wherever a name is.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from anytouch_jax.config import OWN_SENSOR
from anytouch_jax.doors import SENSORS, enter
from anytouch_jax.errors import UserError
from anytouch_jax.text import edit_distance

_LETTERS = 2  # of .sensor, that are a slip


class SensorWord(NamedTuple):
    """The name that a word stands for, and what a fitted sensor knows of itself.

    Attributes:
        name: that of the table of tokens.
        width_mm: what the width of an image shows.
        shape: height of an image over its width.
        modulus_kpa: of the gel.
        family: the sensor of the table that it is one of.
        force_factor: on measured forces, from presses of known force.
        force_spread: standard deviation of its logarithm, 0 without any.
        force_encoder: fingerprint of the encoder that the factor holds for.
        folder: of a fitted sensor.
    """

    name: str
    width_mm: float | None = None
    shape: float | None = None
    modulus_kpa: float | None = None
    family: str = ""
    force_factor: float = 1.0
    force_spread: float = 0.0
    force_encoder: str = ""
    folder: Path | None = None

    @property
    def is_fitted(self) -> bool:
        """Whether the word is a folder of `anytouch sensor fit`."""
        return self.width_mm is not None


def resolve_sensor(word: str | Path) -> SensorWord:
    """Return what a word stands for.

    Raises UserError for a folder NAME.sensor that is missing or damaged, or misspelt.
    """
    path = Path(word)
    if path.suffix != OWN_SENSOR:
        # As a name it would be one that nobody knows, measured without a width or a force.
        if path.suffix and edit_distance(path.suffix, OWN_SENSOR) <= _LETTERS:
            raise UserError(
                f"sensor {str(word)!r} is not known: did you mean {path.with_suffix(OWN_SENSOR)}?"
            )
        return SensorWord(str(word))
    numbers = enter(SENSORS["fitted"])(path.expanduser())
    return SensorWord(
        numbers.name,
        width_mm=numbers.width_mm,
        shape=numbers.height_mm / numbers.width_mm,
        modulus_kpa=numbers.modulus_kpa,
        family=numbers.family,
        force_factor=numbers.force_factor,
        force_spread=numbers.force_spread,
        force_encoder=numbers.force_encoder,
        folder=path.expanduser(),
    )
