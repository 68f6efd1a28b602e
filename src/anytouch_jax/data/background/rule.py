"""The background image (the untouched gel): one rule for every reader of frames.

Manifests, folders, videos, pictures and live sources all ask here. The first of these counts:

* the picture that the user names
* the picture of the same sensor instance that a head or an index was fitted with
* a stored picture: `background_path`, rows of split `background`, background.png of a folder
* the median of the instance's frames
* for a live source, a running estimate

A sensor instance is the column `unit` of one dataset and sensor, or else the sensor. A folder or a
video is one instance. The median is over frames of split train, if these are enough, pressed or
not: whatever is fitted must not see the others. An instance of few sequences may have one press
only, so its median would show that press; it gets that of its sensor, if these look alike.
"""

from __future__ import annotations

import threading
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Generic, NamedTuple, TypeVar

import cv2
import numpy as np
import numpy.typing as npt

from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.data.background.estimate import (
    DIFFERENT,
    EDGE,
    UntouchedGel,
    free_frames,
    scale_picture,
)
from anytouch_jax.data.images import decode, to_rgb
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.transforms import Flip, orient_frame
from anytouch_jax.errors import UserError
from anytouch_jax.files import check_array

Array = npt.NDArray[Any]
T = TypeVar("T")
Item = TypeVar("Item")
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
_ESTIMATED = 24  # frames of one recording among which the free ones are looked for
_FREE_ROWS = "rows of split background"
_SAME_SHAPE = 0.05  # relative difference of the proportions of one camera's pictures


class Spread(Generic[Item]):
    """`make` of at most FRAMES evenly spaced items of a sequence of unknown length.

    It keeps every item until FRAMES are there, then every second one, then every fourth. So a
    source that never ends takes little memory, and what is kept is spread over all of it.
    """

    def __init__(self, make: Callable[[Item], Array]) -> None:
        self.items = list[Array]()
        self.count = 0
        self._make = make
        self._step = 1

    def add(self, item: Item) -> None:
        """Count one item more, and keep it if its turn has come."""
        if self.count % self._step == 0 and len(self.items) == FRAMES:
            self.items = self.items[::2]
            self._step = 2 * self._step
        if self.count % self._step == 0:
            self.items.append(self._make(item))
        self.count += 1


def estimate_background(frames: Iterable[npt.ArrayLike]) -> Array:
    """Return the background u8 (h, w, 3) of a camera: the median of its frames (h, w, 3).

    The frames may be pressed, at changing places. At most FRAMES of them are used, evenly spread.

    Raises UserError for fewer than FEWEST frames, and for frames of several sizes.
    """
    spread: Spread[npt.ArrayLike] = Spread(lambda frame: to_rgb(np.asarray(frame), "a frame"))
    for frame in frames:
        spread.add(frame)
    if spread.count < FEWEST:
        raise UserError(
            f"{spread.count} frames are too few for a picture of the untouched gel. Give {FEWEST} "
            "or more."
        )
    shapes = {frame.shape for frame in spread.items}
    if len(shapes) > 1:
        raise UserError(f"the frames have {len(shapes)} sizes. Give frames of one camera.")
    return median(spread.items)


def median(frames: Sequence[Array]) -> Array:
    """Return the per-pixel median u8 (h, w, 3) of frames of one size.

    Of an even number it is the lower middle, which is a value that was seen.
    """
    middle = (len(frames) - 1) // 2
    return np.partition(np.stack(frames), middle, axis=0)[middle]


def _evenly(count: int, most: int) -> Array:
    """Return at most `most` evenly spread numbers of 0 to `count` - 1, i64, without repeats."""
    return np.unique(np.linspace(0, count - 1, most).astype(int))


def estimate(frames: Sequence[Array]) -> Array:
    """Return the background of one recording.

    It is the median of the recording's free frames if these stand out, else of all frames. A touch
    that is held for most of a recording would be in the median of all.
    """
    some = [frames[i] for i in _evenly(len(frames), _ESTIMATED)]
    small = [scale_picture(frame) for frame in some]
    # the score leaves out a border of EDGE pixels
    is_large_enough = min(small[0].shape[:2]) > 2 * EDGE + 2
    if len(some) < FEWEST or not is_large_enough:
        return median(frames)
    group, _ = free_frames(small)
    if group is None:
        return median(frames)
    return median([some[i] for i in group])


def reduced(frame: Array) -> Array:
    """Return a copy of a frame, whose long side has at most SIDE pixels."""
    if max(frame.shape[:2]) <= SIDE:
        return frame.copy()
    return scale_picture(frame, SIDE)


def recording_gel(frames: Iterable[Array]) -> tuple[Array, int]:
    """Return the background of the frames of a folder or a video, and how many of them count.

    With fewer than FEWEST it shows the press itself.
    """
    spread: Spread[Array] = Spread(reduced)
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
    """The background of a live source: `picture`, None before its first frame.

    A thread estimates it from the frames so far whenever their number has doubled. The result
    counts when the number has doubled again, not when the thread is done. So no frame waits for it,
    and the same frames have the same pictures on a slow machine and on a fast one. It is `settled`
    after SETTLED frames.
    """

    def __init__(self) -> None:
        self.picture: Array | None = None
        self.settled = False
        self._spread: Spread[Array] = Spread(reduced)
        self._thread: threading.Thread | None = None
        self._found = list[Array]()

    def __getstate__(self) -> dict[str, Any]:  # a copy does without the estimate at work
        return self.__dict__ | {"_thread": None}

    def add(self, frame: Array) -> None:
        """Take one frame more, RGB u8 (h, w, 3)."""
        if self.settled:
            return
        self._spread.add(frame)
        count = self._spread.count
        is_power_of_two = count.bit_count() == 1
        if not is_power_of_two:
            return
        if self._thread is not None:
            self._thread.join()
        frames = alike(self._spread.items)
        self.settled = count >= SETTLED
        if self._found:
            self.picture = self._found.pop()
        elif self.picture is None:
            self.picture = frames[0]
        if not self.settled:
            self._thread = threading.Thread(
                target=lambda: self._found.append(estimate(frames)), daemon=True
            )
            self._thread.start()


def as_taken(picture: Array, rotate: int, flip: Flip) -> Array:
    """Return an upright picture as the camera takes it, the inverse of `orient_frame`."""
    return np.ascontiguousarray(orient_frame(orient_frame(picture, 0, flip), -rotate % 360))


def same_unit(
    known: Mapping[str, Array], picture: Array, *, untouched: bool = False
) -> tuple[Array | None, str]:
    """Return the known picture that looks most like `picture`, and how it differs.

    Args:
        known: Backgrounds by the name of their sensor instance, u8 (h, w, 3).
        picture: The background of the camera at hand.
        untouched: Nothing presses in `picture` for sure. Then it must not count as pressed when the
            known picture is subtracted, which two instances of one tint can look like.

    Returns:
        The picture, None without any of these proportions, and why the camera is another instance:
        "" if it is the same one, else words such as "in size".
    """
    shape = picture.shape[1] / picture.shape[0]
    fitting = {}
    for name, gel in known.items():
        ratio = gel.shape[1] / gel.shape[0] / shape
        if abs(ratio - 1) < _SAME_SHAPE:
            fitting[name] = gel
    if not fitting:
        return None, "in size" if known else ""
    # A median over places: a press, or a speck, is in the smaller part of the picture.
    own = _thumbnail(picture)
    tints = {
        name: float(np.median(np.abs(_thumbnail(gel) - own), axis=(0, 1)).max())
        for name, gel in fitting.items()
    }
    name = min(tints, key=lambda one: tints[one])
    gel = fitting[name]
    if tints[name] > TINT:
        return gel, f"in tint, by {tints[name]:.0f} grey levels"
    if untouched:
        # proportions that differ by a few pixels cannot be compared, and say nothing
        with suppress(ValueError):
            score = UntouchedGel(gel).score(picture)
            if score >= DIFFERENT:
                return gel, f"as much as a touch does, by a contact score of {score:.0f}"
    return gel, ""


def _thumbnail(picture: Array) -> Array:
    return cv2.resize(picture, (32, 24), interpolation=cv2.INTER_AREA).astype(np.float32)


class KnownGel(NamedTuple):
    """What the known pictures of a head or an index say about a camera.

    Attributes:
        picture: The one that is subtracted, None if the camera's own counts.
        what: What it is, in words for the report.
        warning: A sentence, "" if all is well.
    """

    picture: Array | None
    what: str
    warning: str


def known_gel(
    known: Mapping[str, Array],
    own: Array,
    *,
    is_background: bool,
    untouched: bool = False,
    of: str = "the head was fitted with",
) -> KnownGel:
    """Return which of the known pictures counts for a camera.

    Args:
        known: Backgrounds by the name of their sensor instance.
        own: What the camera shows.
        is_background: Whether `own` can be subtracted. A few frames show the press itself. That
            changes the tint by up to 17 grey levels on real sensors, as much as another instance
            does, so they cannot tell the two apart. Then the nearest picture is better than none.
        untouched: Nothing presses in `own` for sure.
        of: What the known pictures belong to, in words.
    """
    gel, why = same_unit(known, own, untouched=untouched)
    if gel is not None and not why:
        return KnownGel(gel, f"the picture that {of}", "")
    if is_background:
        return KnownGel(None, "", other_unit(why) if why else "")
    if gel is None:
        return KnownGel(None, "", "")
    return KnownGel(
        gel,
        f"the nearest picture that {of}. So few frames do not tell whether it is the same sensor: "
        "name its own picture with --background if it is another",
        "",
    )


def other_unit(why: str) -> str:
    """Return the warning about a camera that differs from all that something was fitted with."""
    return (
        f"The picture differs {why} from every unit that the head or index was fitted with. Its "
        "own untouched gel is subtracted. Do not trust the result before you have checked it."
    )


class _Unit(NamedTuple):
    """The background of a sensor instance.

    Attributes:
        picture: u8 (h, w, 3), None if there is none.
        source: What it is, in words for the report.
        frames: From how many frames it is, 0 if it is stored.
        fitted: Whether a head or an index has it.
    """

    picture: Array | None = None
    source: str = "none"
    frames: int = 0
    fitted: bool = False


class UnitGels:
    """The background of every row of a manifest.

    An instance is looked at when one of its rows is asked for.

    Args:
        manifest: The frames.
        known: The pictures of a head or an index by instance, of which the same instance gets its
            own: what is computed must be the same as when it was fitted.
        log: Gets one warning about instances that are none of these.
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
        names = ("sensor", "dataset", "unit")
        keys = np.stack([manifest.codes(name, own=True) for name in names], 1)
        # for each instance its first row, and for each row the number of its instance
        _, self._first, self._unit = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        self._stored = manifest.present("background_path")
        self._split = manifest.text_column("split")
        self._has_image = ~np.isin(manifest.text_column("sensor"), FIELD_SENSORS)
        self._units = dict[int, _Unit]()
        self._sensors = dict[int, _Unit]()
        self._lock = threading.Lock()

    def __call__(self, row: int) -> Array | None:
        """Return the picture RGB u8 (h, w, 3) of a row's instance.

        It is None if the stored picture of the row counts, or if there is none.
        """
        return self._of(row).picture

    def read(self, row: int) -> Array | None:
        """Return the background of a row, its stored picture where that counts.

        Raises UserError if that is broken.
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
        """Return a function from a row to `make` of its background, or to None without one.

        `make` is called once for all rows that share a picture. At most `most` results are kept,
        because a data set may have a picture for each row.
        """
        made = dict[Any, T]()

        def of_row(row: int) -> T | None:
            # A stored picture is known by its file, and the picture of an instance by its number.
            key: Any = int(self._unit[row])
            if self(row) is None:
                key = self._manifest.file(row, "background_path") if self._stored[row] else None
            if key is None or key in made:
                return made.get(key)
            picture = self.read(row)
            assert picture is not None
            one = make(picture)
            if len(made) >= most:
                made.clear()
            # another thread may have made it meanwhile
            return made.setdefault(key, one)

        return of_row

    def has(self, rows: Array) -> Array:
        """Return which rows have one, bool (rows,)."""
        found = [self._stored[row] or self(row) is not None for row in rows.tolist()]
        return np.array(found, bool)

    def report(self, rows: Array) -> str:
        """Return a line on what is used for rows."""
        counts = Counter[str]()
        # frames of each instance, by source and by identity: instances of one sensor may share one
        frames_of = dict[str, dict[int, int]]()
        for row in rows.tolist():
            one = self._of(row)
            counts[one.source] += 1
            frames_of.setdefault(one.source, {})[id(one)] = one.frames
        parts = []
        for source, count in counts.items():
            frames = sum(frames_of[source].values())
            units = len(frames_of[source])
            about = f" of {frames:,} frames" if frames else ""
            if frames and units > 1:
                about += f" of {units} units"
            parts.append(f"{source}{about} for {count:,} rows")
        return f"untouched gel: {'; '.join(parts)}"

    def pictures(self, rows: Array) -> dict[str, Array]:
        """Return the pictures of the instances of rows by name, for the STORED most frequent."""
        rows = rows[self.has(rows)]
        units, first, counts = np.unique(self._unit[rows], return_index=True, return_counts=True)
        most_frequent = np.argsort(-counts, kind="stable")[:STORED]
        found = {}
        for place in most_frequent.tolist():
            picture = self.read(int(rows[first[place]]))
            assert picture is not None
            found[self._name(int(units[place]))] = reduced(picture)
        return found

    def _name(self, unit: int) -> str:
        row = int(self._first[unit])
        cells = [self._manifest.value(row, name) for name in ("dataset", "sensor", "unit")]
        return " ".join(str(cell) for cell in cells if cell)

    def digest(self) -> str:
        """Return what decides the pictures that are not stored ones, as text.

        A cache of features has it in its key. Stored pictures are in the manifest's own digest.
        """
        digest = 0
        asked = np.unique(self._first[self._unit[~self._stored]])
        for row in asked:
            picture = self._find_once(int(self._unit[row])).picture
            content = b"-" if picture is None else picture.tobytes()
            digest = zlib.crc32(content, digest)
        return f"{digest:08x}"

    def _of(self, row: int) -> _Unit:
        """Return what counts for a row."""
        if not self._stored[row]:
            return self._find_once(int(self._unit[row]))
        # A stored picture comes after one that a head was fitted with.
        if self._known:
            one = self._find_once(int(self._unit[row]))
            if one.fitted:
                return one
        return _Unit(None, "a stored picture")

    def _find_once(self, unit: int) -> _Unit:
        with self._lock:
            if unit not in self._units:
                self._units[unit] = self._find(unit)
            return self._units[unit]

    def _find(self, unit: int) -> _Unit:
        """Return the picture of the same instance among the known ones, or else the median."""
        rows = np.flatnonzero((self._unit == unit) & self._has_image)
        free = rows[self._split[rows] == "background"]
        found = self._median(free, 1, _FREE_ROWS)
        if found.picture is None:
            found = self._median_of(unit, self._fitted(rows))
        if not self._known:
            return found
        own, untouched = self._own(rows, found)
        if own is None:
            return found
        name = self._name(unit)
        known = {name: self._known[name]} if name in self._known else self._known
        counts = known_gel(
            known, own, is_background=untouched or found.picture is not None, untouched=untouched
        )
        if counts.warning and self._log is not None:
            self._log(counts.warning)
            self._log = None  # once
        if counts.picture is None:
            return found
        return _Unit(counts.picture, counts.what, 0, True)

    def _own(self, rows: Array, found: _Unit) -> tuple[Array | None, bool]:
        """Return what tells an instance, and whether nothing presses in it for sure.

        That is a picture of its untouched gel, else its median, else its few frames.
        """
        if found.source == _FREE_ROWS:
            return found.picture, True
        for row in rows[self._stored[rows]][:1].tolist():
            # a broken one is reported when the row itself is read
            with suppress(UserError):
                return reduced(decode(self._manifest.file(row, "background_path"))), True
        if found.picture is not None:
            return found.picture, False
        return self._median(rows, 1, "").picture, False

    def _median_of(self, unit: int, rows: Array) -> _Unit:
        """Return the median of rows of an instance, or that of its sensor.

        The sensor's counts if the rows are of few sequences, which may have one press only, and
        the two do not show different instances.
        """
        own = self._median(rows, FEWEST, "the median")
        sensors = self._manifest.codes("sensor")
        sensor = int(sensors[self._first[unit]])
        everything = self._fitted(np.flatnonzero((sensors == sensor) & self._has_image))
        sequences = np.unique(self._manifest.codes("sequence", own=True)[rows])
        is_enough = own.picture is not None and len(sequences) >= FEWEST
        if is_enough or len(everything) == len(rows):
            return own
        if sensor not in self._sensors:
            self._sensors[sensor] = self._median(everything, FEWEST, "the median of its sensor")
        shared = self._sensors[sensor]
        if own.picture is None:
            return shared
        if shared.picture is None:
            return own
        _, differs = same_unit({"": shared.picture}, own.picture)
        if differs:
            return own
        return shared

    def _fitted(self, rows: Array) -> Array:
        """Return the rows of split train, or all but those of split background if few."""
        train = rows[self._split[rows] == "train"]
        if len(train) >= FEWEST:
            return train
        return rows[self._split[rows] != "background"]

    def _median(self, rows: Array, fewest: int, source: str) -> _Unit:
        """Return the median of at most FRAMES of the rows, evenly spread; none of fewer frames."""
        frames = []
        chosen = rows[_evenly(len(rows), FRAMES)] if len(rows) else rows
        for row in chosen.tolist():
            # A frame that cannot be read is reported when the row itself is read.
            with suppress(UserError):
                frames.append(reduced(decode(self._manifest.file(row))))
        usual = alike(frames)
        if len(usual) < fewest:
            return _Unit()
        return _Unit(median(usual), source, len(usual))


def gel_arrays(pictures: Mapping[str, Array]) -> dict[str, Array]:
    """Return pictures by instance as arrays for an .npz file."""
    if not pictures:
        return {}
    arrays = {"gels": np.array(list(pictures), str)}
    for number, picture in enumerate(pictures.values()):
        arrays[f"gel/{number}"] = picture
    return arrays


def gels_of_arrays(arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Return the pictures among the arrays of an .npz file.

    Raises KeyError or ValueError for others.
    """
    names = arrays.get("gels", np.zeros(0, str))
    check_array("gels", names, (len(names.reshape(-1)),), "U")
    found = {}
    for number, name in enumerate(names.tolist()):
        picture = arrays[f"gel/{number}"]
        check_array(f"gel/{number}", picture, (*picture.shape[:2], 3), "u")
        found[name] = picture
    return found
