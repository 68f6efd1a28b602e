"""Recordings of one's own: a folder of pictures is a recording, in ROOT or at any depth below it.

    mine/mug/pour_1/000.png ...         the object is the first folder; the recording is the folder itself
    mine/mug/background.png             the untouched gel of every recording in or below this folder
    mine/mug/photo.jpg                  a photograph of what is touched, likewise
    mine/mug/caption.txt                words for what is felt, likewise

Frames are taken in natural order (2 before 10). Their numbers are those at the end of their names where these count
frames (some neighbours are one apart), so that a frame left out is a gap; else they are counted. The object, or the
recording where there is none, is the group of the hash split.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from anytouch_jax.config import FIELD_SENSORS, SENSORS, UNIVERSAL, UserError
from anytouch_jax.data.images import BACKGROUND, PHOTO, SUFFIXES, frame_numbers, frame_order
from anytouch_jax.data.readers.common import (
    Columns,
    DatasetError,
    Notes,
    Options,
    Reader,
    Rows,
    add_recording,
    hash_split,
    walk,
)

CAPTION = "caption.txt"
MANIFESTS = (".csv", ".parquet")  # such as an earlier index


def read(root: Path, options: Options, notes: Notes) -> Columns:
    """Every folder of pictures. Raises UserError without a sensor."""
    known = [name for name in SENSORS if name not in (*FIELD_SENSORS, UNIVERSAL)]
    if options.sensor is None or options.sensor in (*FIELD_SENSORS, UNIVERSAL):
        raise UserError(f"say by --sensor what made these pictures: {', '.join(known)}, or the name of a new sensor")
    if options.sensor not in known and options.sensor.lower() in known:
        raise UserError(f"--sensor {options.sensor}: the sensor is called {options.sensor.lower()}")
    rows = Rows("object", "background_path", "image_path", "text", "dataset")
    beside: dict[str, dict[str, Any]] = {}  # what a folder and those above it hold for their recordings
    for folder, _, files in walk(root, notes):
        beside[folder] = beside.get(folder.rpartition("/")[0], {}) | _beside(root, folder, files)
        if folder.rpartition("/")[2].lower() in (BACKGROUND, PHOTO):
            notes.skip(f"folder called {BACKGROUND} or {PHOTO}, of which one picture is wanted", folder)
            continue
        frames = _frames(files, notes, folder)
        if not frames:
            continue
        obj = folder.split("/")[0] or None
        split = hash_split(root.name, obj or folder, options)
        add_recording(rows, frames, folder, split=split, sensor=options.sensor, sequence=folder or ".",
                      object=obj, dataset=root.name, **beside[folder])  # fmt: skip
    columns = rows.columns()
    columns["path"] = [path.lstrip("/") for path in columns["path"]]
    for split in ("val", "test"):
        if columns["path"] and split not in columns["split"] and getattr(options, split):
            notes.say(f"no object or recording fell to split {split}; with few of them give a larger --{split}")
    return columns


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


def _frames(files: list[str], notes: Notes, folder: str) -> list[tuple[int, str]]:
    """The pictures of a folder in order with their numbers; arrays count where there is nothing else."""
    names = []
    for name in sorted(files, key=frame_order):
        stem, suffix = Path(name).stem.lower(), Path(name).suffix.lower()
        if suffix in SUFFIXES and stem not in (BACKGROUND, PHOTO):
            names.append(name)
        elif suffix not in (*SUFFIXES, *MANIFESTS) and name.lower() != CAPTION:
            notes.skip("file that is no picture (a film is to be cut into pictures first)", f"{folder}/{name}")
    pictures = [name for name in names if Path(name).suffix.lower() != ".npy"]
    if pictures and len(pictures) < len(names):
        arrays = [name for name in names if name not in pictures]
        notes.skip("array beside pictures", f"{folder}/{arrays[0]}", len(arrays))
        names = pictures
    return list(zip(frame_numbers(names), names, strict=True))


READER = Reader(
    name="recordings",
    read=read,
    sensor="",
    license="as their owner says",
    commercial=False,
    about="folders of pictures, a recording each",
    url="",
    citation="nothing, unless their owner says so",
    uses=("val", "test", "sensor"),
)
