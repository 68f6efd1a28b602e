"""The picture of the untouched gel: one rule for manifests, folders, films, pictures and live
sources.

The first of these counts:

* the picture that the user names
* the picture of the same unit that a head or an index was fitted with
* a stored picture: `background_path`, rows of split `background`, background.png of a folder
* the median of the unit's frames
* for a live source, a running estimate

A unit is the column `unit` of one dataset and sensor, or else the sensor. A folder or a film is one
unit. The median is over frames of split train, if these are enough, pressed or not. A unit of few
sequences may have one press only: its median is that of its sensor, if these look alike.
"""

from __future__ import annotations

import threading
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.data.background.estimate import EDGE, free_frames, scale_picture
from anytouch_jax.data.images import decode, to_rgb
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.transforms import Flip, orient_frame
from anytouch_jax.errors import UserError
from anytouch_jax.files import check_array

Array = npt.NDArray[Any]
T = TypeVar("T")
FRAMES = 100  # frames of a median: 10 of them to all of them score alike
FEWEST = 5  # frames of a median, of as many sequences: fewer show the press itself
SIDE = 320  # pixels of the long side of a median
SETTLED = 512  # frames, a power of two, after which a running estimate stays
# grey levels: frames of one unit differ by less in most places, units of one product by more
TINT = 8.0
STORED = 32  # units whose pictures a file stores
ADVICE = (
    f"Record {FEWEST} frames or more of the sensor, or name a picture of its gel in the column "
    "background_path."
)


class Spread:
    """`make` of at most FRAMES evenly spaced items of a sequence of unknown length."""

    def __init__(self, make: Callable[[Any], Array]) -> None:
        self.items = list[Array]()
        self.count = 0
        self._make = make
        self._step = 1

    def add(self, item: Any) -> None:
        """Count one item more, and keep it if its turn has come."""
        if self.count % self._step == 0 and len(self.items) == FRAMES:
            self.items = self.items[::2]
            self._step = 2 * self._step
        if self.count % self._step == 0:
            self.items.append(self._make(item))
        self.count += 1


def untouched_gel(frames: Iterable[npt.ArrayLike]) -> Array:
    """Return the picture u8 (h, w, 3) of the untouched gel: the median of frames (h, w, 3) of one
    camera.

    The frames may be pressed, at changing places. At most FRAMES of them are used, evenly spread.
    Raises UserError for fewer than FEWEST frames, and for frames of several sizes.
    """
    spread = Spread(lambda frame: to_rgb(np.asarray(frame), "a frame"))
    for frame in frames:
        spread.add(frame)
    if spread.count < FEWEST:
        raise UserError(
            f"{spread.count} frames are too few for a picture of the untouched gel. Give {FEWEST} "
            "or more."
        )
    if len(shapes := {frame.shape for frame in spread.items}) > 1:
        raise UserError(f"the frames have {len(shapes)} sizes. Give frames of one camera.")
    return median(spread.items)


def median(frames: Sequence[Array]) -> Array:
    """Return the per-pixel median u8 (h, w, 3) of frames of one size."""
    middle = (len(frames) - 1) // 2
    return np.partition(np.stack(frames), middle, axis=0)[middle]


def estimate(frames: Sequence[Array]) -> Array:
    """Return the untouched gel of one recording: the median of its free frames if these stand out,
    else of all.
    """
    some = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, 24).astype(int))]
    small = [scale_picture(frame) for frame in some]
    decides = len(some) >= FEWEST and min(small[0].shape[:2]) > 2 * EDGE + 2
    group = free_frames(small)[0] if decides else None
    return median(frames if group is None else [some[i] for i in group])


def reduced(frame: Array) -> Array:
    """Return a copy of a frame, whose long side has at most SIDE pixels."""
    if max(frame.shape[:2]) <= SIDE:
        return frame.copy()
    return scale_picture(frame, SIDE)


def recording_gel(frames: Iterable[Array]) -> tuple[Array, int]:
    """Return the untouched gel of frames of a folder or a film, and how many count; below FEWEST it
    shows the press.
    """
    spread = Spread(reduced)
    for frame in frames:
        spread.add(frame)
    if not spread.items:
        raise UserError(
            "no frame can be read, so the untouched gel is unknown. Check the pictures."
        )
    usual = alike(spread.items)
    return estimate(usual), len(usual)


def alike(frames: Sequence[Array]) -> list[Array]:
    """Return the frames of the commonest size."""
    sizes = Counter(frame.shape for frame in frames)
    return [frame for frame in frames if frame.shape == sizes.most_common(1)[0][0]]


class RunningGel:
    """The untouched gel of a live source: `picture`, None before its first frame, from the frames
    so far.

    A thread estimates it whenever their number has doubled. The result counts when it has doubled
    again, so that no frame waits for it, and equal frames have equal pictures. It is `settled`
    after SETTLED frames.
    """

    def __init__(self) -> None:
        self.picture: Array | None = None
        self.settled = False
        self._spread = Spread(reduced)
        self._thread: threading.Thread | None = None
        self._found = list[Array]()

    def __getstate__(self) -> dict[str, Any]:  # a copy does without the estimate at work
        return self.__dict__ | {"_thread": None}

    def add(self, frame: Array) -> None:
        """Take one frame more, RGB u8 (h, w, 3)."""
        if self.settled:
            return
        self._spread.add(frame)
        if (count := self._spread.count).bit_count() > 1:
            return
        if self._thread is not None:
            self._thread.join()
        frames = alike(self._spread.items)
        self.settled = count >= SETTLED
        self.picture = (
            self._found.pop()
            if self._found
            else frames[0]
            if self.picture is None
            else self.picture
        )
        if not self.settled:
            self._thread = threading.Thread(
                target=lambda: self._found.append(estimate(frames)), daemon=True
            )
            self._thread.start()


def as_taken(picture: Array, rotate: int, flip: Flip) -> Array:
    """Return an upright picture as the camera takes it, before `orient_frame` turns and mirrors
    it.
    """
    return np.ascontiguousarray(orient_frame(orient_frame(picture, 0, flip), -rotate % 360))


def same_unit(known: Mapping[str, Array], picture: Array) -> tuple[Array | None, str]:
    """Return the known picture that looks most like `picture`, None without any, and how another
    unit differs ("").
    """
    sizes = {
        name: gel.shape[1] / gel.shape[0] / (picture.shape[1] / picture.shape[0])
        for name, gel in known.items()
    }
    fitting = {name: known[name] for name, ratio in sizes.items() if abs(ratio - 1) < 0.05}
    if not fitting:
        return None, "in size" if known else ""

    def small(one: Array) -> Array:
        return cv2.resize(one, (32, 24), interpolation=cv2.INTER_AREA).astype(np.float32)

    own = small(picture)
    tints = {
        name: np.median(np.abs(small(gel) - own), axis=(0, 1)).max()
        for name, gel in fitting.items()
    }
    name = min(tints, key=lambda one: float(tints[one]))
    return fitting[name], "" if tints[
        name
    ] <= TINT else f"in tint, by {tints[name]:.0f} grey levels"


def other_unit(why: str) -> str:
    """Return the warning about a camera whose picture differs from all that a head or an index was
    fitted with.
    """
    return (
        f"The picture differs {why} from every unit that the head or index was fitted with. Its "
        "own untouched gel is "
        "subtracted. Do not trust the result before you have checked it."
    )


class _Unit(NamedTuple):
    """The picture of a unit, None if there is none, what it is, from how many frames, and whether a
    head has it.
    """

    picture: Array | None = None
    source: str = "none"
    frames: int = 0
    fitted: bool = False


class UnitGels:
    """The untouched gel of every row of a manifest.

    A unit is looked at when one of its rows is asked for.

    `known` are the pictures of a head or an index by unit, of which the same unit gets its own.
    `log` gets one warning about units that are none of these.
    """

    def __init__(
        self,
        manifest: Manifest,
        known: Mapping[str, Array] | None = None,
        log: Callable[[str], None] | None = None,
    ) -> None:
        self._manifest = manifest
        self._known = known or {}
        self._log = log
        keys = np.stack(
            [manifest.codes(name, own=True) for name in ("sensor", "dataset", "unit")], 1
        )
        _, self._first, self._unit = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        self._stored = manifest.present("background_path")
        self._split = manifest.text_column("split")
        self._has_image = ~np.isin(manifest.text_column("sensor"), FIELD_SENSORS)
        self._units = dict[int, _Unit]()
        self._sensors = dict[int, _Unit]()
        self._lock = threading.Lock()

    def __call__(self, row: int) -> Array | None:
        """Return the picture RGB u8 (h, w, 3) of a row's unit; None if that of the row counts, or
        there is none.
        """
        return self._of(row).picture

    def read(self, row: int) -> Array | None:
        """Return the untouched gel of a row, its own picture where that counts.

        Raises UserError if it is broken.
        """
        picture = self(row)
        if picture is not None or not self._stored[row]:
            return picture
        try:
            return decode(self._manifest.file(row, "background_path"))
        except UserError as error:
            raise UserError(
                f"{self._manifest.where(row)}, column 'background_path': {error}"
            ) from None

    def shared(self, make: Callable[[Array], T], most: int = 256) -> Callable[[int], T | None]:
        """Return a function from a row to `make` of its untouched gel (or None), made once for all
        rows of it.
        """
        made = dict[Any, T]()

        def of_row(row: int) -> T | None:
            key: Any = int(self._unit[row])
            if self(row) is None:
                key = self._manifest.file(row, "background_path") if self._stored[row] else None
            if key is not None and key not in made:
                one = make(self.read(row))  # type: ignore[arg-type]
                if len(made) >= most:
                    made.clear()
                return made.setdefault(key, one)
            return made.get(key)

        return of_row

    def has(self, rows: Array) -> Array:
        """Return which rows have one, bool (rows,)."""
        return np.array([self._stored[row] or self(row) is not None for row in rows.tolist()], bool)

    def report(self, rows: Array) -> str:
        """Return a line on what is used for rows."""
        count = Counter[str]()
        units = dict[str, dict[int, int]]()
        for row in rows.tolist():
            one = self._of(row)
            count[one.source] += 1
            units.setdefault(one.source, {})[id(one)] = one.frames
        parts = []
        for source, some in count.items():
            frames = sum(units[source].values())
            of = len(units[source])
            about = f" of {frames:,} frames{f' of {of} units' * (of > 1)}" if frames else ""
            parts.append(f"{source}{about} for {some:,} rows")
        return f"untouched gel: {'; '.join(parts)}"

    def pictures(self, rows: Array) -> dict[str, Array]:
        """Return the pictures of the units of rows by name, those of the STORED units with most
        rows.
        """
        rows = rows[self.has(rows)]
        found = {}
        units, first, counts = np.unique(self._unit[rows], return_index=True, return_counts=True)
        for place in np.argsort(-counts, kind="stable")[:STORED].tolist():
            picture = self.read(int(rows[first[place]]))
            assert picture is not None
            found[self._name(int(units[place]))] = reduced(picture)
        return found

    def _name(self, unit: int) -> str:
        cells = (
            self._manifest.value(int(self._first[unit]), name)
            for name in ("dataset", "sensor", "unit")
        )
        return " ".join(str(cell) for cell in cells if cell)

    def digest(self) -> str:
        """Return what decides the pictures that are not stored ones, as text."""
        digest = 0
        for row in np.unique(np.where(self._stored, -1, self._first[self._unit]))[
            1 if self._stored.any() else 0 :
        ]:
            picture = self._find_once(int(self._unit[row])).picture
            digest = zlib.crc32(b"-" if picture is None else picture.tobytes(), digest)
        return f"{digest:08x}"

    def _of(self, row: int) -> _Unit:
        if not self._stored[row]:
            return self._find_once(int(self._unit[row]))
        one = self._find_once(int(self._unit[row])) if self._known else _Unit()
        if one.fitted:
            return one
        return _Unit(None, "a stored picture")

    def _find_once(self, unit: int) -> _Unit:
        with self._lock:
            if unit not in self._units:
                self._units[unit] = self._find(unit)
            return self._units[unit]

    def _find(self, unit: int) -> _Unit:
        """Return the median of a unit's frames, or the picture of the same unit among the known
        ones.
        """
        rows = np.flatnonzero((self._unit == unit) & self._has_image)
        found = self._median(rows[self._split[rows] == "background"], 1, "rows of split background")
        if found.picture is None:
            found = self._median_of(unit, self._fitted(rows))
        if not self._known:
            return found
        look = found.picture if found.picture is not None else self._median(rows, 1, "").picture
        name = self._name(unit)
        known = {name: self._known[name]} if name in self._known else self._known
        gel, why = (None, "") if look is None else same_unit(known, look)
        if why and self._log is not None:
            self._log(other_unit(why))
            self._log = None  # once
        if gel is None or why:
            return found
        return _Unit(gel, "the picture that the head was fitted with", 0, True)

    def _median_of(self, unit: int, rows: Array) -> _Unit:
        """Return the median of rows of a unit, or that of its sensor if they are few and do not
        show another unit.
        """
        own = self._median(rows, FEWEST, "the median")
        sensors = self._manifest.codes("sensor")
        sensor = int(sensors[self._first[unit]])
        everything = self._fitted(np.flatnonzero((sensors == sensor) & self._has_image))
        few = (
            own.picture is None
            or len(np.unique(self._manifest.codes("sequence", own=True)[rows])) < FEWEST
        )
        if not few or len(everything) == len(rows):
            return own
        if sensor not in self._sensors:
            self._sensors[sensor] = self._median(everything, FEWEST, "the median of its sensor")
        shared = self._sensors[sensor]
        if own.picture is None or shared.picture is None:
            if own.picture is None:
                return shared
            return own
        if same_unit({"": shared.picture}, own.picture)[1]:
            return own
        return shared

    def _fitted(self, rows: Array) -> Array:
        """Return the rows of split train, or all but those of split background if these are too
        few.
        """
        train = rows[self._split[rows] == "train"]
        if len(train) >= FEWEST:
            return train
        return rows[self._split[rows] != "background"]

    def _median(self, rows: Array, fewest: int, source: str) -> _Unit:
        frames = []
        for row in (
            rows[np.unique(np.linspace(0, len(rows) - 1, FRAMES).astype(int))].tolist()
            if len(rows)
            else ()
        ):
            # reading the row itself reports it
            with suppress(UserError):
                frames.append(reduced(decode(self._manifest.file(row))))
        usual = alike(frames)
        if len(usual) < fewest:
            return _Unit()
        return _Unit(median(usual), source, len(usual))


def gel_arrays(pictures: Mapping[str, Array]) -> dict[str, Array]:
    """Return pictures by unit as arrays for an .npz file."""
    arrays = {f"gel/{number}": picture for number, picture in enumerate(pictures.values())}
    if pictures:
        return {"gels": np.array(list(pictures), str)} | arrays
    return {}


def gels_of_arrays(arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Return the pictures among the arrays of an .npz file.

    Raises KeyError or ValueError for others.
    """
    names = arrays.get("gels", np.zeros(0, str))
    found = {}
    check_array("gels", names, (len(names.reshape(-1)),), "U")
    for number, name in enumerate(names.tolist()):
        picture = arrays[f"gel/{number}"]
        check_array(f"gel/{number}", picture, (*picture.shape[:2], 3), "u")
        found[name] = picture
    return found
