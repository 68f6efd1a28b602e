"""Dots of a gel: where they are on its picture, what they hide, and how they move."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from anytouch_jax.data.background.estimate import scale_picture

Array = npt.NDArray[Any]
# pixels of the long side of a picture in which dots are found, and of one in which they move
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


class Dots(NamedTuple):
    """Dots of the gel: the step and the bend of their lattice as in `Markers`, radius of a height,
    ink (3,) in 0..1.
    """

    pitch: float
    bend: float
    radius: float
    aspect: float
    ink: Array
    mask: Array  # bool (h, w), of the untouched gel
    sign: int  # 1 for dots that are darker than the gel, -1 for lighter ones
    change: Array  # (3,) grey levels by which a dot differs from the gel
    spread: float  # of the step, relative


def find_dots(gel: Array) -> Dots | None:
    """Return the dots of an untouched gel u8 (h, w, 3), dark or light ones; None without a lattice
    of them.
    """
    found = [_dots_of(gel, sign) for sign in (1, -1)]
    return next((one for one in found if one is not None), None)


def _spots(picture: Array, sign: int, shape: int = cv2.MORPH_ELLIPSE) -> Array:
    """Return by how many grey levels (h, w, 3) small spots are darker (`sign` 1) or lighter than
    what is around.
    """
    shown = picture if sign > 0 else 255 - picture
    side = 2 * round(0.045 * max(picture.shape[:2])) + 1
    kernel = cv2.getStructuringElement(shape, (side, side))
    return np.asarray(cv2.subtract(cv2.morphologyEx(shown, cv2.MORPH_CLOSE, kernel), shown))


def hidden(frame: Array, dots: Dots) -> Array:
    """Return where (h, w) dots hide the gel of a pressed frame u8 (h, w, 3), or hid it before they
    moved.
    """
    # a dot changes these colours all at once, and a slope does not
    strong = dots.change >= 0.5 * dots.change.max()
    share = (_spots(frame, dots.sign)[..., strong] / dots.change[strong]).min(-1)
    return dots.mask | (cv2.dilate((share > 0.3).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def _dots_of(gel: Array, sign: int) -> Dots | None:
    long = max(gel.shape[:2])
    depth = _spots(gel, sign)
    deep = cv2.GaussianBlur(depth.max(2).astype(np.float32), (0, 0), long / LONG)
    strongest = float(np.percentile(deep, 99))
    _, labels, stats, _ = cv2.connectedComponentsWithStats(
        (deep > max(8.0, 0.5 * strongest)).astype(np.uint8)
    )
    places = []
    moments = []
    areas = []
    centres = []
    for number, (x, y, w, h, area) in enumerate(stats[1:], 1):
        edge = min(x, y, gel.shape[1] - x - w, gel.shape[0] - y - h)
        if area < 4 or edge < 1 or w > 3.5 * h or h > 2.5 * w or area > (0.1 * long) ** 2:
            continue
        part = np.s_[
            max(y - 2, 0) : min(y + h + 2, gel.shape[0]),
            max(x - 2, 0) : min(x + w + 2, gel.shape[1]),
        ]
        own = deep[part] * np.isin(labels[part], (0, number))
        rows, columns = np.mgrid[part]
        total = own.sum()
        cy = (rows * own).sum() / total
        cx = (columns * own).sum() / total
        places.append((cx, cy))
        moments.append(
            (((columns - cx) ** 2 * own).sum() / total, ((rows - cy) ** 2 * own).sum() / total)
        )
        areas.append(total / own.max())
        centres.append(gel[round(cy), round(cx)])
    if len(places) < FEWEST:
        return None
    at = np.array(places)
    apart = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    rough = float(np.median(np.sort(apart, 1)[:, :2]))
    pitch, bend, spread = _lattice(at, apart, rough, gel.shape)
    inked = deep > max(6.0, 0.25 * strongest)
    change = np.percentile(depth[inked], 80, axis=0)
    if spread > IRREGULAR or change.max() < FAINT:
        return None
    blur = (long / LONG) ** 2
    wide, tall = np.maximum(np.median(moments, 0) - blur, 0.05)
    aspect = float(np.clip(np.sqrt(wide / tall), 0.4, 3.5))
    area = float(np.median(areas))
    if len(places) * rough**2 < 0.35 * gel.shape[0] * gel.shape[1]:  # some specks, but no lattice
        return None
    grown = cv2.dilate(inked.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    ink = np.median(np.array(centres), 0) / 255
    return Dots(
        pitch,
        bend,
        float(np.sqrt(area / (np.pi * aspect))),
        aspect,
        ink,
        grown,
        sign,
        change,
        spread,
    )


def _lattice(
    at: Array, apart: Array, rough: float, shape: tuple[int, ...]
) -> tuple[float, float, float]:
    """Return step and bend of the lattice of dots at places (N, 2), and the spread of its steps,
    infinite for few.

    Along x and y the lattice counts `plain` x + `more` x r^2 (see `Markers`), which is one more at
    the next dot.
    """
    place = at - np.array([shape[1], shape[0]]) / 2
    half = float(np.hypot(shape[0], shape[1])) / 2
    counted = np.stack([place, place * (place**2).sum(1)[:, None] / half**2], 2) / rough
    first, second = np.nonzero((apart > 0.75 * rough) & (apart < 1.25 * rough))
    steps = counted[second] - counted[first]
    rows = np.concatenate(
        [steps[:, i][steps[:, i, 0] > 2 * np.abs(steps[:, 1 - i, 0])] for i in range(2)]
    )
    spread = np.inf
    for _ in range(3):
        if len(rows) < FEWEST:
            return rough, 0.0, np.inf
        plain, more = np.linalg.lstsq(rows, np.ones(len(rows)), rcond=None)[0]
        left = np.abs(rows @ [plain, more] - 1)
        spread = float(np.sqrt((left**2).mean()))
        rows = rows[left <= 3 * np.median(left)]
    return rough / (plain + more), float(more / (plain + more)), spread


class DotFlow:
    """How the dots of an untouched gel have moved: dense optical flow of their ink (DIS, Kroeger et
    al. 2016).

    It is false if the picture `gel` u8 (h, w, 3) shows no dots.
    """

    def __init__(self, gel: Array) -> None:
        small = scale_picture(gel, LONG)
        self._dots = dots = _cached_dots(small.tobytes(), small.shape)
        if dots is not None:
            self._strong = dots.change >= 0.5 * dots.change.max()
            self._gel = self._ink(gel)
            self._weight = np.repeat((self._gel > 60)[..., None].astype(np.float32), 2, -1)

    def __bool__(self) -> bool:
        return self._dots is not None

    def _ink(self, picture: Array) -> Array:
        assert self._dots is not None
        shown = np.ascontiguousarray(scale_picture(picture, FLOW)[..., self._strong])
        dark = _spots(shown, self._dots.sign, cv2.MORPH_RECT)
        levels = 160 / self._dots.change[self._strong]
        parts = [
            cv2.convertScaleAbs(one, None, level)
            for one, level in zip(cv2.split(dark), levels, strict=True)
        ]
        return np.asarray(np.minimum.reduce(parts))

    def __call__(self, frame: Array, rows: int, columns: int) -> tuple[Array, Array]:
        """Return shifts (rows, columns, 2) along x and y and their deviations (rows, columns), in
        shares of the width.

        `frame` u8 (h, w, 3) has the proportions of the gel's picture. Between dots a shift is the
        mean of those around.
        """
        assert self._dots is not None
        height, width = self._gel.shape
        ink = cv2.resize(self._ink(frame), (width, height), interpolation=cv2.INTER_LINEAR)
        dis: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        # a third of the time, for half a point of direction
        dis.setFinestScale(2)
        flow = cv2.multiply(dis.calc(self._gel, ink, None), self._weight)
        square = cv2.transform(cv2.multiply(flow, flow), np.ones((1, 2), np.float32))
        sums = cv2.merge([*cv2.split(flow), square, self._weight[..., 0]])
        near = 0.5 * self._dots.pitch / LONG * max(height, width)
        sums = cv2.resize(sums, (columns, rows), interpolation=cv2.INTER_AREA)
        sums = cv2.GaussianBlur(
            sums, (0, 0), sigmaX=near * columns / width, sigmaY=near * rows / height
        )
        means = sums[..., :3] / np.maximum(sums[..., 3:], 1e-4)
        spread = np.sqrt(np.maximum(means[..., 2] - (means[..., :2] ** 2).sum(-1), 0))
        return means[..., :2] / width, (STEADY + UNSTEADY * spread) / width


@lru_cache(maxsize=16)
def _cached_dots(values: bytes, shape: tuple[int, ...]) -> Dots | None:
    return find_dots(np.frombuffer(values, np.uint8).reshape(shape))
