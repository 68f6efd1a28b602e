"""Touches of the demo: a simulated sensor that no encoder has met, and objects that are held out.

The sensor has one ring of amber light. Its gel glows where it is steep, on whatever side, so it
looks like none of the sensors that `anytouch-tiny` was trained on, and like no mixture of them.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import jax
import numpy as np

from anytouch_jax.config import SimulatedConfig
from anytouch_jax.sim import endless
from anytouch_jax.sim.endless import Sampling
from anytouch_jax.sim.scene import training_scenes
from anytouch_jax.sim.sensing.own import OwnSensor, write_sensor
from anytouch_jax.sim.sensing.sensors import SENSORS, bases, look
from anytouch_jax.sim.world.objects import PRIMITIVE_KINDS

BODY = "gelsight"  # the sensor of the table whose gel and camera the new one has
COUNT = 32  # touches that are simulated at once
SIZE = 112  # pixels of a side, of the whole gel: its images are stretched to squares
OBJECTS = 160  # of a split, at most
LEAST = 0.3  # mm; a shallower touch shows little of a shape
AMBER = (1.0, 0.62, 0.18)
GLOW = 1.7  # of a surface as steep as can be, over the brightest white
NAMES = tuple(kind.noun for kind in PRIMITIVE_KINDS.values())
_KEYS = {"train": 11, "test": 12}


class Touches(NamedTuple):
    """Touches of one split, one a row."""

    frame: np.ndarray  # u8 (n, S, S, 3)
    background: np.ndarray  # u8 (n, S, S, 3)
    shape: np.ndarray  # (n,) numbers of NAMES
    object: np.ndarray  # (n,)
    depth: np.ndarray  # (n,) mm of the deepest place
    force: np.ndarray  # (n,) N into the gel


def unstretched(image: np.ndarray) -> np.ndarray:
    """Return an image of the simulated sensor in the proportions of its gel."""
    height, width = SENSORS[BODY].field
    size = (SIZE, round(SIZE * height / width))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def write_ring_light(folder: Path) -> Path:
    """Write the sensor as a folder NAME.sensor, and return it."""
    body = SENSORS[BODY]
    photometry = look(body)
    normal = np.zeros_like(np.asarray(photometry.normal))
    # The powers of the normal are 1, 1, then 2, 2, 2: those of x^2 and y^2 make a glow.
    normal[[2, 4], 0] = GLOW * np.asarray(AMBER)
    lights = photometry._replace(normal=normal, halo=np.zeros_like(np.asarray(photometry.halo)))
    background = bases(body)[:1].mean(-1, keepdims=True) * np.asarray(AMBER) * 0.6
    numbers = OwnSensor(
        name="ring_light",
        width_mm=body.field[1],
        height_mm=body.field[0],
        pixels=body.resolution,
        noise=body.noise,
        skin_mm=body.skin,
        halo_mm=body.halo,
        spread=0.05,
    )
    return write_sensor(folder, numbers, np.rint(255 * background).clip(1, 255), lights)


def simulate(sensor: Path, split: Any, count: int, log: Callable[[str], None]) -> Touches:
    """Return about `count` touches of the objects of a split, "train" or "test".

    Objects of test are pairs of a shape and a surface that occur in no other split, neither here
    nor in the training of the encoder in the package.
    """
    things = endless.objects_of(training_scenes(SimulatedConfig()), split, variants=2)[:OBJECTS]
    shapes = list(PRIMITIVE_KINDS)
    world = jax.device_put(endless.make_world(things, (str(sensor),)))
    sampling = Sampling(takes=1, size=SIZE, depth=(0.4, 1.0))
    parts = []
    for number in range(-(-count // COUNT)):
        key = jax.random.fold_in(jax.random.key(_KEYS[split]), number)
        parts.append(jax.device_get(_sample(key, world, sampling=sampling, count=COUNT)))
        log(f"{split}: {COUNT * len(parts)} touches")
    thing = np.concatenate([part.object for part in parts])
    found = Touches(
        np.concatenate([part.clip[:, 0, -1] for part in parts]),
        np.concatenate([part.background[:, 0] for part in parts]),
        np.array([shapes.index(things[one].shape.primitive) for one in thing]),
        thing,
        np.concatenate([part.labels["depth"][:, 0, -1] for part in parts]),
        np.concatenate([part.labels["force"][:, 0, -1] for part in parts]),
    )
    return Touches(*(values[found.depth > LEAST] for values in found))


_sample = jax.jit(endless.sample_touches, static_argnames=("sampling", "count"))
