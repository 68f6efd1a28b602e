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
from anytouch_jax.data import opencv
from anytouch_jax.data.pixels import ImageError

_GREY = (0.2989, 0.587, 0.114)  # torchvision's weights of red, green, blue
Flip = Literal["none", "across", "down"]
# The two random streams of a row's augmentation.
TOUCH = 0
VISION = 1
FORM = 128  # a background may differ from the proportions of a frame by one part in so many
UNTOUCHED = 128  # grey level of an untouched gel after background subtraction


def augmentation_rng(seed: int, epoch: int, row: int, stream: int = TOUCH) -> np.random.Generator:
    """Return the generator of a row's augmentation.

    It depends on its arguments alone and on no order of calls, so a run that resumes, or has
    another number of threads or hosts, augments each row as before.

    Args:
        seed: That of the run.
        epoch: The pass over the row: each draw of it is augmented anew.
        row: The row of the manifest.
        stream: TOUCH or VISION, so that the frames and the RGB image of a row are drawn apart.
    """
    # numpy takes no negative seeds
    return np.random.default_rng([seed % 2**63, epoch, row, stream])


def touch_transform(
    frames: Sequence[np.ndarray] | np.ndarray,
    size: int,
    rng: np.random.Generator,
    config: DataConfig,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Augment a still or a clip, with one draw for all of its frames.

    The whole image is resized (no crop, because contact may be anywhere), and flipped in each
    direction with probability `config.flip`. It is then rotated, shifted and scaled by up to
    `config.affine` (edges are mirrored; not in the release), and its colours are jittered by
    `config.jitter`.

    Args:
        frames: T frames u8 (h, w, 3).
        size: Pixels of a side of the result.
        rng: Of the row, see `augmentation_rng`.
        config: How much is drawn.
        out: u8 (T, size, size, 3), which the result is written into.

    Returns:
        `out`, or a new array of its shape.
    """
    across, down = rng.random(2) < config.flip
    out = _made(out, len(frames), size)
    if across or down:
        # OpenCV's code: 1 mirrors across, 0 down, -1 both
        code = -1 if across and down else int(across)
        resized = np.empty(out.shape[1:], np.uint8)
        for target, frame in zip(out, frames, strict=True):
            _resize(frame, resized)
            # NumPy takes thirty times longer
            cv2.flip(resized, code, dst=target)
    else:
        for target, frame in zip(out, frames, strict=True):
            _resize(frame, target)
    if any(config.affine):
        warp = _affine(size, rng, config.affine)
        for target in out:
            target[...] = cv2.warpAffine(
                target, warp, (size, size), borderMode=cv2.BORDER_REFLECT_101
            )
    if any(config.jitter):
        return colour_jitter(out, rng, config.jitter, out)
    return out


def _made(out: np.ndarray | None, frames: int, size: int) -> np.ndarray:
    """Return `out`, or a new array u8 (frames, size, size, 3)."""
    if out is None:
        return np.empty((frames, size, size, 3), np.uint8)
    return out


def _affine(size: int, rng: np.random.Generator, spread: tuple[float, float, float]) -> np.ndarray:
    """Return a random affine map of pixels, f64 (2, 3).

    It rotates and scales about the centre, then shifts. `spread` is the largest rotation in
    degrees, and the largest shift and growth as fractions of the side.
    """
    angle, scale, across, down = rng.uniform(-1, 1, 4)
    degrees, fraction, growth = spread
    centre = (size - 1) / 2
    shift = np.array([across, down]) * fraction * size
    # a power, so that growing and shrinking are as likely
    warp = cv2.getRotationMatrix2D((centre, centre), angle * degrees, (1 + growth) ** scale)
    return np.column_stack([warp[:, :2], warp[:, 2] + shift])


def touch_evaluation(
    frames: Sequence[np.ndarray] | np.ndarray, size: int, out: np.ndarray | None = None
) -> np.ndarray:
    """Resize a still or a clip: T frames u8 (h, w, 3) -> u8 (T, size, size, 3).

    The result is written into `out` or a new array.
    """
    out = _made(out, len(frames), size)
    for target, frame in zip(out, frames, strict=True):
        _resize(frame, target)
    return out


def orient_frame(frame: np.ndarray, rotate: int = 0, flip: Flip = "none") -> np.ndarray:
    """Return a frame (h, w, c) turned clockwise by multiples of 90 degrees, then mirrored."""
    if rotate:
        frame = np.rot90(frame, -rotate // 90)
    if flip == "across":
        return frame[:, ::-1]
    if flip == "down":
        return frame[::-1]
    return frame


def subtract_background(
    frames: Sequence[np.ndarray] | np.ndarray, background: np.ndarray
) -> list[np.ndarray]:
    """Return frame - background + 128, clipped to u8, for each of T frames u8 (h, w, 3).

    128 keeps both signs: a dent is brighter on one side and darker on the other. The background is
    resized to the frame's size if they differ.

    Raises ImageError for a background of other proportions.
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
    """Raise ImageError if a background (h, w, ...) has other proportions than a frame (h, w, ...).

    Then one of them was turned or cropped, and their difference would mean nothing.
    """
    height, width = frame[:2]
    high, wide = background[:2]
    scale = max(high, wide) / max(height, width)
    away = max(abs(height * scale - high), abs(width * scale - wide))
    if away > max(high, wide) / FORM:
        raise ImageError(
            f"the background has {wide} x {high} pixels and the frame {width} x {height}: one of "
            "them was turned or cropped; give an image taken as the frames are"
        )


def _resize(frame: np.ndarray, target: np.ndarray) -> None:
    # OpenCV would make a new array for another type, and `target` would stay as it is.
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        raise ImageError(
            f"a frame must be RGB uint8 (height, width, 3), not {frame.dtype} {frame.shape}"
        )
    opencv.set_up()
    interpolation = cv2.INTER_LINEAR
    if min(frame.shape[:2]) > len(target):
        interpolation = cv2.INTER_AREA  # a mean over all pixels, without aliasing
    cv2.resize(frame, (target.shape[1], len(target)), dst=target, interpolation=interpolation)


def colour_jitter(
    frames: np.ndarray,
    rng: np.random.Generator,
    jitter: tuple[float, float, float, float],
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Jitter brightness, contrast, saturation and hue in a random order, the same for all frames.

    This is torchvision's ColorJitter in float32, each step clipped, with one rounding at the end.

    Args:
        frames: u8 (T, h, w, 3).
        rng: Of the row, see `augmentation_rng`.
        jitter: Of brightness, contrast and saturation, whose factors are in 1 +- jitter and at
            least 0, and of the hue, which turns by up to +-jitter of a circle. 0 leaves one out.
        out: What the result is written into. It may be `frames`.

    Returns:
        `out`, or a new array of its shape.
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


# operations of ColorJitter by number, as torchvision counts them; 0 is brightness
_CONTRAST = 1
_SATURATION = 2
_HUE = 3
_IDENTITY = np.eye(3, 4)


class _Jitter:
    """One frame under jitter, f32 (h, w, 3) in 0..255.

    Brightness, contrast and saturation are affine maps of a pixel's colour, and three maps in a row
    are one. `pending` (3, 4) is the map that is not yet applied to `image`. Maps are composed until
    a value could leave 0..255, because torchvision clips after each step, or until the hue changes,
    which is no affine map. `low` and `high` are bounds on the values after `pending`.
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
        """Blend with another image: factor * image + (1 - factor) * other.

        The other is black (brightness, 0), the mean grey of the image (contrast, 1), or the grey of
        each pixel (saturation, 2). `low` and `high` below bound its values.
        """
        step = _IDENTITY * factor
        low = 0.0
        high = 0.0
        if operation == _CONTRAST:
            # The mean after the pending map is the map of the mean.
            mean = self.pending @ (*cv2.mean(self.image)[:3], 1.0)
            low = high = float(np.dot(mean, _GREY))
            step[:, 3] = (1 - factor) * low
        elif operation == _SATURATION:
            step[:, :3] += (1 - factor) * np.asarray(_GREY)
            # Grey is within the bounds of the image. With a factor above 1 it is subtracted, so
            # that its largest value belongs to the lower bound.
            low = self.low if factor <= 1 else self.high
            high = self.high if factor <= 1 else self.low
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
            self.image, self.spare = self.spare, self.image
            self.pending = _IDENTITY

    def _clip(self) -> None:
        if self.high > 255:
            cv2.threshold(self.image, 255, 0, cv2.THRESH_TRUNC, dst=self.image)
        if self.low < 0:
            cv2.threshold(self.image, 0, 0, cv2.THRESH_TOZERO, dst=self.image)
        self.low = max(self.low, 0.0)
        self.high = min(self.high, 255.0)

    def _rotate_hue(self, factor: float) -> None:
        """Rotate the hue. A pixel keeps its largest and smallest value, so the bounds stay."""
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
    """Augment an RGB image u8 (h, w, 3) -> u8 (size, size, 3), and resize it as CLIP does.

    Args:
        image: The whole image.
        size: Pixels of a side of the result.
        rng: Of the row, see `augmentation_rng`.
        rotation: Largest rotation, degrees, to either side.
        flip: Probability of a mirror image.
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
    """Resize the short side (bicubic) and crop the centre, as CLIP does.

    u8 (h, w, 3) -> u8 (size, size, 3). The kernel widens as in Pillow, which rounds between the two
    passes, and this does not: 13 % of the pixels would change by one level. An image more than 6
    times too large is first averaged down to about 3 times.
    """
    image = _shrink(image, size)
    height, width = image.shape[:2]
    short = min(height, width)
    # Both passes resize the first axis; the image is transposed between them.
    columns = np.asarray(image, np.float32).reshape(height, -1)
    first, weights = _bicubic(height, size * height // short, size)
    out = _weigh(columns, first, weights)
    rows = out.reshape(size, width, 3).transpose(1, 0, 2).reshape(width, -1)
    first, weights = _bicubic(width, size * width // short, size)
    out = _weigh(rows, first, weights).reshape(size, size, 3).transpose(1, 0, 2)
    return np.ascontiguousarray(np.rint(np.clip(out, 0, 255)).astype(np.uint8))


def _weigh(image: np.ndarray, first: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return sums of weighted rows, f32 (size, c).

    A matrix product would do, but BLAS has threads of its own, which makes it fifty times slower
    beside those of the loader.

    Args:
        image: f32 (n, c).
        first: i64 (size,), the first row of each sum.
        weights: f32 (taps, size), of the rows from there on.
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
    """Return a bicubic resize of one axis that keeps the centre, as weights.

    Args:
        before: Pixels of the source.
        after: Pixels of the whole result.
        size: Pixels of its centre that are kept.

    Returns:
        The first source pixel of each result i64 (size,), and the weights of the pixels from there
        on f32 (taps, size).
    """
    scale = before / after
    start = round((after - size) / 2)
    centre = (np.arange(start, start + size) + 0.5) * scale
    x = np.abs(np.arange(before) + 0.5 - centre[:, None]) / max(scale, 1.0)
    # Keys' cubic kernel with the parameter of Pillow: one polynomial up to a distance of one pixel,
    # another up to two.
    a = -0.5
    near = ((a + 2) * x - (a + 3)) * x * x + 1
    far = (((x - 5) * x + 8) * x - 4) * a
    weights = np.where(x < 1, near, np.where(x < 2, far, 0.0))
    weights /= weights.sum(axis=1, keepdims=True)
    first = (weights != 0).argmax(axis=1)
    last = before - 1 - (weights[:, ::-1] != 0).argmax(axis=1)
    taps = int((last - first).max()) + 1  # zeros can lie between them
    first = np.minimum(first, before - taps)
    row = np.arange(size)
    kept = np.stack([weights[row, first + k] for k in range(taps)])
    return first, kept.astype(np.float32)
