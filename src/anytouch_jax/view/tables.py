"""What the page shows of files: touches of a manifest, a folder of pictures or a film, and run folders.

A touch is the recordings (sequences) that share a value of `touch`, by any sensors. A recording without one is a touch
by itself. Pictures are read when they are shown.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax import encoder
from anytouch_jax.config import parse_json
from anytouch_jax.data.gels import FRAMES, UnitGels, recording_gel
from anytouch_jax.data.images import QUIET, count_frames, decode, list_images, open_video, to_rgb
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.prepare.contact import DEFAULT_THRESHOLD, THRESHOLDS
from anytouch_jax.data.prepare.untouched_gel import UntouchedGel, contact_score, scale_picture
from anytouch_jax.data.transforms import subtract_background
from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    from anytouch_jax.encoder.fields import Fields

Array = npt.NDArray[Any]
UNKNOWN, UNUSED = "unknown", "unused"  # the sensor and the split of a folder or a film, which the page leaves out
EXAMPLES = Path(encoder.__file__).with_name("examples")  # PRESS-SENSOR.jpg, and PRESS-SENSOR-background.jpg
LAYERS = ("frame", "difference", "contact", "depth", "surface")  # of a touch, by which the page shows it
MEASURED = LAYERS[3:]  # those that an encoder measures
SIDE = 640  # pixels of the long side of a picture on the page
_MOST_ROWS, _MOST_CLIPS, _MOST_CHOICES = 5000, 12, 500  # frames of a clip, clips of a touch, values of a filter
_CLIP = 3  # frames on which a touch is measured
_LINES = 2_000  # points of a loss curve on the page
_BLOCK = 1 << 22  # bytes of metrics.jsonl that are read at once
_FILTERS = ("sensor", "object", "split", "dataset", "unit")
_TINTED = (np.arange(256)[None, :, None] / 2 + (127, 60, 0)).astype(np.uint8)  # colours of contact


class Table:
    """Touches of a manifest. `film` is a video whose frames are the rows."""

    kind = "table"

    def __init__(self, manifest: Manifest, name: str, film: Path | None = None) -> None:
        self.manifest, self.name = manifest, name
        self._film = None if film is None else _Film(film)
        self._chosen, self._measured = lru_cache(8)(self._choose), lru_cache(256)(self._measure)

    def about(self) -> dict[str, Any]:
        """Return the number of rows and touches, and the columns that filter them with their values."""
        about = {"rows": len(self.manifest), "touches": len(self._touches(()))}
        return about | {"filters": self._filters, "layers": LAYERS}

    def touch(self, place: int, filters: dict[str, str]) -> dict[str, Any]:
        """Return touch `place` among those that pass `filters` {column: value}: its clips, and how many there are.

        Raises UserError for a column that is no filter.
        """
        if unknown := sorted(filters.keys() - self._filters.keys()):
            raise UserError(f"{unknown[0][:50]} is no filter of this table.")
        chosen = tuple(sorted(filters.items()))
        touches = self._touches(chosen)
        if not len(touches):
            return {"count": 0, "place": 0, "clips": []}
        place = min(max(place, 0), len(touches) - 1)
        recordings = np.flatnonzero((self._touch_of == touches[place]) & self._chosen(chosen))
        clips = [self._clip(int(one)) for one in recordings[:_MOST_CLIPS]]
        name = self.manifest.value(clips[0]["rows"][0], "touch") or clips[0].get("sequence", self.name)
        more = max(0, len(recordings) - _MOST_CLIPS)
        return {"count": len(touches), "place": place, "name": name, "clips": clips, "more": more}

    def place_of(self, row: int) -> int:
        """Return the place of the touch of a row, without filters."""
        at = int(np.searchsorted(self._order[1], self._position(row), "right")) - 1
        return int(np.searchsorted(self._touches(()), self._touch_of[at]))

    def frame(self, row: int) -> Array:
        """Return the picture of a row, RGB u8 (h, w, 3). Raises UserError."""
        self._check(row)
        if self._film is not None:
            return self._film.read(int(self.manifest.value(row, "frame_index")))
        return decode(self.manifest.file(row))

    def photo(self, row: int) -> Array:
        """Return the photograph of a row, RGB u8 (h, w, 3). Raises UserError if there is none."""
        self._check(row)
        return decode(self.manifest.file(row, "image_path"))

    def layer(self, row: int, name: str) -> tuple[Array, float, Fields | None]:
        """Return a layer of a row (see `touch_layer`), its contact score, NaN without an untouched gel, and its fields.

        Fields are for the layers MEASURED.
        """
        frame, gel = self.frame(row), self._untouched(row)
        view, score = touch_layer(frame, gel, self.threshold(row), name)
        if name not in MEASURED or gel is None or score != score:
            return view, score, None
        from anytouch_jax.view.measured import measured_layer

        fields = self._measured(row)
        return measured_layer(view, fields, name), score, fields

    def _measure(self, row: int) -> Fields:
        from anytouch_jax.view.measured import measure_recorded

        order, starts = self._order
        end = self._position(row) + 1
        rows = order[max(starts[starts < end][-1], end - _CLIP) : end].tolist()
        gel, sensor = self._untouched(row), self.manifest.value(row, "sensor")
        frames = [self.frame(one) for one in rows]
        return measure_recorded(frames, gel and gel[0], None if sensor == UNKNOWN else sensor)

    def threshold(self, row: int) -> float:
        """Return the contact score above which a frame of the row's sensor shows contact."""
        return THRESHOLDS.get(self.manifest.value(row, "sensor"), DEFAULT_THRESHOLD)

    @cached_property
    def _untouched(self) -> Callable[[int], tuple[Array, UntouchedGel] | None]:
        """A function from a row to its untouched gel, scaled down and to compare, None if it is unknown."""

        def made(picture: Array) -> tuple[Array, UntouchedGel]:
            return scale_down(picture), UntouchedGel(picture)

        if self._film is None:
            return UnitGels(self.manifest).shared(made, 32)
        count = len(self.manifest)
        of_film = made(recording_gel(map(self._film.read, range(0, count, -(-count // FRAMES))))[0])
        return lambda _: of_film

    def _check(self, row: int) -> None:
        if not 0 <= row < len(self.manifest):
            raise UserError(f"The table has {len(self.manifest)} rows, no row {row}.")

    @cached_property
    def _order(self) -> tuple[Array, Array]:
        """Row ids by recording and frame, and the first position of each recording."""
        sequence, frame = self.manifest.codes("sequence", own=True), np.asarray(self.manifest.table["frame_index"])
        step = np.diff(sequence)
        if (step >= 0).all() and ((step > 0) | (np.diff(frame) >= 0)).all():  # as readers write
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
            passes &= np.asarray(pc.fill_null(pc.equal(self.manifest.column(name).cast(pa.string()), value), False))
        return np.logical_or.reduceat(passes[order], starts)

    def _touches(self, filters: tuple[tuple[str, str], ...]) -> Array:
        return np.unique(self._touch_of[self._chosen(filters)])

    @cached_property
    def _filters(self) -> dict[str, list[str]]:
        names = [name for name in self.manifest.table.column_names if name in _FILTERS or name.startswith("label.")]
        values = {}
        for name in names:
            column = self.manifest.table[name]
            if name == "object" or not pa.types.is_floating(column.type):
                distinct = column.unique().drop_null()
                if len(distinct) > 1 and (len(distinct) <= _MOST_CHOICES or name == "object"):
                    values[name] = sorted(distinct.cast(pa.string()).to_pylist())[:_MOST_CHOICES]
        return values

    def _clip(self, recording: int) -> dict[str, Any]:
        """Return what the page shows of a recording: its rows, keys, caption, labels and curves."""
        rows = self._rows(recording)
        whole, rows = len(rows), rows[:_MOST_ROWS]
        table = self.manifest.table.take(pa.array(rows))
        first = {name: table[name][0].as_py() for name in table.column_names}
        labels, curves = {}, {}
        for name in (name for name in table.column_names if name.startswith("label.")):
            column = table[name]
            if pa.types.is_floating(column.type) or pa.types.is_integer(column.type):
                curves[name] = [None if value != value else value for value in column.to_pylist()]
            values = column.unique().drop_null().to_pylist()
            labels[name] = values[0] if len(values) == 1 else None if not values else f"{len(values)} values"
        names = ("sensor", "unit", "sequence", "object", "split", "dataset", "text")
        keys = {name: first[name] for name in names if first.get(name) not in (None, "", UNKNOWN, UNUSED)}
        return keys | {
            "rows": rows.tolist(), "frames": table["frame_index"].to_pylist(), "whole": whole, "labels": labels,
            "curves": {name: values for name, values in curves.items() if len(set(values)) > 1},
            "photo": bool(first.get("image_path")), "background": bool(first.get("background_path")),
            "threshold": self.threshold(int(rows[0])),
        }  # fmt: skip


class _Film:
    """Frames of a video by number. The next frame is read without a search."""

    def __init__(self, path: Path) -> None:
        self._path, self._lock, self._next = path, threading.Lock(), 0
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


def scale_down(picture: Array, side: int = SIDE) -> Array:
    """Return a picture whose long side has at most `side` pixels."""
    return picture if max(picture.shape[:2]) <= side else scale_picture(picture, side)


def touch_layer(
    frame: Array, gel: tuple[Array, UntouchedGel] | None, threshold: float, name: str
) -> tuple[Array, float]:
    """Return one of LAYERS as a picture RGB u8 (h, w, 3), and the contact score.

    They are the frame, its difference from the untouched gel as an encoder reads it, and its contact. For MEASURED, it
    is the frame, which is not measured here. Without a `gel` (scaled down) of the same proportions, the frame is
    returned, and the score is NaN. Raises UserError for another name.
    """
    if name not in LAYERS:
        raise UserError(f"A touch has the layers {', '.join(LAYERS)}, not {name[:20]}.")
    view = scale_down(frame)
    height, width = view.shape[:2]
    try:
        change = None if gel is None else gel[1].difference(frame)
    except ValueError:
        change = None
    if gel is None or change is None:
        return view, float("nan")
    if name == "difference":
        background = gel[0] if gel[0].shape == view.shape else cv2.resize(gel[0], (width, height))
        (view,) = subtract_background([view], background)
    elif name == "contact":
        mask, tinted = (cv2.resize(change, (width, height)) > threshold).astype(np.uint8), cv2.LUT(view, _TINTED)
        view = cv2.convertScaleAbs(view, alpha=1 / 3, beta=40)
        cv2.copyTo(tinted, mask, view)
    return view, contact_score(change)


def open_folder(folder: Path) -> Table:
    """Return the pictures of a folder as one recording. Raises UserError if there are none."""
    frames, named = list_images(folder)
    return Table(_one_recording(folder, [file.name for file in frames], named.get("background")), title(folder))


def open_film(film: Path) -> Table:
    """Return the frames of a film as one recording. Raises UserError if it has none."""
    count = count_frames(film)
    if not count:
        raise UserError(f"{film} is no film that can be read. Name a manifest, a folder of pictures or a film.")
    return Table(_one_recording(film.parent, [film.name] * count, None), film.stem, film)


def open_examples() -> Table:
    """Return the example touches of the package: two presses, each by three sensors."""
    touches = [file.stem.split("-") for file in sorted(EXAMPLES.glob("*.jpg")) if file.stem.count("-") == 1]
    names = ["-".join(touch) for touch in touches]
    columns = {
        "path": [f"{name}.jpg" for name in names], "sensor": [sensor for _, sensor in touches], "sequence": names,
        "frame_index": [0] * len(names), "split": [UNUSED] * len(names), "touch": [press for press, _ in touches],
        "background_path": [f"{name}-background.jpg" for name in names],
    }  # fmt: skip
    return Table(manifests.from_columns(columns, EXAMPLES / "manifest.parquet"), "examples")


def title(path: Path) -> str:
    """Return the name of a file or folder for people: a manifest or features are called by their folder."""
    path = path.absolute()
    plain = path.parent.name if path.stem in ("manifest", "features") else path.stem if path.suffix else path.name
    return plain or "recordings"


def _one_recording(folder: Path, names: list[str], background: Path | None) -> Manifest:
    count = len(names)
    columns: dict[str, Any] = {
        "path": names, "sensor": [UNKNOWN] * count, "sequence": [UNKNOWN] * count,
        "frame_index": list(range(count)), "split": [UNUSED] * count,
    }  # fmt: skip
    if background is not None:
        columns["background_path"] = [background.name] * count
    return manifests.from_columns(columns, folder / "manifest.parquet")


class Run:
    """A run folder of `anytouch train`, also while it trains: its metrics.jsonl and figures/."""

    kind = "run"

    def __init__(self, folder: Path) -> None:
        self.name, self._folder = folder.name, folder.resolve()

    def about(self) -> dict[str, Any]:
        """Return nothing: all of it may change."""
        return {}

    def losses(self, start: int) -> dict[str, Any]:
        """Return lines {step, loss, ...} of metrics.jsonl from byte `start`, the byte after them, and the figures.

        A file that has become shorter is read from its beginning.
        """
        file = self._folder / "metrics.jsonl"
        lines: list[dict[str, float]] = []
        if file.is_file():
            start = start if 0 <= start <= file.stat().st_size else 0
            with open(file, "rb") as opened:
                opened.seek(start)
                block = opened.read(_BLOCK)
            whole = block[: block.rfind(b"\n") + 1]
            for line in whole.splitlines():
                try:
                    row = parse_json(line.decode())
                except ValueError:
                    continue
                if isinstance(row, dict) and _is_number(row.get("step")):
                    lines.append({str(name)[:60]: value for name, value in row.items() if _is_number(value)})
            start += len(whole)
        every = -(-len(lines) // _LINES)
        return {"lines": lines[:: max(1, every)], "next": start, "figures": sorted(self._figures(), reverse=True)}

    def figure(self, name: str) -> np.ndarray:
        """Return a figure of the run, RGB u8 (h, w, 3). Raises UserError."""
        if name not in self._figures():
            raise UserError("The run has no such figure.")
        return decode(self._figures()[name])

    def _figures(self) -> dict[str, Path]:
        """Return the PNG files in figures/ by name, without links to other places."""
        files = sorted((self._folder / "figures").glob("*.png"))
        return {file.name: file for file in files if file.resolve().is_relative_to(self._folder)}


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and abs(value) < 1e300  # not NaN: no comparison with it is true
