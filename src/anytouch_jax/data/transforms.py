"""Image transforms: pure functions (image, rng) -> image, uint8 RGB in and out, at the sizes the model wants.

Normalisation happens on the device; its constants are in `anytouch_jax.config`. What is random comes from the
generator that is given, and `augmentation_rng` makes one from (seed, epoch, row) alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np

from anytouch_jax.config import DataConfig
from anytouch_jax.data.images import ImageError, decode

__all__ = [
    "ImageError",
    "augmentation_rng",
    "colour_jitter",
    "decode",
    "orient_frame",
    "subtract_background",
    "touch_evaluation",
    "touch_transform",
    "vision_evaluation",
    "vision_transform",
]  # fmt: skip

_GREY = (0.2989, 0.587, 0.114)  # torchvision's weights of red, green, blue
Flip = Literal["none", "across", "down"]
TOUCH, VISION = 0, 1  # the two streams of one row's augmentation


def augmentation_rng(seed: int, epoch: int, row: int, stream: int = TOUCH) -> np.random.Generator:
    """The generator of a row's augmentation: a function of (seed, epoch, row), apart for touch and vision."""
    return np.random.default_rng([seed % 2**63, epoch, row, stream])


def touch_transform(
    frames: Sequence[np.ndarray] | np.ndarray,
    size: int,
    rng: np.random.Generator,
    config: DataConfig,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Augment a still or a clip: T frames u8 (h, w, 3) -> u8 (T, size, size, 3), one draw for all frames.

    The whole image is resized (no crop), flipped in both directions with probability `config.flip` each, turned, moved
    and scaled about its middle by up to `config.affine` (what comes in at an edge is its mirror image), then jittered
    in colour by `config.jitter` (the release's augmentation but for `affine`). `out`: where to write, else a new array.
    """
    across, down = rng.random(2) < config.flip
    out = np.empty((len(frames), size, size, 3), np.uint8) if out is None else out
    plain = np.empty(out.shape[1:], np.uint8) if across or down else None
    for target, frame in zip(out, frames, strict=True):
        _resize(frame, target if plain is None else plain)
        if plain is not None:  # NumPy takes thirty times as long
            cv2.flip(plain, -1 if across and down else int(across), dst=target)
    if any(config.affine):
        warp = _affine(size, rng, config.affine)
        for frame in out:
            frame[...] = cv2.warpAffine(frame, warp, (size, size), borderMode=cv2.BORDER_REFLECT_101)
    return colour_jitter(out, rng, config.jitter, out) if any(config.jitter) else out


def _affine(size: int, rng: np.random.Generator, spread: tuple[float, float, float]) -> np.ndarray:
    """A random map of pixels f64 (2, 3): a turn and a growth about the middle, then a move (`config.Data.affine`)."""
    turn, grow, across, down = rng.uniform(-1, 1, 4)
    degrees, share, growth = spread
    middle, move = (size - 1) / 2, np.array([across, down]) * share * size
    warp = cv2.getRotationMatrix2D((middle, middle), turn * degrees, (1 + growth) ** grow)
    return np.column_stack([warp[:, :2], warp[:, 2] + move])


def touch_evaluation(frames: Sequence[np.ndarray] | np.ndarray, size: int, out: np.ndarray | None = None) -> np.ndarray:
    """Resize a still or a clip without randomness: T frames u8 (h, w, 3) -> u8 (T, size, size, 3), into `out`."""
    out = np.empty((len(frames), size, size, 3), np.uint8) if out is None else out
    for target, frame in zip(out, frames, strict=True):
        _resize(frame, target)
    return out


def orient_frame(frame: np.ndarray, rotate: int = 0, flip: Flip = "none") -> np.ndarray:
    """A frame (h, w, c) turned clockwise by 0, 90, 180 or 270 degrees, then mirrored across (left and right exchanged)
    or down (top and bottom)."""
    frame = np.rot90(frame, -rotate // 90) if rotate else frame
    return {"none": frame, "across": frame[:, ::-1], "down": frame[::-1]}[flip]


UNTOUCHED = 128  # grey level of a gel that nothing touches, once it is subtracted


def subtract_background(frames: Sequence[np.ndarray] | np.ndarray, background: np.ndarray) -> list[np.ndarray]:
    """Each of T frames u8 (h, w, 3) less the untouched gel, on middle grey: frame - background + 128, clipped to u8.

    A background of another size is resized to the frame's.
    """

    def less(frame: np.ndarray) -> np.ndarray:
        height, width = frame.shape[:2]
        same = background.shape[:2] == (height, width)
        gel = background if same else cv2.resize(background, (width, height), interpolation=cv2.INTER_AREA)
        return cv2.addWeighted(frame, 1.0, gel, -1.0, UNTOUCHED)

    return [less(frame) for frame in frames]


def _resize(frame: np.ndarray, target: np.ndarray) -> None:
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:  # OpenCV would write elsewhere
        raise ImageError(f"a frame must be RGB uint8 (height, width, 3), not {frame.dtype} {frame.shape}")
    smaller = min(frame.shape[:2]) > len(target)
    how = cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
    cv2.resize(frame, (target.shape[1], len(target)), dst=target, interpolation=how)


def colour_jitter(
    frames: np.ndarray,
    rng: np.random.Generator,
    jitter: tuple[float, float, float, float],
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Brightness, contrast, saturation and hue in a random order, the same for all frames: u8 (T, h, w, 3) -> same.

    torchvision's ColorJitter on floats: factors in 1 +- jitter (at least 0), hue turned by up to +-jitter of a circle,
    each step clipped. All is float32 with one rounding at the end, so the error is half a grey level. `out`: where to
    write, also `frames` itself.
    """
    spread = np.asarray(jitter)
    low, high = np.maximum(0.0, 1.0 - spread), 1.0 + spread
    low[3], high[3] = -jitter[3], jitter[3]
    factors = low + (high - low) * rng.random(4)
    steps = [(int(operation), float(factors[operation])) for operation in rng.permutation(4) if jitter[operation]]
    out = np.empty(frames.shape, np.uint8) if out is None else out
    buffers = np.empty((2, *frames.shape[1:]), np.float32)
    for target, frame in zip(out, frames, strict=True):
        _Jitter(frame, *buffers).apply(steps, target)
    return out


_HUE = 3
_IDENTITY = np.eye(3, 4)


class _Jitter:
    """One frame on its way, f32 in 0..255: brightness, contrast and saturation are affine maps of a pixel's colour.

    `pending` (3, 4) is the map that is still to be applied to `here`. Maps are put together until a value could leave
    the range (`low` and `high` bound them), where the picture has to be made and clipped, or until the hue is turned.
    """

    def __init__(self, frame: np.ndarray, here: np.ndarray, spare: np.ndarray) -> None:
        np.copyto(here, frame)
        self.here, self.spare, self.pending = here, spare, _IDENTITY
        self.low, self.high = float(frame.min()), float(frame.max())

    def apply(self, steps: Sequence[tuple[int, float]], target: np.ndarray) -> None:
        """Take the steps (operation, factor) in order and round the result into `target` u8."""
        for operation, factor in steps:
            if operation == _HUE:
                self._turn(factor)
            else:
                self._blend(operation, factor)
        self._settle()
        cv2.convertScaleAbs(self.here, dst=target)

    def _blend(self, operation: int, factor: float) -> None:
        """Mix with black (0), with the mean grey of the picture (1), or with each pixel's own grey (2)."""
        step, low, high = _IDENTITY * factor, 0.0, 0.0
        if operation == 1:
            mean = self.pending @ (*cv2.mean(self.here)[:3], 1.0)
            low = high = float(np.dot(mean, _GREY))
            step[:, 3] = (1 - factor) * low
        elif operation == 2:
            step[:, :3] += (1 - factor) * np.asarray(_GREY)
            low, high = (self.low, self.high) if factor <= 1 else (self.high, self.low)
        self.low, self.high = factor * self.low + (1 - factor) * low, factor * self.high + (1 - factor) * high
        linear = step[:, :3] @ self.pending
        linear[:, 3] += step[:, 3]
        self.pending = linear
        if self.low < 0 or self.high > 255:
            self._settle()
            self._clip()

    def _settle(self) -> None:
        if self.pending is not _IDENTITY:
            cv2.transform(self.here, self.pending.astype(np.float32), dst=self.spare)
            self.here, self.spare, self.pending = self.spare, self.here, _IDENTITY

    def _clip(self) -> None:
        if self.high > 255:
            cv2.threshold(self.here, 255, 0, cv2.THRESH_TRUNC, dst=self.here)
        if self.low < 0:
            cv2.threshold(self.here, 0, 0, cv2.THRESH_TOZERO, dst=self.here)
        self.low, self.high = max(self.low, 0.0), min(self.high, 255.0)

    def _turn(self, factor: float) -> None:
        """Turn the hue; a pixel's largest and smallest value stay, so the bounds do."""
        self._settle()
        cv2.cvtColor(self.here, cv2.COLOR_RGB2HSV, dst=self.spare)
        hue = self.spare[..., 0]
        np.add(hue, np.float32(360 * (factor % 1.0)), out=hue)  # the way back takes angles above 360, not below 0
        cv2.cvtColor(self.spare, cv2.COLOR_HSV2RGB, dst=self.here)


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
