"""LeRobot data sets (version 3): tactile cameras become sequences, and features go back as a column.

The layout is that of github.com/huggingface/lerobot (`src/lerobot/datasets/utils.py`, `dataset_reader.py`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from anytouch_jax.data.images import ImageError, frames_from_video
from anytouch_jax.data.readers.common import DatasetError, DatasetIndex, DatasetReader, read_json, save_png
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, atomic_write

TACTILE = re.compile(r"tactile|gelsight|digit|touch|gel(?![a-z])", re.IGNORECASE)


def _lerobot(index: DatasetIndex) -> None:
    """A LeRobotDataset v3: meta/info.json, meta/episodes/, data/*.parquet, videos/KEY/*.mp4.

    Each tactile camera of an episode is a sequence, with the data set's own frame_index, timestamp and index. Pictures
    in Parquet are read where they are. Films are written as PNG, under LeRobot's names for pictures.
    """
    if not (index.root / "meta" / "info.json").is_file():
        return
    info, sensor = read_json(index.root / "meta" / "info.json"), index.need_sensor()
    if not str(info.get("codebase_version", "")).startswith("v3"):
        raise DatasetError(
            f"{index.root} has version {info.get('codebase_version')} of LeRobot's format; convert it to v3.0 with "
            "LeRobot's script"
        )
    features = {str(name): one for name, one in dict(info.get("features", {})).items() if isinstance(one, dict)}
    cameras = [name for name, one in features.items() if one.get("dtype") in ("image", "video")]
    keys = index.options.keys or tuple(name for name in cameras if TACTILE.search(name))
    if unknown := [key for key in keys if key not in cameras] or ([] if keys else [""]):
        wrong = f"there is no camera {unknown[0]}" if unknown[0] else "no camera is called tactile"
        raise DatasetError(f"{index.root}: {wrong}; choose with --keys from {', '.join(cameras)}")
    episodes = {int(row["episode_index"]): row for row in _parquet_rows(index, "meta/episodes/")}
    tasks = _tasks(index)
    films = [key for key in keys if features[key]["dtype"] == "video"]
    for key in films:
        _export_films(index, info, key, episodes)
    wanted = ["episode_index", "frame_index", "timestamp", "index", "task_index", *index.options.values]
    for name in index.options.values:
        if name not in features:
            raise DatasetError(f"{index.root} has no feature {name}; it has {', '.join(features)}")
    for path in index.paths(".parquet", "data/"):
        columns = pa.parquet.read_schema(index.root / path).names
        table = pa.parquet.read_table(index.root / path, columns=[name for name in wanted if name in columns])
        rows = table.to_pylist()
        labels = _vector_labels(rows, index.options.values)
        labels |= {"label.task": [tasks.get(row.get("task_index")) for row in rows]} if tasks else {}
        episode, frame = ([int(row[name]) for row in rows] for name in ("episode_index", "frame_index"))
        for key in keys:
            paths = [f"{path}/{key}/{at}" for at in range(len(rows))]
            if key in films:
                paths = [_frame_path(key, e, f) for e, f in zip(episode, frame, strict=True)]
            index.add(
                paths, sensor=sensor, unit=key, sequence=[f"episode-{e:06d}/{key}" for e in episode],
                frame_index=frame, split=[index.split_of(f"episode-{e:06d}") for e in episode], episode=episode,
                index=[int(row["index"]) for row in rows], timestamp=[float(row["timestamp"]) for row in rows],
                **labels,
            )  # fmt: skip


def _parquet_rows(index: DatasetIndex, base: str) -> Iterator[dict[str, Any]]:
    if not (index.root / base).is_dir():
        raise DatasetError(f"{index.root} has no {base}; download all of the data set")
    for path in index.paths(".parquet", base):
        try:
            table = pa.parquet.read_table(index.root / path)
        except (pa.ArrowException, OSError) as error:
            raise DatasetError(f"{index.root / path} cannot be read: {error}") from None
        yield from table.select([n for n in table.column_names if not n.startswith("stats/")]).to_pylist()


def _tasks(index: DatasetIndex) -> dict[int, str]:
    """Return the sentence of every task."""
    file = index.root / "meta" / "tasks.parquet"
    if not file.is_file():
        return {}
    rows = pa.parquet.read_table(file).to_pylist()
    return {int(row.pop("task_index")): str(next(iter(row.values()))) for row in rows}


def _frame_path(key: str, episode: int, frame: int) -> str:
    return f"images/{key}/episode-{episode:06d}/frame-{frame:06d}.png"


def _export_films(index: DatasetIndex, info: dict[str, Any], key: str, episodes: dict[int, dict[str, Any]]) -> None:
    """Write the frames of a camera's films, which hold several episodes each, as PNG. Raises DatasetError."""
    index.need_export(f"films of {key}")
    fps, films = float(info["fps"]), dict[str, list[tuple[int, int, int]]]()
    for number, row in episodes.items():
        try:
            chunk, file = row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"]
            path = str(info["video_path"]).format(video_key=key, chunk_index=int(chunk), file_index=int(file))
            first = round(float(row[f"videos/{key}/from_timestamp"]) * fps)
            films.setdefault(path, []).append((first, int(row["length"]), number))
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(f"{index.root}: meta/episodes says nothing of the film of {key}: {error}") from None
    for path, parts in films.items():
        parts, last = sorted(parts), max(first + length for first, length, _ in parts)
        ends = [index.root / _frame_path(key, number, length - 1) for _, length, number in parts]
        if all(end.is_file() for end in ends):
            continue
        try:
            count = 0
            pictures = index.tracked(_pictures(index.root / path), "frames written", last)
            for count, picture in enumerate(pictures, 1):
                for first, length, number in parts:
                    if first <= count - 1 < first + length:
                        save_png(index.root / _frame_path(key, number, count - 1 - first), picture)
                if count == last:
                    break
        except ImageError as error:
            raise DatasetError(f"{error}; download it again, or for AV1 pip install 'anytouch_jax[lerobot]'") from None
        if count < last:
            raise DatasetError(f"{index.root / path} has {count} frames and the episodes {last}; download it again")


def _pictures(path: Path) -> Iterator[np.ndarray]:
    """Yield the pictures RGB u8 of a film. LeRobot writes AV1, which OpenCV cannot decode. Raises ImageError."""
    try:
        import av
    except ImportError:
        yield from frames_from_video(path)
        return
    try:
        with av.open(path) as film:
            yield from (frame.to_ndarray(format="rgb24") for frame in film.decode(video=0))
    except (av.FFmpegError, OSError, ValueError, IndexError) as error:  # IndexError: a file without a film
        raise ImageError(f"{path} is not a video that can be read: {error}") from None


def _vector_labels(rows: list[dict[str, Any]], names: tuple[str, ...]) -> dict[str, list[Any]]:
    """Return label.NAME of numbers and label.NAME_0, ... of vectors."""
    labels: dict[str, list[Any]] = {}
    for name in names:
        values: list[Any] = [row.get(name) for row in rows]
        if isinstance(values[0] if values else None, list):
            labels |= {f"label.{name}_{i}": [value[i] for value in values] for i in range(len(values[0]))}
        else:
            labels[f"label.{name}"] = values
    return labels


def write_features(root: Path, name: str, features: np.ndarray, index: np.ndarray) -> None:
    """Write features f32 (n, E) of the frames with these numbers (column `index`) as the column `name`.

    Frames without features get NaN. Every Parquet file is replaced as a whole, and meta/info.json last. Raises
    UserError for a column that is there, and for frames that are not.
    """
    file = root / "meta" / "info.json"
    info = read_json(file)
    if name in info.get("features", {}):
        raise UserError(f"{root} has a feature {name}; choose another name")
    place = {int(number): row for row, number in enumerate(index)}
    files = sorted((root / "data").glob("*/*.parquet"))
    tables = [pa.parquet.read_table(path) for path in files]
    known = {number for table in tables for number in table["index"].to_pylist()}
    if lost := place.keys() - known:
        raise UserError(f"{root} has no frame of index {min(lost)}; the features are of another data set")
    width = features.shape[1]
    for path, table in zip(files, tables, strict=True):
        values = np.full((len(table), width), np.nan, np.float32)
        for at, number in enumerate(table["index"].to_pylist()):
            if number in place:
                values[at] = features[place[number]]
        column = pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), width)
        metadata = {key: value for key, value in (table.schema.metadata or {}).items() if key != b"huggingface"}
        table = table.append_column(name, column).replace_schema_metadata(metadata or None)
        with atomic_path(path) as part:
            pa.parquet.write_table(table, part)
    info["features"][name] = {"dtype": "float32", "shape": [width], "names": None}
    atomic_write(file, json.dumps(info, indent=4))


READERS = {
    "lerobot": DatasetReader(
        _lerobot, "meta/info.json and data/chunk-000/file-000.parquet", "the data set's own card",
        "as their owner says", "https://github.com/huggingface/lerobot",
        uses=("val", "test", "sensor", "keys", "values", "export"),
    ),
}  # fmt: skip
