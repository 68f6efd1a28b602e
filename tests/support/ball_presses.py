"""Presses of a ball on a device with lights of its own, drawn without the simulator."""

from typing import NamedTuple

import numpy as np

WIDTH = 16.0  # mm
SHAPE = (120, 160)
DIAMETER = 6.0
# x, y and radius of the contact, mm
POSES = np.array(
    [[-3.5, -2.5, 1.3], [3.0, -2.0, 1.6], [0.0, 0.3, 1.9], [-3.0, 2.2, 1.5], [3.6, 2.4, 1.2]]
)


class Presses(NamedTuple):
    """Images u8 (N, h, w, 3), the background, and the depth (N, h, w) mm in the images."""

    frames: np.ndarray
    background: np.ndarray
    depth: np.ndarray


def presses(poses=POSES, *, strength=0.21, seed=0) -> Presses:
    """Press a ball: colours are linear in the normal, and brighter where the gel is deep."""
    rng = np.random.default_rng(seed)
    height, width = SHAPE
    y, x = (np.mgrid[:height, :width] + 0.5 - np.array(SHAPE)[:, None, None] / 2) * WIDTH / width
    lights = np.array([[1.2, -0.3, -0.9], [-0.2, 1.1, -0.8]]) * strength * 255
    texture = rng.normal(0, 2, (height, width, 1))
    background = 110 + 12 * np.stack([x / 8, y / 6, -x / 8], -1) + texture
    radius = DIAMETER / 2
    frames = []
    depths = []
    for px, py, contact in poses:
        away = np.hypot(x - px, y - py) + 1e-9
        inside = np.minimum(away, contact)
        steepest = contact / np.sqrt(radius**2 - contact**2)
        above = np.sqrt(radius**2 - inside**2) - np.sqrt(radius**2 - contact**2)
        beyond = np.exp(-np.maximum(away - contact, 0) / (0.35 * contact))
        slope = np.where(away < contact, inside / np.sqrt(radius**2 - inside**2), steepest * beyond)
        sine = slope / np.sqrt(1 + slope**2) / away
        change = np.stack([sine * (x - px), sine * (y - py)], -1) @ lights
        depths.append(above + 0.35 * contact * steepest * beyond)
        frames.append(background + change + rng.normal(0, 1.0, background.shape))

    def image(values):
        return np.clip(np.rint(values), 0, 255).astype(np.uint8)

    return Presses(image(np.stack(frames)), image(background), np.stack(depths))
