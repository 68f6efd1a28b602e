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
    encoder: Encoder, data: Recordings, sensor: str = "gelsight_mini", pooling: str = "both", clips: bool = False
) -> np.ndarray:
    """Return the class token and the mean of the patch tokens (n, 2E), each with unit variance over train frames.

    With `clips` a frame is embedded together with the two before it.
    """
    touches = np.stack([
        encoder.preprocess(frame, data.backgrounds[place])
        for frame, place in zip(data.frames, data.background, strict=True)
    ])  # fmt: skip
    samples = (touches[rows] for rows in data.clip) if clips else iter(touches)
    x = run_in_batches(lambda batch: encoder.encode_touch(batch, sensor, pooling=pooling), samples, 64)
    fit = x[data.split == "train"]
    return np.asarray((x - fit.mean(0)) / (fit.std(0) + 1e-6), np.float32)


def pixel_values(data: Recordings, clips: bool = False) -> np.ndarray:
    """Return 200 principal components of 32 x 24 pixels and of their difference from the background.

    With `clips` also of the differences from the two frames before.
    """
    small = _small(data.frames)
    parts = [small, small - _small(data.backgrounds)[data.background]]
    if clips:
        parts += [small - small[data.clip[:, step]] for step in (0, 1)]
    return components(np.concatenate(parts, -1).reshape(len(small), -1), data)


def _small(pictures: np.ndarray) -> np.ndarray:
    """Return pictures (n, 24, 32, 3) f32 in 0..1."""
    return np.stack([cv2.resize(one, (32, 24), interpolation=cv2.INTER_AREA) for one in pictures]).astype(np.float32) / 255


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
