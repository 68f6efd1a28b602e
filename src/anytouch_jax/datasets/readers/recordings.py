"""Recordings of your own: a folder of images is a recording, in ROOT or at any depth below it.

    mine/mug/pour_1/000.png ...         the object is the first folder, the recording is the folder
    mine/mug/pour_2.mp4                 with `--export` its frames are written into a folder
    mine/mug/pour_3.npy, pour_4.npz     a stack of frames (frames, height, width, 3) is a recording
    mine/mug/background.png             the untouched gel of every recording in or below this folder
    mine/mug/photo.jpg                  an RGB image of the touched object, for the same recordings
    mine/mug/caption.txt                a caption, for the same recordings

Names decide the order and the numbers of frames (`data.names`). If numbers repeat with other words
(left_0.png and right_0.png: two fingers), each finger is a sequence and a unit. Whole objects, or
recordings without objects, are held out. With `--split-by recording` some recordings of each object
are.
"""

from __future__ import annotations

import hashlib
import os
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pyarrow as pa

from anytouch_jax.data import containers, images
from anytouch_jax.data.images import BACKGROUND, PHOTO, SUFFIXES
from anytouch_jax.data.manifest.schema import EMPTY, REQUIRED, typed_label
from anytouch_jax.data.names import (
    frame_numbers,
    frame_order,
    looks_like_video,
    natural,
    split_series,
)
from anytouch_jax.datasets.readers import common
from anytouch_jax.datasets.readers.common import DatasetError, DatasetIndex, DatasetReader
from anytouch_jax.datasets.readers.exports import export_video, find_export, is_current
from anytouch_jax.errors import UserError

CAPTION = "caption.txt"
MANIFESTS = (".csv", ".parquet")  # of an earlier index
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv")
LABEL_KEYS = ("object", "sequence")
# columns of a label table that do not become label.<name>
PLAIN_COLUMNS = ("unit", "touch", "text")


_TINY = (32, 24)
# largest difference of neighbouring images of a video, as a fraction of that of any two
_VIDEO = 0.75
_SLOW = 5  # seconds between the files of single images
_STILL = 1.0  # grey levels: images that differ by less show nothing


class _Place(NamedTuple):
    """How a folder was understood.

    `kinds` names its parts, `name` is its path without its split.
    """

    split: str | None
    object: str | None
    name: str
    parts: tuple[str, ...]
    kinds: tuple[str, ...]


class _Recording(NamedTuple):
    """A folder's frames of one finger, in order. `place` is how its folder was understood."""

    folder: str
    unit: str
    names: list[str]
    place: _Place


def read(index: DatasetIndex) -> None:
    """Add every folder of images.

    Raises UserError without a sensor, and for options that exclude each other.
    """
    root = index.root
    options = index.options
    sensor = index.need_sensor()
    if options.singles and options.videos:
        raise UserError("--singles and --videos exclude each other; give one of them, or none")
    if options.export:
        _export_videos(index)
    found: dict[str, dict[str, list[str]]] = {}  # folder -> finger -> names
    # folder -> cells from the files in it and in the folders above
    shared: dict[str, dict[str, Any]] = {}
    for folder, folders, files in index.walk():
        shared[folder] = shared.get(folder.rpartition("/")[0], {}) | _shared_cells(
            root, folder, files
        )
        if folder.rpartition("/")[2].lower() in (BACKGROUND, PHOTO):
            index.skip(
                f"folder called {BACKGROUND} or {PHOTO}, where one image is expected", folder
            )
            continue
        if not options.export:
            _skip_videos(index, folder, folders, files)
        for place, fingers in _found_in(index, files, folder).items():
            found[place] = fingers
            shared[place] = shared[folder]
    places = _understand(dict.fromkeys(map(_without_ending, found)))
    recordings = [
        _Recording(folder, unit, names, places[_without_ending(folder)])
        for folder, fingers in found.items()
        for unit, names in fingers.items()
    ]
    videos = _videos(index, recordings)
    sequences = _sequences([(one.place, one.unit, one.names) for one in recordings], videos)
    numbers = frame_numbers if options.order == "names" else lambda names: list(range(len(names)))
    # of every row: the recording that is never split, a folder or a single image
    parts: list[str] = []
    # of every row: the split that a folder decides
    given: list[str | None] = []
    for one, is_video, sequence in zip(recordings, videos, sequences, strict=True):
        paths = [f"{one.folder}/{name}".lstrip("/") for name in one.names]
        index.add(
            paths,
            sensor=sensor,
            unit=one.unit or None,
            object=one.place.object,
            dataset=root.name,
            sequence=sequence,
            frame_index=numbers(one.names) if is_video else 0,
            **shared[one.folder],
        )
        parts += [one.folder] * len(paths) if is_video else paths
        given += [one.place.split] * len(paths)
    if recordings:
        index.notes.insert(0, _sentence([one.place for one in recordings], videos))
        if options.labels is not None:
            _join_labels(index, options.labels.expanduser(), parts)
        _assign_splits(
            index, parts, given, "recording" if 2 * sum(videos) < len(videos) else "object"
        )


def _videos(index: DatasetIndex, recordings: list[_Recording]) -> list[bool]:
    """Return which recordings are videos as images, and put their names into order.

    Names decide, or a few images where every object has one folder. --singles, --videos and
    --order times decide for all.
    """
    options = index.options
    videos = _videos_by_names(index, recordings)
    if options.singles or options.videos or options.order == "times":
        return videos
    several = [
        at
        for at, one in enumerate(recordings)
        # an array of frames has an order of its own
        if videos[at] and len(one.names) > 1 and _without_ending(one.folder) == one.folder
    ]
    objects = [
        (recordings[at].place.split, recordings[at].place.object, recordings[at].unit)
        for at in several
    ]
    # Where each object has one folder, its images may as well be single touches with numbers for
    # names, so a few of them are opened.
    if len(set(objects)) == len(objects):
        if not _move_like_videos(index, [recordings[at] for at in several]):
            videos = [is_video and at not in several for at, is_video in enumerate(videos)]
        elif len({name for _, name, _ in objects}) > 1:
            index.notes.append(
                "each object has one recording; if its images are single touches, give --singles"
            )
    alone = [one.folder for one, is_video in zip(recordings, videos, strict=True) if not is_video]
    if alone:
        where = f"{len(alone)} folders (first: {alone[0] or '.'})"
        index.notes.append(
            f"the images of {where} do not look like a video: each is a single touch; --videos "
            "makes a recording of each folder"
        )
    return videos


def _videos_by_names(index: DatasetIndex, recordings: list[_Recording]) -> list[bool]:
    """Return which recordings are videos by the names of their images, which are put into order.

    A note says where neither names nor times of files give an order.
    """
    options = index.options
    by_time = options.order == "times"
    videos = []
    unclear = []
    for one in recordings:
        one.names[:], is_clear = frame_order(one.names)
        if by_time:
            files = [index.root / one.folder / name for name in one.names]
            times = {file.name: _time_of(file) for file in files}
            one.names.sort(key=times.__getitem__)
            is_clear = len(set(times.values())) == len(times)
        looks_like_one = looks_like_video(one.names) or len(one.names) == 1
        is_video = not options.singles and (options.videos or by_time or looks_like_one)
        videos.append(is_video)
        if is_video and not is_clear:
            unclear.append(one.folder or ".")
    if unclear:
        what = "times of the files" if by_time else "names"
        advice = "" if by_time else "; --order times takes the times of the files"
        index.notes.append(
            f"the {what} do not order {len(unclear)} recordings clearly (first: "
            f"{unclear[0]}){advice}"
        )
    return videos


def _move_like_videos(index: DatasetIndex, recordings: list[_Recording]) -> bool:
    """Return whether images change as a video does, in at most eight recordings."""
    count = len(recordings)
    spread = np.unique(np.linspace(0, count - 1, min(8, count)).astype(int))
    return _moves_like_video(
        [
            [index.root / recordings[at].folder / name for name in recordings[at].names]
            for at in spread
        ]
    )


def ranked_split(
    groups: Iterable[str], options: common.IndexOptions, total: int | None = None
) -> dict[str, str]:
    """Return the split of every group, by rank: sorted by SHA-256, the first are val, the last
    test, the others train.

    The counts are the rounded fractions. One above 0 gets at least one group, if there are enough.
    Another group moves at most one at each cut, if the fractions are given. By default they depend
    on the number of groups, which is `total` if these are a part of them.
    """
    order = sorted(set(groups), key=lambda group: hashlib.sha256(group.encode()).digest())
    val_part, test_part = options.fractions(total or len(order))
    most = max(0, len(order) - (val_part + test_part < 1))
    test = min(most, max(round(test_part * len(order)), test_part > 0))
    val = min(most - test, max(round(val_part * len(order)), val_part > 0))
    if val_part and not val and test > 1:
        test = test - 1
        val = 1
    parts = ["val"] * val + ["train"] * (len(order) - val - test) + ["test"] * test
    return dict(zip(order, parts, strict=True))


def _assign_splits(
    index: DatasetIndex, parts: list[str], given: list[str | None], default: str
) -> None:
    """Fill column split: as folders say, else by rank of groups inside each object, unless groups
    span several.
    """
    options = index.options
    table = index.table
    by = options.split_by or default
    index.keep_together = ["sequence", "object"] if by == "object" else ["sequence"]
    values = parts if by == "recording" else _group_values(table, by)
    groups: dict[str, str] = {}  # of each part
    objects: dict[str, set[str | None]] = {}
    for part, value, obj, split in zip(parts, values, table["object"], given, strict=True):
        if split is None:
            objects.setdefault(
                groups.setdefault(part, part if value is None else str(value)), set()
            ).add(obj)
    pools: dict[Any, set[str]] = {}
    is_whole = by == "object" or any(len(one) > 1 for one in objects.values())
    for group, of in objects.items():
        pools.setdefault(None if is_whole else min(map(str, of)), set()).add(group)
    ranked = {
        group: split
        for pool in pools.values()
        for group, split in ranked_split(pool, options, len(objects)).items()
    }
    index.drawn |= ranked
    table["split"] = [
        split or ranked[groups[part]] for part, split in zip(parts, given, strict=True)
    ]
    fractions = dict(zip(("val", "test"), options.fractions(), strict=True))
    if by == "object" and len(objects) > 1 and sum(fractions.values()) > 0:
        index.notes.append(
            "whole objects are held out; for a classifier of objects: --split-by recording"
        )
    for split in ("val", "test"):
        if split not in table["split"] and fractions[split]:
            reason = "there are too few objects or recordings for" if objects else "no folder is of"
            index.notes.append(f"{reason} split {split}")


def _group_values(table: dict[str, list[Any]], by: str) -> list[Any]:
    """Return the group of every row: a column, or the first part in parentheses of a pattern in its
    path.
    """
    if "(" in by:
        try:
            find = re.compile(by).search
        except re.error as error:
            raise UserError(
                f"--split-by {by!r} is no pattern: {error}; write a part of the path as "
                "'(p[0-9]+)_'"
            ) from None
        matches = [find(path) for path in table["path"]]
        if not any(matches):
            raise UserError(
                f"--split-by {by!r} is in no path, such as {table['path'][0]}; correct the pattern"
            )
        return [match and match[1] for match in matches]
    column = table.get(by, table.get(f"label.{by}"))
    if column is None:
        known = ", ".join(name for name in table if name not in REQUIRED)
        raise UserError(
            f"--split-by {by!r} is no column; give object, recording, a pattern, or one of {known}"
        )
    return column


def _shared_cells(root: Path, folder: str, files: list[str]) -> dict[str, Any]:
    """Return the background, RGB image and caption in a folder.

    Raises DatasetError for a caption that is no text.
    """
    cells: dict[str, Any] = {}
    for name in files:
        path = f"{folder}/{name}".lstrip("/")
        stem = Path(name).stem.lower()
        suffix = Path(name).suffix.lower()
        if name.lower() == CAPTION:
            try:
                cells["text"] = (
                    " ".join((root / path).read_text(encoding="utf-8-sig").split()) or None
                )
            except (OSError, UnicodeDecodeError) as error:
                raise DatasetError(f"{root / path} cannot be read as UTF-8 text: {error}") from None
        elif suffix in SUFFIXES and stem in (BACKGROUND, PHOTO):
            cells["background_path" if stem == BACKGROUND else "image_path"] = path
    return cells


def _understand(folders: Iterable[str]) -> dict[str, _Place]:
    """Return how folders are understood: split words, then the object.

    Raises DatasetError for one in two splits.
    """
    parts = {folder: tuple(part for part in folder.split("/") if part) for folder in folders}
    above = list[tuple[str, ...]]()
    rest = list[int]()
    for folder, names in parts.items():
        words = [common.split_word(name) for name in names]
        if len(set(words) - {None}) > 1:
            named = " and ".join(name for name, word in zip(names, words, strict=True) if word)
            raise DatasetError(f"{folder} names two splits, {named}; rename one of these folders")
        if any(words):
            above.append(names[: next(at for at, word in enumerate(words) if word)])
            rest.append(words.count(None))
    wrapping = [len(set(level)) == 1 for level in zip(*above, strict=False)]
    shared = max(0, min([(*wrapping, False).index(False), *(count - 1 for count in rest if count)]))
    return {folder: _place(names, shared) for folder, names in parts.items()}


def _place(names: tuple[str, ...], shared: int) -> _Place:
    words = [common.split_word(name) for name in names]
    split = next((word for word in words if word), None)
    kinds = list[str]()
    obj = None
    shared = shared if split else 0
    for at, (name, word) in enumerate(zip(names, words, strict=True)):
        is_object = word is None and obj is None and at >= shared
        obj = name if is_object else obj
        kinds.append(
            "<split>"
            if word
            else "<object>"
            if is_object
            else name
            if at < shared
            else "<recording>"
        )
    own = [name for name, word in zip(names, words, strict=True) if not word]
    return _Place(split, obj, "/".join(own), names, tuple(kinds))


def _sequences(
    recordings: Sequence[tuple[_Place, str, list[str]]], videos: Sequence[bool]
) -> list[list[str]]:
    """Return the distinct sequence of every image, its own if it is no video, with a split or
    number.
    """
    names = [
        [f"{place.name}/{unit}"] * len(images)
        if is_video
        else [f"{place.name}/{image}" for image in images]
        for (place, unit, images), is_video in zip(recordings, videos, strict=True)
    ]
    names = [[name.strip("/") or "." for name in one] for one in names]
    splits = [place.split for place, *_ in recordings]
    of_split = {(name, split) for one, split in zip(names, splits, strict=True) for name in one}
    if len(of_split) > len({name for name, _ in of_split}):
        names = [
            [f"{name} ({split})" if split else name for name in one]
            for one, split in zip(names, splits, strict=True)
        ]
    counts: Counter[str] = Counter()
    for one in names:
        counts.update({*one})
        one[:] = [name if counts[name] < 2 else f"{name} ({counts[name]})" for name in one]
    return names


def _sentence(places: Sequence[_Place], videos: Sequence[bool]) -> str:
    """Return how the tree was understood: its levels, the folders of splits, and what an image
    is.
    """
    forms: Counter[str] = Counter()
    words: dict[str, str] = {}
    for place, is_video in zip(places, videos, strict=True):
        last = "frames" if is_video else "<touch>"
        form = [
            kind
            for at, kind in enumerate(place.kinds)
            if kind != "<recording>" or place.kinds[at - 1] != kind
        ]
        forms["/".join([*form, last])] += 1
        words |= {
            part: str(common.split_word(part))
            for part, kind in zip(place.parts, place.kinds, strict=True)
            if kind == "<split>" and common.split_word(part) != part
        }
    first, *others = [form for form, _ in forms.most_common(3)]
    more = f" (also {', '.join(others)})" if others else ""
    named = ", ".join(f"{word} is split {split}" for word, split in words.items())
    return f"folders are understood as {first}{more}" + (f"; {named}" if named else "")


def _moves_like_video(folders: Sequence[Sequence[Path]]) -> bool:
    """Return whether neighbouring images are more alike than others, by a few, and not stored
    seconds apart.
    """
    near = list[float]()
    far = list[float]()
    gaps = list[float]()
    for paths in folders:
        starts = np.unique(np.linspace(0, len(paths) - 2, 4).astype(int))
        try:
            decoded = {
                at: images.decode(paths[at])
                for at in sorted({*starts.tolist(), *(starts + 1).tolist()})
            }
            gaps += [abs(_time_of(paths[at + 1]) - _time_of(paths[at])) / 1e9 for at in starts]
        except (images.ImageError, OSError):
            continue
        tiny = {
            at: cv2.resize(one, _TINY, interpolation=cv2.INTER_AREA) for at, one in decoded.items()
        }
        tiny = {at: one.mean(axis=2).astype(np.float32) for at, one in tiny.items()}
        near += [float(np.abs(tiny[at] - tiny[at + 1]).mean()) for at in starts]
        far += [
            float(np.abs(tiny[a] - tiny[b]).mean()) for a, b in combinations(tiny, 2) if b - a > 1
        ]
    is_slow = bool(gaps) and float(np.median(gaps)) > _SLOW
    is_alike = (
        not far
        or float(np.mean(far)) < _STILL
        or float(np.mean(near)) < _VIDEO * float(np.mean(far))
    )
    return is_alike and not is_slow


def _time_of(frame: Path) -> int:
    """Return when the file of a frame was last changed, ns."""
    place = containers.split_row(frame)
    return os.stat(place[0] if place else frame).st_mtime_ns


def _without_ending(folder: str) -> str:
    """Return the place of a recording: mug/pour_3 of the stack mug/pour_3.npz/frames."""
    return re.sub(r"\.np[yz](/.*)?$", "", folder, flags=re.IGNORECASE)


def _found_in(
    index: DatasetIndex, files: list[str], folder: str
) -> dict[str, dict[str, list[str]]]:
    """Return the frames of a folder by finger, or those of each stack in it, by folder or stack.

    Arrays count only if there are no images, because recorders put other data beside them.
    """
    images = []
    arrays = []
    for name in sorted(files, key=natural):
        stem = Path(name).stem.lower()
        suffix = Path(name).suffix.lower()
        if suffix == ".npz" or (suffix == ".npy" and stem not in (BACKGROUND, PHOTO)):
            arrays.append(name)
        elif suffix in SUFFIXES and stem not in (BACKGROUND, PHOTO):
            images.append(name)
        elif suffix not in (*SUFFIXES, *MANIFESTS, *VIDEOS) and name.lower() != CAPTION:
            index.skip("file that is no image", f"{folder}/{name}".lstrip("/"))
    found: dict[str, dict[str, list[str]]] = {}
    if images:
        index.skip_all("array next to images", [f"{folder}/{name}" for name in arrays])
    else:
        for name in arrays:
            stacks = _stacks(index, f"{folder}/{name}".lstrip("/"))
            if stacks is None:
                images.append(name)
            else:
                found |= stacks
    if images:
        found[folder] = split_series(images)
    return found


def _stacks(index: DatasetIndex, path: str) -> dict[str, dict[str, list[str]]] | None:
    """Return the frames of a stack by its array and finger, None for one image.

    Each array of frames in an .npz is a finger, if there are several. What cannot be read is
    skipped.
    """
    try:
        arrays = containers.stack_rows(index.root / path)
    except containers.ContainerError as error:
        index.skip("file that cannot be read", str(error))
        return {}
    if arrays is None:
        return None
    if not arrays:
        index.skip("array that is no image and no stack of frames", path)
    return {
        f"{path}/{key}".rstrip("/"): {key if len(arrays) > 1 else "": [row.name for row in rows]}
        for key, rows in arrays.items()
    }


def _is_video(name: str) -> bool:
    return Path(name).suffix.lower() in VIDEOS


def _export_videos(index: DatasetIndex) -> None:
    """Write the frames of every video into a folder of its name.

    A video that cannot be read is skipped.
    """
    # before any is made
    for folder, _, files in index.tracked(list(index.walk(count=False))):
        for video in (f"{folder}/{name}".lstrip("/") for name in files if _is_video(name)):
            try:
                export_video(index, video)
            except images.ImageError as error:
                index.skip("video that cannot be read", str(error))


def _skip_videos(index: DatasetIndex, folder: str, folders: list[str], files: list[str]) -> None:
    """Report the videos of a folder without images, or with those of an earlier video."""
    for name in filter(_is_video, files):
        path = f"{folder}/{name}".lstrip("/")
        place, record = find_export(index.root, path.removesuffix(Path(name).suffix), name)
        if record is not None and not is_current(record, [index.root / path]):
            index.skip(
                f"video that was changed after its images in {place} (--export writes them again)",
                path,
            )
        elif record is None and Path(name).stem not in folders:
            index.skip("video (--export writes its frames as images)", path)


def _join_labels(index: DatasetIndex, path: Path, parts: list[str]) -> None:
    """Join the CSV table `path` to the rows by object or sequence; a line of the sequence goes
    first.

    A sequence may be named by its folder or image too, in any Unicode form. Lines and recordings
    without the other are skipped. Raises DatasetError for a table that is missing, has no key, or
    has a column or a key twice.
    """
    names, lines = _read_labels(path)
    table, size = index.table, len(index.table["path"])
    labels: dict[str, list[Any]] = {name: [None] * size for name in names if name not in LABEL_KEYS}
    index.wanted += [
        name if name in PLAIN_COLUMNS else f"label.{name.removeprefix('label.')}" for name in labels
    ]
    used: set[tuple[str | None, str | None]] = set()
    unlabelled: dict[str, None] = {}
    for row, (obj, sequence, part) in enumerate(
        zip(table["object"], table["sequence"], parts, strict=True)
    ):
        by_part = any(key in lines for key in ((None, _plain(part)), (_plain(obj), _plain(part))))
        names_of = _plain(obj), _plain(part if by_part else sequence)
        keys = [
            key
            for key in ((names_of[0], None), (None, names_of[1]), names_of)
            if any(key) and key in lines
        ]
        used.update(keys)
        for name, cell in (item for key in keys for item in lines[key].items()):
            labels[name][row] = labels[name][row] if cell.lower() in EMPTY else cell
        if not keys:
            unlabelled[sequence] = None
    for key in (key for key in lines if key not in used):
        index.skip(
            f"key of {path.name} that no recording has", ", ".join(part for part in key if part)
        )
    for sequence in unlabelled:
        index.skip(f"recording without a line in {path.name}", sequence)
    for name, cells in ((name, cells) for name, cells in labels.items() if any(cells)):
        if name in PLAIN_COLUMNS:
            old = table.get(name, [None] * size)
            table[name] = [new or before for new, before in zip(cells, old, strict=True)]
        else:
            column = typed_label(pa.chunked_array([pa.array(cells, pa.string())]))
            table[f"label.{name.removeprefix('label.')}"] = column.to_pylist()


def _read_labels(
    path: Path,
) -> tuple[list[str], dict[tuple[str | None, str | None], dict[str, str]]]:
    """Return the columns of the table, and (object, sequence) -> the other cells; an empty key cell
    is None.
    """
    rows = common.read_lines(path)
    names = rows[0][1] if rows else []
    if not set(LABEL_KEYS) & set(names):
        raise DatasetError(
            f"{path} has no column object or sequence, by which labels are joined; it has "
            f"{', '.join(names)}"
        )
    if repeated := [name for name in names if names.count(name) > 1]:
        raise DatasetError(f"{path} has the column {repeated[0]!r} twice")
    lines: dict[tuple[str | None, str | None], dict[str, str]] = {}
    for line, row in rows[1:]:
        if len(row) < len(names) or any(row[len(names) :]):
            raise DatasetError(
                f"{path}, line {line}: {len(row)} cells for {len(names)} columns; quote its commas"
            )
        cells = dict(zip(names, row, strict=False))
        key = (
            _plain(cells.pop("object", None)),
            _plain((cells.pop("sequence", "") or "").replace("\\", "/")),
        )
        if not any(key):
            raise DatasetError(
                f"{path}, line {line}: there is neither an object nor a sequence; fill in one"
            )
        if key in lines:
            named = ", ".join(part for part in key if part)
            raise DatasetError(f"{path}, line {line}: {named} is there twice; keep one")
        lines[key] = {name: cell for name, cell in cells.items() if name}
    for name in (name for name in names if name not in (*LABEL_KEYS, *PLAIN_COLUMNS, "")):
        column = pa.chunked_array(
            [pa.array([cells.get(name) for cells in lines.values()], pa.string())]
        )
        typed_label(column, name, lambda row: f"{path}, line {rows[row + 1][0]}")
    return [name for name in names if name], lines


def _plain(name: str | None) -> str | None:
    """Return a name in Unicode form NFC, None for an empty one; file systems of macOS have another
    form.
    """
    if name:
        return unicodedata.normalize("NFC", name)
    return None


READERS = {
    "recordings": DatasetReader(
        read,
        "<object>/<recording>/0.png",
        "nothing, unless their owner asks for it",
        "as their owner says",
        uses=(
            "val",
            "test",
            "split_by",
            "sensor",
            "labels",
            "export",
            "singles",
            "videos",
            "order",
        ),
    )
}
