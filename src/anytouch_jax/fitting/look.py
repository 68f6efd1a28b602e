"""What pictures of a sensor show by themselves: the untouched gel, presses, dots and noise. Lengths are in pixels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np

from anytouch_jax.data.gels import FEWEST, TINT, median
from anytouch_jax.data.prepare.untouched_gel import DIFFERENT, UntouchedGel, change_of_light, median_gel, scale_picture
from anytouch_jax.errors import UserError

Array = np.ndarray
LONG = 320  # pixels of the long side of a picture that is looked at
WORK = 96  # pixels of the long side on which the colour change is fitted
BASE = 40  # pixels of the long side of a stored untouched gel
FEWEST_DOTS = 12
IRREGULAR = 0.08  # spread of the steps from dot to dot that is no lattice
ANOTHER = 0.15  # share of the pictures that shows another unit
DARK = 14  # grey levels: the corners of a round picture
_CURVED = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6  # keeps the deviation of white noise


class Dots(NamedTuple):
    """Dots of the gel: the step and the bend of their lattice as in `Markers`, radius of a height, ink (3,) in 0..1."""

    pitch: float
    bend: float
    radius: float
    aspect: float
    ink: Array
    mask: Array  # bool (h, w), of the untouched gel
    sign: int  # 1 for dots that are darker than the gel, -1 for lighter ones
    change: Array  # (3,) grey levels by which a dot differs from the gel
    spread: float  # of the step, relative


class Seen(NamedTuple):
    """Pictures of one unit u8 (N, h, w, 3), its untouched gel, and the colour change f32 (N, H, W, 3) of the presses.

    `clear` bool (N, H, W) is where no dots hide the change, and no colour is at its limit.
    """

    frames: Array
    gel: Array
    pressed: Array  # bool (N,)
    change: Array
    clear: Array
    dots: Dots | None
    noise: float
    noise_spread: float  # relative, from picture to picture
    source: str  # of the untouched gel, in words


def see(pictures: Sequence[Array], background: Array | None = None) -> Seen:
    """Return what pictures RGB u8 (h, w, 3) of one unit show. Raises UserError for pictures that cannot be fitted."""
    frames = [_reduced(picture) for picture in pictures]
    if len(frames) < FEWEST:
        raise UserError(f"{len(frames)} pictures are too few to fit a sensor; take {FEWEST} or more, 20 are good")
    if len(shapes := {frame.shape for frame in frames}) > 1:
        raise UserError(f"the pictures have {len(shapes)} sizes; give those of one camera and one setting")
    _check_one_unit(frames)
    small = [scale_picture(frame) for frame in frames]
    if background is None:
        gel, source = median(frames), f"median of {len(frames)} pictures"
    else:
        gel, source = _reduced(background), "given"
        if abs(gel.shape[1] / gel.shape[0] / (frames[0].shape[1] / frames[0].shape[0]) - 1) > 0.02:
            raise UserError("the background has other proportions than the pictures; take it with the same camera")
        gel = cv2.resize(gel, frames[0].shape[1::-1], interpolation=cv2.INTER_AREA)
    _check_flat(gel)
    untouched = UntouchedGel(gel)
    pressed = np.array([untouched.score(frame) >= DIFFERENT for frame in frames])
    if not pressed.any():
        raise UserError("no picture shows a press; press objects of all kinds into the gel, at changing places")
    if background is None and median_gel(small) is None:
        raise UserError("every picture shows a press at the same place; name the untouched gel with --background")
    dots = find_dots(gel)
    noise, spread = _noise(np.stack(frames), gel, dots)
    change, clear = _changes([frames[i] for i in np.flatnonzero(pressed)], gel, dots)
    return Seen(np.stack(frames), gel, pressed, change, clear, dots, noise, spread, source)


def _reduced(picture: Array) -> Array:
    return picture if max(picture.shape[:2]) <= LONG else scale_picture(picture, LONG)


def _check_one_unit(frames: Sequence[Array]) -> None:
    """Raise UserError if a part of the pictures differs from the rest in most places, and not from each other."""
    small = np.stack([cv2.resize(one, (32, 24), interpolation=cv2.INTER_AREA).astype(np.float32) for one in frames])
    apart = np.array([np.median(np.abs(small - one), axis=(1, 2)).max(1) for one in small])
    near = apart <= TINT
    rest = np.flatnonzero(~near[np.argmax(near.sum(1))])
    enough = len(rest) >= max(2, ANOTHER * len(frames))
    if enough and near[np.ix_(rest, rest)].sum(1).max() >= max(2, 0.5 * len(rest)):
        raise UserError(
            f"{len(rest)} of {len(frames)} pictures differ from the others in most places, as if taken with another "
            "unit or in other light; fit each unit by itself"
        )


def _check_flat(gel: Array) -> None:
    """Raise UserError for a round picture: four black corners around a bright middle."""
    height, width = (side // 10 for side in gel.shape[:2])
    corners = [gel[rows, columns] for rows in (slice(height), slice(-height, None))
               for columns in (slice(width), slice(-width, None))]  # fmt: skip
    if max(float(corner.max(-1).mean()) for corner in corners) < DARK < gel[3 * height : -3 * height].mean() / 3:
        raise UserError(
            "the picture is round, so the sensor is not flat; a flat gel that fills the picture can be fitted"
        )


def find_dots(gel: Array) -> Dots | None:
    """Return the dots of an untouched gel u8 (h, w, 3), dark or light ones; None without a lattice of them."""
    found = [_dots_of(gel, sign) for sign in (1, -1)]
    return next((one for one in found if one is not None), None)


def _spots(picture: Array, sign: int) -> Array:
    """Return by how many grey levels (h, w, 3) small spots are darker (`sign` 1) or lighter than what is around."""
    shown, side = picture if sign > 0 else 255 - picture, 2 * round(0.045 * max(picture.shape[:2])) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    return np.asarray(cv2.subtract(cv2.morphologyEx(shown, cv2.MORPH_CLOSE, kernel), shown))


def _hidden(frame: Array, dots: Dots) -> Array:
    """Return where (h, w) dots hide the gel of a pressed frame u8 (h, w, 3), or hid it before they moved."""
    strong = dots.change >= 0.5 * dots.change.max()  # a dot changes these colours all at once, and a slope does not
    share = (_spots(frame, dots.sign)[..., strong] / dots.change[strong]).min(-1)
    return dots.mask | (cv2.dilate((share > 0.3).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def _dots_of(gel: Array, sign: int) -> Dots | None:
    long, depth = max(gel.shape[:2]), _spots(gel, sign)
    deep = cv2.GaussianBlur(depth.max(2).astype(np.float32), (0, 0), long / 320)
    strongest = float(np.percentile(deep, 99))
    _, labels, stats, _ = cv2.connectedComponentsWithStats((deep > max(8.0, 0.5 * strongest)).astype(np.uint8))
    places, moments, areas, centres = [], [], [], []
    for number, (x, y, w, h, area) in enumerate(stats[1:], 1):
        edge = min(x, y, gel.shape[1] - x - w, gel.shape[0] - y - h)
        if area < 4 or edge < 1 or w > 3.5 * h or h > 2.5 * w or area > (0.1 * long) ** 2:
            continue
        part = np.s_[max(y - 2, 0) : min(y + h + 2, gel.shape[0]), max(x - 2, 0) : min(x + w + 2, gel.shape[1])]
        own = deep[part] * np.isin(labels[part], (0, number))
        rows, columns = np.mgrid[part]
        total = own.sum()
        cy, cx = (rows * own).sum() / total, (columns * own).sum() / total
        places.append((cx, cy))
        moments.append((((columns - cx) ** 2 * own).sum() / total, ((rows - cy) ** 2 * own).sum() / total))
        areas.append(total / own.max())
        centres.append(gel[round(cy), round(cx)])
    if len(places) < FEWEST_DOTS:
        return None
    at = np.array(places)
    apart = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    rough = float(np.median(np.sort(apart, 1)[:, :2]))
    pitch, bend, spread = _lattice(at, apart, rough, gel.shape)
    if spread > IRREGULAR:
        return None
    blur = (long / 320) ** 2
    wide, tall = np.maximum(np.median(moments, 0) - blur, 0.05)
    aspect = float(np.clip(np.sqrt(wide / tall), 0.4, 3.5))
    area = float(np.median(areas))
    if len(places) * rough**2 < 0.35 * gel.shape[0] * gel.shape[1]:  # some specks, but no lattice
        return None
    grown = cv2.dilate((deep > max(6.0, 0.25 * strongest)).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    ink = np.median(np.array(centres), 0) / 255
    change = np.percentile(depth[grown], 80, axis=0)
    return Dots(pitch, bend, float(np.sqrt(area / (np.pi * aspect))), aspect, ink, grown, sign, change, spread)


def _lattice(at: Array, apart: Array, rough: float, shape: tuple[int, ...]) -> tuple[float, float, float]:
    """Return step and bend of the lattice of dots at places (N, 2), and the spread of its steps, infinite for few.

    Along x and y the lattice counts `plain` x + `more` x r^2 (see `Markers`), which is one more at the next dot.
    """
    place, half = at - np.array([shape[1], shape[0]]) / 2, float(np.hypot(shape[0], shape[1])) / 2
    counted = np.stack([place, place * (place**2).sum(1)[:, None] / half**2], 2) / rough
    first, second = np.nonzero((apart > 0.75 * rough) & (apart < 1.25 * rough))
    steps = counted[second] - counted[first]
    rows = np.concatenate([steps[:, i][steps[:, i, 0] > 2 * np.abs(steps[:, 1 - i, 0])] for i in range(2)])
    spread = np.inf
    for _ in range(3):
        if len(rows) < FEWEST_DOTS:
            return rough, 0.0, np.inf
        plain, more = np.linalg.lstsq(rows, np.ones(len(rows)), rcond=None)[0]
        left = np.abs(rows @ [plain, more] - 1)
        spread, rows = float(np.sqrt((left**2).mean())), rows[left <= 3 * np.median(left)]
    return rough / (plain + more), float(more / (plain + more)), spread


def _noise(frames: Array, gel: Array, dots: Dots | None) -> tuple[float, float]:
    """Return the deviation of a pixel from picture to picture where nothing presses, and its relative spread."""
    fine, calm = [], []
    for frame in frames:
        change = frame.astype(np.float32) - gel
        quiet = np.abs(cv2.GaussianBlur(change - change_of_light(change), (0, 0), 3)).max(2) < 2.0
        calm.append(quiet if dots is None else quiet & ~dots.mask)
        fine.append(cv2.filter2D(frame.astype(np.float32), -1, _CURVED))
    weight = np.stack(calm)[..., None].astype(np.float32)
    count = weight.sum(0)
    left = (np.stack(fine) - (np.stack(fine) * weight).sum(0) / np.maximum(count, 1)) * np.sqrt(
        count / np.maximum(count - 1, 1)
    )
    found = []
    for one, quiet in zip(left, np.stack(calm) & (count[..., 0] > 2), strict=True):
        if quiet.sum() > 100:
            values = one[quiet]
            most = 3 * max(1.4826 * float(np.median(np.abs(values))), 0.3)
            found.append(float(np.mean(np.clip(values, -most, most) ** 2)))
    if not found:
        return 1.0, 1.0
    deviations = np.sqrt(np.maximum(np.array(found) - 1 / 12, 0.01))  # of rounding
    return float(np.median(deviations)), float(np.std(deviations) / np.median(deviations))


def _changes(frames: Sequence[Array], gel: Array, dots: Dots | None) -> tuple[Array, Array]:
    """Return the colour changes f32 (N, H, W, 3) of presses in 0..1, without light and dots, and where they show."""
    height, width = gel.shape[:2]
    size = (round(width * WORK / max(height, width)), round(height * WORK / max(height, width)))
    changes, clear = [], []
    for frame in frames:
        weight = np.ones((height, width), np.float32)
        if dots is not None:
            weight[_hidden(frame, dots)] = 0
        share = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
        change = frame.astype(np.float32) - gel
        change -= change_of_light(change)
        small = cv2.resize(change * weight[..., None], size, interpolation=cv2.INTER_AREA)
        own = small / np.maximum(share, 1e-3)[..., None]
        if dots is not None:  # what the dots hide is as around them
            near = cv2.GaussianBlur(share, (0, 0), 2)
            around = cv2.GaussianBlur(small, (0, 0), 2) / np.maximum(near, 1e-3)[..., None]
            own = np.where(share[..., None] > 0.3, own, around)
        changes.append(own / 255)
        limited = weight * ((frame.min(2) < 3) | (frame.max(2) > 252))
        clear.append((share > 0.3) & (cv2.resize(limited, size, interpolation=cv2.INTER_AREA) < 0.1))
    return np.stack(changes), np.stack(clear)


def without_dots(seen: Seen) -> Array:
    """Return the untouched gel u8 (h, w, 3) of at most BASE pixels a side, with paint in the place of dots."""
    gel: Any = seen.gel
    if seen.dots is not None:
        gel = cv2.inpaint(gel, seen.dots.mask.astype(np.uint8), 3, cv2.INPAINT_TELEA)
    return scale_picture(cv2.GaussianBlur(gel, (0, 0), 1.5), BASE)
