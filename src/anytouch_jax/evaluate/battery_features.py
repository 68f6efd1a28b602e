"""Features for the battery: each row of a manifest encoded once, kept in memory and, when asked, on disk by content."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from anytouch_jax.data.loading.evaluation import evaluation
from anytouch_jax.data.manifest.files import distinct_files, read_file, split_shard_path
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.encoder import Encoder, Features, Join, Pooling, check_backgrounds, save_npz
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import baseline
from anytouch_jax.weights.tree import flatten

Array = npt.NDArray[Any]
Order = Literal["right", "shuffled", "repeated"]
Compute = Callable[[Array, int], Array]  # (rows i64 (n,), frames) -> features f32 (n, d)

VERSION = 3  # of what is computed; a change raises it
BATCH = 64


class Store:
    """Features by row and length of clip; `about` names everything else that they depend on.

    What is in `folder` is read, what is not is computed and added: one .npz a content, replaced whole.
    """

    def __init__(self, compute: Compute, about: Mapping[str, Any], folder: Path | None) -> None:
        self._compute, self._about, self._folder = compute, dict(about), folder
        self._rows: dict[int, Array] = {}
        self._values: dict[int, Array] = {}

    def add(self, rows: Array, frames: int) -> None:
        """Make sure of these rows (any shape), in one pass over those that are missing."""
        rows = np.unique(rows)
        if frames not in self._rows:
            self._load(frames)
        missing = np.setdiff1d(rows, self._rows[frames])
        if not len(missing):
            return
        values = self._compute(missing, frames)
        known = [self._values[frames], values] if len(self._rows[frames]) else [values]
        every = np.concatenate([self._rows[frames], missing])
        order = np.argsort(every)
        self._rows[frames], self._values[frames] = every[order], np.concatenate(known)[order]
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)
            about = {"about": json.dumps(self._about | {"frames": frames}, sort_keys=True)}
            save_npz(self.file(frames), Features(self._values[frames], self._rows[frames], {}), about)

    def get(self, rows: Array, frames: int) -> Array:
        """Features f32 (n, k * d) of `rows` (n, k), those of a row side by side."""
        self.add(rows, frames)
        place = np.searchsorted(self._rows[frames], rows)
        return self._values[frames][place].reshape(len(rows), -1)

    def file(self, frames: int) -> Path:
        """Where features of clips of this length are kept."""
        text = json.dumps(self._about | {"frames": frames}, sort_keys=True)
        return Path(self._folder or ".") / f"{hashlib.sha256(text.encode()).hexdigest()[:32]}.npz"

    def _load(self, frames: int) -> None:
        self._rows[frames], self._values[frames] = np.zeros(0, np.int64), np.zeros((0, 0), np.float32)
        if self._folder is None or not self.file(frames).exists():
            return
        broken = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile)
        with contextlib.suppress(*broken), self.file(frames).open("rb") as file, np.load(file) as held:
            self._rows[frames], self._values[frames] = held["rows"], held["features"]


def encoded(
    encoder: Encoder,
    table: Manifest,
    *,
    pooling: Pooling,
    join: Join,
    order: Order = "right",
    universal: bool = False,
    folder: Path | None = None,
) -> Store:
    """The features of an encoder. `universal`: the universal tokens for every sensor, those that it knows too."""
    about = {
        "version": VERSION,
        "parameters": digest(encoder),
        "manifest": table.content_hash,
        "pictures": pictures(table),
        "pooling": pooling,
        "join": join,
        "order": order,
        "universal": universal,
        "background": encoder.config.data.background,
    }

    def compute(rows: Array, frames: int) -> Array:
        check_backgrounds(encoder, table, rows)
        config = replace(encoder.config, data=replace(encoder.config.data, batch_size=BATCH))
        kind: Literal["still", "clip"] = "still" if frames == 1 else "clip"
        found, read, row = [], 0, encoder.config.model.universal_row
        for ids, part in evaluation(table, rows, config, kind, frames=frames, unknown="universal"):
            clip = ordered(part.clip[: len(ids)], ids, order)
            clip = np.concatenate([clip, np.repeat(clip[-1:], BATCH - len(ids), axis=0)])  # one shape, one compilation
            sensor = np.full(BATCH, row, np.int32) if universal else part.sensor
            found.append(encoder.embed(clip, sensor, pooling=pooling, join=join)[: len(ids)])
            read += len(ids)
        if read != len(rows):
            raise UserError(f"{len(rows) - read} rows could not be read; repair the manifest first")
        return np.concatenate(found)

    return Store(compute, about, folder)


def raw(table: Manifest, *, order: Order = "right", folder: Path | None = None) -> Store:
    """Pixels (24 x 32 x 3) of the last frame beside the difference of every frame from the background, in 0..1."""
    grounds: dict[Path, Array] = {}

    def compute(rows: Array, frames: int) -> Array:
        clips = table.clips(frames) if frames > 1 else np.arange(len(table))[:, None]
        windows = ordered(clips[np.searchsorted(clips[:, -1], rows)], rows, order)
        single, places = np.unique(windows, return_inverse=True)
        plain, changes = np.split(
            np.stack([baseline.row_pixels(table, int(row), grounds) for row in single]), 2, axis=1
        )
        places = places.reshape(windows.shape)
        return np.concatenate([plain[places[:, -1]], changes[places].reshape(len(rows), -1)], axis=1)

    about = {
        "version": VERSION,
        "parameters": "raw pixels in colour",
        "manifest": table.content_hash,
        "pictures": pictures(table),
        "order": order,
    }
    return Store(compute, about, folder)


def ordered(clips: Array, rows: Array, order: Order) -> Array:
    """Clips (n, T, ...) with their frames as they are, in another order (by the row's number), or the last repeated."""
    frames = clips.shape[1]
    if order == "right" or frames == 1:
        return clips
    if order == "repeated":
        return np.repeat(clips[:, -1:], frames, axis=1)
    if order != "shuffled":
        raise UserError(f"unknown order {order!r}; choose right, shuffled or repeated")
    return np.stack([clip[_other_order(frames, int(row))] for clip, row in zip(clips, rows, strict=True)])


def _other_order(frames: int, row: int) -> Array:
    rng = np.random.default_rng([13, row])
    while True:
        found = rng.permutation(frames)
        if (found != np.arange(frames)).any():
            return found


def digest(encoder: Encoder) -> str:
    """SHA-256 over the parameters and what decides the arithmetic on them."""
    found = hashlib.sha256(json.dumps(asdict(encoder.config.model), sort_keys=True).encode())
    for name, leaf in sorted(flatten(encoder.params).items()):
        array = np.ascontiguousarray(leaf)
        found.update(f"{name} {array.dtype} {array.shape}".encode())
        found.update(array.view(np.uint8).data if array.size else b"")
    return found.hexdigest()


def pictures(table: Manifest, count: int = 32) -> str:
    """SHA-256 over what tells other pictures under an equal table: the size and the time of change of every frame (of
    its shard, where it is packed), the bytes of every background and of some frames, evenly spaced. A copy of the
    folder is the same with its times."""
    found = hashlib.sha256()
    files = distinct_files(table, ("path", "background_path"))
    for row, column in zip(files.row, files.column, strict=True):
        with contextlib.suppress(OSError, ValueError):  # one that cannot be read says so when it is wanted
            file = table.file(int(row), column)
            if column == "background_path":
                found.update(read_file(file))
                continue
            packed = split_shard_path(file)
            about = os.stat(packed[0] if packed else file)
            found.update(f"{about.st_size} {about.st_mtime_ns} ".encode())
    for row in np.unique(np.linspace(0, len(table) - 1, count).astype(int)):
        with contextlib.suppress(OSError, ValueError):  # one that cannot be read says so when it is wanted
            found.update(read_file(table.file(int(row))))
    return found.hexdigest()
