"""Tactile sensors: one record of each, which every table of sensors in the library is read from.

A record holds what is known of a product before anything is fitted: the size of its gel, its
camera, the stiffness of the gel, its printed dots, and from which score on a frame shows contact.
How a sensor *looks* in the simulator is in `sim.sensing.sensors`.

A new sensor is one more entry of `RECORDS`, below those of its group: the order of the entries is
the order of the rows of sensor tokens, and stored weights count on it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

RGB = tuple[float, float, float]


@dataclass(frozen=True)
class Markers:
    """A lattice of ink spots (dots) in the skin of a gel."""

    pitch: float  # mm
    radius: float  # mm
    aspect: float = 1.0  # width over height of a spot
    fraction: float = 1.0  # of the units with markers
    ink: RGB = (0.08, 0.08, 0.08)
    # lens distortion: the lattice shrinks outwards from pitch / (1 - bend) in the middle
    bend: float = 0.0


@dataclass(frozen=True)
class SensorRecord:
    """What is known of one sensor. Sizes and moduli are round numbers near published ones.

    None stands for what nobody measured. `size_mm`, `pixels`, `modulus_kpa` and `thickness_mm` are
    known of all sensors that are simulated.
    """

    name: str
    # "image" for a camera behind a gel; "field" for a sensor that reports forces and no image
    measures: Literal["image", "field"] = "image"
    # whether the sensor has a row of tokens, and so is an input of the encoder
    has_tokens: bool = True
    # A simulated gel is flat, so a sensor with another form cannot be fitted.
    is_flat: bool = True
    size_mm: tuple[float, float] | None = None  # (height, width) of the gel that an image shows
    pixels: tuple[int, int] | None = None  # (height, width), or the points of a field sensor
    # Height over width of an image as data sets store it. It is not computed from the two sizes,
    # because these are rounded: 14.0 x 18.7 mm of a DuraGel, 320 x 427 pixels of a GelSlim.
    proportions: float | None = None
    modulus_kpa: float | None = None  # Young's modulus of the gel
    thickness_mm: float | None = None  # of the gel
    dots: Markers | None = None
    # Score above which a frame is contact (`data.background.contact`), measured on real frames.
    # That of 9DTact is below its one light press.
    contact_threshold: float | None = None


_WITH_TOKENS = (
    SensorRecord(
        "gelsight",
        size_mm=(14.16, 18.88),
        pixels=(480, 640),
        proportions=0.75,
        modulus_kpa=150.0,
        thickness_mm=4.0,
        dots=Markers(pitch=1.6, radius=0.22, fraction=0.4),
        contact_threshold=6.5,
    ),
    SensorRecord(
        "digit",
        size_mm=(19.0, 14.25),
        pixels=(320, 240),
        proportions=4 / 3,
        modulus_kpa=120.0,
        thickness_mm=2.5,
    ),
    SensorRecord(
        "gelslim",
        size_mm=(15.0, 20.0),
        pixels=(320, 427),
        proportions=0.75,
        modulus_kpa=220.0,
        thickness_mm=2.0,
        dots=Markers(
            pitch=1.25, radius=0.13, aspect=2.6, fraction=0.5, ink=(0.12, 0.14, 0.2), bend=0.12
        ),
        contact_threshold=6.5,
    ),
    SensorRecord(
        "gelsight_mini",
        size_mm=(14.16, 18.88),
        pixels=(480, 640),
        proportions=0.75,
        modulus_kpa=180.0,
        thickness_mm=4.25,
        dots=Markers(pitch=1.85, radius=0.36, fraction=0.5, ink=(0.10, 0.15, 0.14)),
        contact_threshold=6.5,
    ),
    SensorRecord(
        "duragel",
        size_mm=(14.0, 18.7),
        pixels=(480, 640),
        proportions=0.75,
        modulus_kpa=350.0,
        thickness_mm=3.0,
        dots=Markers(pitch=2.2, radius=0.3, fraction=0.3),
    ),
    SensorRecord(
        "9dtact",
        size_mm=(18.0, 24.0),
        pixels=(480, 640),
        proportions=0.75,
        modulus_kpa=120.0,
        thickness_mm=3.0,
        contact_threshold=4.0,
    ),
    SensorRecord("allsight", is_flat=False),
    SensorRecord("tacto"),
    SensorRecord("taxim"),
)
_FIELDS = (
    SensorRecord(
        "tac3d",
        measures="field",
        has_tokens=False,
        size_mm=(17.0, 17.0),
        pixels=(20, 20),
        modulus_kpa=200.0,
        thickness_mm=3.0,
    ),
)
# Sensors that are known by name alone. `dtact` and `tactip` are here because their names are so
# near to those of other sensors that they would pass for misspelt ones.
_NAMES = (
    SensorRecord("dtact", has_tokens=False),
    SensorRecord("tactip", has_tokens=False, is_flat=False),
    SensorRecord("taclink", has_tokens=False, is_flat=False),
    SensorRecord("digit360", has_tokens=False, is_flat=False),
    SensorRecord("digit_360", has_tokens=False, is_flat=False),
    SensorRecord("omnitact", has_tokens=False, is_flat=False),
    SensorRecord("insight", has_tokens=False, is_flat=False),
)

RECORDS: dict[str, SensorRecord] = {
    record.name: record for record in (*_WITH_TOKENS, *_FIELDS, *_NAMES)
}
