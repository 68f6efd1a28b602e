"""Features of a frame to compare: encoders, raw pixels, and a classical baseline."""

from __future__ import annotations

import cv2
import numpy as np
from sklearn.decomposition import PCA

from anytouch_jax.data.transforms import subtract_background
from anytouch_jax.encoder.embed import run_in_batches
from anytouch_jax.encoder.encoder import Encoder
from experiments.real.recordings import Recordings


def encoder_features(
    encoder: Encoder, data: Recordings, sensor: str = "gelsight_mini", pooling: str = "both"
) -> np.ndarray:
    """Return the class token and the mean of the patch tokens (n, 2E), each with unit variance over train frames."""
    touches = (
        encoder.preprocess(frame, data.backgrounds[place])
        for frame, place in zip(data.frames, data.background, strict=True)
    )
    x = run_in_batches(lambda batch: encoder.encode_touch(batch, sensor, pooling=pooling), touches, 64)
    fit = x[data.split == "train"]
    return np.asarray((x - fit.mean(0)) / (fit.std(0) + 1e-6), np.float32)


def pixel_values(data: Recordings) -> np.ndarray:
    """Return 200 principal components of 32 x 24 pixels and of their difference from the background."""
    small = np.stack([cv2.resize(frame, (32, 24), interpolation=cv2.INTER_AREA) for frame in data.frames]).astype(
        np.float32
    )
    gel = np.stack([cv2.resize(frame, (32, 24), interpolation=cv2.INTER_AREA) for frame in data.backgrounds]).astype(
        np.float32
    )
    values = np.concatenate([small, small - gel[data.background]], -1).reshape(len(small), -1) / 255
    return components(values, data)


def components(values: np.ndarray, data: Recordings, count: int = 200) -> np.ndarray:
    """Return the first principal components (n, count) of values (n, d), fitted on train."""
    fit = values[data.split == "train"]
    return PCA(min(count, *fit.shape), random_state=0).fit(fit).transform(values).astype(np.float32)


def classical_values(data: Recordings) -> np.ndarray:
    """Return histograms of oriented gradients and of local binary patterns of the difference picture."""
    hog = cv2.HOGDescriptor((96, 96), (32, 32), (32, 32), (16, 16), 9)
    values = []
    for frame, place in zip(data.frames, data.background, strict=True):
        difference = subtract_background([frame], data.backgrounds[place])[0]
        grey = cv2.cvtColor(cv2.resize(difference, (96, 96), interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY)
        values.append(np.concatenate([hog.compute(grey).ravel(), _binary_patterns(grey)]))
    return components(np.array(values, np.float32), data)


def _binary_patterns(grey: np.ndarray, cells: int = 4) -> np.ndarray:
    """Return 256-bin histograms of 8-neighbour codes in a grid of cells, pooled to 59 uniform patterns."""
    centre = grey[1:-1, 1:-1]
    code = np.zeros(centre.shape, np.uint8)
    steps = [(-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1), (1, 0), (1, -1), (0, -1)]
    for bit, (down, right) in enumerate(steps):
        neighbour = grey[1 + down : grey.shape[0] - 1 + down, 1 + right : grey.shape[1] - 1 + right]
        code |= (neighbour >= centre).astype(np.uint8) << bit
    uniform = _UNIFORM[code]
    parts = [np.array_split(row, cells, axis=1) for row in np.array_split(uniform, cells, axis=0)]
    return np.concatenate([np.bincount(part.ravel(), minlength=59) / part.size for row in parts for part in row])


def _uniform_table() -> np.ndarray:
    """Return the number of each code among the 58 codes with at most two changes, 58 for all others."""
    bits = (np.arange(256)[:, None] >> np.arange(8)) & 1
    is_uniform = (bits != np.roll(bits, 1, 1)).sum(1) <= 2
    return np.where(is_uniform, np.cumsum(is_uniform) - 1, 58)


_UNIFORM = _uniform_table()
