"""Features of a frame to compare: encoders, raw pixels, and a classical baseline."""

from __future__ import annotations

import cv2
import numpy as np

from anytouch_jax.data.transforms import subtract_background
from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.encoder.encoder import Encoder
from anytouch_jax.evaluate.feature_cache import principal_components
from anytouch_jax.train.progress import silent
from experiments.real.recordings import Recordings


def encoder_features(encoder: Encoder, data: Recordings, sensor: str | None = None) -> np.ndarray:
    """Return the class token and the mean of the patch tokens (n, 2E), each with unit variance over
    train frames.

    With `sensor` all frames get the tokens of that sensor.
    """
    rows = np.arange(len(data.manifest))
    row = None if sensor is None else encoder.sensor_row(sensor)
    x = embed_rows(
        encoder,
        data.manifest,
        rows,
        pooling="both",
        sensor_row=row,
        backgrounds=data.backgrounds,
        log=silent,
    )[1]
    fit = x[data.split == "train"]
    return np.asarray((x - fit.mean(0)) / (fit.std(0) + 1e-6), np.float32)


def pixel_values(data: Recordings) -> np.ndarray:
    """Return 200 principal components of 32 x 24 pixels and of their difference from the untouched
    gel.
    """

    def small(image: np.ndarray) -> np.ndarray:
        return cv2.resize(image, (32, 24), interpolation=cv2.INTER_AREA).astype(np.float32) / 255

    pairs = ((small(frame), small(gel)) for frame, gel in data.pairs())
    return components(
        [np.concatenate([frame, frame - gel], -1).ravel() for frame, gel in pairs], data
    )


def components(values: list[np.ndarray], data: Recordings, count: int = 200) -> np.ndarray:
    """Return the first principal components (n, count) of values (n, d), fitted on train."""
    return principal_components(
        np.array(values, np.float32), data.split == "train", count, "randomized"
    )


def classical_values(data: Recordings) -> np.ndarray:
    """Return histograms of oriented gradients and of local binary patterns of the difference
    image.
    """
    hog = cv2.HOGDescriptor((96, 96), (32, 32), (32, 32), (16, 16), 9)
    values = []
    for frame, gel in data.pairs():
        small = cv2.resize(
            subtract_background([frame], gel)[0], (96, 96), interpolation=cv2.INTER_AREA
        )
        grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
        values.append(np.concatenate([hog.compute(grey).ravel(), _binary_patterns(grey)]))
    return components(values, data)


def _binary_patterns(grey: np.ndarray, cells: int = 4) -> np.ndarray:
    """Return 256-bin histograms of 8-neighbour codes in a grid of cells, pooled to 59 uniform
    patterns.
    """
    centre = grey[1:-1, 1:-1]
    code = np.zeros(centre.shape, np.uint8)
    steps = [(-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1)]
    for bit, (down, right) in enumerate(steps):
        neighbour = grey[1 + down : grey.shape[0] - 1 + down, 1 + right : grey.shape[1] - 1 + right]
        code |= (neighbour >= centre).astype(np.uint8) << bit
    parts = [
        np.array_split(row, cells, axis=1) for row in np.array_split(_UNIFORM[code], cells, axis=0)
    ]
    return np.concatenate(
        [np.bincount(part.ravel(), minlength=59) / part.size for row in parts for part in row]
    )


# The number of each code among the 58 codes with at most two changes, 58 for all others.
_BITS = (np.arange(256)[:, None] >> np.arange(8)) & 1
_FEW = np.abs(np.diff(_BITS, axis=1, append=_BITS[:, :1])).sum(1) <= 2
_UNIFORM = np.where(_FEW, np.cumsum(_FEW) - 1, 58)
