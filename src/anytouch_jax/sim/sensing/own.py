"""Your own sensor: a folder `NAME.sensor` with readable numbers and the arrays of its photometry.

The numbers are in sensor.json, the arrays in look.npz. Wherever the simulator takes the name of a
sensor, it takes such a folder too.
"""

from __future__ import annotations

import hashlib
import io
import json
import zlib
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.config import OWN_SENSOR
from anytouch_jax.config.parsing import (
    Above0,
    Finite,
    NotNegative,
    Range,
    check,
    parse_json,
    read_value,
)
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_write, read_arrays
from anytouch_jax.sensors import Markers
from anytouch_jax.sim.contact.mechanics import Gel
from anytouch_jax.sim.sensing.sensors import MOST_BASES, POISSON, SENSORS, Photometry, Sensor

NUMBERS = "sensor.json"
ARRAYS = "look.npz"
MM = Range(4, 40, "4 to 40 mm")
SHAPES = {  # of the arrays; 0 is any number
    "bases": (0, 0, 0, 3),
    "normal": (20, 6, 3),
    "halo": (3, 3, 3),
    "steepest": (),
    "widest": (3,),
}


@dataclass(frozen=True)
class OwnSensor:
    """What sensor.json holds. Lengths are in mm, pixels are (height, width).

    `sure` says how each part was found and how sure it is. The simulator does not read it.
    """

    name: str
    width_mm: Annotated[float, MM]
    height_mm: Annotated[float, MM]
    pixels: Annotated[tuple[int, int], Range(16, 4096, "16 to 4096")]
    noise: NotNegative[float]  # standard deviation of a pixel, 0 to 255
    dots: Markers | None = None
    thickness_mm: Annotated[float, Range(1, 20, "1 to 20 mm")] = 3.0
    modulus_kpa: Annotated[float, Range(5, 5000, "5 to 5000 kPa")] = 150.0
    skin_mm: NotNegative[float] = 0.1  # smallest detail that the coating passes
    halo_mm: Above0[float] = 1.0  # width of the soft shadow
    contrast: Finite[float] = 1.0  # of dents, over that of the images
    # variation of simulated devices: 1 is that of a product
    spread: Annotated[float, Range(0, 1, "0 to 1")] = 0.3
    # The sensor of the table that it is one of. It has the tokens of this one, unless it has some
    # of its own.
    family: str = ""
    # Factor on measured forces, from presses of known force, the standard deviation of its
    # logarithm, and the fingerprint of the encoder that it holds for.
    force_factor: Above0[float] = 1.0
    force_spread: NotNegative[float] = 0.0
    force_encoder: str = ""
    sure: dict = field(default_factory=dict)
    written: str = ""  # hash of the rest as `sensor fit` wrote it: another one is an edit

    def __post_init__(self) -> None:
        check(self)


def find_sensor(word: str) -> Sensor:
    """Return the sensor of a name in `SENSORS`, or of a folder NAME.sensor.

    Raises UserError for another word.
    """
    if word in SENSORS:
        return SENSORS[word]
    if Path(word).suffix == OWN_SENSOR:
        return read_sensor(word)
    raise UserError(
        f"there is no simulated sensor {word!r}; choose among {', '.join(SENSORS)}, or name a "
        f"folder{OWN_SENSOR} of `anytouch sensor fit`"
    )


def sensor_number(sensor: Sensor) -> int:
    """Return the number that separates the random streams of sensors."""
    if sensor.name in SENSORS:
        return list(SENSORS).index(sensor.name)
    return zlib.crc32(sensor.name.encode())


def read_numbers(folder: str | Path) -> OwnSensor:
    """Return sensor.json of a folder. Raises UserError for a missing or damaged file."""
    file = Path(folder) / NUMBERS
    try:
        numbers: OwnSensor = read_value(OwnSensor, parse_json(file.read_bytes()), "sensor")
    except OSError as error:
        raise UserError(
            f"{file}: {error.strerror}. Make the sensor with `anytouch sensor fit`."
        ) from None
    except UserError as error:
        raise UserError(f"{file}: {error}") from None
    if numbers.name in SENSORS:
        raise UserError(f"{file}: {numbers.name} is a sensor of the table; give yours another name")
    return numbers


def read_sensor(folder: str | Path) -> Sensor:
    """Return the sensor of a folder NAME.sensor. Raises UserError for a missing or damaged file."""
    path = Path(folder).expanduser().resolve()
    one = read_numbers(path)
    file = path / ARRAYS
    # The time of the file is part of the question, because the answer is kept.
    fault = _fault(file, file.stat().st_mtime_ns if file.is_file() else 0)
    if fault:
        raise UserError(f"{file}: {fault}. Fit the sensor again.")
    return Sensor(
        one.name,
        (one.height_mm, one.width_mm),
        one.pixels,
        Gel(modulus=one.modulus_kpa, poisson=POISSON, thickness=one.thickness_mm),
        one.dots,
        skin=one.skin_mm,
        contrast=one.contrast,
        halo=one.halo_mm,
        noise=one.noise,
        spread=one.spread,
        arrays=str(file),
        version=file.stat().st_mtime_ns,
    )


@lru_cache(maxsize=16)
def _fault(file: Path, _: int) -> str:
    """Return what is wrong with the arrays of a sensor, "" for nothing."""
    try:
        arrays = read_arrays(file)
    except (OSError, ValueError) as error:
        return str(getattr(error, "strerror", None) or error)
    for name, shape in SHAPES.items():
        array = arrays.get(name, np.zeros(0))
        fits = array.ndim == len(shape) and all(
            wanted in (0, side) for side, wanted in zip(array.shape, shape, strict=True)
        )
        if not fits or not np.isfinite(array).all() or not 0 < array.size < 1 << 20:
            return f"the array {name} is missing, or has another shape than {shape}"
    if len(arrays["bases"]) <= MOST_BASES:
        return ""
    return f"more than {MOST_BASES} untouched gels"


def write_sensor(
    folder: str | Path, numbers: OwnSensor, bases: npt.ArrayLike, look: Photometry
) -> Path:
    """Write a folder NAME.sensor, with untouched gels u8 (n, h, w, 3), and return it.

    Args:
        folder: NAME.sensor.
        numbers: what sensor.json holds.
        bases: untouched gels u8 (n, h, w, 3).
        look: colours by slope and depth.
    """
    path = Path(folder)
    data = io.BytesIO()
    arrays = {name: np.asarray(value, np.float32) for name, value in look._asdict().items()}
    np.savez(data, allow_pickle=False, bases=np.asarray(bases, np.uint8), **arrays)
    atomic_write(path / ARRAYS, data.getvalue())
    write_numbers(path / NUMBERS, replace(numbers, written=_hash(asdict(numbers))))
    return path


def check_unedited(folder: str | Path) -> None:
    """Raise UserError for a sensor that holds more than a fit: edits, or a calibration."""
    file = Path(folder).expanduser() / NUMBERS
    if not file.exists():
        return
    try:
        numbers = parse_json(file.read_bytes())
        as_fitted = numbers["written"] == _hash(numbers)
    except (OSError, UserError, KeyError, TypeError):
        as_fitted = False
    if not as_fitted:
        raise UserError(
            f"{file} was edited or calibrated, and a new fit would lose that. Name another --out, "
            "or remove the folder first."
        )


def _hash(numbers: dict[str, Any]) -> str:
    """Return the hash of the values of sensor.json, however they are laid out in the file."""
    values = {name: value for name, value in numbers.items() if name != "written"}
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]


def write_numbers(file: Path, numbers: OwnSensor) -> None:
    """Write sensor.json."""
    atomic_write(file, json.dumps(asdict(numbers), indent=2) + "\n")
