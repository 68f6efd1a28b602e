"""Do the intervals of force hold? Coverage by what is known of a device.

    python -m experiments.encoders.intervals anytouch-tiny

Simulated devices press things of the desk: balls, studs, a ring, a bar, an edge and a grid. Three
cases are told apart: a gel whose factor is set by three presses of one object, and that presses the
others; a device of a known family; and one that nobody knows, which gets universal tokens and a
usual modulus. Moduli differ by 15 % in a family, and by what products have among unknown ones.
Intervals are from 5 to 95 %, so 90 % is right. Rows go to `experiments/results/intervals.jsonl`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import numpy.typing as npt
from tyro.conf import Positional

from anytouch_jax.config import UNIVERSAL
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.encoder.measured import Fields
from anytouch_jax.fields.calibration import AMONG_OBJECTS
from anytouch_jax.fields.measure import GELS, border_in_contact, interval_of
from anytouch_jax.sim.recorder import simulate_touch
from anytouch_jax.sim.sensing.sensors import SENSORS, draw_unit
from anytouch_jax.train.mesh import enable_compilation_cache
from experiments.command import run_script
from experiments.encoders.measure import STIFFNESS
from experiments.records import write_record

Array = npt.NDArray[Any]
FAMILIES = ("gelsight_mini", "digit", "gelslim", "9dtact")
_SIDE = 120  # cells of 0.1 mm of a height map
_DEPTHS = (0.25, 0.5, 0.8, 1.1)  # mm


@dataclass(frozen=True)
class IntervalOptions:
    """Count how often true forces lie in their intervals."""

    model: Positional[Path]  # Encoder that measures.
    units: int = 4  # Devices of each family.
    seed: int = 0
    out: Path = Path("experiments/results/intervals.jsonl")  # JSON lines.


class Presses(NamedTuple):
    """Presses by one device: what was read of them by its family and as unknown, and the truth."""

    family: Fields
    unknown: Fields
    force: Array
    object: Array


def objects() -> dict[str, Array]:
    """Return height maps mm (120, 120) of things that people press."""
    y, x = (np.mgrid[:_SIDE, :_SIDE] - (_SIDE - 1) / 2) * 0.1
    away = np.hypot(x, y)
    low = -3.0

    def ball(radius: float) -> Array:
        inside = np.sqrt(np.maximum(radius**2 - away**2, 0)) - radius
        return np.where(away < radius, np.maximum(inside, low), low)

    studs = np.where((np.abs(np.mod(x + 1.25, 2.5) - 1.25) < 0.6), 0.0, -0.8)
    studs = np.where(np.abs(np.mod(y + 1.25, 2.5) - 1.25) < 0.6, studs, -0.8)
    return {
        "ball 4 mm": ball(2.0),
        "ball 8 mm": ball(4.0),
        "stud": np.where(away < 2.4, 0.0, low),
        "ring": np.where(np.abs(away - 2.2) < 0.6, 0.0, low),
        "bar": np.where((np.abs(x) < 0.8) & (np.abs(y) < 4), 0.0, low),
        "edge": np.where(x < 0, 0.0, low) * np.where(np.abs(y) < 3, 1, 1)
        + np.where((np.abs(y) < 3) & (x > -4), 0.0, low),
        "grid of studs": np.where(away < 4, studs, low),
    }


def presses(encoder: Any, name: str, units: int, seed: int) -> Iterator[Presses]:
    """Yield the presses of some devices of a family."""
    rng = np.random.default_rng([73, seed, list(FAMILIES).index(name)])
    sensor = SENSORS[name]
    things = objects()

    @jax.jit
    def touch(relief: Any, poses: Any, unit: Any) -> Any:
        # The tables of the gel are for numpy, so its two numbers are constants of the program.
        unit = unit._replace(thickness=np.float32(1), modulus=np.float32(1))
        return simulate_touch(relief, poses, name, unit=unit)

    for _ in range(units):
        unit = draw_unit(sensor, rng)
        stiffness = float(np.exp(rng.normal(0, STIFFNESS)))
        frames = []
        forces = []
        numbers = []
        background = np.zeros(0)
        for number, relief in enumerate(things.values()):
            poses = np.zeros((len(_DEPTHS), 4), np.float32)
            poses[:, :2] = rng.uniform(-0.5, 0.5, (len(_DEPTHS), 2))
            poses[:, 2] = rng.uniform(-np.pi, np.pi, len(_DEPTHS))
            poses[:, 3] = np.array(_DEPTHS) * rng.uniform(0.9, 1.1)
            out = jax.device_get(touch(relief.astype(np.float32), poses, unit))
            frames.append(out.image)
            forces.append(out.force[:, 2] * stiffness)
            numbers.append(np.full(len(_DEPTHS), number))
            background = out.background[0]
        images = np.concatenate(frames)
        width = GELS[name].width * float(unit.zoom)
        force = np.concatenate(forces)
        pressed = force > 0.05
        known, unknown = (
            encoder.measure(images[pressed], background, word, width_mm=width, log=lambda _: None)
            for word in (name, UNIVERSAL)
        )
        yield Presses(known, unknown, force[pressed], np.concatenate(numbers)[pressed])


def inside(low: Array, high: Array, true: Array) -> Array:
    """Return which true forces lie in their intervals."""
    return (low <= true) & (true <= high)


def calibrated(one: Presses) -> Iterator[tuple[Array, Array]]:
    """Yield which forces of all other objects are covered, and how far off they are, for a factor
    that each object in turn sets by three presses.
    """
    assert one.family.force is not None
    read = one.family.force[:, 2]
    for thing in np.unique(one.object):
        own = np.flatnonzero((one.object == thing) & (read > 0.02))[-3:]
        rest = one.object != thing
        if not len(own):
            continue
        factor = float(np.exp(np.median(np.log(one.force[own] / read[own]))))
        assert one.family.force_low is not None and one.family.force_high is not None
        low, high = interval_of(
            factor * read,
            _deviation(one.family),
            "calibrated",
            AMONG_OBJECTS,
            border_in_contact(one.family.contact),
        )
        yield (
            inside(low, high, one.force)[rest],
            np.abs(factor * read / one.force - 1)[rest],
        )


def _deviation(measured: Fields) -> Array:
    """Return the deviation of the logarithm of force that the network gives."""
    assert measured.force is not None and measured.force_std is not None
    return np.asarray(measured.force_std[:, 2] / np.maximum(measured.force[:, 2], 1e-3))


def run(options: IntervalOptions) -> int:
    """Write the coverage of each case."""
    enable_compilation_cache()
    encoder = load_encoder(options.model, engine="xla")
    cases: dict[str, list[tuple[Array, Array]]] = {"calibrated": [], "family": [], "unknown": []}
    kept = []
    for name in FAMILIES:
        for one in presses(encoder, name, options.units, options.seed):
            kept.append((name, one))
            for case, read in (("family", one.family), ("unknown", one.unknown)):
                assert read.force is not None
                assert read.force_low is not None and read.force_high is not None
                covered = inside(read.force_low, read.force_high, one.force)
                cases[case].append((covered, np.abs(read.force[:, 2] / one.force - 1)))
            cases["calibrated"] += list(calibrated(one))
        print(name, flush=True)
    for case, parts in cases.items():
        covered, off = (np.concatenate(values) for values in zip(*parts, strict=True))
        record = {
            "covered": float(covered.mean()),
            "median_off": float(np.median(off)),
            "presses": len(off),
        }
        write_record(options.out, case, record)
        print(case, record)
    return 0


if __name__ == "__main__":
    sys.exit(run_script(IntervalOptions, run))
