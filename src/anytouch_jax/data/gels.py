"""The picture of the untouched gel: one rule for manifests, folders, films, pictures and live sources.

In this order: the picture that the user names; the picture of the same unit that a head or an index was fitted with;
the median of many recordings of the unit; its stored picture; the median of fewer frames. A live source has a running
estimate. A unit is the column `unit` of one dataset and sensor, or else the sensor. A folder or a film is one unit.

The median is over frames of split train, if the unit has any. Pressed or not, they may all take part: presses are at
changing places. `experiments/results/backgrounds.md` compares the forms.
"""

from __future__ import annotations

import threading
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.data.images import decode, to_rgb
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.prepare.untouched_gel import UntouchedGel, free_frames, scale_picture
from anytouch_jax.data.transforms import Flip, orient_frame
from anytouch_jax.errors import UserError
from anytouch_jax.files import check_array

Array = npt.NDArray[Any]
FRAMES = 100  # frames of a median: 30 to all of them score alike
FEWEST = 5  # frames of a median: fewer show the press itself
MANY = 10  # recordings from which the median is better than a stored picture, whose light has drifted since
SIDE = 320  # pixels of the long side of a median
SETTLED = 300  # frames after which a running estimate stays
TINT = 8.0  # grey levels: frames of one unit differ by less in most places, units of one product by more
STORED = 32  # units whose pictures a file stores
ADVICE = "Give one of the gel with nothing on it: --background, or background.png next to the frames."


class Spread:
    """At most `most` evenly spaced items of a sequence of unknown length."""

    def __init__(self, most: int = FRAMES) -> None:
        self.items, self.count = list[Any](), 0
        self._most, self._step = most, 1

    def add(self, make: Callable[[], Any]) -> None:
        """Count one item more, and make it if it is kept."""
        if self.count % self._step == 0:
            if len(self.items) == self._most:
                self.items, self._step = self.items[::2], 2 * self._step
            if self.count % self._step == 0:
                self.items.append(make())
        self.count += 1


def untouched_gel(frames: Iterable[npt.ArrayLike]) -> Array:
    """Return the picture u8 (h, w, 3) of the untouched gel: the median of frames (h, w, 3) of one camera.

    The frames may be pressed, at changing places. At most FRAMES of them are used, evenly spread. Raises UserError for
    fewer than FEWEST frames, and for frames of several sizes.
    """
    spread = Spread()
    for frame in frames:
        spread.add(lambda frame=frame: to_rgb(np.asarray(frame), "a frame"))  # type: ignore[misc]
    if spread.count < FEWEST:
        raise UserError(f"{spread.count} frames are too few for a picture of the untouched gel. Give {FEWEST} or more.")
    if len(shapes := {frame.shape for frame in spread.items}) > 1:
        raise UserError(f"the frames have {len(shapes)} sizes. Give frames of one camera.")
    return median(spread.items)


def median(frames: Sequence[Array]) -> Array:
    """Return the per-pixel median u8 (h, w, 3) of frames of one size."""
    stack = np.stack(frames)
    return np.partition(stack, len(stack) // 2, axis=0)[len(stack) // 2]


def estimate(frames: Sequence[Array]) -> tuple[Array, bool]:
    """Return the untouched gel in the frames of one recording, and whether some of them show it for sure.

    Otherwise it is their median, which may show a press that lasts.
    """
    if len(frames) < FEWEST:
        return median(frames), False
    some = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, 24).astype(int))]
    group, _ = free_frames([scale_picture(frame) for frame in some])
    return (median(frames), False) if group is None else (median([some[i] for i in group]), True)


def reduced(frame: Array) -> Array:
    """Return a frame whose long side has at most SIDE pixels."""
    return frame if max(frame.shape[:2]) <= SIDE else scale_picture(frame, SIDE)


def recording_gel(frames: Iterable[Array]) -> tuple[Array, int]:
    """Return the untouched gel of one frame or more of a folder or a film, and how many count for it.

    With fewer than FEWEST it shows the press itself.
    """
    spread = Spread()
    for frame in frames:
        spread.add(lambda frame=frame: reduced(frame))  # type: ignore[misc]
    usual = alike(spread.items)
    if not usual:
        raise UserError("no frame can be read, so the untouched gel is unknown. Check the pictures.")
    return estimate(usual)[0], len(usual)


def alike(frames: Sequence[Array]) -> list[Array]:
    """Return the frames of the commonest size."""
    sizes = Counter(frame.shape for frame in frames)
    return [frame for frame in frames if frame.shape == sizes.most_common(1)[0][0]]


class RunningGel:
    """The untouched gel of a live source, from its frames so far.

    `picture` is the newest estimate, None before the first frame. It stays once it is `settled`: two estimates in turn
    find the same free gel, or SETTLED frames have come.
    """

    def __init__(self) -> None:
        self.picture: Array | None = None
        self.settled = False
        self._spread, self._due, self._sure = Spread(), 1, False

    def add(self, frame: Array) -> None:
        """Take one frame more, RGB u8 (h, w, 3). The estimate is made again whenever their number has doubled."""
        if self.settled:
            return
        self._spread.add(lambda: reduced(frame).copy())
        count = self._spread.count
        if count < min(self._due, SETTLED):
            return
        self._due = max(2 * count, 2)
        before, (picture, sure) = self.picture, estimate(self._spread.items)
        again = sure and self._sure and before is not None and UntouchedGel(before).score(picture) < TINT / 2
        self.picture, self._sure, self.settled = picture, sure, again or count >= SETTLED


def as_taken(picture: Array, rotate: int, flip: Flip) -> Array:
    """Return an upright picture as the camera takes it, before `orient_frame` turns and mirrors it."""
    return np.ascontiguousarray(orient_frame(orient_frame(picture, 0, flip), -rotate % 360))


def same_unit(known: Mapping[str, Array], picture: Array) -> tuple[Array | None, str]:
    """Return the known picture that looks most like `picture`, None without any, and how another unit differs ("")."""
    sizes = {name: gel.shape[1] / gel.shape[0] / (picture.shape[1] / picture.shape[0]) for name, gel in known.items()}
    fitting = {name: known[name] for name, ratio in sizes.items() if abs(ratio - 1) < 0.05}
    if not fitting:
        return None, "in size" if known else ""

    def small(one: Array) -> Array:
        return cv2.resize(one, (32, 24), interpolation=cv2.INTER_AREA).astype(np.float32)

    own = small(picture)
    tints = {name: np.median(np.abs(small(gel) - own), axis=(0, 1)).max() for name, gel in fitting.items()}
    name = min(tints, key=lambda one: float(tints[one]))
    return fitting[name], "" if tints[name] <= TINT else f"in tint, by {tints[name]:.0f} grey levels"


def other_unit(why: str) -> str:
    """Return the warning about a camera whose picture differs from all that a head or an index was fitted with."""
    return (
        f"The picture differs {why} from every unit that the head or index was fitted with. Its own untouched gel is "
        "subtracted. Do not trust the result before you have checked it."
    )


class _Unit(NamedTuple):
    """The picture of a unit, None for that of each row or for none, and what it is, from how many frames."""

    picture: Array | None
    source: str
    frames: int = 0


class UnitGels:
    """The untouched gel of every row of a manifest. A unit is looked at when one of its rows is asked for.

    `known` are the pictures of a head or an index by unit, of which the same unit gets its own. `log` gets one warning
    about units that are none of these.
    """

    def __init__(
        self, manifest: Manifest, known: Mapping[str, Array] | None = None, log: Callable[[str], None] | None = None
    ) -> None:
        self._manifest, self._known, self._log = manifest, known or {}, log
        keys = np.stack([manifest.codes(name, own=True) for name in ("sensor", "dataset", "unit")], 1)
        _, self._first, self._unit = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        self._stored = manifest.present("background_path")
        self._split = manifest.text_column("split")
        self._has_image = ~np.isin(manifest.text_column("sensor"), FIELD_SENSORS)
        self._units, self._lock = dict[int, _Unit](), threading.Lock()

    def __call__(self, row: int) -> Array | None:
        """Return the picture RGB u8 (h, w, 3) of a row's unit; None if that of the row counts, or there is none."""
        return self._of(int(self._unit[row])).picture

    def key(self, row: int) -> tuple[int, Path | None] | None:
        """Return what rows of one picture share, None for a row without one."""
        unit = int(self._unit[row])
        if self._of(unit).picture is not None:
            return unit, None
        return (unit, self._manifest.file(row, "background_path")) if self._stored[row] else None

    def read(self, row: int) -> Array | None:
        """Return the untouched gel of a row, its own picture where that counts. Raises UserError if it is broken."""
        picture = self(row)
        return decode(self._manifest.file(row, "background_path")) if picture is None and self._stored[row] else picture

    def has(self, rows: Array) -> Array:
        """Return which rows have one, bool (rows,)."""
        known = {unit: self._of(unit).picture is not None for unit in np.unique(self._unit[rows]).tolist()}
        return self._stored[rows] | np.array([known[unit] for unit in self._unit[rows].tolist()], bool)

    def report(self, rows: Array) -> str:
        """Return a line on what is used for rows."""
        count, frames, units = Counter[str](), Counter[str](), Counter[str]()
        own = np.unique(self._unit[rows], return_counts=True)
        for unit, size in zip(*(part.tolist() for part in own), strict=True):
            one = self._of(unit)
            stored = 0 if one.picture is not None else int(self._stored[rows[self._unit[rows] == unit]].sum())
            for source, some in ((one.source, size - stored), ("a stored picture", stored)):
                count[source] += some
                if some and source == one.source:
                    frames[source], units[source] = frames[source] + one.frames, units[source] + 1
        parts = []
        for source, some in count.items():
            of = f" of {frames[source]:,} frames of {units[source]} units" if frames[source] else ""
            parts += [f"{source}{of} for {some:,} rows"] if some else []
        return f"untouched gel: {'; '.join(parts)}"

    def pictures(self, rows: Array) -> dict[str, Array]:
        """Return the pictures of the units of rows by name, those of the STORED units with most rows."""
        units, counts = np.unique(self._unit[rows], return_counts=True)
        found = {}
        for unit in units[np.argsort(-counts, kind="stable")][:STORED].tolist():
            row = next(iter(rows[(self._unit[rows] == unit) & self.has(rows)].tolist()), None)
            picture = None if row is None else self.read(row)
            if picture is not None:
                found[self._name(unit)] = reduced(picture)
        return found

    def digest(self) -> str:
        """Return what decides the pictures that are not stored ones, as text."""
        ones = [self._of(unit).picture for unit in range(len(self._first))]
        return f"{zlib.crc32(b''.join(b'-' if one is None else one.tobytes() for one in ones)):08x}"

    def _name(self, unit: int) -> str:
        cells = (self._manifest.value(int(self._first[unit]), name) for name in ("dataset", "sensor", "unit"))
        return " ".join(str(cell) for cell in cells if cell)

    def _of(self, unit: int) -> _Unit:
        with self._lock:
            if unit not in self._units:
                self._units[unit] = self._find(unit)
            return self._units[unit]

    def _find(self, unit: int) -> _Unit:
        rows = np.flatnonzero((self._unit == unit) & self._has_image)
        free, rows = rows[self._split[rows] == "background"], rows[self._split[rows] != "background"]
        if not len(rows):
            return _Unit(None, "none")
        train = rows[self._split[rows] == "train"]
        train = train if len(train) else rows
        stored = self._stored[rows].any()
        pictures = len(np.unique(self._manifest.codes("background_path", own=True)[rows[self._stored[rows]]]))
        many = len(train) >= FRAMES and len(np.unique(self._manifest.codes("sequence", own=True)[train])) >= MANY
        if stored and not self._known and not (many and pictures == 1):
            return _Unit(None, "none")
        found = _Unit(None, "none") if many else self._median(free, 1, "the unit's rows of split background")
        if found.picture is None and (many or not stored):
            found = self._median(train, FEWEST, "the median")
        if found.picture is None and not stored:  # a unit of few frames is taken for one of its sensor
            like = self._unit_of_sensor(unit)
            found = self._median(like, FEWEST, "the median of its sensor") if len(like) > len(train) else found
        return self._same(found, rows) if self._known else found

    def _unit_of_sensor(self, unit: int) -> Array:
        sensor, first = self._manifest.codes("sensor"), int(self._first[unit])
        rows = np.flatnonzero((sensor == sensor[first]) & (self._split != "background"))
        train = rows[self._split[rows] == "train"]
        return train if len(train) else rows

    def _median(self, rows: Array, fewest: int, source: str) -> _Unit:
        frames = []
        for row in rows[np.unique(np.linspace(0, len(rows) - 1, FRAMES).astype(int))].tolist() if len(rows) else ():
            try:
                frames.append(reduced(decode(self._manifest.file(row))))
            except UserError:
                continue  # its own reading reports it
        usual = alike(frames)
        return _Unit(None, "none") if len(usual) < fewest else _Unit(median(usual), source, len(usual))

    def _same(self, found: _Unit, rows: Array) -> _Unit:
        look = found.picture if found.picture is not None else self._median(rows, 1, "").picture
        gel, why = (None, "") if look is None else same_unit(self._known, look)
        if why and self._log is not None:
            self._log(other_unit(why))
            self._log = None  # once
        return found if why or gel is None else _Unit(gel, "the picture that the head was fitted with")


def gel_arrays(pictures: Mapping[str, Array]) -> dict[str, Array]:
    """Return pictures by unit as arrays for an .npz file."""
    arrays = {f"gel/{number}": picture for number, picture in enumerate(pictures.values())}
    return {"gels": np.array(list(pictures), str)} | arrays if pictures else {}


def gels_of_arrays(arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Return the pictures among the arrays of an .npz file. Raises KeyError or ValueError for others."""
    names, found = arrays.get("gels", np.zeros(0, str)), {}
    check_array("gels", names, (len(names.reshape(-1)),), "U")
    for number, name in enumerate(names.tolist()):
        picture = arrays[f"gel/{number}"]
        check_array(f"gel/{number}", picture, (*picture.shape[:2], 3), "u")
        found[name] = picture
    return found
