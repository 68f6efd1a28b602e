"""What the page shows of files: touches of a manifest, a folder of pictures or a film, features,
and run folders.

A touch is the recordings (sequences) that share a value of `touch`, or one without. Pictures are
read when shown, and libraries that take seconds are imported when they are needed.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from functools import cache, cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax import encoder
from anytouch_jax.config import UNIVERSAL, parse_json
from anytouch_jax.data.background.contact import DEFAULT_THRESHOLD, THRESHOLDS
from anytouch_jax.data.background.estimate import UntouchedGel, contact_score, scale_picture
from anytouch_jax.data.background.rule import FRAMES, UnitGels, recording_gel
from anytouch_jax.data.images import QUIET, count_frames, decode, list_images, open_video, to_rgb
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.transforms import subtract_background
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.fields.measure import Fields

# the sensor and the split of a folder or a film, which the page leaves out
UNKNOWN = "unknown"
UNUSED = "unused"
# PRESS-SENSOR.jpg, and PRESS-SENSOR-background.jpg
EXAMPLES = Path(encoder.__file__).with_name("examples")
# of a touch, by which the page shows it
LAYERS = ("frame", "difference", "contact", "depth", "surface")
MEASURED = LAYERS[3:]  # those that an encoder measures
SIDE = 640  # pixels of the long side of a picture on the page
# frames of a clip, clips of a touch, values of a filter
_MOST_ROWS = 5000
_MOST_CLIPS = 12
_MOST_CHOICES = 500
_CLIP = 3  # frames on which a touch is measured
_LINES = 2_000  # points of a loss curve on the page
_SHARP = 480  # pixels of the long side of a picture with arrows, at least
_SIDE = 72  # cells of a surface along the long side of the picture
_ONE_BY_ONE = threading.Lock()
METHODS = {"pca": 20_000, "tsne": 2_000}  # and how many points each draws
_NAMES = 20  # values of a column with a colour each
_NEAR = 40  # frames of a recording that may be nearer than the next recording, on average
_BLOCK = 1 << 22  # bytes of metrics.jsonl that are read at once
_FILTERS = ("sensor", "object", "split", "dataset", "unit")
# colours of contact
_TINTED = (np.arange(256)[None, :, None] / 2 + (127, 60, 0)).astype(np.uint8)


class Table:
    """Touches of a manifest. `film` is a video whose frames are the rows."""

    kind = "table"

    def __init__(self, manifest: Manifest, name: str, film: Path | None = None) -> None:
        self.manifest = manifest
        self.name = name
        self._film = None if film is None else _Film(film)
        self._chosen = lru_cache(8)(self._choose)
        self._measured = lru_cache(256)(self._measure)

    def about(self) -> dict[str, Any]:
        """Return the number of rows and touches, and the columns that filter them with their
        values.
        """
        about = {"rows": len(self.manifest), "touches": len(self._touches(()))}
        return about | {"filters": self._filters, "layers": LAYERS}

    def touch(self, place: int, filters: dict[str, str]) -> dict[str, Any]:
        """Return touch `place` among those that pass `filters` {column: value}, and their number.

        Raises UserError.
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
        name = self.manifest.value(clips[0]["rows"][0], "touch") or clips[0].get(
            "sequence", self.name
        )
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
        """Return a layer of a row (see `touch_layer`), its contact score, and its fields for the
        layers MEASURED.
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
        rows = order[max(starts[starts < end][-1], end - _CLIP) : end].tolist()
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
    def _untouched(self) -> Callable[[int], tuple[Array, UntouchedGel] | None]:
        """A function from a row to its untouched gel, scaled down and to compare, None if it is
        unknown.
        """

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
        sequence = self.manifest.codes("sequence", own=True)
        frame = np.asarray(self.manifest.table["frame_index"])
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
            passes &= np.asarray(
                pc.fill_null(pc.equal(self.manifest.column(name).cast(pa.string()), value), False)
            )
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
            if name == "object" or not pa.types.is_floating(column.type):
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
        for name in (name for name in table.column_names if name.startswith("label.")):
            column = table[name]
            if pa.types.is_floating(column.type) or pa.types.is_integer(column.type):
                curves[name] = [None if value != value else value for value in column.to_pylist()]
            values = column.unique().drop_null().to_pylist()
            labels[name] = (
                values[0] if len(values) == 1 else None if not values else f"{len(values)} values"
            )
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
            "curves": {name: values for name, values in curves.items() if len(set(values)) > 1},
            "photo": bool(first.get("image_path")),
            "background": bool(first.get("background_path")),
            "threshold": self.threshold(int(rows[0])),
        }


class _Film:
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


def scale_down(picture: Array, side: int = SIDE) -> Array:
    """Return a picture whose long side has at most `side` pixels."""
    if max(picture.shape[:2]) <= side:
        return picture
    return scale_picture(picture, side)


def touch_layer(
    frame: Array, gel: tuple[Array, UntouchedGel] | None, limit: float, name: str
) -> tuple[Array, float]:
    """Return one of LAYERS as a picture RGB u8 (h, w, 3), and the contact score.

    Without a `gel` (scaled down) of the same proportions, it is the frame, and the score is NaN.
    For MEASURED it is the frame, too. Raises UserError for another name.
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
        mask = (cv2.resize(change, (width, height)) > limit).astype(np.uint8)
        tinted = cv2.LUT(view, _TINTED)
        view = cv2.convertScaleAbs(view, alpha=1 / 3, beta=40)
        cv2.copyTo(tinted, mask, view)
    return view, contact_score(change)


def open_folder(folder: Path) -> Table:
    """Return the pictures of a folder as one recording. Raises UserError if there are none."""
    frames, named = list_images(folder)
    return Table(
        _one_recording(folder, [file.name for file in frames], named.get("background")),
        title(folder),
    )


def open_film(film: Path) -> Table:
    """Return the frames of a film as one recording. Raises UserError if it has none."""
    count = count_frames(film)
    if not count:
        raise UserError(
            f"{film} is no film that can be read. Name a manifest, a folder of pictures or a film."
        )
    return Table(_one_recording(film.parent, [film.name] * count, None), film.stem, film)


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
    """Return the name of a file or folder for people: a manifest or features are called by their
    folder.
    """
    path = path.absolute()
    plain = (
        path.parent.name
        if path.stem in ("manifest", "features")
        else path.stem
        if path.suffix
        else path.name
    )
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


class Run:
    """A run folder of `anytouch train`, also while it trains: its metrics.jsonl and figures/."""

    kind = "run"

    def __init__(self, folder: Path) -> None:
        self.name = folder.name
        self._folder = folder.resolve()

    def about(self) -> dict[str, Any]:
        """Return nothing: all of it may change."""
        return {}

    def losses(self, start: int) -> dict[str, Any]:
        """Return lines {step, loss, ...} of metrics.jsonl from byte `start`, the byte after them,
        and the figures.
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
                    lines.append(
                        {str(name)[:60]: value for name, value in row.items() if _is_number(value)}
                    )
            start += len(whole)
        every = -(-len(lines) // _LINES)
        return {
            "lines": lines[:: max(1, every)],
            "next": start,
            "figures": sorted(self._figures(), reverse=True),
        }

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
    # not NaN: no comparison with it is true
    return isinstance(value, int | float) and abs(value) < 1e300


@cache
def _encoder() -> Encoder:
    from anytouch_jax.encoder.encoder import load_encoder

    # measures recordings, by which no encoder is named
    return load_encoder("anytouch-tiny")


def last_clip(frames: Sequence[Array], length: int) -> Array:
    """Return the last frames as a clip (length, h, w, 3).

    Before the first of them nothing moved.
    """
    same = [frame for frame in frames[-length:] if frame.shape == frames[-1].shape]
    return np.stack([same[0]] * (length - len(same)) + same)


def measured_layer(frame: Array, measured: Fields, name: str) -> Array:
    """Return what was measured of a frame as a picture u8 (h, w, 3): "depth" on the frame, or a
    "surface" in grey.
    """
    from anytouch_jax.fields.measure import depth_levels, overlay

    if name == "depth":
        # lines on few pixels would be thick
        larger = max(1.0, _SHARP / max(frame.shape[:2]))
        return overlay(cv2.resize(frame, None, fx=larger, fy=larger), measured, text=False)
    scale = _SIDE / max(1.0, measured.shape)
    small = cv2.resize(measured.depth[0], (round(scale), round(scale * measured.shape)))
    return cv2.cvtColor(depth_levels(small, measured.width_mm)[0], cv2.COLOR_GRAY2RGB)


def field_numbers(measured: Fields) -> dict[str, Any]:
    """Return what the page writes of a frame; `high` is the depth of a white place of the surface,
    in widths.
    """
    from anytouch_jax.fields.measure import depth_levels

    about = measured.summary()
    unit = "widths" if measured.width_mm is None else "mm"
    curves = {"force, N": about["force_z"], f"depth, {unit}": about["depth"]}
    curves["slip"] = about["slip"] if measured.area[0] > 0 else 0.0
    _, high = depth_levels(measured.depth[0], measured.width_mm)
    return {
        "curves": {name: round(value, 4) for name, value in curves.items() if value is not None},
        "force": None if measured.force is None else [about[f"force_{axis}"] for axis in "xyz"],
        "force_std": about["force_z_std"],
        "sideways_std": about["force_x_std"],
        "depth": about["depth"],
        "depth_std": about["depth_std"],
        "area": about["area"],
        "unit": unit,
        "faults": measured.faults,
        "high": high / (measured.width_mm or 1.0),
    }


class FeatureMap:
    """A features file of `anytouch embed`, with pictures of the first of `tables` that has its
    rows; or UserError.
    """

    kind = "space"

    def __init__(self, path: Path, tables: list[Table]) -> None:
        from anytouch_jax.encoder.embed import load_index

        self.name = title(path)
        self.index = load_index(path)
        self._rows = self.index.rows
        self.table = next(
            (number for number, table in enumerate(tables) if self._has_rows_of(table)), None
        )
        self.map = lru_cache(len(METHODS))(self._map)

    def about(self) -> dict[str, Any]:
        """Return the number of features, the columns that colour them, and where they come from."""
        about = {"count": len(self._rows), "columns": sorted(self.index.keys), "table": self.table}
        about["sensors"] = len(np.unique(self.index.keys.get("sensor", np.zeros(1))))
        return about | {"methods": list(METHODS), "from": self.index.about}

    def _map(self, method: str) -> dict[str, Any]:
        """Return points {x, y, rows} in -1..1 of at most METHODS[method] rows, evenly spread.

        Raises UserError.
        """
        if method not in METHODS:
            raise UserError(f"A map is by {' or '.join(METHODS)}, not {method[:20]}.")
        rows = np.unique(
            np.linspace(0, len(self._rows) - 1, min(METHODS[method], len(self._rows))).astype(int)
        )
        values = self.index.values[rows]
        if method == "tsne":
            from anytouch_jax.evaluate.plots import tsne

            points = tsne(values)
        else:
            centred = values - values.mean(0)
            points = centred @ np.linalg.eigh(centred.T @ centred)[1][:, :-3:-1]
            points = np.pad(points, ((0, 0), (0, 2 - points.shape[1])))
        points = points - (points.max(0) + points.min(0)) / 2
        points = points / max(float(np.abs(points).max()), 1e-9)
        return {
            "x": points[:, 0].round(4).tolist(),
            "y": points[:, 1].round(4).tolist(),
            "rows": rows.tolist(),
        }

    def colours(self, method: str, column: str) -> dict[str, Any]:
        """Return {values} of a column of numbers, or {codes, names}, for the points of a map.

        Raises UserError.
        """
        if column not in self.index.keys:
            raise UserError(f"The features have no column {column[:50]}.")
        values = self.index.keys[column][self.map(method)["rows"]]
        if values.dtype.kind in "iuf" and len(np.unique(values)) > _NAMES:
            return {
                "values": [None if not np.isfinite(value) else float(value) for value in values]
            }
        distinct, codes, counts = np.unique(
            values.astype(str), return_inverse=True, return_counts=True
        )
        shown = np.sort(np.argsort(-counts, kind="stable")[:_NAMES])
        place = np.full(len(distinct), len(shown))
        place[shown] = np.arange(len(shown))
        names = [*distinct[shown].tolist(), *(["others"] if len(distinct) > len(shown) else [])]
        return {"codes": place[codes].tolist(), "names": names}

    def neighbours(self, row: int, *, others: bool) -> dict[str, Any]:
        """Return a row and its ten nearest of other recordings, by cosine; of other sensors with
        `others`.
        """
        if not 0 <= row < len(self._rows):
            raise UserError(f"There are {len(self._rows)} features, no row {row}.")
        allowed = np.ones(len(self._rows), bool)
        allowed[row] = False
        for name in ("sequence", *(["sensor"] if others else [])):
            if name in self.index.keys:
                allowed &= self.index.keys[name] != self.index.keys[name][row]
        found = self.near(self.index.values[row], np.flatnonzero(allowed))
        return {"row": self._describe(row), "hits": found}

    def near(
        self, values: Array, among: Array | None = None, count: int = 10
    ) -> list[dict[str, Any]]:
        """Return the nearest of `among` rows (m,) to unit features (d,) with cosines, one frame of
        a recording.
        """
        from anytouch_jax.encoder.embed import nearest

        among = np.arange(len(self._rows)) if among is None else among
        if not len(among):
            return []
        stored = self.index.values if len(among) == len(self._rows) else self.index.values[among]
        places, cosines = nearest(stored, values[None], min(_NEAR * count, len(among)))
        rows = among[places[0]]
        if "sequence" in self.index.keys:
            rows = rows[np.sort(np.unique(self.index.keys["sequence"][rows], return_index=True)[1])]
        cosine = dict(zip(among[places[0]].tolist(), cosines[0].tolist(), strict=True))
        return [
            self._describe(row) | {"cosine": round(cosine[row], 4)} for row in rows[:count].tolist()
        ]

    def _describe(self, row: int) -> dict[str, Any]:
        return {"row": row, "table_row": int(self._rows[row]), "about": self.index.describe(row)}

    def _has_rows_of(self, table: Table) -> bool:
        """Whether the rows of the file are rows of a table: the same frames at the first, middle
        and last.
        """
        few = self._rows[[0, len(self._rows) // 2, -1]]
        if few.min() < 0 or self._rows.max() >= len(table.manifest):
            return False
        keys = [name for name in ("path", "frame_index") if name in self.index.keys]
        ours = {
            name: self.index.keys[name][[0, len(self._rows) // 2, -1]].astype(str).tolist()
            for name in keys
        }
        there = {
            name: [str(table.manifest.value(row, name)).rpartition("/")[2] for row in few]
            for name in keys
        }
        return bool(keys) and all(
            [one.rpartition("/")[2] for one in ours[name]] == there[name] for name in keys
        )
