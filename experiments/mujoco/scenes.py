"""Small MuJoCo scenes of the studies: one pad, and objects whose height maps are known."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np

from anytouch_jax.sim.recorder import SPACING
from anytouch_jax.sim.sensing.own import find_sensor

MM = 1e-3
PIXELS = 320  # of a height map, 32 mm


class Shape(NamedTuple):
    """An object that is pressed: its geom, and its heights as a function of x and y in mm."""

    geom: str  # attributes of MJCF
    half: float  # mm from its middle to its lowest point
    heights: Callable[[np.ndarray, np.ndarray], np.ndarray]  # mm, 0 at the lowest point, NaN none


def _ellipsoid(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    inside = 1 - (x / 7) ** 2 - (y / 4) ** 2
    return np.where(inside > 0, 3 * np.sqrt(np.maximum(inside, 0)) - 3, np.nan)


def _capsule(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    beyond = np.maximum(np.abs(x) - 4, 0)
    inside = 9 - y**2 - beyond**2
    return np.where(inside > 0, np.sqrt(np.maximum(inside, 0)) - 3, np.nan)


def _ball(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    inside = 16 - x**2 - y**2
    return np.where(inside > 0, np.sqrt(np.maximum(inside, 0)) - 4, np.nan)


def _box(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.where((np.abs(x) <= 3) & (np.abs(y) <= 2), 0.0, np.nan)


def _cylinder(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.where(x**2 + y**2 <= 9, 0.0, np.nan)


SHAPES = {
    "ball": Shape('type="sphere" size=".004"', 4, _ball),
    "capsule": Shape('type="capsule" size=".003 .004" euler="0 90 0"', 3, _capsule),
    "ellipsoid": Shape('type="ellipsoid" size=".007 .004 .003"', 3, _ellipsoid),
    "cylinder": Shape('type="cylinder" size=".003 .003"', 3, _cylinder),
    "box": Shape('type="box" size=".003 .002 .003"', 3, _box),
}


def height_map(shape: Shape) -> np.ndarray:
    """Return the height map (PIXELS, PIXELS) mm of a shape, NaN where it ends."""
    line = (np.arange(PIXELS) - (PIXELS - 1) / 2) * SPACING
    return shape.heights(*np.meshgrid(line, line)).astype(np.float32)


def pressing_scene(shape: Shape, sensor: str, *, mass: float = 0.1, friction: float = 0.6) -> str:
    """Return MJCF of a pad that looks up, and an object above it on slides and a hinge.

    The object's joints are x, y, z (m) and its turn about z. A weight is a force on z.
    """
    height, width = (side / 2 * MM for side in find_sensor(sensor).field)
    return f"""
<mujoco>
  <compiler angle="degree"/>
  <option gravity="0 0 0" timestep="0.001" cone="elliptic" impratio="100"/>
  <worldbody>
    <body name="finger">
      <geom name="pad" type="box" size="{width} {height} .004" pos="0 0 -.004"
        friction="{friction}"/>
      <site name="pad" type="box" size="{width} {height} .0005"/>
    </body>
    <body name="object" pos="0 0 {shape.half * MM}">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="y" type="slide" axis="0 1 0"/>
      <joint name="z" type="slide" axis="0 0 1" damping="2"/>
      <joint name="turn" type="hinge" axis="0 0 1"/>
      <geom name="object" {shape.geom} mass="{mass}" friction="{friction}"/>
    </body>
  </worldbody>
</mujoco>"""


def loaded(xml: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return the model and the state of a scene."""
    model = mujoco.MjModel.from_xml_string(xml)
    return model, mujoco.MjData(model)
