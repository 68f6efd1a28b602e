"""Recordings on the page: touches of a manifest, a folder of images, or a video.

A touch is the recordings (sequences) that share a value of `touch`, or one without. Images are
read when shown, and libraries that take seconds are imported when they are needed.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax import encoder
from anytouch_jax.config import UNIVERSAL
from anytouch_jax.data.background.contact import DEFAULT_THRESHOLD, THRESHOLDS
from anytouch_jax.data.background.estimate import UntouchedBackground
from anytouch_jax.data.background.rule import FRAMES, Backgrounds, recording_gel
from anytouch_jax.data.images import QUIET, count_frames, decode, list_images, open_video, to_rgb
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.errors import UserError
from anytouch_jax.live.page.layers import (
    LAYERS,
    MEASURED,
    last_clip,
    measured_layer,
    scale_down,
    touch_layer,
)

if TYPE_CHECKING:
    from anytouch_jax.data.manifest.manifest import Manifest
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.encoder.measured import Fields

# the sensor and the split of a folder or a video, which the page leaves out
UNKNOWN = "unknown"
UNUSED = "unused"
# PRESS-SENSOR.jpg, and PRESS-SENSOR-background.jpg
EXAMPLES = Path(encoder.__file__).with_name("examples")
# frames of a clip, clips of a touch, values of a filter
_MOST_ROWS = 5000
_MOST_CLIPS = 12
_MOST_CHOICES = 500
_MOST_TILES = 48  # touches of a page of thumbnails
_CLIP = 3  # frames on which a touch is measured
_FILTERS = ("sensor", "object", "split", "dataset", "unit")
_ONE_BY_ONE = threading.Lock()  # the encoder is opened and compiled by one request


class Table:
    """Touches of a manifest. `video` is a video whose frames are the rows."""

    kind = "table"

    def __init__(self, manifest: Manifest, name: str, video: Path | None = None) -> None:
        self.manifest = manifest
        self.name = name
        self._video = None if video is None else _Video(video)
        self._chosen = lru_cache(8)(self._choose)
        self._measured = lru_cache(256)(self._measure)

    def about(self) -> dict[str, Any]:
        """Return the number of rows and touches, and the values of columns that filter them."""
        about = {"rows": len(self.manifest), "touches": len(self._touches(()))}
        return about | {"filters": self._filters, "layers": LAYERS}

    def touch(self, place: int, filters: dict[str, str]) -> dict[str, Any]:
        """Return touch `place` among those that pass `filters` {column: value}, and their number.

        Raises UserError.
        """
        self._check_filters(filters)
        chosen = tuple(sorted(filters.items()))
        touches = self._touches(chosen)
        if not len(touches):
            return {"count": 0, "place": 0, "clips": []}
        place = min(max(place, 0), len(touches) - 1)
        recordings = np.flatnonzero((self._touch_of == touches[place]) & self._chosen(chosen))
        clips = [self._clip(int(one)) for one in recordings[:_MOST_CLIPS]]
        name = self.manifest.value(clips[0]["rows"][0], "touch")
        name = name or clips[0].get("sequence", self.name)
        more = max(0, len(recordings) - _MOST_CLIPS)
        return {"count": len(touches), "place": place, "name": name, "clips": clips, "more": more}

    def touches(self, start: int, filters: dict[str, str]) -> dict[str, Any]:
        """Return a page of the touches that pass `filters`, from place `start`, and their number.

        Each has its place, its name, its sensors, and the row in the middle of its first recording.
        Raises UserError.
        """
        self._check_filters(filters)
        chosen = tuple(sorted(filters.items()))
        touches = self._touches(chosen)
        passes = self._chosen(chosen)
        found = []
        for place in range(start, min(start + _MOST_TILES, len(touches))):
            recordings = np.flatnonzero((self._touch_of == touches[place]) & passes)
            rows = self._rows(int(recordings[0]))
            row = int(rows[len(rows) // 2])
            several = recordings[:_MOST_CLIPS].tolist()
            sensors = [self.manifest.value(int(self._rows(one)[0]), "sensor") for one in several]
            name = self.manifest.value(row, "object") or self.manifest.value(row, "sequence")
            found.append(
                {
                    "place": place,
                    "row": row,
                    "name": str(name or self.name),
                    "sensors": [one for one in dict.fromkeys(sensors) if one != UNKNOWN],
                }
            )
        return {"count": len(touches), "touches": found}

    def place_of(self, row: int) -> int:
        """Return the place of the touch of a row, without filters."""
        at = int(np.searchsorted(self._order[1], self._position(row), "right")) - 1
        return int(np.searchsorted(self._touches(()), self._touch_of[at]))

    def frame(self, row: int) -> Array:
        """Return the image of a row, RGB u8 (h, w, 3). Raises UserError."""
        self._check(row)
        if self._video is not None:
            return self._video.read(int(self.manifest.value(row, "frame_index")))
        return decode(self.manifest.file(row))

    def photo(self, row: int) -> Array:
        """Return the RGB image of a row, RGB u8 (h, w, 3). Raises UserError if there is none."""
        self._check(row)
        return decode(self.manifest.file(row, "image_path"))

    def layer(self, row: int, name: str) -> tuple[Array, float, Fields | None]:
        """Return a layer of a row (see `touch_layer`) and its contact score.

        For the layers MEASURED its fields come last, else None.
        """
        frame = self.frame(row)
        gel = self._untouched(row)
        view, score = touch_layer(frame, gel, self.threshold(row), name)
        if name not in MEASURED or gel is None or score != score:
            return view, score, None
        fields = self._measured(row)
        return measured_layer(view, fields, name), score, fields

    def _measure(self, row: int) -> Fields:
        order, starts = self._order
        end = self._position(row) + 1
        # No clip begins before its recording.
        begin = max(starts[starts < end][-1], end - _CLIP)
        rows = order[begin:end].tolist()
        gel = self._untouched(row)
        sensor = self.manifest.value(row, "sensor")
        frames = [self.frame(one) for one in rows]
        # the first call takes seconds
        with _ONE_BY_ONE:
            clip = last_clip(frames, _encoder().config.model.frames)[None]
            name = UNIVERSAL if sensor == UNKNOWN else sensor
            return _encoder().measure(clip, gel and gel[0], name, log=lambda _: None)

    def threshold(self, row: int) -> float:
        """Return the contact score above which a frame of the row's sensor shows contact."""
        return THRESHOLDS.get(self.manifest.value(row, "sensor"), DEFAULT_THRESHOLD)

    @cached_property
    def _untouched(self) -> Callable[[int], tuple[Array, UntouchedBackground] | None]:
        """A function from a row to its background, scaled down and to compare.

        It returns None if the background is unknown.
        """

        def made(image: Array) -> tuple[Array, UntouchedBackground]:
            return scale_down(image), UntouchedBackground(image)

        if self._video is None:
            return Backgrounds(self.manifest).shared(made, 32)
        count = len(self.manifest)
        chosen = range(0, count, -(-count // FRAMES))
        of_video = made(recording_gel(map(self._video.read, chosen))[0])
        return lambda _: of_video

    def _check_filters(self, filters: dict[str, str]) -> None:
        """Raise UserError for a filter that the table does not have."""
        unknown = sorted(filters.keys() - self._filters.keys())
        if unknown:
            raise UserError(f"{unknown[0][:50]} is no filter of this table.")

    def _check(self, row: int) -> None:
        if not 0 <= row < len(self.manifest):
            raise UserError(f"The table has {len(self.manifest)} rows, no row {row}.")

    @cached_property
    def _order(self) -> tuple[Array, Array]:
        """Row ids by recording and frame, and the first position of each recording."""
        sequence = self.manifest.codes("sequence", own=True)
        frame = np.asarray(self.manifest.table["frame_index"])
        step = np.diff(sequence)
        if (step >= 0).all() and ((step > 0) | (np.diff(frame) >= 0)).all():
            # Readers write rows in this order, and sorting millions of them takes seconds.
            order = np.arange(len(sequence))
        else:
            order = np.lexsort((frame, sequence))
        return order, np.flatnonzero(np.diff(sequence[order], prepend=-1))

    @cached_property
    def _touch_of(self) -> Array:
        """The number of each recording's touch, by that of its first frame."""
        order, starts = self._order
        touch = self.manifest.codes("touch", own=True)[order[starts]]
        alone = touch < 0
        touch[alone] = touch.max(initial=-1) + 1 + np.arange(alone.sum())
        return np.unique(touch, return_inverse=True)[1]

    @cached_property
    def _ranks(self) -> Array:
        ranks = np.empty(len(self.manifest), np.int64)
        ranks[self._order[0]] = np.arange(len(ranks))
        return ranks

    def _position(self, row: int) -> int:
        self._check(row)
        return int(self._ranks[row])

    def _rows(self, recording: int) -> Array:
        order, starts = self._order
        end = starts[recording + 1] if recording + 1 < len(starts) else len(order)
        return order[starts[recording] : end]

    def _choose(self, filters: tuple[tuple[str, str], ...]) -> Array:
        """Return which recordings have a row that passes all filters."""
        order, starts = self._order
        if not filters:
            return np.ones(len(starts), bool)
        passes = np.ones(len(self.manifest), bool)
        for name, value in filters:
            same = pc.equal(self.manifest.column(name).cast(pa.string()), value)
            passes &= np.asarray(pc.fill_null(same, False))
        return np.logical_or.reduceat(passes[order], starts)

    def _touches(self, filters: tuple[tuple[str, str], ...]) -> Array:
        return np.unique(self._touch_of[self._chosen(filters)])

    @cached_property
    def _filters(self) -> dict[str, list[str]]:
        names = [
            name
            for name in self.manifest.table.column_names
            if name in _FILTERS or name.startswith("label.")
        ]
        values = {}
        for name in names:
            column = self.manifest.table[name]
            if name != "object" and pa.types.is_floating(column.type):
                continue
            distinct = column.unique().drop_null()
            if len(distinct) > 1 and (len(distinct) <= _MOST_CHOICES or name == "object"):
                values[name] = sorted(distinct.cast(pa.string()).to_pylist())[:_MOST_CHOICES]
        return values

    def _clip(self, recording: int) -> dict[str, Any]:
        """Return what the page shows of a recording: its rows, keys, caption, labels and curves."""
        rows = self._rows(recording)
        whole = len(rows)
        rows = rows[:_MOST_ROWS]
        table = self.manifest.table.take(pa.array(rows))
        first = {name: table[name][0].as_py() for name in table.column_names}
        labels = {}
        curves = {}
        for name in table.column_names:
            if not name.startswith("label."):
                continue
            column = table[name]
            if pa.types.is_floating(column.type) or pa.types.is_integer(column.type):
                values = [None if value != value else value for value in column.to_pylist()]
                if len(set(values)) > 1:
                    curves[name] = values
            labels[name] = _one_of(column.unique().drop_null().to_pylist())
        names = ("sensor", "unit", "sequence", "object", "split", "dataset", "text")
        keys = {
            name: first[name]
            for name in names
            if first.get(name) not in (None, "", UNKNOWN, UNUSED)
        }
        return keys | {
            "rows": rows.tolist(),
            "frames": table["frame_index"].to_pylist(),
            "whole": whole,
            "labels": labels,
            "curves": curves,
            "photo": bool(first.get("image_path")),
            "background": bool(first.get("background_path")),
            "threshold": self.threshold(int(rows[0])),
        }


def _one_of(values: list[Any]) -> Any:
    """Return the only value, None of none, or how many there are."""
    if len(values) > 1:
        return f"{len(values)} values"
    return values[0] if values else None


class _Video:
    """Frames of a video by number. The next frame is read without a search."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = threading.Lock()
        self._next = 0
        self._video = open_video(path)
        self.read = lru_cache(256)(self._read)

    def _read(self, number: int) -> Array:
        with self._lock, QUIET:
            if number != self._next:
                self._video.set(cv2.CAP_PROP_POS_FRAMES, number)
            whole, frame = self._video.read()
            self._next = number + 1 if whole else -1
        if not whole or frame is None:
            raise UserError(f"Frame {number} of {self._path} cannot be read.")
        return np.ascontiguousarray(to_rgb(scale_down(frame), self._path)[..., ::-1])


def open_folder(folder: Path) -> Table:
    """Return the images of a folder as one recording. Raises UserError if there are none."""
    frames, named = list_images(folder)
    return Table(
        _one_recording(
            folder,
            [file.relative_to(folder).as_posix() for file in frames],
            named.get("background"),
        ),
        title(folder),
    )


def open_video_table(video: Path) -> Table:
    """Return the frames of a video as one recording. Raises UserError if it has none."""
    count = count_frames(video)
    if not count:
        raise UserError(
            f"{video} is no video that can be read. Name a manifest, a folder of images or a video."
        )
    return Table(_one_recording(video.parent, [video.name] * count, None), video.stem, video)


def open_examples() -> Table:
    """Return the example touches of the package: two presses, each by three sensors."""
    touches = [
        file.stem.split("-") for file in sorted(EXAMPLES.glob("*.jpg")) if file.stem.count("-") == 1
    ]
    names = ["-".join(touch) for touch in touches]
    columns = {
        "path": [f"{name}.jpg" for name in names],
        "sensor": [sensor for _, sensor in touches],
        "sequence": names,
        "frame_index": [0] * len(names),
        "split": [UNUSED] * len(names),
        "touch": [press for press, _ in touches],
        "background_path": [f"{name}-background.jpg" for name in names],
    }
    return Table(manifests.from_columns(columns, EXAMPLES / "manifest.parquet"), "examples")


def title(path: Path) -> str:
    """Return the name of a file or folder for people.

    A manifest or features are called by their folder.
    """
    path = path.absolute()
    if path.stem in ("manifest", "features"):
        plain = path.parent.name
    elif path.suffix:
        plain = path.stem
    else:
        plain = path.name
    return plain or "recordings"


def _one_recording(folder: Path, names: list[str], background: Path | None) -> Manifest:
    count = len(names)
    columns: dict[str, Any] = {
        "path": names,
        "sensor": [UNKNOWN] * count,
        "sequence": [UNKNOWN] * count,
        "frame_index": list(range(count)),
        "split": [UNUSED] * count,
    }
    if background is not None:
        columns["background_path"] = [background.name] * count
    return manifests.from_columns(columns, folder / "manifest.parquet")


@cache
def _encoder() -> Encoder:
    from anytouch_jax.encoder.encoder import load_encoder

    # It measures recordings, for which nobody named an encoder.
    return load_encoder("anytouch-tiny")
