"""Recordings of one's own: a folder of pictures is a recording, in ROOT or at any depth below it.

    mine/mug/pour_1/000.png ...         the object is the first folder; the recording is the folder itself
    mine/mug/pour_2.mp4                 with `--export` its frames are written into a folder of its name
    mine/mug/background.png             the untouched gel of every recording in or below this folder
    mine/mug/photo.jpg                  a photograph of what is touched, likewise
    mine/mug/caption.txt                words for what is felt, likewise

Frames are taken in natural order (2 before 10). Their numbers are those at the end of their names where these count
frames (some neighbours are one apart), so that a frame left out is a gap; else they are counted. Where numbers repeat
behind different stems (left_0.png, right_0.png: two fingers), each stem is a sequence and a unit of its own. Whole
objects, or recordings where there are none, are held out; with `--split-by recording` some recordings of each object.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from anytouch_jax.config import FIELD_SENSORS, SENSORS, UNIVERSAL, check_spelling
from anytouch_jax.data.images import BACKGROUND, PHOTO, SUFFIXES, frame_numbers, frame_sort_key, split_series
from anytouch_jax.data.readers import films, label_table
from anytouch_jax.data.readers.common import (
    Columns,
    DatasetError,
    DatasetReader,
    Frames,
    IndexOptions,
    Notes,
    RowBuilder,
    add_recording,
    walk,
)
from anytouch_jax.errors import UserError

CAPTION = "caption.txt"
MANIFESTS = (".csv", ".parquet")  # such as an earlier index


def read(root: Path, options: IndexOptions, notes: Notes) -> Columns:
    """Every folder of pictures. Raises UserError without a sensor."""
    known = [name for name in SENSORS if name not in (*FIELD_SENSORS, UNIVERSAL)]
    if options.sensor is None or options.sensor in (*FIELD_SENSORS, UNIVERSAL):
        raise UserError(f"say by --sensor what made these pictures: {', '.join(known)}, or the name of a new sensor")
    check_spelling(options.sensor)
    found: list[tuple[str, dict[str, Frames]]] = []
    beside: dict[str, dict[str, Any]] = {}  # what a folder and those above it hold for their recordings
    if options.export:
        films.write_video_frames(root, notes)
    for folder, folders, files in walk(root, notes):
        beside[folder] = beside.get(folder.rpartition("/")[0], {}) | _beside(root, folder, files)
        if folder.rpartition("/")[2].lower() in (BACKGROUND, PHOTO):
            notes.skip(f"folder called {BACKGROUND} or {PHOTO}, of which one picture is wanted", folder)
            continue
        files = [name for name in files if not _is_cut(name, folders)]
        if fingers := _frames(files, notes, folder):
            found.append((folder, fingers))
    rows = RowBuilder("object", "unit", "background_path", "image_path", "text", "dataset")
    splits = _splits([folder for folder, _ in found], options, notes)
    for folder, fingers in found:
        for unit, frames in fingers.items():
            sequence = f"{folder}/{unit}".strip("/") or "."
            add_recording(rows, frames, folder, split=splits[folder], sensor=options.sensor, sequence=sequence,
                          unit=unit or None, object=_object(folder) or None, dataset=root.name,
                          **beside[folder])  # fmt: skip
    columns = rows.columns()
    columns["path"] = [path.lstrip("/") for path in columns["path"]]
    if options.labels is not None:
        columns = label_table.join(columns, options.labels.expanduser(), notes)
    for split in ("val", "test"):
        if columns["path"] and split not in columns["split"] and getattr(options, split):
            notes.log(f"there are too few objects or recordings for split {split}")
    return columns


def _object(folder: str) -> str:
    return folder.split("/")[0]


def ranked_split(groups: Iterable[str], options: IndexOptions) -> dict[str, str]:
    """The split of every group: sorted by SHA-256 of its name, the first round(val n) are val, the last round(test n)
    test, the others train.

    A share above 0 gets at least one group, and a share left for train too; where groups are too few, train goes first,
    then test. A group that is added or lost moves no other but at the two cuts, one at each.
    """
    order = sorted(set(groups), key=lambda group: hashlib.sha256(group.encode()).digest())
    most = max(0, len(order) - (options.val + options.test < 1))
    test = min(most, max(round(options.test * len(order)), options.test > 0))
    val = min(most - test, max(round(options.val * len(order)), options.val > 0))
    if options.val and not val and test > 1:
        test, val = test - 1, 1
    parts = ["val"] * val + ["train"] * (len(order) - val - test) + ["test"] * test
    return dict(zip(order, parts, strict=True))


def _splits(folders: list[str], options: IndexOptions, notes: Notes) -> dict[str, str]:
    """The split of every recording: that of its object, or, by recording, a part of each object's."""
    objects: dict[str, list[str]] = {}
    for folder in folders:
        objects.setdefault(_object(folder), []).append(folder)
    if options.split_by == "recording":
        return {name: split for one in objects.values() for name, split in ranked_split(one, options).items()}
    if len(objects) > 1 and options.val + options.test > 0:
        notes.log("whole objects are held out; for a classifier of objects: --split-by recording")
    split = ranked_split(objects, options)
    return {folder: split[_object(folder)] for folder in folders}


def _beside(root: Path, folder: str, files: list[str]) -> dict[str, Any]:
    """Background, photograph and caption that lie in a folder. Raises DatasetError for a caption that is no text."""
    found: dict[str, Any] = {}
    for name in files:
        path = f"{folder}/{name}".lstrip("/")
        stem, suffix = Path(name).stem.lower(), Path(name).suffix.lower()
        if name.lower() == CAPTION:
            try:
                found["text"] = " ".join((root / path).read_text(encoding="utf-8-sig").split()) or None
            except (OSError, UnicodeDecodeError) as error:
                raise DatasetError(f"{root / path} cannot be read as UTF-8 text: {error}") from None
        elif suffix in SUFFIXES and stem in (BACKGROUND, PHOTO):
            found["background_path" if stem == BACKGROUND else "image_path"] = path
    return found


def _is_cut(name: str, folders: list[str]) -> bool:
    """Whether it is a film whose frames lie in a folder of its name."""
    return Path(name).suffix.lower() in films.SUFFIXES and Path(name).stem in folders


def _frames(files: list[str], notes: Notes, folder: str) -> dict[str, Frames]:
    """The pictures of a folder in order with their numbers, by finger; arrays count where there is nothing else."""
    names = []
    for name in sorted(files, key=frame_sort_key):
        stem, suffix = Path(name).stem.lower(), Path(name).suffix.lower()
        if suffix in SUFFIXES and stem not in (BACKGROUND, PHOTO):
            names.append(name)
        elif suffix in films.SUFFIXES:
            notes.skip("film (--export writes its frames as pictures)", f"{folder}/{name}".lstrip("/"))
        elif suffix not in (*SUFFIXES, *MANIFESTS) and name.lower() != CAPTION:
            notes.skip("file that is no picture", f"{folder}/{name}".lstrip("/"))
    pictures = [name for name in names if Path(name).suffix.lower() != ".npy"]
    if pictures and len(pictures) < len(names):
        arrays = [name for name in names if name not in pictures]
        notes.skip("array beside pictures", f"{folder}/{arrays[0]}", len(arrays))
        names = pictures
    if not names:
        return {}
    return {unit: list(zip(frame_numbers(one), one, strict=True)) for unit, one in split_series(names).items()}


READER = DatasetReader(
    name="recordings",
    read=read,
    sensor="",
    license="as their owner says",
    commercial=False,
    about="folders of pictures, a recording each",
    url="",
    citation="nothing, unless their owner says so",
    uses=("val", "test", "split_by", "sensor", "labels", "export"),
)
