"""Fit of your own sensor: from a few images to a folder NAME.sensor for the simulator.

`see` finds what the images show by themselves: the untouched gel, presses, dots and noise.
`fit_sensor` adds the colours by slope (`colour`), and writes the folder. Lengths of images are in
pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from anytouch_jax.config import FIELD_SENSORS, OWN_SENSOR, SENSORS, check_spelling
from anytouch_jax.data.background.dots import Dots, find_dots, hidden
from anytouch_jax.data.background.estimate import (
    DIFFERENT,
    UntouchedBackground,
    change_of_light,
    median_background,
    scale_image,
)
from anytouch_jax.data.background.rule import FEWEST, TINT, median, reduced
from anytouch_jax.errors import UserError
from anytouch_jax.sensors import RECORDS, Markers
from anytouch_jax.sim.fitting import colour
from anytouch_jax.sim.fitting.colour import Colour
from anytouch_jax.sim.sensing import own
from anytouch_jax.sim.sensing.own import MM, OwnSensor

Array = np.ndarray
WORK = 96  # pixels of the long side on which the colour change is fitted
BASE = 40  # pixels of the long side of a stored untouched gel
ANOTHER = 0.15  # fraction of the images that shows another unit
DARK = 14  # grey levels: the corners of a round image
# A filter that removes surfaces and keeps the deviation of white noise: its squares sum to one.
_CURVED = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32) / 6
NOT_FLAT = tuple(name for name, record in RECORDS.items() if not record.is_flat)


class Seen(NamedTuple):
    """What N images of one unit show, P of them presses."""

    frames: Array  # u8 (N, h, w, 3)
    gel: Array  # u8 (h, w, 3), untouched
    pressed: Array  # bool (N,)
    change: Array  # f32 (P, H, W, 3) colour change of the presses, 0..1
    clear: Array  # bool (P, H, W), where no dots hide it, and no colour is at its limit
    dots: Dots | None
    noise: float
    noise_spread: float  # relative, from image to image
    source: str  # of the untouched gel, in words


def see(images: Sequence[Array], background: Array | None = None) -> Seen:
    """Return what images RGB u8 (h, w, 3) of one unit show.

    Raises UserError for images that cannot be fitted.
    """
    frames = [reduced(image) for image in images]
    if len(frames) < FEWEST:
        raise UserError(
            f"{len(frames)} images are too few to fit a sensor; take {FEWEST} or more, 20 are good"
        )
    shapes = {frame.shape for frame in frames}
    if len(shapes) > 1:
        raise UserError(
            f"the images have {len(shapes)} sizes; give those of one camera and one setting"
        )
    _check_one_unit(frames)
    if background is None:
        gel = median(frames)
        source = f"median of {len(frames)} images"
    else:
        gel = _given(background, frames[0])
        source = "given"
    _check_flat(gel)
    untouched = UntouchedBackground(gel)
    pressed = np.array([untouched.score(frame) >= DIFFERENT for frame in frames])
    if not pressed.any():
        raise UserError(
            "no image shows a press; press objects of all kinds into the gel, at changing places"
        )
    # A median of presses at one place would hold the press.
    if background is None and median_background([scale_image(frame) for frame in frames]) is None:
        raise UserError(
            "every image shows a press at the same place; name the untouched gel with --background"
        )
    dots = find_dots(gel)
    noise, spread = _noise(np.stack(frames), gel, dots)
    change, clear = colour_changes([frames[i] for i in np.flatnonzero(pressed)], gel, dots)
    return Seen(np.stack(frames), gel, pressed, change, clear, dots, noise, spread, source)


def _given(background: Array, frame: Array) -> Array:
    """Return the background that the user names, in the size of a frame.

    Raises UserError for one of other proportions.
    """
    gel = reduced(background)
    height, width = frame.shape[:2]
    if abs(gel.shape[1] / gel.shape[0] / (width / height) - 1) > 0.02:
        raise UserError(
            "the background has other proportions than the images; take it with the same camera"
        )
    return cv2.resize(gel, (width, height), interpolation=cv2.INTER_AREA)


def _check_one_unit(frames: Sequence[Array]) -> None:
    """Raise UserError if the images are of two units.

    Then a part of them differs from the rest in most places, and its images not from each other.
    """
    thumbs = [cv2.resize(one, (32, 24), interpolation=cv2.INTER_AREA) for one in frames]
    small = np.stack(thumbs).astype(np.float32)
    # A press changes a part of an image, so the median over the places is that of the gels.
    apart = np.array([np.median(np.abs(small - one), axis=(1, 2)).max(1) for one in small])
    near = apart <= TINT
    rest = np.flatnonzero(~near[np.argmax(near.sum(1))])
    enough = len(rest) >= max(2, ANOTHER * len(frames))
    if enough and near[np.ix_(rest, rest)].sum(1).max() >= max(2, 0.5 * len(rest)):
        raise UserError(
            f"{len(rest)} of {len(frames)} images differ from the others in most places, as if "
            "taken with another unit or in other light; fit each unit by itself"
        )


def _check_flat(gel: Array) -> None:
    """Raise UserError for a round image: four black corners around a bright middle."""
    height, width = (side // 10 for side in gel.shape[:2])
    corners = [
        gel[rows, columns]
        for rows in (slice(height), slice(-height, None))
        for columns in (slice(width), slice(-width, None))
    ]
    brightest = max(float(corner.max(-1).mean()) for corner in corners)
    middle = gel[3 * height : -3 * height].mean()
    if brightest < DARK < middle / 3:
        raise UserError(
            "the image is round, so the sensor is not flat; a flat gel that fills the image "
            "can be fitted"
        )


class Fitted(NamedTuple):
    """A fitted sensor: its folder, its numbers, what the images show, and the colour change."""

    folder: Path
    numbers: OwnSensor
    seen: Seen
    colour: Colour


def check_name(name: str) -> None:
    """Raise UserError for the name of another sensor, or of one that cannot be fitted."""
    word = name.lower().replace("-", "_").replace(" ", "_")
    if word in FIELD_SENSORS:
        raise UserError(
            f"{name} measures a field and has no camera; a sensor with a camera can be fitted"
        )
    if word in NOT_FLAT:
        raise UserError(f"{name} is not flat; a flat gel that fills the image can be fitted")
    if word in SENSORS:
        raise UserError(
            f"{name} is a sensor of the table; give yours another name, such as my_{word}"
        )
    if not word.isidentifier() and not word.replace("_", "").isalnum():
        raise UserError(f"the name {name!r} must be letters, digits and _")
    check_spelling(name)


def fit_sensor(
    images: Sequence[np.ndarray],
    name: str,
    width_mm: float,
    out: str | Path,
    *,
    background: np.ndarray | None = None,
    ball_mm: float | None = None,
) -> Fitted:
    """Fit a sensor to images of one unit, and write its folder.

    Args:
        images: RGB u8 (h, w, 3).
        name: Of the sensor.
        width_mm: Width of the gel that an image shows.
        out: The folder, NAME.sensor.
        background: The untouched gel; without it, the median of the images.
        ball_mm: Diameter of the ball, if all presses are of one. Its slopes are known, so the
            strength of the colours and the thickness of the gel are found too.

    Raises:
        UserError: For images that cannot be fitted, and for a folder whose numbers were edited.
    """
    check_name(name)
    if Path(out).suffix != OWN_SENSOR:
        raise UserError(f"{out} must end in {OWN_SENSOR}; choose another --out")
    own.check_unedited(out)
    height, width = images[0].shape[:2]
    height_mm = width_mm * height / width
    if not all(MM.low <= side <= MM.high for side in (width_mm, height_mm)):
        raise UserError(
            f"an image of {width} x {height} pixels that is {width_mm:g} mm wide shows "
            f"{width_mm:g} x {height_mm:.3g} mm; the sides of a gel are {MM.words}. Check "
            "--width-mm."
        )
    if ball_mm is not None and not 1 <= ball_mm <= 40:
        raise UserError(f"a ball of {ball_mm:g} mm cannot be used; take one of 3 to 12 mm")
    seen = see(images, background)
    if ball_mm is None:
        found = colour.fit_presses(seen.change, seen.clear)
    else:
        found = colour.fit_balls(seen.change, seen.clear, width_mm, ball_mm)
    pixel = width_mm / seen.gel.shape[1]
    numbers = OwnSensor(
        name,
        float(width_mm),
        round(height_mm, 4),
        (height, width),
        round(seen.noise, 3),
        None if seen.dots is None else _markers(seen.dots, pixel),
        thickness_mm=found.thickness,
        halo_mm=found.halo,
        sure=_sure(seen, found, with_ball=ball_mm is not None),
    )
    folder = own.write_sensor(out, numbers, without_dots(seen)[None], found.look)
    return Fitted(folder, numbers, seen, found)


def _markers(dots: Dots, pixel: float) -> Markers:
    """Return dots in mm, with `pixel` mm a pixel."""
    red, green, blue = (round(float(value), 3) for value in dots.ink)
    return Markers(
        pitch=round(dots.pitch * pixel, 4),
        radius=round(dots.radius * pixel, 4),
        aspect=round(dots.aspect, 3),
        fraction=1.0,
        ink=(red, green, blue),
        bend=round(dots.bend, 4),
    )


def _sure(seen: Seen, found: Colour, *, with_ball: bool) -> dict[str, str]:
    """Return how each part of a sensor was found, and how sure it is, in words."""
    if seen.dots is None:
        dots = "none seen"
    else:
        dots = f"steps from dot to dot {seen.dots.spread:.1%} around the lattice"
    return {
        "images": f"{len(seen.frames)}, of which {int(seen.pressed.sum())} show a press",
        "untouched gel": f"{seen.source}; its lights and vignette are in it",
        "dots": dots,
        "noise": f"{seen.noise_spread:.0%} from image to image",
        "colour": f"explains {found.explained:.0%} of the change, from {found.source}",
        "size": "as given",
        "thickness_mm, halo_mm": "the best of a few" if with_ball else "not seen",
        "modulus_kpa, skin_mm": "not seen in images: usual values, edit what you know",
    }


def _noise(frames: Array, gel: Array, dots: Dots | None) -> tuple[float, float]:
    """Return the standard deviation of a pixel where nothing presses, and its relative spread.

    Both are from image to image.
    """
    fine = []
    calm = []
    for frame in frames:
        change = frame.astype(np.float32) - gel
        quiet = np.abs(cv2.GaussianBlur(change - change_of_light(change), (0, 0), 3)).max(2) < 2.0
        calm.append(quiet if dots is None else quiet & ~dots.mask)
        fine.append(cv2.filter2D(frame.astype(np.float32), -1, _CURVED))
    weight = np.stack(calm)[..., None].astype(np.float32)
    count = weight.sum(0)
    # The fixed pattern of camera and gel is no noise. It is the mean over the calm images, which
    # takes a part of the noise with it: hence the factor of an unbiased variance.
    mean = (np.stack(fine) * weight).sum(0) / np.maximum(count, 1)
    left = (np.stack(fine) - mean) * np.sqrt(count / np.maximum(count - 1, 1))
    found = []
    for one, quiet in zip(left, np.stack(calm) & (count[..., 0] > 2), strict=True):
        if quiet.sum() > 100:
            values = one[quiet]
            # Three deviations, by the median: specks and edges are no noise.
            most = 3 * max(1.4826 * float(np.median(np.abs(values))), 0.3)
            found.append(float(np.mean(np.clip(values, -most, most) ** 2)))
    if not found:
        return 1.0, 1.0
    # Rounding to whole grey levels adds a variance of 1/12.
    deviations = np.sqrt(np.maximum(np.array(found) - 1 / 12, 0.01))
    return float(np.median(deviations)), float(np.std(deviations) / np.median(deviations))


def colour_changes(
    frames: Sequence[Array], gel: Array, dots: Dots | None, long_side: int = WORK
) -> tuple[Array, Array]:
    """Return the colour changes of presses in 0..1, and where they show.

    A change of the light, which is a plane for each colour, is removed, and so are the dots.

    Args:
        frames: N images RGB u8 (h, w, 3).
        gel: the untouched gel, of the same size.
        dots: those of the gel.
        long_side: pixels H or W of the result.

    Returns:
        f32 (N, H, W, 3) and bool (N, H, W).
    """
    height, width = gel.shape[:2]
    shrink = long_side / max(height, width)
    size = (round(width * shrink), round(height * shrink))
    changes = []
    clear = []
    for frame in frames:
        weight = np.ones((height, width), np.float32)
        if dots is not None:
            weight[hidden(frame, dots)] = 0
        # Averages over the pixels that no dot hides.
        fraction = cv2.resize(weight, size, interpolation=cv2.INTER_AREA)
        change = frame.astype(np.float32) - gel
        change -= change_of_light(change)
        small = cv2.resize(change * weight[..., None], size, interpolation=cv2.INTER_AREA)
        own = small / np.maximum(fraction, 1e-3)[..., None]
        if dots is not None:  # what the dots hide is as around them
            near = cv2.GaussianBlur(fraction, (0, 0), 2)
            around = cv2.GaussianBlur(small, (0, 0), 2) / np.maximum(near, 1e-3)[..., None]
            own = np.where(fraction[..., None] > 0.3, own, around)
        changes.append(own / 255)
        limited = weight * ((frame.min(2) < 3) | (frame.max(2) > 252))
        clear.append(
            (fraction > 0.3) & (cv2.resize(limited, size, interpolation=cv2.INTER_AREA) < 0.1)
        )
    return np.stack(changes), np.stack(clear)


def without_dots(seen: Seen) -> Array:
    """Return the untouched gel u8 (h, w, 3) of at most BASE pixels a side, without its dots."""
    gel: Any = seen.gel
    if seen.dots is not None:
        gel = cv2.inpaint(gel, seen.dots.mask.astype(np.uint8), 3, cv2.INPAINT_TELEA)
    return scale_image(cv2.GaussianBlur(gel, (0, 0), 1.5), BASE)
