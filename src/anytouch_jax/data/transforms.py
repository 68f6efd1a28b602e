"""Image transforms: pure functions from images (and a generator) to images, uint8 RGB in and out.

Normalisation happens on the device, with the constants in `anytouch_jax.config`. All randomness
comes from the generator argument, which `augmentation_rng` makes from (seed, epoch, row).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np

from anytouch_jax.config import DataConfig
from anytouch_jax.data.images import ImageError

_GREY = (0.2989, 0.587, 0.114)  # torchvision's weights of red, green, blue
Flip = Literal["none", "across", "down"]
# the two random streams of a row's augmentation
TOUCH = 0
VISION = 1
FORM = 128  # a background may differ from the proportions of a frame by one part in so many
UNTOUCHED = 128  # grey level of an untouched gel after background subtraction


def augmentation_rng(seed: int, epoch: int, row: int, stream: int = TOUCH) -> np.random.Generator:
    """Return the generator of a row's augmentation, a function of (seed, epoch, row) and of the
    stream.
    """
    return np.random.default_rng([seed % 2**63, epoch, row, stream])


def touch_transform(
    frames: Sequence[np.ndarray] | np.ndarray,
    size: int,
    rng: np.random.Generator,
    config: DataConfig,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Augment a still or a clip: T frames u8 (h, w, 3) -> u8 (T, size, size, 3), with one draw for
    all frames.

    The whole image is resized (no crop), and flipped in each direction with probability
    `config.flip`. It is then rotated, shifted and scaled by up to `config.affine` (edges are
    mirrored; not in the release), and its colours are jittered by `config.jitter`. The result is
    written into `out` or a new array.
    """
    across, down = rng.random(2) < config.flip
    out = np.empty((len(frames), size, size, 3), np.uint8) if out is None else out
    plain = np.empty(out.shape[1:], np.uint8) if across or down else None
    for target, frame in zip(out, frames, strict=True):
        _resize(frame, target if plain is None else plain)
        if plain is not None:  # NumPy takes thirty times longer
            cv2.flip(plain, -1 if across and down else int(across), dst=target)
    if any(config.affine):
        warp = _affine(size, rng, config.affine)
        for frame in out:
            frame[...] = cv2.warpAffine(
                frame, warp, (size, size), borderMode=cv2.BORDER_REFLECT_101
            )
    if any(config.jitter):
        return colour_jitter(out, rng, config.jitter, out)
    return out


def _affine(size: int, rng: np.random.Generator, spread: tuple[float, float, float]) -> np.ndarray:
    """Return a random affine map of pixels, f64 (2, 3): rotation and scaling about the centre, then
    a shift.
    """
    angle, scale, across, down = rng.uniform(-1, 1, 4)
    degrees, share, growth = spread
    centre = (size - 1) / 2
    shift = np.array([across, down]) * share * size
    warp = cv2.getRotationMatrix2D((centre, centre), angle * degrees, (1 + growth) ** scale)
    return np.column_stack([warp[:, :2], warp[:, 2] + shift])


def touch_evaluation(
    frames: Sequence[np.ndarray] | np.ndarray, size: int, out: np.ndarray | None = None
) -> np.ndarray:
    """Resize a still or a clip: T frames u8 (h, w, 3) -> u8 (T, size, size, 3), written into `out`
    or a new array.
    """
    out = np.empty((len(frames), size, size, 3), np.uint8) if out is None else out
    for target, frame in zip(out, frames, strict=True):
        _resize(frame, target)
    return out


def orient_frame(frame: np.ndarray, rotate: int = 0, flip: Flip = "none") -> np.ndarray:
    """Return a frame (h, w, c) turned clockwise by multiples of 90 degrees, then mirrored across or
    down.
    """
    frame = np.rot90(frame, -rotate // 90) if rotate else frame
    return {"none": frame, "across": frame[:, ::-1], "down": frame[::-1]}[flip]


def subtract_background(
    frames: Sequence[np.ndarray] | np.ndarray, background: np.ndarray
) -> list[np.ndarray]:
    """Return background-subtracted frames: frame - background + 128, clipped to u8, for each of T
    frames u8 (h, w, 3).

    The background is an image of the untouched gel. It is resized to the frame's size if they
    differ. Raises ImageError for one of other proportions.
    """

    def subtract(frame: np.ndarray) -> np.ndarray:
        height, width = frame.shape[:2]
        gel = background
        if gel.shape[:2] != (height, width):
            check_proportions(frame.shape, gel.shape)
            gel = cv2.resize(gel, (width, height), interpolation=cv2.INTER_AREA)
        return cv2.addWeighted(frame, 1.0, gel, -1.0, UNTOUCHED)

    return [subtract(frame) for frame in frames]


def check_proportions(frame: Sequence[int], background: Sequence[int]) -> None:
    """Raise ImageError if a background (h, w, ...) has other proportions than a frame: it is turned
    or cropped.
    """
    (height, width) = frame[:2]
    (high, wide) = background[:2]
    scale = max(high, wide) / max(height, width)
    if max(abs(height * scale - high), abs(width * scale - wide)) > max(high, wide) / FORM:
        raise ImageError(
            f"the background has {wide} x {high} pixels and the frame {width} x {height}: one of "
            "them was turned or "
            "cropped; give a picture taken as the frames are"
        )


def _resize(frame: np.ndarray, target: np.ndarray) -> None:
    if (
        frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3
    ):  # else OpenCV would not write into `target`
        raise ImageError(
            f"a frame must be RGB uint8 (height, width, 3), not {frame.dtype} {frame.shape}"
        )
    interpolation = cv2.INTER_AREA if min(frame.shape[:2]) > len(target) else cv2.INTER_LINEAR
    cv2.resize(frame, (target.shape[1], len(target)), dst=target, interpolation=interpolation)


def colour_jitter(
    frames: np.ndarray,
    rng: np.random.Generator,
    jitter: tuple[float, float, float, float],
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Jitter brightness, contrast, saturation and hue in a random order, the same for all frames u8
    (T, h, w, 3).

    This is torchvision's ColorJitter in float32, each step clipped, with one rounding at the end.
    Factors are in 1 +- jitter (at least 0), the hue turns by up to +-jitter of a circle. The result
    is written into `out` (`frames` is allowed) or a new array.
    """
    spread = np.asarray(jitter)
    low = np.maximum(0.0, 1.0 - spread)
    high = 1.0 + spread
    low[3] = -jitter[3]
    high[3] = jitter[3]
    factors = low + (high - low) * rng.random(4)
    steps = [
        (int(operation), float(factors[operation]))
        for operation in rng.permutation(4)
        if jitter[operation]
    ]
    out = np.empty(frames.shape, np.uint8) if out is None else out
    buffers = np.empty((2, *frames.shape[1:]), np.float32)
    for target, frame in zip(out, frames, strict=True):
        _Jitter(frame, *buffers).apply(steps, target)
    return out


_HUE = 3
_IDENTITY = np.eye(3, 4)


class _Jitter:
    """One frame under jitter, f32 in 0..255; brightness, contrast and saturation are affine maps of
    a pixel's colour.

    `pending` (3, 4) is not yet applied to `image`: maps are composed until a value could leave the
    range, bounded by `low` and `high`, or until the hue changes.
    """

    def __init__(self, frame: np.ndarray, image: np.ndarray, spare: np.ndarray) -> None:
        np.copyto(image, frame)
        self.image = image
        self.spare = spare
        self.pending = _IDENTITY
        self.low = float(frame.min())
        self.high = float(frame.max())

    def apply(self, steps: Sequence[tuple[int, float]], target: np.ndarray) -> None:
        """Apply the steps (operation, factor) in order and round the result into `target` u8."""
        for operation, factor in steps:
            if operation == _HUE:
                self._rotate_hue(factor)
            else:
                self._blend(operation, factor)
        self._apply_pending()
        cv2.convertScaleAbs(self.image, dst=target)

    def _blend(self, operation: int, factor: float) -> None:
        """Blend with black (0), with the mean grey of the image (1), or with the grey of each pixel
        (2).
        """
        step = _IDENTITY * factor
        low = 0.0
        high = 0.0
        if operation == 1:
            mean = self.pending @ (*cv2.mean(self.image)[:3], 1.0)
            low = high = float(np.dot(mean, _GREY))
            step[:, 3] = (1 - factor) * low
        elif operation == 2:
            step[:, :3] += (1 - factor) * np.asarray(_GREY)
            low, high = (self.low, self.high) if factor <= 1 else (self.high, self.low)
        self.low = factor * self.low + (1 - factor) * low
        self.high = factor * self.high + (1 - factor) * high
        linear = step[:, :3] @ self.pending
        linear[:, 3] += step[:, 3]
        self.pending = linear
        if self.low < 0 or self.high > 255:
            self._apply_pending()
            self._clip()

    def _apply_pending(self) -> None:
        if self.pending is not _IDENTITY:
            cv2.transform(self.image, self.pending.astype(np.float32), dst=self.spare)
            self.image, self.spare, self.pending = self.spare, self.image, _IDENTITY

    def _clip(self) -> None:
        if self.high > 255:
            cv2.threshold(self.image, 255, 0, cv2.THRESH_TRUNC, dst=self.image)
        if self.low < 0:
            cv2.threshold(self.image, 0, 0, cv2.THRESH_TOZERO, dst=self.image)
        self.low = max(self.low, 0.0)
        self.high = min(self.high, 255.0)

    def _rotate_hue(self, factor: float) -> None:
        """Rotate the hue; the largest and the smallest value of a pixel stay, and so do the
        bounds.
        """
        self._apply_pending()
        cv2.cvtColor(self.image, cv2.COLOR_RGB2HSV, dst=self.spare)
        hue = self.spare[..., 0]
        # HSV2RGB accepts angles above 360 but not below 0
        np.add(hue, np.float32(360 * (factor % 1.0)), out=hue)
        cv2.cvtColor(self.spare, cv2.COLOR_HSV2RGB, dst=self.image)


def vision_transform(
    image: np.ndarray,
    size: int,
    rng: np.random.Generator,
    rotation: float = 20.0,
    flip: float = 0.5,
) -> np.ndarray:
    """Augment a photograph u8 (h, w, 3) -> u8 (size, size, 3): turn by +-`rotation` degrees, flip,
    CLIP's resize.
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
    """Resize the short side (bicubic) and crop the centre, as CLIP does: u8 (h, w, 3) -> u8 (size,
    size, 3).

    The kernel widens as in Pillow, which rounds between the passes: 13 % of the pixels would change
    by one level. An image more than 6 times too large is first averaged down to about 3 times.
    """
    image = _shrink(image, size)
    height, width = image.shape[:2]
    short = min(height, width)
    out = _weigh(
        np.asarray(image, np.float32).reshape(height, -1),
        *_bicubic(height, size * height // short, size),
    )
    out = out.reshape(size, width, 3).transpose(1, 0, 2).reshape(width, -1)
    out = (
        _weigh(out, *_bicubic(width, size * width // short, size))
        .reshape(size, size, 3)
        .transpose(1, 0, 2)
    )
    return np.ascontiguousarray(np.rint(np.clip(out, 0, 255)).astype(np.uint8))


def _weigh(image: np.ndarray, first: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return rows (size, c) of weighted taps.

    A matrix product is fifty times slower next to threads.
    """
    out = np.zeros((len(first), image.shape[1]), np.float32)
    part = np.empty_like(out)
    for k, weight in enumerate(weights):
        np.take(image, first + k, axis=0, out=part, mode="clip")
        np.multiply(part, weight[:, None], out=part)
        np.add(out, part, out=out)
    return out


def _shrink(image: np.ndarray, size: int) -> np.ndarray:
    """Return a much too large image averaged down by a whole factor."""
    factor = min(image.shape[:2]) // (3 * size)
    if factor < 2:
        return image
    height = image.shape[0] // factor
    width = image.shape[1] // factor
    return cv2.resize(
        image[: height * factor, : width * factor], (width, height), interpolation=cv2.INTER_AREA
    )


@lru_cache(maxsize=256)
def _bicubic(before: int, after: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a bicubic resize of the centre: first source pixels i64 (size,), weights from them on
    f32 (taps, size).
    """
    scale = before / after
    start = round((after - size) / 2)
    centre = (np.arange(start, start + size) + 0.5) * scale
    x = np.abs(np.arange(before) + 0.5 - centre[:, None]) / max(scale, 1.0)
    a = -0.5
    near = ((a + 2) * x - (a + 3)) * x * x + 1
    far = (((x - 5) * x + 8) * x - 4) * a
    weights = np.where(x < 1, near, np.where(x < 2, far, 0.0))
    weights /= weights.sum(axis=1, keepdims=True)
    first = (weights != 0).argmax(axis=1)
    last = before - 1 - (weights[:, ::-1] != 0).argmax(axis=1)
    taps = int((last - first).max()) + 1  # zeros can lie between them
    first = np.minimum(first, before - taps)
    return first, np.stack([weights[np.arange(size), first + k] for k in range(taps)]).astype(
        np.float32
    )
