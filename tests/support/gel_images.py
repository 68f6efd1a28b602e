"""Images of a gel, untouched or pressed."""

import numpy as np


def press(depth: float, size: int = 48) -> np.ndarray:
    """A grey gel u8 (size, size, 3) with a bright bump in its middle as high as `depth` (0:
    untouched).
    """
    y, x = np.mgrid[:size, :size] - size / 2
    bump = depth * np.exp(-(x**2 + y**2) / (2 * (size / 6) ** 2))
    return np.repeat(np.clip(90 + bump, 0, 255)[..., None], 3, axis=2).astype(np.uint8)
