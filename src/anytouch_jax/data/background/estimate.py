"""Estimates of the background image (the untouched gel) from the frames of a recording.

Frames of the untouched gel are alike, and have less structure than frames in which something
presses. The estimate is the group of alike frames that has less structure than all frames that
differ from it, however long the press lasts. Where no group stands out, or it shows a light press
itself, the background cannot be known from the frames.

All lengths are in pixels of an image with LONG_SIDE pixels on its long side, see `scale_image`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import cv2
import numpy as np

from anytouch_jax.data import opencv

LONG_SIDE = 160  # pixels of the long side on which all lengths below are measured
# widest marker dot, its darkness in grey levels, dots that a marked gel shows
DOT = 13
DOT_DEPTH = 12
FEWEST_DOTS = 20
# of the difference image: blur, cut edge, score
BLUR = 1.5
EDGE = 4
PERCENTILE = 98
FIT = 12  # cells of a side of the difference image, to which a change of light is fitted
WIDE = 8  # blur of the gel's slow changes of light
# grey levels: frames of one state, and frames of two
ALIKE = 3.0
DIFFERENT = 6.5
# least excess of structure, as a fraction of the sum; measured on real and simulated recordings
MARGIN = 0.1

# of the largest part of contact, and of the image: less than that is noise
_ISLAND = 0.1
_SPECK = 2e-4
_TAKEN = 0.95  # fraction of a change that takes edges away, see `holds_press`
_FITTING = 0.6  # fraction of the cells that a change of light is fitted to
_AT = (np.arange(FIT, dtype=np.float32) + 0.5) / FIT - 0.5
# The terms 1, x and y of a plane, in each cell.
_TERMS = np.stack([np.ones(FIT * FIT, np.float32), np.tile(_AT, FIT), np.repeat(_AT, FIT)], 1)


def scale_image(image: np.ndarray, long_side: int = LONG_SIDE) -> np.ndarray:
    """Scale an image to `long_side` pixels on its long side."""
    opencv.set_up()
    height, width = image.shape[:2]
    shrink = long_side / max(height, width)
    size = max(1, round(width * shrink)), max(1, round(height * shrink))
    interpolation = cv2.INTER_AREA if shrink < 1 else cv2.INTER_LINEAR
    return cv2.resize(image, size, interpolation=interpolation)


def close_dots(image: np.ndarray) -> np.ndarray:
    """Fill dark dots and thin dark lines, which shear moves without any change of contact."""
    return cv2.morphologyEx(
        image, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (DOT, DOT))
    )


def has_dots(image: np.ndarray) -> bool:
    """Return whether a scaled image of the untouched gel shows marker dots."""
    depth = cv2.GaussianBlur(cv2.subtract(close_dots(image), image).max(2), (0, 0), 1)
    _, _, stats, _ = cv2.connectedComponentsWithStats((depth > DOT_DEPTH).astype(np.uint8))
    # the first component is the ground
    _, _, width, height, area = stats[1:].T
    is_dot_sized = (area >= 4) & (area <= DOT * DOT)
    is_round = (width <= 2.5 * height) & (height <= 2.5 * width)
    return int(np.sum(is_dot_sized & is_round)) >= FEWEST_DOTS


def difference_image(frame: np.ndarray, background: np.ndarray, blur: float = BLUR) -> np.ndarray:
    """Return the colour difference of two images, without light, tint and noise.

    Args:
        frame: u8 (h, w, 3).
        background: u8 (h, w, 3).
        blur: Standard deviation of the blur, pixels.

    Returns:
        f32 (h, w), the largest difference of the three colours, in grey levels.
    """
    change = cv2.subtract(frame, background, dtype=cv2.CV_32F)
    change -= change_of_light(change)
    red, green, blue = cv2.split(np.abs(cv2.GaussianBlur(change, (0, 0), blur)))
    return cv2.max(cv2.max(red, green), blue)


def change_of_light(change: np.ndarray) -> np.ndarray:
    """Return the part of a change f32 (h, w, 3) that lamps make: a plane for each colour.

    Lamps drift, and all of the image with them. A press covers little of it, so the plane is
    fitted again and again to those 60 % of the cells that it fits best (least trimmed squares).
    """
    small = cv2.resize(change, (FIT, FIT), interpolation=cv2.INTER_AREA).reshape(-1, 3)
    most = int(_FITTING * len(small))
    fits = np.arange(len(small))
    for _ in range(3):
        chosen = _TERMS[fits]
        plane = np.linalg.solve(chosen.T @ chosen, chosen.T @ small[fits])
        residual = np.abs(small - _TERMS @ plane).max(1)
        fits = np.argpartition(residual, most)[:most]
    height, width = change.shape[:2]
    y = ((np.arange(height, dtype=np.float32) + 0.5) / height - 0.5)[:, None]
    x = ((np.arange(width, dtype=np.float32) + 0.5) / width - 0.5)[:, None]
    return np.asarray((plane[0] + y * plane[2])[:, None] + x * plane[1], np.float32)


class UntouchedBackground:
    """A background u8 (h, w, 3), which scores frames.

    Dots are closed only on a gel that has some, because closing takes small contacts away too.
    """

    def __init__(self, image: np.ndarray) -> None:
        self.image = scale_image(image)
        self.has_dots = has_dots(self.image)
        self._compared = close_dots(self.image) if self.has_dots else self.image

    def score(self, frame: np.ndarray) -> float:
        """Return the difference, 0 to 255, of a frame u8 (h, w, 3) from the gel.

        Raises ValueError for its shape.
        """
        return contact_score(self.difference(frame))

    def difference(self, frame: np.ndarray) -> np.ndarray:
        """Return the difference image f32 (h, w) of a frame at the gel's size.

        Raises ValueError as `score`.
        """
        frame = scale_image(frame)
        sides = zip(frame.shape, self.image.shape, strict=True)
        if max(abs(a - b) for a, b in sides) > 2:
            raise ValueError("its background has other proportions")
        if min(frame.shape[:2]) <= 2 * EDGE:
            raise ValueError("it is too thin a strip")
        if frame.shape != self.image.shape:
            frame = cv2.resize(frame, self.image.shape[1::-1])
        if self.has_dots:
            frame = close_dots(frame)
        return difference_image(frame, self._compared)


def estimate_background_image(
    images: Sequence[np.ndarray],
) -> tuple[UntouchedBackground | None, str]:
    """Return the background of scaled frames u8 (h, w, 3) of one recording, and the reason.

    It is None if the frames do not show it.
    """
    group, reason = free_frames(images)
    if group is None:
        return None, reason
    return UntouchedBackground(_median([images[i] for i in group])), "estimated"


def free_frames(images: Sequence[np.ndarray]) -> tuple[np.ndarray | None, str]:
    """Return the numbers of the frames that show the untouched gel, or None and the reason.

    `images` are scaled frames u8 (h, w, 3) of one recording.
    """
    reason = ""
    # Dots are structure, and move with shear. Whether the gel has some is known only once the free
    # frames are found, so both are tried, and the answer must agree with what was assumed.
    for marked in (False, True):
        frames = [close_dots(image) for image in images] if marked else list(images)
        group, reason = _least_structured_group(frames)
        if group is None:
            continue
        if has_dots(_median([images[i] for i in group])) == marked:
            return group, ""
        reason = "free and pressed gel look alike"
    return None, reason


def median_background(images: Sequence[np.ndarray]) -> UntouchedBackground | None:
    """Return the median of frames of one sensor instance, if it shows the untouched gel.

    It is None if it shows a press, or if all frames are alike and may be pressed.
    """
    if not len(images):
        return None
    free = _median(images)
    others = [image for image in images if _distance(free, image) >= DIFFERENT]
    if not others or np.median([_press_of(free, other) for other in others]) >= ALIKE:
        return None
    return UntouchedBackground(free)


def background_of_unit(backgrounds: Sequence[UntouchedBackground]) -> UntouchedBackground | None:
    """Return the background that most estimates of one sensor instance agree on.

    It is None if fewer than two do, or as many on another.
    """
    if len(backgrounds) < 2:
        return None
    groups = _alike([gel.score(other.image) for gel, other in combinations(backgrounds, 2)])
    groups.sort(key=len, reverse=True)
    first = groups[0]
    if len(first) < 2:
        return None
    centre = UntouchedBackground(_median([backgrounds[i].image for i in first]))
    for group in groups[1:]:
        if len(group) < len(first):
            continue
        rival = UntouchedBackground(_median([backgrounds[i].image for i in group]))
        if centre.score(rival.image) >= ALIKE:
            return None
    return centre


def _median(images: Sequence[np.ndarray]) -> np.ndarray:
    return np.asarray(np.median(images, axis=0)).astype(np.uint8)


def _alike(distances: Sequence[float]) -> list[np.ndarray]:
    """Return groups of numbers within ALIKE of each other, from condensed distances.

    Complete linkage: all pairs of a group are alike. With single linkage a press that grows slowly
    would join the free frames.
    """
    # 0.3 s, which training has no use for
    from scipy.cluster.hierarchy import fcluster, linkage

    labels = fcluster(linkage(np.asarray(distances), "complete"), ALIKE, "distance")
    return [np.flatnonzero(labels == label) for label in np.unique(labels)]


def _least_structured_group(frames: list[np.ndarray]) -> tuple[np.ndarray | None, str]:
    """Return the numbers of the frames that have less structure than all that differ from them."""
    # Half the size, and half the blur: a quarter of the time for the many pairs.
    halves = [
        cv2.resize(frame, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA) for frame in frames
    ]
    distances = [_distance(frame, other, BLUR / 2) for frame, other in combinations(halves, 2)]
    if not distances:
        return None, "fewer than two frames can be read"
    if max(distances) < DIFFERENT:
        return None, "all frames are alike: always free, or always pressed"
    groups = _alike(distances)
    centres = [_median([frames[i] for i in group]) for group in groups]
    best = None
    best_margin = MARGIN
    for group, centre in zip(groups, centres, strict=True):
        if len(group) < 2:
            continue
        margin = _least_excess(centre, centres, best_margin)
        # infinite if no other group differs from it
        if best_margin <= margin < np.inf:
            best = group
            best_margin = margin
    if best is None:
        return None, "no frames stand out as the untouched gel"
    free = _median([frames[i] for i in best])
    presses = [_press_of(free, other) for other in centres if _distance(free, other) >= DIFFERENT]
    # Measured: below 0.5 for untouched gel, 3 for a faint touch (score 5), 11 for a bar that is
    # pressed all the time.
    if np.median(presses) >= ALIKE:
        return None, "the frames with the least structure are pressed themselves"
    return best, ""


def _least_excess(centre: np.ndarray, centres: Sequence[np.ndarray], enough: float) -> float:
    """Return the least excess of structure over `centre` of all that differ from it.

    The search ends once it is below `enough`, as the group is out then.
    """
    margin = np.inf
    for other in centres:
        if _distance(centre, other) >= DIFFERENT:
            margin = min(margin, _excess_structure(centre, other))
            if margin < enough:
                break
    return margin


def _distance(frame: np.ndarray, other: np.ndarray, blur: float = BLUR) -> float:
    return contact_score(difference_image(frame, other, blur), round(EDGE * blur / BLUR))


def without_islands(mask: np.ndarray) -> np.ndarray:
    """Return a mask of contact u8 or bool (h, w) without what is noise to the eye.

    The largest part stays. Others go if they are less than a tenth of it and lie at the border,
    where gels curl and lenses blur, or if they are specks.
    """
    count, labels, about, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if count <= 2:
        return mask
    area = about[:, cv2.CC_STAT_AREA].astype(np.float64)
    area[0] = 0.0  # what is not contact
    left = about[:, cv2.CC_STAT_LEFT]
    top = about[:, cv2.CC_STAT_TOP]
    right = left + about[:, cv2.CC_STAT_WIDTH]
    bottom = top + about[:, cv2.CC_STAT_HEIGHT]
    height, width = mask.shape
    at_border = (left == 0) | (top == 0) | (right == width) | (bottom == height)
    small = area < _ISLAND * area.max()
    keep = ~(small & at_border) & (area >= _SPECK * mask.size)
    keep[int(np.argmax(area))] = True
    keep[0] = False
    return keep[labels].astype(mask.dtype)


def contact_score(difference: np.ndarray, edge: int = EDGE) -> float:
    """Return the contact score of a difference image (h, w), without its edges.

    A percentile, not the maximum: single pixels are noise. And not the mean: a small press covers a
    few per cent of the gel.
    """
    return float(np.percentile(difference[edge:-edge, edge:-edge], PERCENTILE))


def _excess_structure(free: np.ndarray, pressed: np.ndarray) -> float:
    """Return how much more edges `pressed` has where the two differ, -1 to 1."""
    region = _changed(free, pressed)
    less = _edges(free, region)
    more = _edges(pressed, region)
    return (more - less) / (more + less + 1e-6)


def _edges(image: np.ndarray, region: np.ndarray) -> float:
    """Return the sum of the strengths of the edges in a region bool (h, w)."""
    gradient = _gradient(_smooth(image))[region]
    return float(np.sqrt((gradient**2).sum(1)).sum())


def _press_of(free: np.ndarray, pressed: np.ndarray) -> float:
    """Return the score of the press that `free` shows itself.

    A press that gets deeper strengthens edges that are there already. Edges of the untouched gel
    are others. So the fraction of the change that is along the edges of `free` (a projection),
    times the score of the change, is what was there before.
    """
    region = _changed(free, pressed)
    before = _gradient(_smooth(free) - _smooth(free, WIDE))[region]
    after = _gradient(_smooth(pressed) - _smooth(pressed, WIDE))[region]
    change = after - before
    along = float((before * change).sum() / ((change**2).sum() + 1e-6))
    return _distance(free, pressed) * along


def holds_press(background: np.ndarray, frame: np.ndarray) -> bool:
    """Return whether a background image shows a press that a frame lacks, u8 (h, w, 3) both.

    Then the frame's change takes edges of the background away: 97 to 100 % of it does where a real
    press was taken as the background, and the frame is free. Of presses beside their own background
    at most 4 % does, but up to 94 % on gels with dots, which move. So it takes nearly all.
    """
    free = scale_image(background)
    pressed = scale_image(frame)
    if pressed.shape != free.shape or has_dots(free) or has_dots(pressed):
        return False
    score = _distance(free, pressed)
    return score >= DIFFERENT and _press_of(free, pressed) < -_TAKEN * score


def _changed(free: np.ndarray, pressed: np.ndarray) -> np.ndarray:
    """Return where two images differ, bool (h, w)."""
    change = difference_image(free, pressed)
    region = change > max(0.35 * float(np.percentile(change, 99)), 1.0)
    return np.asarray(cv2.dilate(region.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0)


def _smooth(image: np.ndarray, blur: float = BLUR) -> np.ndarray:
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur))


def _gradient(image: np.ndarray) -> np.ndarray:
    """Return the colour gradient, f32 (h, w, 6)."""
    sides = [cv2.Sobel(image, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=0.125) for dx in (1, 0)]
    return np.concatenate(sides, axis=2)
