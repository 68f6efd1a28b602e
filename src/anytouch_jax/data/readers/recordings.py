"""Recordings of your own: a folder of pictures is a recording, in ROOT or at any depth below it.

    mine/mug/pour_1/000.png ...         the object is the first folder, the recording is the folder
    mine/mug/pour_2.mp4                 with `--export` its frames are written into a folder of its name
    mine/mug/background.png             the untouched gel of every recording in or below this folder
    mine/mug/photo.jpg                  a photograph of the touched object, for the same recordings
    mine/mug/caption.txt                a caption, for the same recordings

Frames are in natural order (2 before 10). Their numbers are the last ones that differ between their names if these
count frames, so that a missing frame is a gap. Otherwise they are counted. If numbers repeat with other words or serial
numbers (left_0.png and right_0.png, or 0_D1.png and 0_D2.png: two fingers), each finger is a sequence and a unit. Whole
objects, or recordings without objects, are held out. With `--split-by recording` some recordings of each object are.
"""

from __future__ import annotations

import hashlib
import unicodedata
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import pyarrow as pa

from anytouch_jax.data import images
from anytouch_jax.data.images import BACKGROUND, PHOTO, SUFFIXES
from anytouch_jax.data.manifest.schema import EMPTY, typed_label
from anytouch_jax.data.readers.common import (
    DatasetError,
    DatasetIndex,
    DatasetReader,
    Frames,
    IndexOptions,
    export_video,
    read_lines,
)

CAPTION = "caption.txt"
MANIFESTS = (".csv", ".parquet")  # of an earlier index
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv")
LABEL_KEYS = ("object", "sequence")
PLAIN_COLUMNS = ("unit", "touch", "text")  # columns of a label table that do not become label.<name>


def read(index: DatasetIndex) -> None:
    """Add every folder of pictures. Raises UserError without a sensor."""
    root, options = index.root, index.options
    sensor = index.need_sensor()
    if options.export:
        _export_videos(index)
    recordings: dict[str, dict[str, Frames]] = {}  # folder -> finger -> frames
    shared: dict[str, dict[str, Any]] = {}  # folder -> cells from the files in it and in the folders above
    for folder, folders, files in index.walk():
        shared[folder] = shared.get(folder.rpartition("/")[0], {}) | _shared_cells(root, folder, files)
        if folder.rpartition("/")[2].lower() in (BACKGROUND, PHOTO):
            index.skip(f"folder called {BACKGROUND} or {PHOTO}, where one picture is expected", folder)
            continue
        # A video with a folder of its name has been exported.
        files = [name for name in files if not (_is_video(name) and Path(name).stem in folders)]
        if fingers := _fingers(index, files, folder):
            recordings[folder] = fingers
    splits = _splits(index, list(recordings))
    for folder, fingers in recordings.items():
        for unit, frames in fingers.items():
            sequence = f"{folder}/{unit}".strip("/") or "."
            index.add_recording(frames, folder, split=splits[folder], sensor=sensor, sequence=sequence,
                                unit=unit or None, object=folder.split("/")[0] or None, dataset=root.name,
                                **shared[folder])  # fmt: skip
    if options.labels is not None and recordings:
        _join_labels(index, options.labels.expanduser())
    for split in ("val", "test"):
        if recordings and split not in splits.values() and getattr(options, split):
            index.notes.append(f"there are too few objects or recordings for split {split}")


def ranked_split(groups: Iterable[str], options: IndexOptions) -> dict[str, str]:
    """Return the split of every group, by rank: sorted by SHA-256, the first are val, the last test, the others train.

    The counts are the rounded shares. A share above 0 gets at least one group, and train too if it has a share; with
    too few groups train comes first, then test. Adding or removing a group moves at most one other at each cut.
    """
    order = sorted(set(groups), key=lambda group: hashlib.sha256(group.encode()).digest())
    most = max(0, len(order) - (options.val + options.test < 1))
    test = min(most, max(round(options.test * len(order)), options.test > 0))
    val = min(most - test, max(round(options.val * len(order)), options.val > 0))
    if options.val and not val and test > 1:
        test, val = test - 1, 1
    parts = ["val"] * val + ["train"] * (len(order) - val - test) + ["test"] * test
    return dict(zip(order, parts, strict=True))


def _splits(index: DatasetIndex, folders: list[str]) -> dict[str, str]:
    """Return the split of every recording: that of its object, or a part of each object's recordings."""
    options = index.options
    objects: dict[str, list[str]] = {}
    for folder in folders:
        objects.setdefault(folder.split("/")[0], []).append(folder)
    if options.split_by == "recording":
        return {name: split for one in objects.values() for name, split in ranked_split(one, options).items()}
    if len(objects) > 1 and options.val + options.test > 0:
        index.notes.append("whole objects are held out; for a classifier of objects: --split-by recording")
    split = ranked_split(objects, options)
    return {folder: split[folder.split("/")[0]] for folder in folders}


def _shared_cells(root: Path, folder: str, files: list[str]) -> dict[str, Any]:
    """Return the background, photograph and caption in a folder. Raises DatasetError for a caption that is no text."""
    cells: dict[str, Any] = {}
    for name in files:
        path = f"{folder}/{name}".lstrip("/")
        stem, suffix = Path(name).stem.lower(), Path(name).suffix.lower()
        if name.lower() == CAPTION:
            try:
                cells["text"] = " ".join((root / path).read_text(encoding="utf-8-sig").split()) or None
            except (OSError, UnicodeDecodeError) as error:
                raise DatasetError(f"{root / path} cannot be read as UTF-8 text: {error}") from None
        elif suffix in SUFFIXES and stem in (BACKGROUND, PHOTO):
            cells["background_path" if stem == BACKGROUND else "image_path"] = path
    return cells


def _fingers(index: DatasetIndex, files: list[str], folder: str) -> dict[str, Frames]:
    """Return the pictures of a folder in order with their numbers, by finger; arrays only if there is nothing else."""
    names = []
    for name in sorted(files, key=images.frame_sort_key):
        path, stem, suffix = f"{folder}/{name}".lstrip("/"), Path(name).stem.lower(), Path(name).suffix.lower()
        if suffix in SUFFIXES and stem not in (BACKGROUND, PHOTO):
            names.append(name)
        elif _is_video(name):
            index.skip("video (--export writes its frames as pictures)", path)
        elif suffix not in (*SUFFIXES, *MANIFESTS) and name.lower() != CAPTION:
            index.skip("file that is no picture", path)
    arrays = [name for name in names if Path(name).suffix.lower() == ".npy"]
    if arrays and len(arrays) < len(names):
        index.skip("array next to pictures", f"{folder}/{arrays[0]}", len(arrays))
        names = [name for name in names if name not in arrays]
    if not names:
        return {}
    series = images.split_series(names)
    return {unit: dict(zip(images.frame_numbers(one), one, strict=True)) for unit, one in series.items()}


def _is_video(name: str) -> bool:
    return Path(name).suffix.lower() in VIDEOS


def _export_videos(index: DatasetIndex) -> None:
    """Write the frames of every video as 000000.png, ... into a folder of its name, unless that exists.

    A video that cannot be read is skipped. Raises UserError if nothing can be written.
    """
    for folder, folders, files in index.tracked(list(index.walk(count=False))):  # before any is made
        for video in (index.root / folder / name for name in files if _is_video(name)):
            if video.stem in folders:
                continue
            folders.append(video.stem)
            try:
                count = export_video(video)
            except images.ImageError:
                index.skip("video that cannot be read", str(video))
            else:
                if 0.98 * (declared := images.count_frames(video)) > count + 2:  # some containers only estimate it
                    index.notes.append(f"{video} declares {declared} frames and {count} could be read; is it whole?")


def _join_labels(index: DatasetIndex, path: Path) -> None:
    """Join the CSV table `path` to the rows by object or sequence; a line of the sequence goes first.

    Names match in any Unicode form. Lines without a recording, and recordings without a line, are skipped. Raises
    DatasetError for a table that is missing, has no key, or has a column or a key twice.
    """
    names, lines = _read_labels(path)
    table, size = index.table, len(index.table["path"])
    labels: dict[str, list[Any]] = {name: [None] * size for name in names if name not in LABEL_KEYS}
    used: set[tuple[str | None, str | None]] = set()
    unlabelled: dict[str, None] = {}
    for row, (obj, sequence) in enumerate(zip(table["object"], table["sequence"], strict=True)):
        names_of = _plain(obj), _plain(sequence)
        keys = [key for key in ((names_of[0], None), (None, names_of[1]), names_of) if any(key) and key in lines]
        used.update(keys)
        for name, cell in (item for key in keys for item in lines[key].items()):
            labels[name][row] = labels[name][row] if cell.lower() in EMPTY else cell
        if not keys:
            unlabelled[sequence] = None
    for key in (key for key in lines if key not in used):
        index.skip(f"key of {path.name} that no recording has", ", ".join(part for part in key if part))
    for sequence in unlabelled:
        index.skip(f"recording without a line in {path.name}", sequence)
    for name, cells in ((name, cells) for name, cells in labels.items() if any(cells)):
        if name in PLAIN_COLUMNS:
            old = table.get(name, [None] * size)
            table[name] = [new or before for new, before in zip(cells, old, strict=True)]
        else:
            column = typed_label(pa.chunked_array([pa.array(cells, pa.string())]))
            table[f"label.{name.removeprefix('label.')}"] = column.to_pylist()


def _read_labels(path: Path) -> tuple[list[str], dict[tuple[str | None, str | None], dict[str, str]]]:
    """Return the columns of the table, and (object, sequence) -> the other cells; an empty key cell is None."""
    rows = read_lines(path)
    names = rows[0][1] if rows else []
    if not set(LABEL_KEYS) & set(names):
        raise DatasetError(f"{path} has no column object or sequence, by which labels are joined; it has "
                           f"{', '.join(names)}")  # fmt: skip
    if repeated := [name for name in names if names.count(name) > 1]:
        raise DatasetError(f"{path} has the column {repeated[0]!r} twice")
    lines: dict[tuple[str | None, str | None], dict[str, str]] = {}
    for line, row in rows[1:]:
        if len(row) < len(names) or any(row[len(names) :]):
            raise DatasetError(f"{path}, line {line}: {len(row)} cells for {len(names)} columns; quote its commas")
        cells = dict(zip(names, row, strict=False))
        key = (_plain(cells.pop("object", None)), _plain((cells.pop("sequence", "") or "").replace("\\", "/")))
        if not any(key):
            raise DatasetError(f"{path}, line {line}: there is neither an object nor a sequence; fill in one")
        if key in lines:
            raise DatasetError(
                f"{path}, line {line}: {', '.join(part for part in key if part)} is there twice; keep one"
            )
        lines[key] = {name: cell for name, cell in cells.items() if name}
    for name in (name for name in names if name not in (*LABEL_KEYS, *PLAIN_COLUMNS, "")):
        column = pa.chunked_array([pa.array([cells.get(name) for cells in lines.values()], pa.string())])
        typed_label(column, name, lambda row: f"{path}, line {rows[row + 1][0]}")
    return [name for name in names if name], lines


def _plain(name: str | None) -> str | None:
    """Return a name in Unicode form NFC, None for an empty one; file systems of macOS have another form."""
    return unicodedata.normalize("NFC", name) if name else None


READERS = {
    "recordings": DatasetReader(
        read,
        "<object>/<recording>/0.png",
        "nothing, unless their owner asks for it",
        "as their owner says",
        uses=("val", "test", "split_by", "sensor", "labels", "export"),
    )
}
