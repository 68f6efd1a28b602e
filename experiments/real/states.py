"""Is `anytouch sensor check` right? A grid of simulated devices and gels, and its confusion matrix.

    python -m experiments.real.states fit
    python -m experiments.real.states test

Five devices carry six gels each. Devices differ in lights, camera and place, gels in coating, dots,
specks and grain. Differences are scaled to those that were measured in public: 15 grey levels (root
mean square) for another gel on one device, 26 for another device, with noise of 1.3. Light drifts
by as much as a change of gel. A worn gel has scratches, abraded spots or lost dots. `fit` draws
other devices than `test`, and writes the classifier of `data.background.condition`. `test` writes
the counts to `experiments/results/states.jsonl`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt
from sklearn.linear_model import LogisticRegression
from tyro.conf import Positional

from anytouch_jax.data.background import condition
from anytouch_jax.sim.fitting.balls import depth_of
from anytouch_jax.sim.sensing import optics
from anytouch_jax.sim.sensing.sensors import SENSORS, Sensor, Unit, draw_unit
from anytouch_jax.train.mesh import enable_compilation_cache
from experiments.command import run_script
from experiments.records import write_record

Array = npt.NDArray[Any]
FAMILIES = ("gelsight", "gelsight_mini", "digit", "9dtact", "gelslim", "duragel")
GEL = 15.0  # grey levels
DEVICE = 26.0
NOISE = 1.3
_SHORT = 160  # pixels of the short side of an image
_PITCH = 0.2  # mm of a dent
_NOISES = (0.3, 2.5)  # from a median of frames to a poor camera
_FITTED = 60  # devices that the classifier is fitted to
_TESTED = 5
_GELS = 6
_TURNS = 4  # pairs of each state, gel and device


@dataclass(frozen=True)
class StateOptions:
    """Fit or test the classifier of a sensor's condition."""

    what: Positional[Literal["fit", "test"]]
    seed: int = 1  # Of the devices that are tested; `fit` draws others.
    out: Path = Path("experiments/results/states.jsonl")  # JSON lines.


class Device:
    """A simulated device, which shows gels and presses."""

    def __init__(self, family: str, rng: np.random.Generator) -> None:
        self.sensor = SENSORS[family]
        self.unit = draw_unit(self.sensor, rng)
        self.size = optics.image_size(self.sensor, _SHORT)
        self.side = [pixels * _PITCH for pixels in (96, 96)]

    def gel(self, rng: np.random.Generator) -> Unit:
        """Return the device with another gel: its coating, dots, specks and grain."""
        other = draw_unit(self.sensor, rng)
        height, width = np.asarray(self.unit.base).shape[:2]
        # from a wide change of colour to blotches
        cells = int(rng.integers(2, 7))
        coarse = rng.normal(0, 1, (cells, cells + 1, 3)).astype(np.float32)
        coating = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        blotches = np.asarray(other.base).mean(2) / np.maximum(
            cv2.GaussianBlur(np.asarray(other.base).mean(2), (0, 0), 3), 0.02
        )
        base = np.asarray(self.unit.base) * (1 + 0.05 * coating) * blotches[..., None]
        return self.unit._replace(
            base=np.clip(base, 0, 1).astype(np.float32),
            specks=other.specks,
            grain=other.grain,
            marked=other.marked if rng.uniform() < 0.3 else self.unit.marked,
            marker_phase=other.marker_phase,
            marker_size=other.marker_size,
        )

    def show(self, unit: Unit, dent: Array | None = None) -> Array:
        """Return the image f32 (h, w, 3) of a gel under a dent mm (96, 96), without noise."""
        skin = np.zeros((96, 96), np.float32) if dent is None else dent
        return np.asarray(_render(self.sensor, self.size)(skin, unit), np.float32)


_PROGRAMS: dict[Any, Any] = {}


def _render(sensor: Sensor, size: tuple[int, int]) -> Any:
    if (sensor.name, size) not in _PROGRAMS:
        _PROGRAMS[sensor.name, size] = jax.jit(
            lambda dent, unit: optics.render(
                dent, jnp.zeros((96, 96, 2)), _PITCH, sensor, unit, resolution=size
            )
        )
    return _PROGRAMS[sensor.name, size]


def smooth(image: Array) -> Array:
    """Return the broad part of an image."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 8))


def at_distance(before: Array, after: Array, wanted: float) -> Array:
    """Return `after` with its broad part scaled so that it differs by `wanted` grey levels."""
    broad = smooth(after - before)
    fine = after - before - broad
    # Dots of one gel alone may differ by more.
    fine *= min(1.0, 0.7 * wanted / max(float(np.sqrt((fine**2).mean())), 1e-3))
    rest = np.sqrt(max(wanted**2 - float((fine**2).mean()), 1.0))
    scale = rest / max(float(np.sqrt((broad**2).mean())), 1e-3)
    return np.asarray(before + fine + broad * scale)


def lit(image: Array, wanted: float, rng: np.random.Generator) -> Array:
    """Return an image in light that changes it by `wanted` levels: a plane for each colour."""
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width] / np.array([height, width])[:, None, None] - 0.5
    planes = rng.normal(0, 1, 3) + rng.normal(0, 1, (3,)) * rng.uniform(0, 1.5)
    change = np.stack(
        [planes[c] + rng.normal(0, 1) * x + rng.normal(0, 1) * y for c in range(3)], -1
    )
    change = image * change
    return np.asarray(image + change * wanted / max(float(np.sqrt((change**2).mean())), 1e-3))


def worn(device: Device, unit: Unit, image: Array, rng: np.random.Generator) -> Array:
    """Return an image with scratches, abraded spots, or lost dots."""
    height, width = image.shape[:2]
    mask = np.zeros((height, width), np.float32)
    strength = rng.uniform(8, 45) * rng.choice([-1, 1])
    kind = rng.integers(3)
    if kind == 2 and float(unit.marked) > 0:
        bare = device.show(unit._replace(marked=np.float32(0)))
        for _ in range(rng.integers(2, 6)):
            at = (int(rng.uniform(0.1, 0.9) * width), int(rng.uniform(0.1, 0.9) * height))
            cv2.circle(mask, at, int(rng.uniform(0.05, 0.12) * height), 1.0, -1)
        mask = cv2.GaussianBlur(mask, (0, 0), 1)
        return np.asarray(image + mask[..., None] * (bare - image))
    if kind == 0:
        for _ in range(rng.integers(1, 4)):
            points = np.cumsum(rng.normal(0, 0.06, (8, 2)) + rng.normal(0, 0.05, 2), 0)
            points = (points + rng.uniform(0.2, 0.8, 2)) * [width, height]
            cv2.polylines(mask, [points.astype(np.int32)], False, 1.0, int(rng.integers(1, 3)))
        mask = cv2.GaussianBlur(mask, (0, 0), rng.uniform(0.5, 1.0))
    else:
        for _ in range(rng.integers(2, 9)):
            at = (int(rng.uniform(0, 1) * width), int(rng.uniform(0, 1) * height))
            cv2.circle(mask, at, int(rng.uniform(1.5, 5)), float(rng.uniform(0.5, 1)), -1)
        mask = cv2.GaussianBlur(mask, (0, 0), rng.uniform(0.6, 1.2))
    colour = strength * (1 + rng.normal(0, 0.12, 3))
    return np.asarray(image + mask[..., None] * colour)


def pressed(device: Device, unit: Unit, rng: np.random.Generator) -> Array:
    """Return an image of a gel that an object presses."""
    y, x = (np.mgrid[:96, :96] - 47.5) * _PITCH
    reach = np.array(device.sensor.field[::-1]) * 0.3
    dent = np.zeros((96, 96), np.float32)
    for _ in range(rng.integers(1, 3)):
        at = rng.uniform(-reach, reach) + np.asarray(unit.window)
        turn = rng.uniform(0, np.pi)
        along = (x - at[0]) * np.cos(turn) + (y - at[1]) * np.sin(turn)
        across = (y - at[1]) * np.cos(turn) - (x - at[0]) * np.sin(turn)
        away = np.hypot(along / rng.uniform(1, 3), across)
        radius = rng.uniform(2, 6)
        dent = np.maximum(dent, depth_of(away, rng.uniform(0.12, 0.6) * radius, radius))
    return device.show(unit, dent.astype(np.float32))


def filmed(image: Array, noise: float, rng: np.random.Generator) -> Array:
    """Return an image as a camera takes it: light of every day, noise and whole levels."""
    image = lit(image, abs(rng.normal(0, 1.5)), rng)
    if rng.uniform() < 0.5:  # the camera moves in its mount by a part of a pixel
        shift = np.float32([[1, 0, rng.normal(0, 0.15)], [0, 1, rng.normal(0, 0.15)]])
        image = cv2.warpAffine(image, shift, image.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)
    return np.clip(np.rint(image + rng.normal(0, noise, image.shape)), 0, 255).astype(np.uint8)


def pairs(
    devices: int, turns: int, seed: int, noises: tuple[float, float] = (NOISE, NOISE)
) -> Iterator[tuple[str, Array, Array]]:
    """Yield a state, and the stored background and that of today.

    Args:
        devices: how many there are.
        turns: pairs of each state, gel and device.
        seed: of everything.
        noises: least and largest deviation of a pixel, of which each pair has one.
    """
    rng = np.random.default_rng([73, seed])
    all_devices = [Device(FAMILIES[(n + seed) % len(FAMILIES)], rng) for n in range(devices)]
    for device in all_devices:
        gels = [device.gel(rng) for _ in range(_GELS)]
        shown = [device.show(gel) for gel in gels]
        for number, (gel, before) in enumerate(zip(gels, shown, strict=True)):
            for _ in range(turns):
                other = Device(device.sensor.name, rng)
                new = other.show(other.gel(rng))
                another = shown[(number + rng.integers(1, _GELS)) % _GELS]
                today = {
                    "same": before,
                    "gel": at_distance(before, another, GEL * np.exp(rng.normal(0, 0.15))),
                    "device": at_distance(before, new, DEVICE * np.exp(rng.normal(0, 0.1))),
                    "worn": worn(device, gel, before, rng),
                    "light": lit(before, GEL * np.exp(rng.normal(0, 0.2)), rng),
                    "pressed": pressed(device, gel, rng),
                }
                for state, after in today.items():
                    noise = float(np.exp(rng.uniform(*np.log(noises))))
                    yield state, filmed(before, noise, rng), filmed(after, noise, rng)


def fit(seed: int) -> None:
    """Write the classifier."""
    rows = []
    states = []
    for state, before, after in pairs(_FITTED, 1, 1000 + seed, _NOISES):
        rows.append(condition.features_of(before, after))
        states.append(condition.STATES.index(state))
    values = np.array(rows)
    mean, scale = values.mean(0), values.std(0)
    ready = condition.expanded((values - mean) / scale)
    model = LogisticRegression(C=3.0, max_iter=4000).fit(ready, states)
    np.savez(
        Path(condition.__file__).with_name(condition.FILE),
        mean=mean,
        scale=scale,
        weights=model.coef_,
        intercept=model.intercept_,
    )
    print(f"{len(rows)} pairs, {model.score(ready, states):.1%} of them right")


def test(seed: int, out: Path) -> None:
    """Count the states of a grid, and print the confusion matrix."""
    count = np.zeros((len(condition.STATES),) * 2, int)
    for state, before, after in pairs(_TESTED, _TURNS, seed):
        found = condition.check_condition(before, after).state
        count[condition.STATES.index(state), condition.STATES.index(found)] += 1
    print(f"{'true':>9}  called " + " ".join(f"{name:>8}" for name in condition.STATES))
    for state, row in zip(condition.STATES, count, strict=True):
        print(f"{state:>9}         " + " ".join(f"{100 * n / row.sum():8.1f}" for n in row))
    right = np.diag(count) / count.sum(1)
    record = {
        "counts": count.tolist(),
        "states": list(condition.STATES),
        "right": dict(zip(condition.STATES, right.round(4).tolist(), strict=True)),
        "false_alarms": float(1 - right[0]),
    }
    write_record(out, f"states {seed}", record)


def run(options: StateOptions) -> int:
    """Fit or test."""
    enable_compilation_cache()
    if options.what == "fit":
        fit(options.seed)
    else:
        test(options.seed, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(run_script(StateOptions, run))
