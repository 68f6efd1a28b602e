"""LeRobot data sets (version 3): tactile cameras become sequences, and features go back as a column.

The layout is that of github.com/huggingface/lerobot (`src/lerobot/datasets/utils.py`, `dataset_reader.py`).
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet

from anytouch_jax.data.images import ImageError, frames_from_video
from anytouch_jax.data.readers.common import (
    TACTILE,
    DatasetError,
    DatasetIndex,
    DatasetReader,
    label_cells,
    read_json,
    split_word,
)
from anytouch_jax.data.readers.exports import Export, exported
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, atomic_write


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
    tasks, splits = _tasks(index), _stated_splits(index, info, episodes)
    films = [key for key in keys if features[key]["dtype"] == "video"]
    folders = {key: _export_films(index, info, key, episodes) for key in films}
    wanted = ["episode_index", "frame_index", "timestamp", "index", "task_index", *index.options.values]
    for name in index.options.values:
        if name not in features:
            raise DatasetError(f"{index.root} has no feature {name}; it has {', '.join(features)}")
    files = [(path, set(pa.parquet.read_schema(index.root / path).names)) for path in index.paths(".parquet", "data/")]
    for name in index.options.values:
        index.skip(f"file without the column {name}", *_without(name, files))
    rows_of = {
        path: pa.parquet.read_table(index.root / path, columns=[one for one in wanted if one in columns]).to_pylist()
        for path, columns in files
    }
    cells = {
        name: label_cells(name, [row.get(name) for rows in rows_of.values() for row in rows])
        for name in index.options.values
    }
    index.wanted += [f"label.{label}" for names in cells.values() for label in names]
    others = [name for name in features if name not in (*cameras, *wanted)]
    if others:
        index.notes.append(f"features that are not read: {', '.join(others)}; --values makes labels of those it names")
    first = 0
    for path, rows in rows_of.items():
        labels = {f"label.{label}": values[first : first + len(rows)]
                  for names in cells.values() for label, values in names.items()}  # fmt: skip
        first += len(rows)
        labels |= {"label.task": [tasks.get(row.get("task_index")) for row in rows]} if tasks else {}
        episode, frame = ([int(row[name]) for row in rows] for name in ("episode_index", "frame_index"))
        index.skip("frame of an episode in no stated split (split unused)", path, sum(e not in splits for e in episode))
        for key in keys:
            paths = [f"{path}/{key}/{at}" for at in range(len(rows))]
            if key in films:
                paths = [f"{folders[key][e]}/frame-{f:06d}.png" for e, f in zip(episode, frame, strict=True)]
            index.add(
                paths, sensor=sensor, unit=key, sequence=[f"episode-{e:06d}/{key}" for e in episode],
                frame_index=frame, split=[splits.get(e, "unused") for e in episode], episode=episode,
                index=[int(row["index"]) for row in rows], timestamp=[float(row["timestamp"]) for row in rows],
                **labels,
            )  # fmt: skip


def _without(name: str, files: list[tuple[str, set[str]]]) -> tuple[str, int]:
    missing = [path for path, columns in files if name not in columns]
    return "".join(missing[:1]), len(missing)


def _stated_splits(index: DatasetIndex, info: dict[str, Any], episodes: Iterable[int]) -> dict[int, str]:
    """Return the split of each episode: those of meta/info.json, as "0:2", if it states several; else by hash.

    Raises DatasetError for splits that cannot be read or that share an episode.
    """
    stated: dict[int, str] = {}
    splits = dict(info.get("splits") or {})
    if len(splits) < 2:
        if splits and index.options.val + index.options.test:
            index.notes.append(
                f"meta/info.json states split {next(iter(splits))} alone, so episodes are split by hash; --val 0 "
                "--test 0 keeps all in train"
            )
        return {number: index.split_of(f"episode-{number:06d}") for number in episodes}
    for name, ranges in splits.items():
        split = split_word(str(name))
        if split is None:
            index.notes.append(f"split {name} of meta/info.json has no name that is known: its episodes are unused")
        try:
            ends = [part.split(":") for part in str(ranges).strip("[]").split(",")]
            numbers = [number for end in ends for number in range(int(end[0]), int(end[-1]) + (len(end) == 1))]
        except ValueError:
            raise DatasetError(f"{index.root}: split {name} of meta/info.json is {ranges}; write it as 0:2") from None
        for number in numbers:
            if stated.setdefault(number, split or "unused") != (split or "unused"):
                raise DatasetError(f"{index.root}: episode {number} is in two splits of meta/info.json; correct them")
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
        yield from table.select([n for n in table.column_names if not n.startswith("stats/")]).to_pylist()


def _tasks(index: DatasetIndex) -> dict[int, str]:
    """Return the sentence of every task."""
    file = index.root / "meta" / "tasks.parquet"
    if not file.is_file():
        return {}
    rows = pa.parquet.read_table(file).to_pylist()
    return {int(row.pop("task_index")): str(next(iter(row.values()))) for row in rows}


def _export_films(
    index: DatasetIndex, info: dict[str, Any], key: str, episodes: dict[int, dict[str, Any]]
) -> dict[int, str]:
    """Write the frames of a camera's films, which hold several episodes each, as PNG; return the episodes' folders.

    Raises DatasetError.
    """
    index.need_export(f"films of {key}")
    fps, films = float(info["fps"]), dict[str, list[tuple[int, int, int]]]()
    folders: dict[int, str] = {}
    for number, row in episodes.items():
        try:
            chunk, file = row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"]
            path = str(info["video_path"]).format(video_key=key, chunk_index=int(chunk), file_index=int(file))
            first = round(float(row[f"videos/{key}/from_timestamp"]) * fps)
            films.setdefault(path, []).append((first, int(row["length"]), number))
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(f"{index.root}: meta/episodes says nothing of the film of {key}: {error}") from None
    for path, parts in films.items():
        film = index.root / path
        if not film.is_file():
            raise DatasetError(f"there is no film {film}; download all of the data set")
        with ExitStack() as stack:
            exports = {
                number: stack.enter_context(exported(
                    index, f"images/{key}/episode-{number:06d}", f"{key}, episode {number}", [film], [first, length]
                ))
                for first, length, number in parts
            }  # fmt: skip
            if any(export.is_new for export in exports.values()):
                _write_episodes(index, film, sorted(parts), exports)
        folders |= {number: export.folder for number, export in exports.items()}
    return folders


def _write_episodes(
    index: DatasetIndex, film: Path, parts: list[tuple[int, int, int]], exports: dict[int, Export]
) -> None:
    last, count = max(first + length for first, length, _ in parts), 0
    try:
        for count, picture in enumerate(index.tracked(frames_from_video(film), "frames written", last), 1):
            for first, length, number in parts:
                if first <= count - 1 < first + length:
                    exports[number].save(f"frame-{count - 1 - first:06d}.png", picture)
            if count == last:
                break
    except ImageError as error:
        raise DatasetError(f"{error}; or download it again") from None
    if count < last:
        raise DatasetError(f"{film} has {count} frames and the episodes {last}; download it again")


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
