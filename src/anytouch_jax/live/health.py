"""Health of sensor units: orientation, colour order, exposure, focus, frozen frames, drift, wear,
background, contact.

A check reads some recordings of a unit and gives a value, a limit and what to do. The limits were
set on real units in good order (`experiments/real/trust.py`). Pictures are compared at 160 pixels
on the long side.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np

from anytouch_jax.data.background.contact import DEFAULT_THRESHOLD, THRESHOLDS, spread
from anytouch_jax.data.background.estimate import (
    DOT_DEPTH,
    UntouchedGel,
    has_dots,
    scale_picture,
)

# Some of these names were defined here, and are asked for here.
from anytouch_jax.data.background.layout import (  # noqa: F401
    ORIENTATION,
    Check,
    UnitFrames,
    check_layout,
    known_gels,
    small_look,
)
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest.manifest import Manifest, group_rows
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.errors import UserError

# that are read of a unit, and of a recording
RECORDINGS = 24
FRAMES = 6
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
_SHARE = 0.25  # of recordings that look like another unit
_ALIKE = 0.6  # distance within another unit, as a share of that between the two
_DOTS = 21  # pixels of the widest marker dots, at 160 pixels
_FEWEST = 4  # recordings from which a fixed pattern is judged


@dataclass(frozen=True, eq=False)
class UnitHealth:
    """The checks of a unit, and its usual picture."""

    sensor: str
    unit: str
    rows: int
    checks: tuple[Check, ...]
    picture: Array

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
        starts = np.flatnonzero(np.r_[True, ~same]) if len(ordered) else np.zeros(0, int)
        parts = np.split(ordered, starts[1:]) if len(ordered) else []
        chosen = [parts[i] for i in spread(np.arange(len(parts)), RECORDINGS)]
        recordings = [read for part in chosen if (read := _pictures(manifest, part[:FRAMES]))]
        free = _background(manifest, rows, group[split[group] == "background"])
        if not recordings and free is not None:
            recordings = [[free]]
        shapes = [recording[0].shape for recording in recordings]
        recordings = [r for r in recordings if r[0].shape == max(set(shapes), key=shapes.count)]
        if recordings:
            sensor, unit = (
                str(manifest.column(name)[int(group[0])].as_py() or "") for name in names[1:]
            )
            yield UnitFrames(sensor, unit, recordings, free, steps, len(rows))


def _pictures(manifest: Manifest, rows: Array) -> list[Array]:
    pictures = []
    for row in rows.tolist():
        with suppress(UserError):
            pictures.append(decode(manifest.file(row)))
    return [picture for picture in pictures if picture.shape == pictures[0].shape]


def _background(manifest: Manifest, rows: Array, free: Array) -> Array | None:
    """Return the commonest background picture of `rows`, or the first picture of the `free`
    rows.
    """
    paths = [
        manifest.file(int(row), "background_path")
        for row in rows[manifest.present("background_path")[rows]]
    ]
    paths = (
        [max(set(paths), key=paths.count)] if paths else [manifest.file(int(row)) for row in free]
    )
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

    `references` are untouched gels of the same family. Recordings are compared with the `others` of
    the data.
    """
    checks: dict[str, Callable[[], Check]] = {
        "orientation and colours": lambda: check_layout(unit, references),
        "one unit": lambda: _one_unit(unit, others),
        "exposure": lambda: _exposure(unit),
        "focus": lambda: _focus(unit),
        "frozen frames": lambda: _frozen(unit),
        "dropped frames": lambda: _dropped(unit),
        "tint drift": lambda: _tint(unit),
        "worn gel": lambda: _scratch(unit),
        "dead pixels": lambda: _dead(unit),
        "background": lambda: _background_fits(unit),
        "contact": lambda: _contact(unit),
    }
    chosen = checks.values() if only is None else (checks[only],)
    return UnitHealth(
        unit.sensor, unit.unit, unit.rows, tuple(check() for check in chosen), unit.usual
    )


def check_units(
    units: Sequence[UnitFrames], references: Mapping[str, Sequence[Array]]
) -> list[UnitHealth]:
    """Return the health of all units; `references` by sensor are joined by the other units of the
    same sensor.
    """
    results = []
    for unit in units:
        others = [other for other in units if other.sensor == unit.sensor and other is not unit]
        # each costs time
        others = [others[i] for i in spread(np.arange(len(others)), RECORDINGS)]
        known = [*references.get(unit.sensor, ()), *(other.untouched() for other in others)]
        results.append(examine(unit, known, others))
    return results


def _exposure(unit: UnitFrames) -> Check:
    frames = np.concatenate(unit.small)[:, ::2, ::2]
    # without the black rim of a round gel
    lit = frames[frames.max(axis=3) > 8].reshape(-1, 3)
    burnt = float((lit >= 252).any(1).mean()) if len(lit) else 0.0
    mean = float(lit.mean()) if len(lit) else 0.0
    ok = burnt <= LIMITS["exposure"] and 25 <= mean <= 225 and len(lit) > 0.4 * frames[..., 0].size
    return Check(
        "exposure", ok, f"mean {mean:.0f}, {burnt:.0%} saturated", "Change exposure, gain or light."
    )


def _focus(unit: UnitFrames) -> Check:
    """Compare details of one pixel with those of two: blur removes the first."""
    if max(unit.frames[0].shape) < 240:  # made larger, it would look blurred
        return Check("focus", None, "too small a picture")
    shares = []
    details = []
    for frame in (recording[len(recording) // 2] for recording in unit.recordings):
        grey = scale_picture(frame, 320).mean(2).astype(np.float32)
        one, two = (cv2.GaussianBlur(grey, (0, 0), sigma) for sigma in (1, 2))
        details.append(float(np.std(one - two)))
        shares.append(float(np.std(grey - one)) / (details[-1] + 1e-6))
    share = float(np.median(shares))
    detail = float(np.median(details))
    if detail < LIMITS["detail"]:
        return Check("focus", None, f"too few details ({detail:.2f})")
    return Check(
        "focus", share >= LIMITS["focus"], f"{share:.2f}", "Focus the camera, or clean its lens."
    )


def _frozen(unit: UnitFrames) -> Check:
    pairs = [np.array_equal(a, b) for r in unit.recordings for a, b in pairwise(r)]
    if not pairs:
        return Check("frozen frames", None, "stills")
    share = float(np.mean(pairs))
    return Check(
        "frozen frames",
        share <= LIMITS["frozen"],
        f"{share:.0%} repeat",
        "Check cable, driver and buffer.",
    )


def _dropped(unit: UnitFrames) -> Check:
    # a longer gap separates clips
    near = unit.steps[(unit.steps > 0) & (unit.steps <= 4)]
    if not len(near):
        return Check("dropped frames", None, "stills")
    share = float((near > 1).mean())
    return Check(
        "dropped frames",
        share <= LIMITS["dropped"],
        f"{share:.1%} of steps",
        "Lower the load or the rate.",
    )


def _tint(unit: UnitFrames) -> Check:
    """Measure the drift of colour from the first recordings to the last, in logarithms of red and
    blue over green.
    """
    if len(unit.recordings) < _FEWEST:
        return Check("tint drift", None, "too few recordings")
    colours = np.stack([np.median(middle, axis=(0, 1)) + 4 for middle in unit.middles])
    tint = np.log(colours[:, [0, 2]] / colours[:, 1:2])
    part = max(1, len(tint) // 4)
    drift = float(np.abs(np.median(tint[-part:], 0) - np.median(tint[:part], 0)).max())
    return Check(
        "tint drift", drift <= LIMITS["tint"], f"{drift:.2f}", "Fix white balance and exposure."
    )


def _dead(unit: UnitFrames) -> Check:
    frames = [frame for recording in unit.recordings for frame in recording[:1]]
    away = None
    for frame in frames:
        peak = np.abs(frame.astype(np.int16) - cv2.medianBlur(frame, 3)).max(2)
        away = peak if away is None else np.minimum(away, peak)
    count = 0 if away is None or len(frames) < 3 else int((away > 40).sum())
    ok = None if len(frames) < 3 else count <= LIMITS["dead pixels"]
    return Check("dead pixels", ok, str(count), "Mask them, or exchange the camera.")


def _difference(unit: UnitFrames) -> tuple[Array, Array] | None:
    """Return the usual picture minus the background f32 (h, w, 3) at 160 pixels without tint, and
    where no dots are.
    """
    if unit.background is None or unit.background.shape != unit.frames[0].shape:
        return None
    gel = scale_picture(unit.background)
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
    weight = cv2.GaussianBlur(clear, (0, 0), sigma)
    return np.asarray(cv2.GaussianBlur(change, (0, 0), sigma) / np.maximum(weight, 0.1)[..., None])


def _scratch(unit: UnitFrames) -> Check:
    """Look for a long thin pattern that never moves and that the background lacks: a scratch, a
    tear, a hair.
    """
    name = "worn gel"
    found = _difference(unit)
    if found is None or len(unit.recordings) < _FEWEST:
        return Check(name, None, "no background" if found is None else "too few recordings")
    change, clear = found
    thin = np.abs(_blurred(change, clear, 0.7) - _blurred(change, clear, 4)).max(2) * clear
    lines = cv2.dilate((thin[4:-4, 4:-4] > LIMITS["scratch"]).astype(np.uint8), np.ones((3, 3)))
    _, _, boxes, _ = cv2.connectedComponentsWithStats(lines)
    value = float(np.hypot(boxes[1:, 2], boxes[1:, 3]).max(initial=0))
    advice = "Clean or exchange the gel, and record its background again."
    return Check(
        name, value <= LIMITS["scratch length"], f"fixed line of {value:.0f} pixels", advice
    )


def _background_fits(unit: UnitFrames) -> Check:
    """Compare the background with the usual picture: a press in one of them is a broad
    difference.
    """
    name = "background"
    found = _difference(unit)
    if found is None or len(unit.recordings) < _FEWEST:
        return Check(name, None, "no background" if found is None else "too few recordings")
    value = float(np.percentile(np.abs(_blurred(*found, 3)).max(2)[4:-4, 4:-4], 98))
    advice = "Record the background again, with nothing on the gel. Or the touch never ends."
    return Check(name, value <= LIMITS["background"], f"differs by {value:.1f}", advice)


def _contact(unit: UnitFrames) -> Check:
    """Report the share of frames in contact.

    All or none of many recordings is a fault of the data.
    """
    if unit.background is None or unit.background.shape != unit.frames[0].shape:
        return Check("contact", None, "no background")
    if len(unit.recordings) < _FEWEST:
        return Check("contact", None, "too few recordings")
    gel = UntouchedGel(unit.background)
    limit = THRESHOLDS.get(unit.sensor, DEFAULT_THRESHOLD)
    frames = np.concatenate(unit.small)[::3]
    moves = UntouchedGel(unit.usual)
    touched = np.array([gel.score(frame) > limit for frame in frames])
    still = np.mean([moves.score(frame) < limit / 2 for frame in frames]) if touched.all() else 0.0
    constant = touched.all() and still > 0.9
    advice = "The touch never ends: check what rests on the gel, and the background."
    return Check("contact", not constant, f"{touched.mean():.0%} of frames", advice)


def _one_unit(unit: UnitFrames, others: Sequence[UnitFrames]) -> Check:
    """Look for recordings that look like another gel: two units in one folder, or left and right
    exchanged.
    """
    name = "one unit"
    if len(unit.recordings) < _FEWEST:
        return Check(name, None, "too few recordings")
    looks = np.stack([small_look(middle) for middle in unit.middles])
    middle = np.median(looks, axis=0)
    own = np.sqrt(np.mean((looks - middle) ** 2, axis=1))
    for other in others:
        if other.frames[0].shape == unit.frames[0].shape and len(other.recordings) >= _FEWEST:
            away = np.sqrt(np.mean((looks - small_look(other.usual)) ** 2, axis=1))
            share = float(((own > LIMITS["two units"] / 2) & (away < 0.4 * own)).mean())
            if share >= _SHARE:
                advice = "Sort them by unit. Left and right may be exchanged."
                return Check(
                    name,
                    False,
                    f"{share:.0%} of recordings look like {other.unit or 'another'}",
                    advice,
                )
    far = own > LIMITS["two units"]
    value = float(np.percentile(own, 95))
    # Deep touches of a soft gel look unlike the others, and unlike each other. Those of another
    # unit look alike.
    apart = (
        np.sqrt(np.mean((looks[far] - np.median(looks[far], axis=0)) ** 2, axis=1))
        if far.any()
        else np.zeros(0)
    )
    is_one = far.mean() < _SHARE or np.median(apart) > _ALIKE * np.median(own[far])
    return Check(
        name,
        bool(is_one),
        f"looks differ by {value:.0f}",
        "The folder seems to have two units. Sort them.",
    )


def contact_visible(features: Array, contact: Array, draws: int = 200) -> Check:
    """Return whether features (n, d) of frames in contact (n,) bool differ from the others more
    than by chance.

    The value is the distance of the means over the spread. The limit is that of 95 % of `draws`
    random assignments.
    """
    if min(contact.sum(), (~contact).sum()) < _FEWEST:
        return Check(
            "contact visible to the encoder", None, "too few frames with or without contact"
        )

    def apart(touched: Array) -> float:
        within = np.concatenate(
            [features[side] - features[side].mean(0) for side in (touched, ~touched)]
        )
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
    """Write a PNG with the usual picture of each unit, its name and its verdict."""
    from anytouch_jax.files import atomic_write

    bands = []
    for unit in results:
        band = np.full((132, 720, 3), 255, np.uint8)
        tile = scale_picture(unit.picture, 124)[..., ::-1]
        band[4 : 4 + tile.shape[0], 4 : 4 + tile.shape[1]] = tile
        lines = [
            f"{unit.sensor} {unit.unit}: {unit.verdict}",
            *(f"{c.name}: {c.value}" for c in unit.faults),
        ]
        for place, line in enumerate(lines[:6]):
            colour = (60, 60, 230) if unit.faults else (80, 150, 60)
            text = line.encode("ascii", "replace").decode()[:80]
            cv2.putText(
                band,
                text,
                (140, 20 + 20 * place),
                cv2.FONT_HERSHEY_SIMPLEX,
                0.45,
                colour,
                1,
                cv2.LINE_AA,
            )
        bands.append(band)
    atomic_write(path, cv2.imencode(".png", np.vstack(bands))[1].tobytes())
