"""HDF5 and zarr files, and stacks of frames in .npz and .npy: arrays of images become sequences.

Three layouts are understood, and any other of the same kind:

    robomimic            data/demo_0/obs/tactile (T, h, w, 3), the attributes of data/demo_0
    diffusion policy     data/camera0_rgb (N, h, w, 3), meta/episode_ends (episodes,)
    a file a recording   observations/images/gelsight (T,), each a JPEG, attributes of the file

The images stay in their files, and none is decoded here. A key is the path of an array inside its
recording, as obs/tactile, and counts as a camera.
"""

from __future__ import annotations

import fnmatch
import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from anytouch_jax.data import containers
from anytouch_jax.data.containers import ArrayInfo, Container, ContainerError, FrameForm
from anytouch_jax.data.manifest.schema import listed
from anytouch_jax.data.names import natural
from anytouch_jax.datasets.readers import common
from anytouch_jax.datasets.readers.common import DatasetError, DatasetIndex, DatasetReader
from anytouch_jax.datasets.readers.recordings import ranked_split

_ENDS = "episode_ends"
# In names of groups that hold a camera, not a recording: left/rgb and right/rgb are one moment.
_OF_CAMERA = re.compile(
    r"cam|sensor|digit|gel|finger|thumb|left|right|front|side|top|wrist|obs|tactile|rgb|image|img|"
    r"colou?r|frames|view|depth|vision",
    re.IGNORECASE,
)
_MOST_CAMERAS = 4  # of names that differ in a number alone: more are recordings
_BACKGROUND = re.compile(r"[\W_]*(background|untouched)[\W_]*", re.IGNORECASE)
# Attributes that HDF5 and its tools write for themselves.
_HOUSEKEEPING = re.compile(
    r"CLASS|VERSION|TITLE|NAME|IMAGE_\w+|INTERLACE_MODE|DISPLAY_ORIGIN|PALETTE|DIMENSION_\w+|"
    r"REFERENCE_LIST|_Netcdf\w+|_ARRAY_DIMENSIONS"
)
_LONGEST_LABEL = 200  # characters; longer texts are settings of a simulator and the like
_MOST_NUMBERS = 16  # of an attribute that is a vector
_COLUMNS = ("object", "text")  # labels that are columns of a manifest as well


class CameraArrays(NamedTuple):
    """The frames of one camera in a recording.

    Attributes:
        key: Its path inside the recording.
        form: How its first array holds frames.
        frames: (number, array, row) of every frame.
        background: The path of an image of the untouched gel: array and row.
    """

    key: str
    form: FrameForm
    dtype: str
    frames: list[tuple[int, str, int]]
    background: tuple[str, int] | None = None


@dataclass
class StoredRecording:
    """What belongs together in a file: the frames of its cameras, labels, and other arrays.

    `place` is the group in the file, "" for the whole file. `name` has the number of an episode,
    too. `rows` are the rows of arrays of all episodes that are its own.
    """

    place: str
    name: str
    cameras: list[CameraArrays]
    labels: dict[str, Any] = field(default_factory=dict)
    # arrays of numbers, by their path inside the recording
    others: dict[str, ArrayInfo] = field(default_factory=dict)
    rows: slice = field(default_factory=lambda: slice(None))


class Contents(NamedTuple):
    """What is in a container: its recordings, the splits that it states, and what was left out."""

    recordings: list[StoredRecording]
    splits: dict[str, str]  # of a group's name
    left_out: list[str]  # attributes and scalars that are no labels


def read_contents(container: Container) -> Contents:
    """Return the recordings of a container. Raises ContainerError for episodes that do not fit."""
    fields = {one.key: one for one in container.fields()}
    images = {
        key: one
        for key, one in fields.items()
        # the same frames once more, a step later
        if one.form is not None and "next_obs" not in key.split("/")
    }
    place_of = _places(images)
    ends = _episode_ends(container, fields)
    recordings: list[StoredRecording] = []
    left_out: dict[str, None] = {}
    for place in dict.fromkeys(place_of.values()):
        keys = [key for key, own in place_of.items() if own == place]
        cameras = _cameras([images[key] for key in keys], place)
        labels = _labels(container, fields, place, left_out)
        others = {
            key[len(place) :].lstrip("/"): one
            for key, one in fields.items()
            if _is_inside(key, place)
            and key not in place_of
            and "next_obs" not in key.split("/")
            and (one.shape and one.shape[0] > 1)
            and (ends is None or key.rpartition("/")[0] != ends[0].rpartition("/")[0])
        }
        whole = StoredRecording(place, place, cameras, labels, others)
        if ends is None or place:
            recordings.append(whole)
            continue
        key, stops = ends
        recordings += _episodes(container, whole, stops, _of_episodes(container, fields, key))
    return Contents(recordings, _stated_splits(container, fields), list(left_out))


def _is_inside(key: str, place: str) -> bool:
    return not place or key.startswith(f"{place}/")


def _places(images: Mapping[str, ArrayInfo]) -> dict[str, str]:
    """Return the recording of every array of images: a group, an array, or "" for the file.

    A group is a recording if its name ends in a number, or if a group beside it has the same
    arrays, unless its name is that of a camera. Arrays in one group whose names differ in a number
    are recordings too.
    """
    below: dict[str, set[str]] = {}
    for key in images:
        parts = key.split("/")
        for at in range(1, len(parts)):
            below.setdefault("/".join(parts[:at]), set()).add("/".join(parts[at:]))
    alike: Counter[tuple[str, frozenset[str]]] = Counter()
    numbered: Counter[tuple[str, str, frozenset[str]]] = Counter()
    for group, inside in below.items():
        parent, _, name = group.rpartition("/")
        alike[parent, frozenset(inside)] += 1
        numbered[parent, _without_number(name), frozenset(inside)] += 1
    series = Counter(
        _without_number(key)
        for key, one in images.items()
        if one.form is not None and not one.form.single
    )

    def is_recording(group: str) -> bool:
        parent, _, name = group.rpartition("/")
        inside = frozenset(below[group])
        if numbered[parent, _without_number(name), inside] > _MOST_CAMERAS:
            return True
        has_number = _without_number(name) != name
        return not _OF_CAMERA.search(name) and (has_number or alike[parent, inside] > 1)

    places = {}
    for key, one in images.items():
        parts = key.split("/")
        groups = ["/".join(parts[:at]) for at in range(len(parts) - 1, 0, -1)]
        place = next((group for group in groups if is_recording(group)), "")
        form = _without_number(key)
        is_alone = one.form is not None and not one.form.single and form != key
        is_camera = bool(_OF_CAMERA.search(parts[-1])) and series[form] <= _MOST_CAMERAS
        if is_alone and series[form] > 1 and not is_camera:
            place = key
        places[key] = place
    return places


def _without_number(name: str) -> str:
    """Return a name without the number at its end: demo of demo_12."""
    return re.sub(r"[\W_]*\d+$", "", name)


def _cameras(images: Sequence[ArrayInfo], place: str) -> list[CameraArrays]:
    """Return the cameras of a recording.

    Single images in one group whose names are numbers, as frames/17, are frames of one camera.
    """
    found: dict[str, list[tuple[int, str, int]]] = {}
    first: dict[str, ArrayInfo] = {}
    backgrounds: dict[str, tuple[str, int]] = {}
    counts = Counter(_group_of_numbers(one) for one in images)
    for one in images:
        inside = one.key[len(place) :].lstrip("/") or _without_number(place.rpartition("/")[2])
        if one.form is None:
            continue
        name = inside.rpartition("/")[2]
        if one.form.frames == 1 and _BACKGROUND.search(name):
            backgrounds[_BACKGROUND.sub("", inside).strip("/")] = (one.key, 0)
            continue
        group = _group_of_numbers(one)
        if group is not None and counts[group] > 1:
            key = inside.rpartition("/")[0] or "frames"
            number = int(re.sub(r"\D", "", name))
            found.setdefault(key, []).append((number, one.key, 0))
        else:
            key = inside
            found[key] = [(row, one.key, row) for row in range(one.form.frames)]
        first.setdefault(key, one)
    return [
        CameraArrays(
            key, _form_of(first[key]), first[key].dtype, sorted(frames), _own(backgrounds, key)
        )
        for key, frames in found.items()
    ]


def _form_of(one: ArrayInfo) -> FrameForm:
    if one.form is None:  # of no image
        raise DatasetError(f"{one.key} holds no images")
    return one.form


def _own(backgrounds: dict[str, tuple[str, int]], key: str) -> tuple[str, int] | None:
    """Return the background image of a camera: the one of its name, or the only one."""
    if key in backgrounds:
        return backgrounds[key]
    if len(backgrounds) == 1:
        return next(iter(backgrounds.values()))
    return None


def _group_of_numbers(one: ArrayInfo) -> str | None:
    """Return the group of a single image whose name is a number of 18 digits at most."""
    group, _, name = one.key.rpartition("/")
    if one.form is not None and one.form.single and re.fullmatch(r"\D{0,8}\d{1,18}", name):
        return group
    return None


def _labels(
    container: Container, fields: Mapping[str, ArrayInfo], place: str, left_out: dict[str, None]
) -> dict[str, Any]:
    """Return the labels of a recording: attributes and scalars of it and of the groups above.

    What lies nearer to the recording goes first. Names of what is no label go into `left_out`.
    """
    parts = place.split("/") if place else []
    above = ["/".join(parts[:at]) for at in range(len(parts) + 1)]
    labels: dict[str, Any] = {}
    for group in above:
        inside = [
            key
            for key, one in fields.items()
            if one.form is None
            and one.shape in ((), (1,))
            and (key.rpartition("/")[0] == group or (group == place and _is_inside(key, place)))
        ]
        found = {
            name: value
            for name, value in container.attributes(group).items()
            if not _HOUSEKEEPING.fullmatch(name)
        }
        found |= _scalars(container, inside, group)
        for name, value in found.items():
            plain = _plain(value)
            if plain is None or not name.strip():
                left_out[name] = None
            else:
                labels[name.strip().removeprefix("label.")] = plain
    return labels


def _scalars(container: Container, keys: Sequence[str], group: str) -> dict[str, Any]:
    """Return scalar datasets by name, by the whole path in the group where a name is there twice.

    One that cannot be read is None.
    """
    names = Counter(key.rpartition("/")[2] for key in keys)
    values: dict[str, Any] = {}
    for key in keys:
        name = key.rpartition("/")[2]
        if names[name] > 1:
            name = key[len(group) :].strip("/").replace("/", ".")
        try:
            values[name] = container.read(key)
        except ContainerError:
            values[name] = None
    return values


def _plain(value: Any) -> Any:
    """Return a value as number, text or a list of these, None for what is no label."""
    try:
        array = np.asarray(value)
        plain = array.item() if array.size == 1 else array.tolist()
    except (ValueError, TypeError):
        return None
    if array.size > _MOST_NUMBERS or array.ndim > 1:
        return None
    texts = [_text(one) for one in (plain if isinstance(plain, list) else [plain])]
    if any(one is None for one in texts):
        return None
    return texts if isinstance(plain, list) else texts[0]


def _text(value: Any) -> int | float | str | None:
    """Return one value of a label: a finite number, or a short text."""
    if isinstance(value, bytes):
        try:
            value = value.decode()
        except UnicodeDecodeError:
            return None
    if isinstance(value, bool):
        return int(value)
    if isinstance(value, int) and abs(value) >= 1 << 63:
        return None
    if isinstance(value, str):
        value = " ".join(value.split())
        if (
            not value
            or len(value) > _LONGEST_LABEL
            or value.encode(errors="ignore").decode() != value
        ):
            return None
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value if isinstance(value, int | float | str) else None


def _episode_ends(
    container: Container, fields: Mapping[str, ArrayInfo]
) -> tuple[str, list[int]] | None:
    """Return the array episode_ends with its values, None without one.

    Raises ContainerError.
    """
    keys = [key for key in fields if key.rpartition("/")[2] == _ENDS]
    if not keys:
        return None
    ends = container.read(keys[0])
    rises = ends.ndim == 1 and ends.dtype.kind in "iu" and (np.diff(ends, prepend=0) >= 0).all()
    if not rises or not len(ends):
        raise ContainerError(
            f"{container.path}/{keys[0]} is not a row of rising numbers, where episodes end"
        )
    return keys[0], ends.tolist()


def _of_episodes(
    container: Container, fields: Mapping[str, ArrayInfo], ends: str
) -> dict[str, list[Any]]:
    """Return labels with a value for each episode: arrays beside episode_ends of its length."""
    group = ends.rpartition("/")[0]
    labels = {}
    for key, one in fields.items():
        beside = key.rpartition("/")[0] == group and key != ends and one.form is None
        if beside and one.shape == fields[ends].shape:
            values = [_plain(value) for value in container.read(key)]
            labels[key.rpartition("/")[2]] = values
    return labels


def _episodes(
    container: Container,
    whole: StoredRecording,
    ends: Sequence[int],
    labels: Mapping[str, list[Any]],
) -> Iterator[StoredRecording]:
    """Yield the episodes of a replay buffer, whose frames are counted from 0 in each.

    Raises ContainerError if they end behind the last frame.
    """
    for camera in whole.cameras:
        if len(camera.frames) < ends[-1]:
            raise ContainerError(
                f"{container.path}: {_ENDS} ends at {ends[-1]} and {camera.key} has "
                f"{len(camera.frames)} frames; copy it again"
            )
    for number, (start, end) in enumerate(zip((0, *ends), ends, strict=False)):
        cameras = [
            camera._replace(
                frames=[(row - start, key, at) for row, key, at in camera.frames[start:end]]
            )
            for camera in whole.cameras
        ]
        own = {name: values[number] for name, values in labels.items()}
        yield StoredRecording(
            whole.place,
            f"episode-{number:06d}",
            cameras,
            whole.labels | {name: value for name, value in own.items() if value is not None},
            whole.others,
            slice(start, end),
        )


def _stated_splits(container: Container, fields: Mapping[str, ArrayInfo]) -> dict[str, str]:
    """Return the split of recordings that the lists of robomimic state, as mask/train.

    A recording in two lists, as the filters of robomimic may have it, is in the first.
    """
    splits: dict[str, str] = {}
    for key, one in fields.items():
        group, _, name = key.rpartition("/")
        split = common.split_word(name)
        if group != "mask" or split is None or len(one.shape) != 1:
            continue
        for member in container.read(key).tolist():
            splits.setdefault(str(_text(member)), split)
    return splits


def describe_container(container: Container) -> list[str]:
    """Return lines about a container: its cameras with their --keys, labels, and other arrays."""
    contents = read_contents(container)
    kinds: dict[str, list[CameraArrays]] = {}
    for recording in contents.recordings:
        for camera in recording.cameras:
            kinds.setdefault(camera.key, []).append(camera)
    labels = dict.fromkeys(name for one in contents.recordings for name in one.labels)
    others = dict.fromkeys(key for one in contents.recordings for key in one.others)
    lines = [f"recordings: {len(contents.recordings):,}"] if kinds else []
    for key, cameras in kinds.items():
        frames = sum(len(one.frames) for one in cameras)
        lines.append(
            f"key {key}: {frames:,} frames in {len(cameras):,} of the recordings, "
            f"{cameras[0].form.words(cameras[0].dtype)}"
        )
    if not kinds:
        arrays = [f"{one.key} {one.dtype} {one.shape}" for one in container.fields()]
        lines.append(f"no images; arrays: {listed(arrays) or 'none'}")
    if labels:
        lines.append(f"labels of a recording: {listed(list(labels))}")
    if others:
        lines.append(f"other arrays: {listed(list(others))}")
    if contents.left_out:
        lines.append(
            f"no labels, because they are long or of another kind: {listed(contents.left_out)}"
        )
    lines += [f"not read, {key}: {reason}" for key, reason in container.refused.items()]
    return lines


def _read(index: DatasetIndex) -> None:
    """Add the frames of every container in ROOT, or of ROOT itself.

    Raises DatasetError without a camera, and for a damaged file that was named.
    """
    index.need_sensor()
    kind = index.name
    found: list[tuple[str, Contents]] = []
    for path in index.tracked(list(_files(index, kind)), "files read"):
        try:
            with containers.open_container(index.root / path) as container:
                contents = read_contents(container)
                index.skip_all(
                    "array that is not read",
                    [f"{path}/{key}: {reason}" for key, reason in container.refused.items()],
                )
                _join_values(index.options.values, container, contents)
        except ContainerError as error:
            if index.file is not None:
                raise
            index.skip("file that cannot be read", str(error))
            continue
        found.append((path, contents))
    if not found:
        return
    _check_values(index, found)
    keys = _chosen(index, [contents for _, contents in found])
    _add(index, found, keys)
    _report(index, found)


def _files(index: DatasetIndex, kind: str) -> Iterator[str]:
    """Yield the paths of the containers of a kind in ROOT, in natural order."""
    if index.file is not None:
        yield index.file
        return
    for folder, folders, files in index.walk(enter=lambda name: not name.lower().endswith(".zarr")):
        names = [*files, *(name for name in folders if name.lower().endswith(".zarr"))]
        for name in sorted(names, key=natural):
            path = f"{folder}/{name}".lstrip("/")
            if containers.kind_of(index.root / path) == kind:
                yield path


def _chosen(index: DatasetIndex, found: Sequence[Contents]) -> set[str]:
    """Return the cameras that --keys names, or whose names say that they are tactile.

    Raises DatasetError for a name that is not there, and if no name says so.
    """
    arrays: dict[str, set[str]] = {}
    for contents in found:
        for recording in contents.recordings:
            for camera in recording.cameras:
                arrays.setdefault(camera.key, set()).update(key for _, key, _ in camera.frames[:1])
    known = ", ".join(arrays)
    if not arrays:
        raise DatasetError(
            f"{index.root} has no array of images; anytouch info FILE lists what a file holds"
        )
    if not index.options.keys:
        tactile = {key for key in arrays if common.TACTILE.search(key)}
        if not tactile and len(arrays) == 1:
            # a file with one camera leaves no choice
            return {*arrays}
        if not tactile:
            raise DatasetError(
                f"{index.root}: no camera is called tactile; choose with --keys from {known}"
            )
        return tactile
    chosen: set[str] = set()
    for wanted in index.options.keys:
        exact = {key for key, own in arrays.items() if wanted in (key, *own)}
        matched = exact or {
            key
            for key, own in arrays.items()
            if key.endswith(f"/{wanted}")
            or any(fnmatch.fnmatchcase(one, wanted) for one in (key, *own))
        }
        if not matched:
            raise DatasetError(
                f"{index.root}: there is no camera {wanted}; choose with --keys from {known}"
            )
        chosen |= matched
    return chosen


def _join_values(wanted: Sequence[str], container: Container, contents: Contents) -> None:
    """Make labels of the arrays that --values names."""
    for recording in contents.recordings:
        for name in wanted:
            keys = [key for key in recording.others if key == name or key.endswith(f"/{name}")]
            if keys:
                rows = container.read(recording.others[keys[0]].key)[recording.rows]
                recording.labels[name] = _Rows(
                    [one.item() if one.size == 1 else one.tolist() for one in rows]
                )


def _check_values(index: DatasetIndex, found: Sequence[tuple[str, Contents]]) -> None:
    """Raise DatasetError for a word of --values that no recording has."""
    everything = [recording for _, contents in found for recording in contents.recordings]
    for name in index.options.values:
        if not any(name in recording.labels for recording in everything):
            others = dict.fromkeys(key for one in everything for key in one.others)
            raise DatasetError(
                f"{index.root} has no array {name}; --values takes {listed(list(others))}"
            )


class _Rows(list[Any]):
    """Values of a label, one for each frame of a recording."""


def _add(index: DatasetIndex, found: Sequence[tuple[str, Contents]], keys: set[str]) -> None:
    """Add the rows of the chosen cameras, with labels and splits."""
    rows: list[tuple[str, StoredRecording, CameraArrays]] = []
    for path, contents in found:
        for recording in contents.recordings:
            rows += [
                (path, recording, camera) for camera in recording.cameras if camera.key in keys
            ]
    splits = _splits(index, found, rows)
    labels = _label_columns(rows)
    first = 0
    for path, recording, camera in rows:
        count = len(camera.frames)
        cells = {name: values[first : first + count] for name, values in labels.items()}
        first += count
        episode = "/".join(filter(None, (path, recording.name)))
        background = camera.background
        index.add(
            [f"{path}/{key}/{row}" if key else f"{path}/{row}" for _, key, row in camera.frames],
            sensor=index.options.sensor,
            unit=camera.key or None,
            sequence="/".join(filter(None, (episode, camera.key))),
            frame_index=[number for number, _, _ in camera.frames],
            split=splits[episode],
            episode=episode,
            background_path=background and f"{path}/{background[0]}/{background[1]}",
            **cells,
        )


def _splits(
    index: DatasetIndex,
    found: Sequence[tuple[str, Contents]],
    rows: Sequence[tuple[str, StoredRecording, CameraArrays]],
) -> dict[str, str]:
    """Return the split of each recording: what a file or a name states, else by rank.

    Cameras of a recording show the same moments, so they share its split. Recordings are divided
    inside each object, so that a classifier of objects meets all of them in training.
    """
    stated = {path: contents.splits for path, contents in found}
    splits: dict[str, str] = {}
    pools: dict[str, set[str]] = {}
    for path, recording, _ in rows:
        episode = "/".join(filter(None, (path, recording.name)))
        name = recording.place.rpartition("/")[2]
        parts = [*os.path.splitext(path)[0].split("/"), *recording.place.split("/")]
        words = [word for word in map(common.split_word, parts) if word]
        split = stated[path].get(name) or (words[0] if words else None)
        if split is None and stated[path]:
            split = "unused"
        if split is None:
            pools.setdefault(str(recording.labels.get("object")), set()).add(episode)
        else:
            splits[episode] = split
    total = sum(map(len, pools.values()))
    for pool in pools.values():
        index.drawn |= ranked_split(pool, index.options, total)
    splits |= index.drawn
    fractions = dict(zip(("val", "test"), index.options.fractions(), strict=True))
    for split in fractions if pools else ():
        if split not in splits.values() and fractions[split]:
            index.notes.append(f"there are too few recordings for split {split}")
    if any(stated.values()):
        index.notes.append("the splits are those that the lists in mask/ state")
    return splits


def _label_columns(
    rows: Sequence[tuple[str, StoredRecording, CameraArrays]],
) -> dict[str, list[Any]]:
    """Return the labels of all rows: label.NAME, and the columns that a manifest has for some.

    A label is of one type: numbers where all values are numbers, else texts.
    """
    names = dict.fromkeys(name for _, recording, _ in rows for name in recording.labels)
    columns: dict[str, list[Any]] = {}
    for name in names:
        values: list[Any] = []
        for path, recording, camera in rows:
            value = recording.labels.get(name)
            if isinstance(value, _Rows):
                if len(value) != len(camera.frames):
                    raise DatasetError(
                        f"{path}: {name} has {len(value)} values and {camera.key} "
                        f"{len(camera.frames)} frames; choose another for --values"
                    )
                values += value
            else:
                values += [value] * len(camera.frames)
        for label, cells in common.label_cells(name, values).items():
            has_text = any(isinstance(cell, str) for cell in cells)
            column = [str(cell) if has_text and cell is not None else cell for cell in cells]
            columns[f"label.{label}"] = column
            if label in _COLUMNS:
                columns[label] = [None if cell is None else str(cell) for cell in column]
    return columns


def _report(index: DatasetIndex, found: Sequence[tuple[str, Contents]]) -> None:
    """Name what was not read."""
    everything = [recording for _, contents in found for recording in contents.recordings]
    others = [
        key
        for key in dict.fromkeys(key for one in everything for key in one.others)
        if not any(key == name or key.endswith(f"/{name}") for name in index.options.values)
    ]
    if others:
        index.notes.append(
            f"arrays that are not read: {listed(others)}; --values makes labels of those it names"
        )
    left_out = dict.fromkeys(name for _, contents in found for name in contents.left_out)
    if left_out:
        index.notes.append(
            f"no labels, because they are long or of another kind: {listed(list(left_out))}"
        )


_USES = ("val", "test", "sensor", "keys", "values")
READERS = {
    "hdf5": DatasetReader(
        _read,
        "<recording>.h5",
        "nothing, unless their owner asks for it",
        "as their owner says",
        uses=_USES,
        files=containers.HDF5,
    ),
    "zarr": DatasetReader(
        _read,
        "<recording>.zarr",
        "nothing, unless their owner asks for it",
        "as their owner says",
        uses=_USES,
        files=containers.ZARR,
    ),
}
