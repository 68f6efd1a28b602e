"""The background image (the untouched gel): one rule for every reader of frames.

Manifests, folders, videos, images and live sources all ask here. The first of these counts:

* the image that the user names
* the image of the same sensor instance that a head or an index was fitted with
* a stored image: `background_path`, rows of split `background`, background.png of a folder
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
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt

from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.data.background.medians import (
    FEWEST,
    FRAMES,
    SETTLED,
    SIDE,
    RunningBackground,
    Spread,
    alike,
    estimate,
    estimate_background,
    evenly,
    median,
    recording_gel,
    reduced,
)
from anytouch_jax.data.background.recognition import (
    TINT,
    Recognised,
    other_unit,
    recognise,
    same_unit,
)
from anytouch_jax.data.images import decode
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.transforms import Flip, orient_frame
from anytouch_jax.errors import UserError
from anytouch_jax.files import check_array

# What others ask for here, the parts of the rule in `medians` and `recognition` among it.
__all__ = [
    "ADVICE",
    "FEWEST",
    "FRAMES",
    "SETTLED",
    "SIDE",
    "STORED",
    "TINT",
    "Backgrounds",
    "Recognised",
    "RunningBackground",
    "Spread",
    "alike",
    "as_taken",
    "background_arrays",
    "backgrounds_of_arrays",
    "estimate",
    "estimate_background",
    "median",
    "other_unit",
    "recognise",
    "recording_gel",
    "reduced",
    "same_unit",
]

Array = npt.NDArray[Any]
T = TypeVar("T")
STORED = 32  # units whose images a file stores
ADVICE = (
    f"Record {FEWEST} frames or more of the sensor, or name an image of its gel in the column "
    "background_path."
)
_FREE_ROWS = "rows of split background"


def as_taken(image: Array, rotate: int, flip: Flip) -> Array:
    """Return an upright image as the camera takes it, the inverse of `orient_frame`."""
    return np.ascontiguousarray(orient_frame(orient_frame(image, 0, flip), -rotate % 360))


class _Unit(NamedTuple):
    """The background of a sensor instance.

    Attributes:
        image: u8 (h, w, 3), None if there is none.
        source: What it is, in words for the report.
        frames: From how many frames it is, 0 if it is stored.
        fitted: Whether a head or an index has it.
    """

    image: Array | None = None
    source: str = "none"
    frames: int = 0
    fitted: bool = False


class Backgrounds:
    """The background of every row of a manifest.

    An instance is looked at when one of its rows is asked for.

    Args:
        manifest: The frames.
        known: The images of a head or an index by instance, of which the same instance gets its
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
        """Return the image RGB u8 (h, w, 3) of a row's instance.

        It is None if the stored image of the row counts, or if there is none.
        """
        return self._of(row).image

    def read(self, row: int) -> Array | None:
        """Return the background of a row, its stored image where that counts.

        Raises UserError if that is broken.
        """
        image = self(row)
        if image is not None or not self._stored[row]:
            return image
        try:
            return decode(self._manifest.file(row, "background_path"))
        except UserError as error:
            raise UserError(
                f"{self._manifest.where(row)}, column 'background_path': {error}"
            ) from None

    def shared(self, make: Callable[[Array], T], most: int = 256) -> Callable[[int], T | None]:
        """Return a function from a row to `make` of its background, or to None without one.

        `make` is called once for all rows that share an image. At most `most` results are kept,
        because a data set may have an image for each row.
        """
        made = dict[Any, T]()

        def of_row(row: int) -> T | None:
            # A stored image is known by its file, and the image of an instance by its number.
            key: Any = int(self._unit[row])
            if self(row) is None:
                key = self._manifest.file(row, "background_path") if self._stored[row] else None
            if key is None or key in made:
                return made.get(key)
            image = self.read(row)
            assert image is not None
            one = make(image)
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

    def images(self, rows: Array) -> dict[str, Array]:
        """Return the images of the instances of rows by name, for the STORED most frequent."""
        rows = rows[self.has(rows)]
        units, first, counts = np.unique(self._unit[rows], return_index=True, return_counts=True)
        most_frequent = np.argsort(-counts, kind="stable")[:STORED]
        found = {}
        for place in most_frequent.tolist():
            image = self.read(int(rows[first[place]]))
            assert image is not None
            found[self._name(int(units[place]))] = reduced(image)
        return found

    def _name(self, unit: int) -> str:
        row = int(self._first[unit])
        cells = [self._manifest.value(row, name) for name in ("dataset", "sensor", "unit")]
        return " ".join(str(cell) for cell in cells if cell)

    def digest(self) -> str:
        """Return what decides the images that are not stored ones, as text.

        A cache of features has it in its key. Stored images are in the manifest's own digest.
        """
        digest = 0
        asked = np.unique(self._first[self._unit[~self._stored]])
        for row in asked:
            image = self._find_once(int(self._unit[row])).image
            content = b"-" if image is None else image.tobytes()
            digest = zlib.crc32(content, digest)
        return f"{digest:08x}"

    def _of(self, row: int) -> _Unit:
        """Return what counts for a row."""
        if not self._stored[row]:
            return self._find_once(int(self._unit[row]))
        # A stored image comes after one that a head was fitted with.
        if self._known:
            one = self._find_once(int(self._unit[row]))
            if one.fitted:
                return one
        return _Unit(None, "a stored image")

    def _find_once(self, unit: int) -> _Unit:
        with self._lock:
            if unit not in self._units:
                self._units[unit] = self._find(unit)
            return self._units[unit]

    def _find(self, unit: int) -> _Unit:
        """Return the image of the same instance among the known ones, or else the median."""
        rows = np.flatnonzero((self._unit == unit) & self._has_image)
        free = rows[self._split[rows] == "background"]
        found = self._median(free, 1, _FREE_ROWS)
        if found.image is None:
            found = self._median_of(unit, self._fitted(rows))
        if not self._known:
            return found
        own, untouched = self._own(rows, found)
        if own is None:
            return found
        name = self._name(unit)
        known = {name: self._known[name]} if name in self._known else self._known
        counts = recognise(
            known, own, is_background=untouched or found.image is not None, untouched=untouched
        )
        if counts.warning and self._log is not None:
            self._log(counts.warning)
            self._log = None  # once
        if counts.image is None:
            return found
        return _Unit(counts.image, counts.what, 0, True)

    def _own(self, rows: Array, found: _Unit) -> tuple[Array | None, bool]:
        """Return what tells an instance, and whether nothing presses in it for sure.

        That is an image of its untouched gel, else its median, else its few frames.
        """
        if found.source == _FREE_ROWS:
            return found.image, True
        for row in rows[self._stored[rows]][:1].tolist():
            # a broken one is reported when the row itself is read
            with suppress(UserError):
                return reduced(decode(self._manifest.file(row, "background_path"))), True
        if found.image is not None:
            return found.image, False
        return self._median(rows, 1, "").image, False

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
        is_enough = own.image is not None and len(sequences) >= FEWEST
        if is_enough or len(everything) == len(rows):
            return own
        if sensor not in self._sensors:
            self._sensors[sensor] = self._median(everything, FEWEST, "the median of its sensor")
        shared = self._sensors[sensor]
        if own.image is None:
            return shared
        if shared.image is None:
            return own
        _, differs = same_unit({"": shared.image}, own.image)
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
        chosen = rows[evenly(len(rows), FRAMES)] if len(rows) else rows
        for row in chosen.tolist():
            # A frame that cannot be read is reported when the row itself is read.
            with suppress(UserError):
                frames.append(reduced(decode(self._manifest.file(row))))
        usual = alike(frames)
        if len(usual) < fewest:
            return _Unit()
        return _Unit(median(usual), source, len(usual))


def background_arrays(images: Mapping[str, Array]) -> dict[str, Array]:
    """Return images by instance as arrays for an .npz file."""
    if not images:
        return {}
    arrays = {"gels": np.array(list(images), str)}
    for number, image in enumerate(images.values()):
        arrays[f"gel/{number}"] = image
    return arrays


def backgrounds_of_arrays(arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Return the images among the arrays of an .npz file.

    Raises KeyError or ValueError for others.
    """
    names = arrays.get("gels", np.zeros(0, str))
    check_array("gels", names, (len(names.reshape(-1)),), "U")
    found = {}
    for number, name in enumerate(names.tolist()):
        image = arrays[f"gel/{number}"]
        check_array(f"gel/{number}", image, (*image.shape[:2], 3), "u")
        found[name] = image
    return found
