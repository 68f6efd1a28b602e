"""Marker dots of a gel: where they are on its background, what they hide, and how they move."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from anytouch_jax.data import opencv
from anytouch_jax.data.background.estimate import scale_image

Array = npt.NDArray[Any]
# pixels of the long side of an image in which dots are found, and of one in which they move
LONG = 320
FLOW = 240
FEWEST = 12
# spread of the steps from dot to dot, and grey levels of a dot, that are no lattice
IRREGULAR = 0.08
FAINT = 12
# Deviation of a motion in pixels of FLOW: of dots that move alike, and for each pixel by which dots
# nearby differ.
STEADY = 0.2
UNSTEADY = 0.5

_WIDEST = 0.045  # of a dot, as a fraction of the long side of the image
_COVERED = 0.35  # fraction of the image that a lattice covers at least
_STRONG = 0.5  # of a dot's largest change: colours that change less are left out
_IN_A_ROW = 3  # fits of the lattice, each without the steps that the last one fits worst


class Dots(NamedTuple):
    """Dots of the gel.

    Attributes:
        pitch: Step of their lattice, pixels.
        bend: How the step changes towards the edge, see `_lattice`.
        radius: Of a dot's height, pixels.
        aspect: Width of a dot over its height.
        ink: (3,) colour in 0..1.
        mask: bool (h, w), where they are on the background.
        sign: 1 for dots that are darker than the gel, -1 for lighter ones.
        change: (3,) grey levels by which a dot differs from the gel.
        spread: Of the step, relative.
    """

    pitch: float
    bend: float
    radius: float
    aspect: float
    ink: Array
    mask: Array
    sign: int
    change: Array
    spread: float


def find_dots(gel: Array) -> Dots | None:
    """Return the dots of a background u8 (h, w, 3), dark or light; None without a lattice of them.

    Dark dots are looked for first, because almost all gels have these.
    """
    dark = _dots_of(gel, 1)
    if dark is not None:
        return dark
    return _dots_of(gel, -1)


def _spots(image: Array, sign: int, shape: int = cv2.MORPH_ELLIPSE) -> Array:
    """Return by how many grey levels u8 (h, w, 3) small spots differ from what is around.

    With `sign` 1 it is by how much they are darker, with -1 lighter. It is a black-hat transform:
    what a closing with a kernel wider than a dot fills.
    """
    shown = image if sign > 0 else 255 - image
    side = 2 * round(_WIDEST * max(image.shape[:2])) + 1
    kernel = cv2.getStructuringElement(shape, (side, side))
    return np.asarray(cv2.subtract(cv2.morphologyEx(shown, cv2.MORPH_CLOSE, kernel), shown))


def hidden(frame: Array, dots: Dots) -> Array:
    """Return where dots hide the gel of a pressed frame, or hid it before they moved.

    `frame` is u8 (h, w, 3) of the size of `dots.mask`. The result is bool (h, w).
    """
    # a dot changes these colours all at once, and a slope does not
    strong = dots.change >= _STRONG * dots.change.max()
    fraction = (_spots(frame, dots.sign)[..., strong] / dots.change[strong]).min(-1)
    now = cv2.dilate((fraction > 0.3).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return dots.mask | now


class _Blob(NamedTuple):
    """One dark (or light) spot.

    `place` is (x, y), `moments` the variances of its ink along x and y, and `area` its size in
    pixels of full ink.
    """

    place: tuple[float, float]
    moments: tuple[float, float]
    area: float


def _dots_of(gel: Array, sign: int) -> Dots | None:
    long = max(gel.shape[:2])
    depth = _spots(gel, sign)
    deep = cv2.GaussianBlur(depth.max(2).astype(np.float32), (0, 0), long / LONG)
    strongest = float(np.percentile(deep, 99))
    blobs = _blobs(deep, max(8.0, 0.5 * strongest))
    if len(blobs) < FEWEST:
        return None
    at = np.array([blob.place for blob in blobs])
    apart = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    # Most dots have two neighbours at the step of the lattice, even at the edge.
    rough = float(np.median(np.sort(apart, 1)[:, :2]))
    pitch, bend, spread = _lattice(at, apart, rough, gel.shape)
    inked = deep > max(6.0, 0.25 * strongest)
    change = np.percentile(depth[inked], 80, axis=0)
    if spread > IRREGULAR or change.max() < FAINT:
        return None
    if len(blobs) * rough**2 < _COVERED * gel.shape[0] * gel.shape[1]:
        return None  # some specks, but no lattice
    # The blur above has widened the dots.
    blur = (long / LONG) ** 2
    wide, tall = np.maximum(np.median([blob.moments for blob in blobs], 0) - blur, 0.05)
    aspect = float(np.clip(np.sqrt(wide / tall), 0.4, 3.5))
    area = float(np.median([blob.area for blob in blobs]))
    centres = np.array([gel[round(y), round(x)] for x, y in at])
    return Dots(
        pitch=pitch,
        bend=bend,
        radius=float(np.sqrt(area / (np.pi * aspect))),
        aspect=aspect,
        ink=np.median(centres, 0) / 255,
        mask=cv2.dilate(inked.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0,
        sign=sign,
        change=change,
        spread=spread,
    )


def _blobs(deep: Array, threshold: float) -> list[_Blob]:
    """Return the spots of a depth f32 (h, w) that may be dots."""
    height, width = deep.shape
    _, labels, stats, _ = cv2.connectedComponentsWithStats((deep > threshold).astype(np.uint8))
    blobs = []
    for number, (x, y, w, h, area) in enumerate(stats[1:], 1):
        edge = min(x, y, width - x - w, height - y - h)
        is_speck = area < 4 or area > (0.1 * max(height, width)) ** 2
        # wider than high is allowed: images of some sensors are stretched along x
        is_line = w > 3.5 * h or h > 2.5 * w
        if edge < 1 or is_speck or is_line:
            continue
        # Its surroundings belong to it, but not other spots.
        part = np.s_[max(y - 2, 0) : min(y + h + 2, height), max(x - 2, 0) : min(x + w + 2, width)]
        own = deep[part] * np.isin(labels[part], (0, number))
        rows, columns = np.mgrid[part]
        total = own.sum()
        cy = (rows * own).sum() / total
        cx = (columns * own).sum() / total
        across = ((columns - cx) ** 2 * own).sum() / total
        down = ((rows - cy) ** 2 * own).sum() / total
        blobs.append(_Blob((cx, cy), (across, down), total / own.max()))
    return blobs


def _lattice(
    at: Array, apart: Array, rough: float, shape: tuple[int, ...]
) -> tuple[float, float, float]:
    """Fit the lattice of dots, which a lens bends.

    Along x and y the lattice counts `plain` x + `more` x r^2, with r the distance from the middle
    over half the diagonal. It counts one more at the next dot, which gives one linear equation for
    each pair of neighbours.

    Args:
        at: Places (N, 2), pixels.
        apart: Distances (N, N), infinite on the diagonal.
        rough: A first guess of the step, pixels.
        shape: Of the image, (h, w, 3).

    Returns:
        Step in the middle, bend, and the spread of the steps, which is infinite for few.
    """
    place = at - np.array([shape[1], shape[0]]) / 2
    half = float(np.hypot(shape[0], shape[1])) / 2
    counted = np.stack([place, place * (place**2).sum(1)[:, None] / half**2], 2) / rough
    first, second = np.nonzero((apart > 0.75 * rough) & (apart < 1.25 * rough))
    steps = counted[second] - counted[first]
    equations = []
    for axis in range(2):
        along = steps[:, axis]
        # steps that go along this axis, forward
        is_along = along[:, 0] > 2 * np.abs(steps[:, 1 - axis, 0])
        equations.append(along[is_along])
    rows = np.concatenate(equations)
    spread = np.inf
    for _ in range(_IN_A_ROW):
        if len(rows) < FEWEST:
            return rough, 0.0, np.inf
        plain, more = np.linalg.lstsq(rows, np.ones(len(rows)), rcond=None)[0]
        left = np.abs(rows @ [plain, more] - 1)
        spread = float(np.sqrt((left**2).mean()))
        rows = rows[left <= 3 * np.median(left)]
    return rough / (plain + more), float(more / (plain + more)), spread


class DotFlow:
    """How the dots of a background have moved: dense optical flow of their ink.

    The flow is DIS (Kroeger et al. 2016). Of the whole image it would follow the colours of a
    press, so it sees the ink alone. The object is false if the image `gel` u8 (h, w, 3) shows no
    dots.
    """

    def __init__(self, gel: Array) -> None:
        small = scale_image(gel, LONG)
        self._dots = dots = _cached_dots(small.tobytes(), small.shape)
        if dots is not None:
            self._strong = dots.change >= _STRONG * dots.change.max()
            self._gel = self._ink(gel)
            # where a dot is
            inked = (self._gel > 60)[..., None].astype(np.float32)
            self._weight = np.repeat(inked, 2, -1)

    def __bool__(self) -> bool:
        return self._dots is not None

    def _ink(self, image: Array) -> Array:
        """Return the ink of dots u8 (h, w) at FLOW pixels: 160 in the middle of a dot, else 0."""
        assert self._dots is not None
        shown = np.ascontiguousarray(scale_image(image, FLOW)[..., self._strong])
        dark = _spots(shown, self._dots.sign, cv2.MORPH_RECT)
        levels = 160 / self._dots.change[self._strong]
        parts = [
            cv2.convertScaleAbs(one, None, level)
            for one, level in zip(cv2.split(dark), levels, strict=True)
        ]
        # A dot changes all of these colours at once, and a slope does not.
        return np.asarray(np.minimum.reduce(parts))

    def __call__(self, frame: Array, rows: int, columns: int) -> tuple[Array, Array]:
        """Return how the dots have moved, on a grid. Between dots it is the mean of those around.

        Args:
            frame: u8 (h, w, 3), of the proportions of the background.
            rows: Of the grid.
            columns: Of the grid.

        Returns:
            Shifts (rows, columns, 2) along x and y, and their standard deviations (rows, columns),
            both over the width of the image.
        """
        assert self._dots is not None
        height, width = self._gel.shape
        ink = cv2.resize(self._ink(frame), (width, height), interpolation=cv2.INTER_LINEAR)
        opencv.set_up()  # the flow depends on the number of threads
        # Any, because OpenCV's types do not know that there may be no first guess of the flow
        dis: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        # a third of the time, for half a point of direction
        dis.setFinestScale(2)
        flow = cv2.multiply(dis.calc(self._gel, ink, None), self._weight)
        # Weighted sums of shift, squared shift and weight around each place of the grid; then their
        # ratios are mean and spread over the dots there.
        square = cv2.transform(cv2.multiply(flow, flow), np.ones((1, 2), np.float32))
        sums = cv2.merge([*cv2.split(flow), square, self._weight[..., 0]])
        near = 0.5 * self._dots.pitch / LONG * max(height, width)
        sums = cv2.resize(sums, (columns, rows), interpolation=cv2.INTER_AREA)
        sums = cv2.GaussianBlur(
            sums, (0, 0), sigmaX=near * columns / width, sigmaY=near * rows / height
        )
        means = sums[..., :3] / np.maximum(sums[..., 3:], 1e-4)
        shift = means[..., :2]
        spread = np.sqrt(np.maximum(means[..., 2] - (shift**2).sum(-1), 0))
        return shift / width, (STEADY + UNSTEADY * spread) / width


@lru_cache(maxsize=16)
def _cached_dots(values: bytes, shape: tuple[int, ...]) -> Dots | None:
    """Return the dots of an image by its bytes, as each recording asks about the same few."""
    return find_dots(np.frombuffer(values, np.uint8).reshape(shape))
