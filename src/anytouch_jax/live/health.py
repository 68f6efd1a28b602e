"""Health of sensors: layout, exposure, focus, frozen frames, drift, wear, background, contact.

A check reads some recordings of a unit and gives a value, a limit and what to do. The limits were
set on real units in good order (`experiments/real/trust.py`). Images are compared at 160 pixels
on the long side.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from anytouch_jax.data.background.contact import DEFAULT_THRESHOLD, THRESHOLDS, spread
from anytouch_jax.data.background.estimate import (
    DOT_DEPTH,
    UntouchedBackground,
    has_dots,
    scale_image,
)

# Some of these names were defined here, and are asked for here.
from anytouch_jax.data.background.layout import (  # noqa: F401
    ORIENTATION,
    Check,
    UnitFrames,
    check_layout,
    known_backgrounds,
    small_look,
)
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest.manifest import Manifest, group_rows
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.errors import UserError

RECORDINGS = 24  # that are read of a unit
FRAMES = 6  # that are read of a recording
# What sensors in good order stay within. Units are those of the checks' values: fractions, grey
# levels, or pixels of an image of 160.
LIMITS = {
    "orientation": ORIENTATION,
    "exposure": 0.25,
    "focus": 0.5,
    "detail": 0.7,
    "frozen": 0.02,
    "dropped": 0.01,
    "tint": 0.20,
    "dead pixels": 0.0,
    "scratch": 12.0,
    "scratch length": 36.0,
    "background": 20.0,
    "two units": 16.0,
}
_FRACTION = 0.25  # of recordings that look like another unit
_ALIKE = 0.6  # distance within another unit, as a fraction of that between the two
_DOTS = 21  # pixels of the widest marker dots, at 160 pixels
_FEWEST = 4  # recordings from which a fixed pattern is judged


@dataclass(frozen=True, eq=False)
class UnitHealth:
    """The checks of a unit, and its usual image."""

    sensor: str
    unit: str
    rows: int
    checks: tuple[Check, ...]
    image: Array

    @property
    def faults(self) -> tuple[Check, ...]:
        """The checks that failed."""
        return tuple(check for check in self.checks if check.ok is False)

    @property
    def verdict(self) -> str:
        """Return "good", or the names of the faults."""
        return ", ".join(check.name for check in self.faults) or "good"


def read_units(manifest: Manifest) -> Iterator[UnitFrames]:
    """Yield the frames of each unit of a manifest: at most RECORDINGS recordings, evenly spaced,
    and FRAMES of each.
    """
    names = ("dataset", "sensor", "unit")
    codes = np.stack([manifest.codes(name) for name in names], 1)
    sequence = manifest.codes("sequence", own=True)
    split = manifest.text_column("split")
    number = np.asarray(manifest.column("frame_index"))
    stride = np.asarray(manifest.column("stride").fill_null(1))
    for group in group_rows(np.arange(len(manifest)), codes):
        rows = group[split[group] != "background"]
        ordered = rows[np.lexsort((number[rows], sequence[rows]))]
        same = np.diff(sequence[ordered]) == 0
        steps = (np.diff(number[ordered]) / stride[ordered[1:]])[same]
        parts = []
        if len(ordered):
            parts = np.split(ordered, np.flatnonzero(~same) + 1)
        recordings = []
        for place in spread(np.arange(len(parts)), RECORDINGS):
            images = _images(manifest, parts[place][:FRAMES])
            if images:
                recordings.append(images)
        free = _background(manifest, rows, group[split[group] == "background"])
        if not recordings and free is not None:
            recordings = [[free]]
        if recordings:
            # Checks compare pixels, so recordings of another size are left out.
            shapes = [recording[0].shape for recording in recordings]
            usual = max(set(shapes), key=shapes.count)
            recordings = [recording for recording in recordings if recording[0].shape == usual]
            sensor, unit = (
                str(manifest.column(name)[int(group[0])].as_py() or "") for name in names[1:]
            )
            yield UnitFrames(sensor, unit, recordings, free, steps, len(rows))


def _images(manifest: Manifest, rows: Array) -> list[Array]:
    images = []
    for row in rows.tolist():
        with suppress(UserError):
            images.append(decode(manifest.file(row)))
    return [image for image in images if image.shape == images[0].shape]


def _background(manifest: Manifest, rows: Array, free: Array) -> Array | None:
    """Return the commonest background image of `rows`, or the first of the `free` rows."""
    named = rows[manifest.present("background_path")[rows]]
    paths = [manifest.file(int(row), "background_path") for row in named]
    if paths:
        paths = [max(set(paths), key=paths.count)]
    else:
        paths = [manifest.file(int(row)) for row in free]
    for path in paths:
        with suppress(UserError):
            return decode(path)
    return None


def examine(
    unit: UnitFrames,
    references: Sequence[Array] = (),
    others: Sequence[UnitFrames] = (),
    only: str | None = None,
) -> UnitHealth:
    """Return the checks of a unit, or the one called `only`.

    Args:
        unit: its frames.
        references: backgrounds RGB u8 of the same family of sensors.
        others: units of the same data, with which its recordings are compared.
        only: the name of a check.

    Raises:
        KeyError: no check has the name.
    """
    checks: dict[str, Callable[[], Check]] = {
        "orientation and colours": partial(check_layout, unit, references),
        "one unit": partial(_one_unit, unit, others),
        "exposure": partial(_exposure, unit),
        "focus": partial(_focus, unit),
        "frozen frames": partial(_frozen, unit),
        "dropped frames": partial(_dropped, unit),
        "tint drift": partial(_tint, unit),
        "worn gel": partial(_scratch, unit),
        "dead pixels": partial(_dead, unit),
        "background": partial(_background_fits, unit),
        "contact": partial(_contact, unit),
    }
    chosen = checks.values() if only is None else (checks[only],)
    found = tuple(check() for check in chosen)
    return UnitHealth(unit.sensor, unit.unit, unit.rows, found, unit.usual)


def check_units(
    units: Sequence[UnitFrames], references: Mapping[str, Sequence[Array]]
) -> list[UnitHealth]:
    """Return the health of all units.

    Backgrounds of the other units of a sensor join its `references`, which are by sensor.
    """
    results = []
    for unit in units:
        others = [other for other in units if other.sensor == unit.sensor and other is not unit]
        # Each costs time.
        others = [others[i] for i in spread(np.arange(len(others)), RECORDINGS)]
        known = [*references.get(unit.sensor, ()), *(other.untouched() for other in others)]
        results.append(examine(unit, known, others))
    return results


def _exposure(unit: UnitFrames) -> Check:
    frames = np.concatenate(unit.small)[:, ::2, ::2]
    # The black rim of a round gel says nothing about its light.
    lit = frames[frames.max(axis=3) > 8].reshape(-1, 3)
    burnt = float((lit >= 252).any(1).mean()) if len(lit) else 0.0
    mean = float(lit.mean()) if len(lit) else 0.0
    ok = burnt <= LIMITS["exposure"] and 25 <= mean <= 225 and len(lit) > 0.4 * frames[..., 0].size
    return Check(
        "exposure", ok, f"mean {mean:.0f}, {burnt:.0%} saturated", "Change exposure, gain or light."
    )


def _focus(unit: UnitFrames) -> Check:
    """Compare details of one pixel with those of two: blur removes the first."""
    if max(unit.frames[0].shape) < 240:
        # It would be made larger, and then look blurred.
        return Check("focus", None, "too small an image")
    fractions = []
    details = []
    for frame in (recording[len(recording) // 2] for recording in unit.recordings):
        grey = scale_image(frame, 320).mean(2).astype(np.float32)
        one = cv2.GaussianBlur(grey, (0, 0), 1)
        two = cv2.GaussianBlur(grey, (0, 0), 2)
        details.append(float(np.std(one - two)))
        fractions.append(float(np.std(grey - one)) / (details[-1] + 1e-6))
    fraction = float(np.median(fractions))
    detail = float(np.median(details))
    if detail < LIMITS["detail"]:
        return Check("focus", None, f"too few details ({detail:.2f})")
    return Check(
        "focus",
        fraction >= LIMITS["focus"],
        f"{fraction:.2f}",
        "Focus the camera, or clean its lens.",
    )


def _frozen(unit: UnitFrames) -> Check:
    pairs = [
        np.array_equal(before, after)
        for recording in unit.recordings
        for before, after in pairwise(recording)
    ]
    if not pairs:
        return Check("frozen frames", None, "stills")
    fraction = float(np.mean(pairs))
    return Check(
        "frozen frames",
        fraction <= LIMITS["frozen"],
        f"{fraction:.0%} repeat",
        "Check cable, driver and buffer.",
    )


def _dropped(unit: UnitFrames) -> Check:
    # A longer gap separates clips.
    near = unit.steps[(unit.steps > 0) & (unit.steps <= 4)]
    if not len(near):
        return Check("dropped frames", None, "stills")
    fraction = float((near > 1).mean())
    return Check(
        "dropped frames",
        fraction <= LIMITS["dropped"],
        f"{fraction:.1%} of steps",
        "Lower the load or the rate.",
    )


def _tint(unit: UnitFrames) -> Check:
    """Measure the drift of colour from the first recordings to the last.

    It is that of the logarithms of red and blue over green, which brightness does not change.
    """
    if len(unit.recordings) < _FEWEST:
        return Check("tint drift", None, "too few recordings")
    # 4 grey levels more keep the logarithms of a dark image from being noise.
    colours = np.stack([np.median(middle, axis=(0, 1)) + 4 for middle in unit.middles])
    tint = np.log(colours[:, [0, 2]] / colours[:, 1:2])
    part = max(1, len(tint) // 4)
    drift = float(np.abs(np.median(tint[-part:], 0) - np.median(tint[:part], 0)).max())
    return Check(
        "tint drift", drift <= LIMITS["tint"], f"{drift:.2f}", "Fix white balance and exposure."
    )


def _dead(unit: UnitFrames) -> Check:
    """Count pixels that differ from their neighbours in every recording."""
    peaks = []
    for recording in unit.recordings:
        frame = recording[0]
        peaks.append(np.abs(frame.astype(np.int16) - cv2.medianBlur(frame, 3)).max(2))
    if len(peaks) < 3:
        # A single image may show a speck of dust, or an edge.
        return Check("dead pixels", None, "0", "Mask them, or exchange the camera.")
    count = int((np.min(peaks, axis=0) > 40).sum())
    ok = count <= LIMITS["dead pixels"]
    return Check("dead pixels", ok, str(count), "Mask them, or exchange the camera.")


def _difference(unit: UnitFrames) -> tuple[Array, Array] | None:
    """Return what never moves and the background lacks, None if it cannot be told.

    It is the usual image minus the background f32 (h, w, 3) at 160 pixels, without tint, and a
    mask f32 (h, w) of where no dots are: dots move, and are no wear.
    """
    if unit.background is None or unit.background.shape != unit.frames[0].shape:
        return None
    gel = scale_image(unit.background)
    change = unit.usual.astype(np.float32) - gel
    clear = np.ones(gel.shape[:2], np.float32)
    change -= np.median(change, axis=(0, 1))
    if has_dots(gel):
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (_DOTS, _DOTS))
        dots = cv2.morphologyEx(gel, cv2.MORPH_BLACKHAT, kernel).min(2) > DOT_DEPTH
        clear -= cv2.dilate(dots.astype(np.uint8), np.ones((5, 5)))
    if clear.mean() < 0.3:
        return None
    return (change * clear[..., None], clear)


def _blurred(change: Array, clear: Array, sigma: float) -> Array:
    """Return the blurred change of the clear pixels alone."""
    # Of a pixel with few clear neighbours the mean would be noise, so the weight has a floor.
    weight = cv2.GaussianBlur(clear, (0, 0), sigma)
    return np.asarray(cv2.GaussianBlur(change, (0, 0), sigma) / np.maximum(weight, 0.1)[..., None])


def _scratch(unit: UnitFrames) -> Check:
    """Look for a scratch, a tear or a hair.

    It is a long thin pattern that never moves and that the background lacks.
    """
    name = "worn gel"
    found = _difference(unit)
    if found is None or len(unit.recordings) < _FEWEST:
        return Check(name, None, "no background" if found is None else "too few recordings")
    change, clear = found
    # Between the two blurs lie lines of some pixels. Noise is thinner, and touch is broader.
    thin = np.abs(_blurred(change, clear, 0.7) - _blurred(change, clear, 4)).max(2) * clear
    lines = cv2.dilate((thin[4:-4, 4:-4] > LIMITS["scratch"]).astype(np.uint8), np.ones((3, 3)))
    _, _, boxes, _ = cv2.connectedComponentsWithStats(lines)
    value = float(np.hypot(boxes[1:, 2], boxes[1:, 3]).max(initial=0))
    advice = "Clean or exchange the gel, and record its background again."
    return Check(
        name, value <= LIMITS["scratch length"], f"fixed line of {value:.0f} pixels", advice
    )


def _background_fits(unit: UnitFrames) -> Check:
    """Compare the background with the usual image.

    A press in one of them is a broad difference.
    """
    name = "background"
    found = _difference(unit)
    if found is None or len(unit.recordings) < _FEWEST:
        return Check(name, None, "no background" if found is None else "too few recordings")
    value = float(np.percentile(np.abs(_blurred(*found, 3)).max(2)[4:-4, 4:-4], 98))
    advice = "Record the background again, with nothing on the gel. Or the touch never ends."
    return Check(name, value <= LIMITS["background"], f"differs by {value:.1f}", advice)


def _contact(unit: UnitFrames) -> Check:
    """Report the fraction of frames in contact.

    A touch that never ends, and does not move, is a fault of the data.
    """
    if unit.background is None or unit.background.shape != unit.frames[0].shape:
        return Check("contact", None, "no background")
    if len(unit.recordings) < _FEWEST:
        return Check("contact", None, "too few recordings")
    gel = UntouchedBackground(unit.background)
    limit = THRESHOLDS.get(unit.sensor, DEFAULT_THRESHOLD)
    frames = np.concatenate(unit.small)[::3]
    moves = UntouchedBackground(unit.usual)
    touched = np.array([gel.score(frame) > limit for frame in frames])
    constant = False
    if touched.all():
        still = np.mean([moves.score(frame) < limit / 2 for frame in frames])
        constant = bool(still > 0.9)
    advice = "The touch never ends: check what rests on the gel, and the background."
    return Check("contact", not constant, f"{touched.mean():.0%} of frames", advice)


def _one_unit(unit: UnitFrames, others: Sequence[UnitFrames]) -> Check:
    """Look for recordings of another gel: two in one folder, or left and right exchanged."""
    name = "one unit"
    if len(unit.recordings) < _FEWEST:
        return Check(name, None, "too few recordings")
    looks = np.stack([small_look(middle) for middle in unit.middles])
    own = _distances(looks, np.median(looks, axis=0))
    for other in others:
        if other.frames[0].shape != unit.frames[0].shape or len(other.recordings) < _FEWEST:
            continue
        away = _distances(looks, small_look(other.usual))
        # They are unlike this unit, and much more like the other.
        exchanged = (own > LIMITS["two units"] / 2) & (away < 0.4 * own)
        if exchanged.mean() >= _FRACTION:
            return Check(
                name,
                False,
                f"{exchanged.mean():.0%} of recordings look like {other.unit or 'another'}",
                "Sort them by unit. Left and right may be exchanged.",
            )
    far = own > LIMITS["two units"]
    is_one = far.mean() < _FRACTION
    if not is_one:
        # Deep touches of a soft gel look unlike the others, and unlike each other. Those of another
        # unit look alike.
        apart = _distances(looks[far], np.median(looks[far], axis=0))
        is_one = np.median(apart) > _ALIKE * np.median(own[far])
    value = float(np.percentile(own, 95))
    return Check(
        name,
        bool(is_one),
        f"looks differ by {value:.0f}",
        "The folder seems to have two units. Sort them.",
    )


def _distances(looks: Array, other: Array) -> Array:
    """Return the root mean square differences (n,) of looks (n, d) from another one (d,)."""
    return np.asarray(np.sqrt(np.mean((looks - other) ** 2, axis=1)))


def contact_visible(features: Array, contact: Array, draws: int = 200) -> Check:
    """Return whether features of frames in contact differ from the others more than by chance.

    The value is the distance of the means over the spread. Chance is what 95 % of random
    assignments stay below.

    Args:
        features: (n, d).
        contact: (n,) bool.
        draws: how many assignments.
    """
    if min(contact.sum(), (~contact).sum()) < _FEWEST:
        return Check(
            "contact visible to the encoder", None, "too few frames with or without contact"
        )

    def apart(touched: Array) -> float:
        sides = [features[touched], features[~touched]]
        within = np.concatenate([side - side.mean(0) for side in sides])
        gap = features[touched].mean(0) - features[~touched].mean(0)
        return float(np.linalg.norm(gap) / np.sqrt(np.square(within).sum(1).mean() + 1e-12))

    rng = np.random.default_rng(0)
    chance = np.quantile([apart(rng.permutation(contact)) for _ in range(draws)], 0.95)
    value = apart(contact)
    advice = "This encoder does not see contact of this unit. Check the checks above, or adapt it."
    return Check(
        "contact visible to the encoder",
        bool(value > chance),
        f"{value:.2f} (chance {chance:.2f})",
        advice,
    )


def health_sheet(results: Sequence[UnitHealth], path: Path) -> None:
    """Write a PNG with the usual image of each unit, its name and its verdict."""
    from anytouch_jax.files import atomic_write

    bands = [_band(unit) for unit in results]
    atomic_write(path, cv2.imencode(".png", np.vstack(bands))[1].tobytes())


def _band(unit: UnitHealth) -> Array:
    """Return the band of a unit on the sheet, BGR u8 (132, 720, 3)."""
    band = np.full((132, 720, 3), 255, np.uint8)
    tile = scale_image(unit.image, 124)[..., ::-1]
    band[4 : 4 + tile.shape[0], 4 : 4 + tile.shape[1]] = tile
    lines = [f"{unit.sensor} {unit.unit}: {unit.verdict}"]
    lines += [f"{check.name}: {check.value}" for check in unit.faults]
    colour = (60, 60, 230) if unit.faults else (80, 150, 60)
    for place, line in enumerate(lines[:6]):
        # OpenCV's letters are ASCII only.
        text = line.encode("ascii", "replace").decode()[:80]
        corner = (140, 20 + 20 * place)
        cv2.putText(band, text, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)
    return band
