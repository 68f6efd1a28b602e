"""Options of simulated data sets: one record for the command line and for the simulator.

`cli.data.SimulateOptions` and `sim.scene.Scenes` are this record, the one with an output folder,
the other with its checks. `SimulatedConfig`, which draws touches for training, has some of the same
settings, and says where and why its defaults are others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from anytouch_jax.config.parsing import Below1, Count, NotNegative, Ratio, Seed


@dataclass(frozen=True)
class SceneOptions:
    """What to simulate. The comment of each field is its help text on the command line.

    With grade "fine" all sensors share place, depth and motion, so frames correspond one to one.
    With "coarse" every sensor has its own tilt, twist, offset, speed and motion, as by hand, and
    only the place is shared. Data sets with the same seed, number of objects and held-out share
    have the same objects and splits. They share no touch if their numbers, from `first` on, do not
    overlap.
    """

    touches: Count[int] = 400  # Number of places to touch. Every sensor feels each place once.
    sensors: tuple[str, ...] = ("gelsight_mini", "digit", "duragel")
    """Sensors: gelsight, gelsight_mini, gelslim, digit, 9dtact, duragel, tac3d (a force field), or
    your NAME.sensor.
    """
    seed: Seed = 0  # Random seed.
    grade: Literal["fine", "coarse"] = "fine"
    """fine repeats the motion frame by frame for all sensors; coarse shares only the place."""
    # Solve contact in a few rounds, or to convergence.
    fidelity: Literal["fast", "exact"] = "fast"
    # Frames of a recording. They show a part of one gesture, with pauses and regrasps.
    frames: Count[int] = 10
    objects: Count[int] = 200  # Number of objects.
    depth: NotNegative[tuple[float, float]] = (0.3, 1.0)  # Range of the deepest press, mm.
    vision: Ratio = 0.7  # Fraction of the recordings with an RGB image.
    text: Ratio = 0.7  # Fraction of the recordings with a caption.
    # Fraction of the objects in the test split, by pairs of primitive and texture.
    held_out: Below1 = 0.25
    fields: tuple[str, ...] = ()  # Fields to write as .npy: displacement, pressure, shear.
    # Pixels of an image's shorter side. 0 keeps the sensor's resolution.
    size: NotNegative[int] = 224
    units: Literal["each", "one"] = "each"
    """each simulates a new device for every recording; one uses one device of each sensor, mounted
    straight.
    """
    # Number of the first touch. Others give other touches of the same objects and splits.
    first: NotNegative[int] = 0
