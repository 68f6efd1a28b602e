"""A writer of LeRobot data sets (version 3), so that policies with touch are trained by its tools.

The layout is that of github.com/huggingface/lerobot. Tactile images are PNG in the tables, without
loss. `anytouch data index lerobot` reads what is written here.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.parquet

from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, atomic_write

Frame = Mapping[str, npt.ArrayLike]
_COUNTED = ("frame_index", "episode_index", "index", "task_index")
_CHUNK = 1000  # files of a folder
_DATA = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
_VIDEOS = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"


class LeRobotWriter:
    """Writes a LeRobot data set, an episode at a time.

        with LeRobotWriter("touches", fps=20) as writer:
            writer.add({"observation.images.tactile": image, "action": action})
            writer.end_episode("hold the cup")

    An array u8 (H, W, 3) is an image, others are vectors of float32. Call a tactile camera
    `observation.images.tactile...`, so that it is recognised. meta/info.json is written last, when
    the block ends: without it nothing is a data set. Episodes that did not end are left out.

    Args:
        root: A new or empty folder.
        fps: Frames a second.
        robot: The type of the robot.

    Raises:
        UserError: For a folder that is not empty, and for frames that do not fit the first one.
    """

    def __init__(self, root: str | Path, *, fps: float, robot: str = "mujoco") -> None:
        self._root = Path(root)
        if self._root.exists() and (not self._root.is_dir() or any(self._root.iterdir())):
            raise UserError(f"{root} is not an empty folder; name another one")
        if not fps > 0:
            raise UserError(f"fps is above 0, not {fps}")
        self._fps = fps
        self._robot = robot
        self._shapes: dict[str, tuple[int, ...]] = {}
        self._images: set[str] = set()
        self._frames: list[dict[str, Any]] = []
        self._episodes: list[dict[str, Any]] = []
        self._tasks: dict[str, int] = {}
        self._sums: dict[str, _Sums] = {}
        self._total = 0
        self._closed = False

    def __enter__(self) -> LeRobotWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._episodes:
            self.close()

    def add(self, frame: Frame) -> None:
        """Add a frame of the current episode: arrays by LeRobot's names of features.

        Raises UserError.
        """
        if self._closed:
            raise UserError(f"{self._root} is closed; write another data set")
        arrays = {name: np.asarray(value) for name, value in frame.items()}
        if not self._shapes:
            self._first(arrays)
        row: dict[str, Any] = {}
        for name, shape in self._shapes.items():
            value = arrays.get(name, np.zeros(0))
            if np.atleast_1d(value).shape != shape:
                raise UserError(
                    f"a frame has {name} of {np.shape(value)}, and the first one {shape}; give all "
                    "frames the same features"
                )
            if name in self._images:
                row[name] = {"bytes": _png(value), "path": None}
                self._sums[name].add(value.reshape(-1, 3) / 255)
            else:
                row[name] = np.atleast_1d(value).astype(np.float32)
                if not np.isfinite(row[name]).all():
                    raise UserError(f"a frame has {name} with NaN or infinity; leave it out")
                self._sums[name].add(row[name][None])
        if extra := sorted(arrays.keys() - self._shapes.keys()):
            raise UserError(f"a frame has {extra[0]}, which the first one has not")
        self._frames.append(row)

    def _first(self, arrays: Mapping[str, npt.NDArray[Any]]) -> None:
        """Take features from the first frame."""
        for name, value in arrays.items():
            if "/" in name or name in (*_COUNTED, "timestamp"):
                raise UserError(f"a feature may not be called {name}")
            is_image = value.dtype == np.uint8 and value.ndim == 3 and value.shape[-1] == 3
            if not is_image and value.ndim > 1:
                raise UserError(
                    f"{name} has the shape {value.shape}: a feature is an image u8 (H, W, 3) or a "
                    "vector"
                )
            if is_image:
                self._images.add(name)
            self._shapes[name] = np.atleast_1d(value).shape
            self._sums[name] = _Sums(3 if is_image else self._shapes[name][0])

    def end_episode(self, task: str) -> None:
        """End the current episode, and write its frames. `task` says in words what was to be done.

        Raises UserError for an episode without frames.
        """
        if not self._frames:
            raise UserError("an episode has at least one frame: add it first")
        number = len(self._episodes)
        length = len(self._frames)
        chunk, file = divmod(number, _CHUNK)
        kind = self._tasks.setdefault(task, len(self._tasks))
        counted = {
            "timestamp": (np.arange(length) / self._fps).astype(np.float32),
            "frame_index": np.arange(length),
            "episode_index": np.full(length, number),
            "index": np.arange(self._total, self._total + length),
            "task_index": np.full(length, kind),
        }
        columns = {name: self._column(name) for name in self._shapes}
        table = pa.table(columns | {name: pa.array(value) for name, value in counted.items()})
        with atomic_path(self._root / _DATA.format(chunk_index=chunk, file_index=file)) as part:
            pa.parquet.write_table(table, part)
        self._episodes.append(
            {
                "episode_index": number,
                "tasks": [task],
                "length": length,
                "data/chunk_index": chunk,
                "data/file_index": file,
                "dataset_from_index": self._total,
                "dataset_to_index": self._total + length,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
            }
        )
        self._total += length
        self._frames = []

    def _column(self, name: str) -> pa.Array:
        """Return a column of the current episode."""
        values = [row[name] for row in self._frames]
        if name in self._images:
            return pa.array(values, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))
        if self._shapes[name] == (1,):
            return pa.array(np.concatenate(values))
        flat = pa.array(np.concatenate(values))
        return pa.FixedSizeListArray.from_arrays(flat, self._shapes[name][0])

    def close(self) -> None:
        """Write what describes the data set. Raises UserError without an episode."""
        if self._closed:
            return
        if not self._episodes:
            raise UserError(f"{self._root} has no episode: end one first")
        with atomic_path(self._root / "meta/episodes/chunk-000/file-000.parquet") as part:
            pa.parquet.write_table(pa.Table.from_pylist(self._episodes), part)
        with atomic_path(self._root / "meta/tasks.parquet") as part:
            pa.parquet.write_table(_tasks_table(self._tasks), part)
        stats = {name: one.result(name in self._images) for name, one in self._sums.items()}
        atomic_write(self._root / "meta/stats.json", json.dumps(stats, indent=4))
        atomic_write(self._root / "meta/info.json", json.dumps(self._info(), indent=4))
        self._closed = True

    def _info(self) -> dict[str, Any]:
        """Return meta/info.json."""
        features: dict[str, Any] = {}
        for name, shape in self._shapes.items():
            is_image = name in self._images
            names = ["height", "width", "channels"] if is_image else None
            kind = "image" if is_image else "float32"
            features[name] = {"dtype": kind, "shape": list(shape), "names": names}
        features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
        features |= {name: {"dtype": "int64", "shape": [1], "names": None} for name in _COUNTED}
        return {
            "codebase_version": "v3.0",
            "robot_type": self._robot,
            "total_episodes": len(self._episodes),
            "total_frames": self._total,
            "total_tasks": len(self._tasks),
            "chunks_size": _CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 500,
            "fps": self._fps,
            "splits": {"train": f"0:{len(self._episodes)}"},
            "data_path": _DATA,
            "video_path": _VIDEOS,
            "features": features,
        }


class _Sums:
    """Running statistics of rows (n, channels)."""

    def __init__(self, channels: int) -> None:
        self._count = 0
        self._sum = np.zeros(channels)
        self._squares = np.zeros(channels)
        self._least = np.full(channels, np.inf)
        self._most = np.full(channels, -np.inf)
        self._frames = 0

    def add(self, rows: npt.NDArray[Any]) -> None:
        """Add the rows of a frame."""
        self._frames += 1
        self._count += len(rows)
        self._sum += rows.sum(0)
        self._squares += (rows.astype(np.float64) ** 2).sum(0)
        self._least = np.minimum(self._least, rows.min(0))
        self._most = np.maximum(self._most, rows.max(0))

    def result(self, is_image: bool) -> dict[str, Any]:
        """Return LeRobot's statistics. Those of an image are (3, 1, 1)."""
        mean = self._sum / self._count
        spread = np.sqrt(np.maximum(self._squares / self._count - mean**2, 0))
        values = {"min": self._least, "max": self._most, "mean": mean, "std": spread}
        result: dict[str, Any] = {
            name: (value.reshape(-1, 1, 1) if is_image else value).tolist()
            for name, value in values.items()
        }
        return result | {"count": [self._frames]}


def _png(image: npt.NDArray[Any]) -> bytes:
    """Return an image RGB u8 (H, W, 3) as PNG."""
    good, data = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    assert good
    return data.tobytes()


def _tasks_table(tasks: Mapping[str, int]) -> pa.Table:
    """Return the table of tasks, whose sentences are the index of a pandas frame."""
    table = pa.table({"task_index": list(tasks.values()), "__index_level_0__": list(tasks)})
    columns = [
        {
            "name": name,
            "field_name": field,
            "pandas_type": kind,
            "numpy_type": stored,
            "metadata": None,
        }
        for name, field, kind, stored in (
            ("task_index", "task_index", "int64", "int64"),
            (None, "__index_level_0__", "unicode", "object"),
        )
    ]
    about = {
        "index_columns": ["__index_level_0__"],
        "column_indexes": [],
        "columns": columns,
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({b"pandas": json.dumps(about).encode()})
