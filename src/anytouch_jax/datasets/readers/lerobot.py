"""LeRobot data sets (version 3): tactile cameras become sequences, and features go back as a
column.

The layout is that of github.com/huggingface/lerobot (`src/lerobot/datasets/utils.py`,
`dataset_reader.py`).
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from anytouch_jax.data.images import ImageError, frames_from_video
from anytouch_jax.datasets.readers import common
from anytouch_jax.datasets.readers.common import DatasetError, DatasetIndex, DatasetReader
from anytouch_jax.datasets.readers.exports import Export, exported
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path


class _Dataset(NamedTuple):
    """What meta/info.json states, and what was asked for of it.

    `features` and `cameras` are by LeRobot's names. `keys` are the cameras that are indexed, and
    `videos` those of them that are stored as videos.
    """

    info: dict[str, Any]
    features: dict[str, dict[str, Any]]
    cameras: list[str]
    keys: tuple[str, ...]
    videos: list[str]


def _lerobot(index: DatasetIndex) -> None:
    """Index a LeRobotDataset v3: a sequence for each tactile camera of an episode.

    Frames of videos become PNG under LeRobot's names. Raises DatasetError.
    """
    if not (index.root / "meta" / "info.json").is_file():
        return
    sensor = index.need_sensor()
    dataset = _read_info(index)
    episodes = {int(row["episode_index"]): row for row in _parquet_rows(index, "meta/episodes/")}
    splits = _stated_splits(index, dataset.info, episodes)
    folders = {key: _export_videos(index, dataset.info, key, episodes) for key in dataset.videos}
    rows_of, labels = _read_rows(index, dataset)
    first = 0
    for path, rows in rows_of.items():
        here = {name: values[first : first + len(rows)] for name, values in labels.items()}
        first += len(rows)
        episode = [int(row["episode_index"]) for row in rows]
        frame = [int(row["frame_index"]) for row in rows]
        unstated = sum(number not in splits for number in episode)
        index.skip("frame of an episode in no stated split (split unused)", path, unstated)
        for key in dataset.keys:
            if key in folders:
                paths = [
                    f"{folders[key][number]}/frame-{at:06d}.png"
                    for number, at in zip(episode, frame, strict=True)
                ]
            else:  # the images are cells of the table
                paths = [f"{path}/{key}/{at}" for at in range(len(rows))]
            index.add(
                paths,
                sensor=sensor,
                unit=key,
                sequence=[f"episode-{number:06d}/{key}" for number in episode],
                frame_index=frame,
                split=[splits.get(number, "unused") for number in episode],
                episode=episode,
                index=[int(row["index"]) for row in rows],
                timestamp=[float(row["timestamp"]) for row in rows],
                **here,
            )


def _read_info(index: DatasetIndex) -> _Dataset:
    """Return what meta/info.json states of the cameras that were asked for.

    Raises DatasetError for another version, and for a camera or a feature that is not there.
    """
    info = common.read_json(index.root / "meta" / "info.json")
    version = str(info.get("codebase_version", ""))
    if not version.startswith("v3"):
        raise DatasetError(
            f"{index.root} has version {info.get('codebase_version')} of LeRobot's format; convert "
            "it to v3.0 with LeRobot's script"
        )
    features = {
        str(name): feature
        for name, feature in dict(info.get("features", {})).items()
        if isinstance(feature, dict)
    }
    cameras = [name for name, one in features.items() if one.get("dtype") in ("image", "video")]
    keys = index.options.keys or tuple(name for name in cameras if common.TACTILE.search(name))
    unknown = [key for key in keys if key not in cameras]
    if unknown or not keys:
        wrong = f"there is no camera {unknown[0]}" if unknown else "no camera is called tactile"
        raise DatasetError(f"{index.root}: {wrong}; choose with --keys from {', '.join(cameras)}")
    for name in index.options.values:
        if name not in features:
            raise DatasetError(f"{index.root} has no feature {name}; it has {', '.join(features)}")
    videos = [key for key in keys if features[key]["dtype"] == "video"]
    return _Dataset(info, features, cameras, keys, videos)


def _read_rows(
    index: DatasetIndex, dataset: _Dataset
) -> tuple[dict[str, list[dict[str, Any]]], dict[str, list[Any]]]:
    """Return the rows of each table below data/, and the labels of all rows in that order.

    A label is a value that --values names, or the sentence of the task. Features that nobody asked
    for are named in a note.
    """
    values = index.options.values
    wanted = ["episode_index", "frame_index", "timestamp", "index", "task_index", *values]
    columns_of = {
        path: set(pa.parquet.read_schema(index.root / path).names)
        for path in index.paths(".parquet", "data/")
    }
    for name in values:
        without = [path for path, columns in columns_of.items() if name not in columns]
        index.skip_all(f"file without the column {name}", without)
    rows_of = {}
    for path, columns in columns_of.items():
        present = [name for name in wanted if name in columns]
        rows_of[path] = pa.parquet.read_table(index.root / path, columns=present).to_pylist()
    all_rows = [row for rows in rows_of.values() for row in rows]
    labels: dict[str, list[Any]] = {}
    # One call a name over all rows, because the type of a label is that of all its values.
    for name in values:
        for label, cells in common.label_cells(name, [row.get(name) for row in all_rows]).items():
            labels[f"label.{label}"] = cells
    index.wanted += labels
    tasks = _tasks(index)
    if tasks:
        labels["label.task"] = [tasks.get(row.get("task_index")) for row in all_rows]
    others = [name for name in dataset.features if name not in (*dataset.cameras, *wanted)]
    if others:
        index.notes.append(
            f"features that are not read: {', '.join(others)}; --values makes labels of those it "
            "names"
        )
    return rows_of, labels


def _stated_splits(
    index: DatasetIndex, info: dict[str, Any], episodes: Iterable[int]
) -> dict[int, str]:
    """Return the split of each episode, as meta/info.json states several ("0:2"), else by hash.

    Raises DatasetError.
    """
    stated: dict[int, str] = {}
    splits = dict(info.get("splits") or {})
    if len(splits) < 2:
        if splits and sum(index.options.fractions()):
            index.notes.append(
                f"meta/info.json states split {next(iter(splits))} alone, so episodes are split by "
                "hash; --val 0 --test 0 keeps all in train"
            )
        return {number: index.split_of(f"episode-{number:06d}") for number in episodes}
    for name, ranges in splits.items():
        split = common.split_word(str(name))
        if split is None:
            index.notes.append(
                f"split {name} of meta/info.json has no name that is known: its episodes are unused"
            )
        try:
            ends = [part.split(":") for part in str(ranges).strip("[]").split(",")]
            numbers = [
                number
                for end in ends
                for number in range(int(end[0]), int(end[-1]) + (len(end) == 1))
            ]
        except ValueError:
            raise DatasetError(
                f"{index.root}: split {name} of meta/info.json is {ranges}; write it as 0:2"
            ) from None
        for number in numbers:
            if stated.setdefault(number, split or "unused") != (split or "unused"):
                raise DatasetError(
                    f"{index.root}: episode {number} is in two splits of meta/info.json; correct "
                    "them"
                )
    index.notes.append(f"the splits are those of meta/info.json: {', '.join(splits)}")
    return stated


def _parquet_rows(index: DatasetIndex, base: str) -> Iterator[dict[str, Any]]:
    if not (index.root / base).is_dir():
        raise DatasetError(f"{index.root} has no {base}; download all of the data set")
    for path in index.paths(".parquet", base):
        try:
            table = pa.parquet.read_table(index.root / path)
        except (pa.ArrowException, OSError) as error:
            raise DatasetError(f"{index.root / path} cannot be read: {error}") from None
        yield from table.select(
            [n for n in table.column_names if not n.startswith("stats/")]
        ).to_pylist()


def _tasks(index: DatasetIndex) -> dict[int, str]:
    """Return the sentence of every task."""
    file = index.root / "meta" / "tasks.parquet"
    if not file.is_file():
        return {}
    rows = pa.parquet.read_table(file).to_pylist()
    return {int(row.pop("task_index")): str(next(iter(row.values()))) for row in rows}


def _export_videos(
    index: DatasetIndex, info: dict[str, Any], key: str, episodes: dict[int, dict[str, Any]]
) -> dict[int, str]:
    """Write the episodes of a camera's videos as PNG, and return their folders.

    Raises DatasetError.
    """
    index.need_export(f"videos of {key}")
    fps = float(info["fps"])
    videos = dict[str, list[tuple[int, int, int]]]()
    folders: dict[int, str] = {}
    for number, row in episodes.items():
        try:
            chunk = row[f"videos/{key}/chunk_index"]
            file = row[f"videos/{key}/file_index"]
            path = str(info["video_path"]).format(
                video_key=key, chunk_index=int(chunk), file_index=int(file)
            )
            first = round(float(row[f"videos/{key}/from_timestamp"]) * fps)
            videos.setdefault(path, []).append((first, int(row["length"]), number))
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(
                f"{index.root}: meta/episodes says nothing of the video of {key}: {error}"
            ) from None
    for path, parts in videos.items():
        video = index.root / path
        if not video.is_file():
            raise DatasetError(f"there is no video {video}; download all of the data set")
        with ExitStack() as stack:
            exports = {
                number: stack.enter_context(
                    exported(
                        index,
                        f"images/{key}/episode-{number:06d}",
                        f"{key}, episode {number}",
                        [video],
                        [first, length],
                    )
                )
                for first, length, number in parts
            }
            if any(export.is_new for export in exports.values()):
                _write_episodes(index, video, sorted(parts), exports)
        folders |= {number: export.folder for number, export in exports.items()}
    return folders


def _write_episodes(
    index: DatasetIndex, video: Path, parts: list[tuple[int, int, int]], exports: dict[int, Export]
) -> None:
    last = max(first + length for first, length, _ in parts)
    count = 0
    try:
        for count, image in enumerate(
            index.tracked(frames_from_video(video), "frames written", last), 1
        ):
            for first, length, number in parts:
                if first <= count - 1 < first + length:
                    exports[number].save(f"frame-{count - 1 - first:06d}.png", image)
            if count == last:
                break
    except ImageError as error:
        raise DatasetError(f"{error}; or download it again") from None
    if count < last:
        raise DatasetError(f"{video} has {count} frames and the episodes {last}; download it again")


def camera_names(cameras: Sequence[str]) -> list[str]:
    """Return what distinguishes the keys of cameras: left and right of observation.left.gel,
    observation.right.gel.
    """
    parts = [camera.split(".") for camera in cameras]
    first = _common(parts)
    last = _common([part[first:][::-1] for part in parts])
    names = [".".join(part[first : len(part) - last]) for part in parts]
    if all(names) and len(cameras) > 1:
        return names
    return list(cameras)


def _common(lists: Sequence[Sequence[str]]) -> int:
    """Return how many items all lists begin with."""
    return sum(
        1
        for _ in itertools.takewhile(lambda items: len(set(items)) == 1, zip(*lists, strict=False))
    )


def write_features(root: Path, columns: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> None:
    """Write columns by name: features f32 (n, E), and the numbers (n,) of their frames in the
    column `index`.

    Other frames get NaN. meta/stats.json gets their statistics. All files are written before the
    first is replaced, meta/info.json last. Raises UserError for a column that is there, and for
    frames that are not.
    """
    file = root / "meta" / "info.json"
    statistics = root / "meta" / "stats.json"
    info = common.read_json(file)
    stats = common.read_json(statistics) if statistics.is_file() else {}
    files = sorted((root / "data").glob("*/*.parquet"))
    known = [np.asarray(pa.parquet.read_table(path, columns=["index"])["index"]) for path in files]
    for name, (features, index) in columns.items():
        if name in info.get("features", {}):
            raise UserError(f"{root} has a feature {name}; choose another name")
        if len(lost := np.setdiff1d(index, np.concatenate([np.zeros(0, int), *known]))):
            raise UserError(
                f"{root} has no frame of index {lost[0]}; the features are of another data set"
            )
        info["features"][name] = {"dtype": "float32", "shape": [features.shape[1]], "names": None}
        stats[name] = _statistics(features)
    # what is entered last is replaced first
    with ExitStack() as written:
        for path, content in ((file, info), (statistics, stats)):
            written.enter_context(atomic_path(path)).write_text(json.dumps(content, indent=4))
        for path, numbers in zip(files, known, strict=True):
            table = pa.parquet.read_table(path)
            for name, (features, index) in columns.items():
                values = np.full((len(numbers), features.shape[1]), np.nan, np.float32)
                order = np.argsort(index)
                at = order[np.searchsorted(index, numbers, sorter=order).clip(max=len(order) - 1)]
                values[index[at] == numbers] = features[at[index[at] == numbers]]
                column = pa.FixedSizeListArray.from_arrays(
                    pa.array(values.ravel()), features.shape[1]
                )
                # left by an interrupted run
                kept = [own for own in table.column_names if own != name]
                table = table.select(kept).append_column(name, column)
            metadata = {
                key: value
                for key, value in (table.schema.metadata or {}).items()
                if key != b"huggingface"
            }
            table = table.replace_schema_metadata(metadata or None)
            pa.parquet.write_table(table, written.enter_context(atomic_path(path)))


def _statistics(features: np.ndarray) -> dict[str, list[float]]:
    """Return statistics of features (n, E) under the names of LeRobot
    (`src/lerobot/datasets/compute_stats.py`).
    """
    x = features.astype(np.float64)
    values = {"min": x.min(0), "max": x.max(0), "mean": x.mean(0), "std": x.std(0)}
    values |= {
        f"q{percent:02d}": np.percentile(x, percent, axis=0) for percent in (1, 10, 50, 90, 99)
    }
    return {name: value.tolist() for name, value in values.items()} | {"count": [len(x)]}


READERS = {
    "lerobot": DatasetReader(
        _lerobot,
        "meta/info.json and data/chunk-000/file-000.parquet",
        "the data set's own card",
        "as their owner says",
        "https://github.com/huggingface/lerobot",
        uses=("val", "test", "sensor", "keys", "values", "export"),
    ),
}
