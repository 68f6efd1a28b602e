"""Image transforms: pure functions (image, rng) -> image, uint8 RGB in and out, at the sizes the model wants.

Normalisation happens on the device; its constants are in `anytouch_jax.config`. What is random comes from the
generator that is given, and `augmentation_rng` makes one from (seed, epoch, row) alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import cv2
import numpy as np

from anytouch_jax.config import Data
from anytouch_jax.data.images import ImageError, decode

__all__ = [
    "ImageError", "augmentation_rng", "colour_jitter", "decode",
    "touch_evaluation", "touch_transform", "vision_evaluation", "vision_transform",
]  # fmt: skip

_GREY = (0.2989, 0.587, 0.114)  # torchvision's weights of red, green, blue
TOUCH, VISION = 0, 1  # the two streams of one row's augmentation


def augmentation_rng(seed: int, epoch: int, row: int, stream: int = TOUCH) -> np.random.Generator:
    """The generator of a row's augmentation: a function of (seed, epoch, row), apart for touch and vision."""
    return np.random.default_rng([seed % 2**63, epoch, row, stream])


def touch_transform(
    frames: Sequence[np.ndarray] | np.ndarray, size: int, rng: np.random.Generator, config: Data
) -> np.ndarray:
    """Augment a still or a clip: T frames u8 (h, w, 3) -> u8 (T, size, size, 3), one draw for all frames.

    The whole image is resized (no crop), flipped in both directions with probability `config.flip` each, then
    jittered in colour by `config.jitter` (the release's augmentation).
    """
    across, down = rng.random(2) < config.flip
    out = touch_evaluation(frames, size)
    if across or down:
        # A contiguous copy: arithmetic on a view with negative strides is six times slower than the flip.
        out = np.ascontiguousarray(out[:, :: -1 if down else 1, :: -1 if across else 1])
    return colour_jitter(out, rng, config.jitter)


def touch_evaluation(frames: Sequence[np.ndarray] | np.ndarray, size: int) -> np.ndarray:
    """Resize a still or a clip without randomness: T frames u8 (h, w, 3) -> u8 (T, size, size, 3)."""
    out = np.empty((len(frames), size, size, 3), np.uint8)
    for target, frame in zip(out, frames, strict=True):
        smaller = min(frame.shape[:2]) > size
        cv2.resize(frame, (size, size), dst=target, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
    return out


def colour_jitter(
    frames: np.ndarray, rng: np.random.Generator, jitter: tuple[float, float, float, float]
) -> np.ndarray:
    """Brightness, contrast, saturation and hue in a random order, the same for all frames: u8 (T, h, w, 3) -> same.

    torchvision's ColorJitter on floats in 0..1: factors in 1 +- jitter (at least 0), hue turned by up to +-jitter of a
    circle, each step clipped. All is float32 with one rounding at the end, so the error is half a grey level.
    """
    spread = np.asarray(jitter)
    low, high = np.maximum(0.0, 1.0 - spread), 1.0 + spread
    low[3], high[3] = -jitter[3], jitter[3]
    factors = low + (high - low) * rng.random(4)
    order = [operation for operation in rng.permutation(4) if jitter[operation]]
    out = np.empty(frames.shape, np.uint8)
    buffers = np.empty((2, *frames.shape[1:]), np.float32)
    for target, frame in zip(out, frames, strict=True):
        here, there = buffers
        np.multiply(frame, np.float32(1 / 255), out=here)
        for operation in order:
            here, there = _OPERATIONS[operation](here, there, float(factors[operation]))
            np.clip(here, 0.0, 1.0, out=here)
        cv2.convertScaleAbs(here, dst=target, alpha=255)
    return out


# Each operation takes the image, a buffer and a factor, and gives back (image, buffer): some of them swap the two.
_Pair = tuple[np.ndarray, np.ndarray]


def _brightness(image: np.ndarray, spare: np.ndarray, factor: float) -> _Pair:
    np.multiply(image, np.float32(factor), out=image)
    return image, spare


def _contrast(image: np.ndarray, spare: np.ndarray, factor: float) -> _Pair:
    mean = float(np.dot(cv2.mean(image)[:3], _GREY))
    np.multiply(image, np.float32(factor), out=image)
    np.add(image, np.float32((1 - factor) * mean), out=image)
    return image, spare


def _saturation(image: np.ndarray, spare: np.ndarray, factor: float) -> _Pair:
    mix = factor * np.eye(3) + (1 - factor) * np.tile(_GREY, (3, 1))
    cv2.transform(image, mix.astype(np.float32), dst=spare)
    return spare, image


def _hue(image: np.ndarray, spare: np.ndarray, factor: float) -> _Pair:
    cv2.cvtColor(image, cv2.COLOR_RGB2HSV, dst=spare)
    hue = spare[..., 0]
    np.add(hue, np.float32(360 * (factor % 1.0)), out=hue)  # the way back takes angles above 360, not below 0
    cv2.cvtColor(spare, cv2.COLOR_HSV2RGB, dst=image)
    return image, spare


_OPERATIONS = (_brightness, _contrast, _saturation, _hue)


def vision_transform(
    image: np.ndarray, size: int, rng: np.random.Generator, rotation: float = 20.0, flip: float = 0.5
) -> np.ndarray:
    """Augment an ordinary picture u8 (h, w, 3) -> u8 (size, size, 3): rotation, horizontal flip, CLIP's resize.

    The picture is turned by up to +-`rotation` degrees about its centre (corners black), flipped with probability
    `flip`, then resized and cropped as by `vision_evaluation`.
    """
    angle = rng.uniform(-rotation, rotation)
    across = rng.random() < flip
    image = _shrink(image, size)
    if rotation:
        height, width = image.shape[:2]
        turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), angle, 1.0)
        image = cv2.warpAffine(image, turn, (width, height), flags=cv2.INTER_LINEAR)
    if across:
        image = cv2.flip(image, 1)
    return vision_evaluation(image, size)


def vision_evaluation(image: np.ndarray, size: int) -> np.ndarray:
    """CLIP's preparation without randomness: bicubic resize of the short side, centre crop; u8 (size, size, 3).

    The kernel widens with the reduction (no aliasing), as in PIL; a picture more than 6 times too large is first
    averaged down to about 3 times.
    """
    image = _shrink(image, size)
    height, width = image.shape[:2]
    short = min(height, width)
    out = _weigh(np.asarray(image, np.float32).reshape(height, -1), *_bicubic(height, size * height // short, size))
    out = out.reshape(size, width, 3).transpose(1, 0, 2).reshape(width, -1)
    out = _weigh(out, *_bicubic(width, size * width // short, size)).reshape(size, size, 3).transpose(1, 0, 2)
    return np.ascontiguousarray(np.rint(np.clip(out, 0, 255)).astype(np.uint8))


def _weigh(image: np.ndarray, first: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Rows (n, c) -> (size, c): row i is the sum over k of weights[k, i] * image[first[i] + k].

    Tap by tap and not as a matrix product: BLAS threads beside those of the loader cost fifty times its work.
    """
    out = np.zeros((len(first), image.shape[1]), np.float32)
    part = np.empty_like(out)
    for k, weight in enumerate(weights):
        np.take(image, first + k, axis=0, out=part, mode="clip")
        np.multiply(part, weight[:, None], out=part)
        np.add(out, part, out=out)
    return out


def _shrink(image: np.ndarray, size: int) -> np.ndarray:
    """A much too large picture averaged down by a whole factor."""
    factor = min(image.shape[:2]) // (3 * size)
    if factor < 2:
        return image
    height, width = image.shape[0] // factor, image.shape[1] // factor
    return cv2.resize(image[: height * factor, : width * factor], (width, height), interpolation=cv2.INTER_AREA)


@lru_cache(maxsize=256)
def _bicubic(before: int, after: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """A bicubic resize from `before` to `after` pixels, the central `size` of them: the first source pixel of each
    i64 (size,) and the weights f32 (taps, size) of it and the following ones."""
    scale = before / after
    start = round((after - size) / 2)
    centre = (np.arange(start, start + size) + 0.5) * scale
    x = np.abs(np.arange(before) + 0.5 - centre[:, None]) / max(scale, 1.0)
    a = -0.5
    near = ((a + 2) * x - (a + 3)) * x * x + 1
    far = (((x - 5) * x + 8) * x - 4) * a
    weights = np.where(x < 1, near, np.where(x < 2, far, 0.0))
    weights /= weights.sum(axis=1, keepdims=True)
    first, last = (weights != 0).argmax(axis=1), before - 1 - (weights[:, ::-1] != 0).argmax(axis=1)
    taps = int((last - first).max()) + 1  # zeros can lie between them
    first = np.minimum(first, before - taps)
    return first, np.stack([weights[np.arange(size), first + k] for k in range(taps)]).astype(np.float32)
