"""Embedding of many touches: arrays, manifest rows, frames of a folder or a video; features files,
and search in them.

Search is exact, by numpy, or `approximate`, by FAISS (an extra).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pyarrow as pa

from anytouch_jax.data.background.rule import ADVICE, UnitGels, gel_arrays, gels_of_arrays
from anytouch_jax.data.loading.samples import evaluation
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import (
    BATCH,
    Array,
    Join,
    Log,
    Pooling,
    run_in_batches,
    unit_rows,
    warn,
)
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, read_arrays
from anytouch_jax.progress import tracked
from anytouch_jax.shown import described, shown_short

if TYPE_CHECKING:
    from anytouch_jax.encoder.base import Encoder

# features of a cell that k-means reads, and cells that a search looks into
_OF_CELL = 64
_LOOKED_INTO = 64
# keys of a hit, besides labels
SHOWN = ("path", "frame_index", "sensor", "unit", "sequence", "object")


@shown_short
@dataclass(frozen=True)
class Features:
    """Features f32 (n, d), their `rows` i64 (n,) and further `keys` (n,).

    Rows are those of a manifest, or frame numbers of a video or folder. `predictions`: arrays (n,
    ...) of a head. `skipped` counts rows without features. `gels`: pictures of the untouched gel by
    unit.
    """

    values: np.ndarray
    rows: np.ndarray
    keys: dict[str, np.ndarray]
    skipped: int = 0
    predictions: dict[str, np.ndarray] = field(default_factory=dict)
    gels: dict[str, np.ndarray] = field(default_factory=dict)


def embed_rows(
    encoder: Encoder,
    manifest: Manifest,
    rows: np.ndarray,
    frames: int = 1,
    pooling: Pooling = "class",
    join: Join = "mean",
    *,
    batch: int = BATCH,
    on_bad_sample: Literal["error", "skip"] = "error",
    sensor_row: int | None = None,
    edit: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    gels: UnitGels | None = None,
    log: Log = warn,
) -> tuple[np.ndarray, np.ndarray]:
    """Return (row numbers i64 (n,), features f32 (n, d)) of manifest rows, each frame encoded once.

    A row's clip is the `frames` frames that end at it. An unknown sensor gets the universal tokens,
    which is logged; `sensor_row` serves all rows. `edit` changes clips u8 (B, T, H, W, 3) of rows
    (B,) before they are encoded. With `on_bad_sample` "skip", rows that cannot be read are left
    out, and the first are logged. So are rows without a picture of the untouched gel (`gels`), if
    the encoder needs one. Raises UserError.
    """
    if not len(rows):
        raise UserError("there are no rows to embed; check the split and the filters")
    if gels is None and encoder.subtracts:
        gels = UnitGels(manifest)
        log(gels.report(rows))
    rows = rows_with_gel(encoder, gels, rows, log)
    for name in sorted(set(manifest.text_column("sensor")[rows])) if sensor_row is None else ():
        encoder.sensor_row(name, log)
    settings = {"data.batch_size": min(batch, len(rows)), "data.on_bad_sample": on_bad_sample}
    config = encoder.config.with_settings(settings)
    ids = []
    skipped = list[str]()

    def touches() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        kind: Literal["still", "clip"] = "still" if frames == 1 else "clip"
        for row_ids, part in evaluation(
            manifest,
            rows,
            config,
            kind,
            frames=frames,
            unknown="universal",
            prepare=encoder.prepare,
            like=encoder.blank,
            skipped=skipped,
            gels=gels,
        ):
            ids.append(row_ids)
            clips = part.clip[: len(row_ids)]
            clips = clips if edit is None else edit(clips, row_ids)
            yield from zip(clips, part.sensor[: len(row_ids)], strict=True)

    def encode(part: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        clips, sensor = part
        sensor = sensor if sensor_row is None else np.full_like(sensor, sensor_row)
        return encoder.encode_touch(clips, sensor, pooling=pooling, join=join)

    values = run_in_batches(
        encode, tracked(touches(), "frames embedded", len(rows)), config.data.batch_size
    )
    for sentence in skipped:
        log(f"skipped: {sentence}")
    if not ids:
        raise UserError(
            f"none of the {len(rows)} rows can be read; check them with `anytouch data verify`"
        )
    return np.concatenate(ids), values


def embed_frames(
    encoder: Encoder,
    frames: Iterable[tuple[int, str, np.ndarray | None]],
    sensor_row: int,
    preprocess: Callable[[np.ndarray], np.ndarray] | None = None,
    *,
    length: int = 1,
    pooling: Pooling = "class",
    join: Join = "mean",
    batch: int = BATCH,
) -> Features:
    """Return features of every clip of `length` consecutive frames, keyed by the place of its last
    frame.

    `frames` yields number, name ("" for a video) and pixels of each frame, None for an unreadable
    one, which no clip spans. `preprocess` is `encoder.preprocess` by default. Raises UserError if
    there is no clip.
    """
    prepare = encoder.preprocess if preprocess is None else preprocess
    names = list[str]()
    ends = list[int]()

    def clips() -> Iterator[np.ndarray]:
        last = None
        ring = list[np.ndarray]()
        for number, name, frame in frames:
            names.append(name)
            ring = ring if last is None or number == last + 1 else []
            ring = [] if frame is None else [*ring, prepare(frame)][-length:]
            last = number
            if len(ring) == length:
                ends.append(len(names) - 1)
                yield np.stack(ring)

    def encode(clips: np.ndarray) -> np.ndarray:
        return encoder.encode_touch(
            clips, np.full(len(clips), sensor_row), pooling=pooling, join=join
        )

    values = run_in_batches(encode, clips(), batch)
    if not ends:
        raise UserError(
            f"{len(names)} frames are too few for clips of {length} readable frames; ask for fewer"
        )
    index = np.array(ends)
    keys = {"frame_index": index} | ({"path": np.array(names)[index]} if any(names) else {})
    return Features(values, index, keys, max(0, len(names) - length + 1) - len(index))


def rows_with_gel(
    encoder: Encoder, gels: UnitGels | None, rows: np.ndarray, log: Log = warn
) -> np.ndarray:
    """Return those of `rows` that have an untouched gel, if the encoder needs one.

    Raises UserError if none has one.
    """
    if not encoder.needs_background or gels is None:
        return rows
    has = gels.has(rows)
    if not has.any():
        raise UserError(
            f"{encoder.source} subtracts the untouched gel. {len(rows)} rows have no picture of "
            "it, and too few frames "
            f"to estimate it. {ADVICE}"
        )
    if not has.all():
        log(
            f"{(~has).sum()} of {len(rows)} rows have no picture of the untouched gel, and are "
            "left out"
        )
    return rows[has]


def plain_column(manifest: Manifest, name: str) -> np.ndarray:
    """Return a column of a manifest as an array without objects: numbers with NaN for null, all
    others as text.
    """
    kind = manifest.column(name).type
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        return manifest.text_column(name)
    return np.asarray(
        [np.nan if value is None else value for value in manifest.column(name).to_pylist()]
    )


def save_npz(path: str | Path, features: Features, metadata: dict[str, str]) -> None:
    """Write features, rows, keys and metadata as one `.npz`, whole or not at all.

    Raises OSError.
    """
    described = {f"about/{name}": np.asarray(value) for name, value in metadata.items()}
    keys = {f"key/{name}": values for name, values in features.keys.items()}
    arrays: dict[str, Any] = {"features": features.values, "rows": features.rows}
    arrays |= features.predictions | keys | described | gel_arrays(features.gels)
    with atomic_path(path) as part, open(part, "wb") as file:
        np.savez(file, **arrays)


def read_npz(path: str | Path) -> tuple[Features, dict[str, str]]:
    """Return the features and the metadata of a file of `save_npz`.

    Raises UserError for any other file.
    """
    try:
        arrays = read_arrays(path)
        gels = gels_of_arrays(arrays)
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"{path} is not a features file of `anytouch embed`: {error}") from None
    values, rows = (arrays.get(name, np.zeros(0, str)) for name in ("features", "rows"))
    numeric = values.dtype.kind in "fiu" and rows.dtype.kind in "iu"
    if values.ndim != 2 or not numeric or rows.shape != values.shape[:1] or not len(rows):
        raise UserError(
            f"{path} needs numeric arrays features (n, d) and rows (n,), not {values.shape}, "
            f"{rows.shape}."
        )
    if not values.shape[1] or not np.isfinite(values).all():
        raise UserError(
            f"{path}: the array features has no columns, or values that are not finite (NaN or "
            "infinite)."
        )
    keys = {
        name.removeprefix("key/"): array
        for name, array in arrays.items()
        if name.startswith("key/")
    }
    if any(array.shape != rows.shape for array in keys.values()):
        raise UserError(
            f"{path}: its keys (key/path and others) must be one for each of the {len(rows)} rows."
        )
    about = {
        name.removeprefix("about/"): str(array)[:200]
        for name, array in arrays.items()
        if name[:6] == "about/"
    }
    return Features(values, rows, keys, gels=gels), about


def nearest(z_train: Array, z_rows: Array, k: int) -> tuple[Array, Array]:
    """Return row numbers in `z_train` and cosines of the k nearest of each unit row of `z_rows`,
    nearest first.
    """
    # scikit-learn's NearestNeighbors, brute force, takes 1.5 (euclidean) to 6 times longer (cosine)
    # on 100,000 rows.
    k = min(k, len(z_train))
    ids = np.empty((len(z_rows), k), np.int64)
    cosines = np.empty((len(z_rows), k), np.float32)
    for start in range(0, len(z_rows), 512):
        part = slice(start, start + 512)
        ids[part], cosines[part] = _largest(z_rows[part] @ z_train.T, k)
    return ids, cosines


def _largest(values: Array, k: int, block: int = 64) -> tuple[Array, Array]:
    """Return columns and values of the k largest of each row, largest first."""
    # They lie in the k blocks of columns with the largest maxima. Partitioning whole rows takes ten
    # times longer.
    blocks = values.shape[1] // block
    columns = np.broadcast_to(np.arange(values.shape[1]), values.shape)
    if blocks > 2 * k:
        whole = values[:, : blocks * block].reshape(len(values), blocks, block)
        best = np.argpartition(-whole.max(2), k - 1, axis=1)[:, :k]
        inside = (best[:, :, None] * block + np.arange(block)).reshape(len(values), -1)
        columns = np.concatenate([inside, columns[:, blocks * block :]], axis=1)
    candidates = np.take_along_axis(values, columns, 1)
    near = np.argpartition(-candidates, k - 1, axis=1)[:, :k]
    near = np.take_along_axis(
        near, np.argsort(-np.take_along_axis(candidates, near, 1), axis=1, kind="stable"), 1
    )
    return np.take_along_axis(columns, near, 1), np.take_along_axis(candidates, near, 1)


@dataclass(frozen=True, eq=False)
class TouchIndex:
    """Unit features f32 (n, d), their `rows` and `keys` (n,), metadata `about` them, and untouched
    `gels` by unit.
    """

    values: Array
    rows: Array
    keys: dict[str, Array]
    about: dict[str, str]
    source: str = "the index"
    cells: Any = field(default=None, repr=False)
    gels: dict[str, Array] = field(default_factory=dict, repr=False)

    def __repr__(self) -> str:
        return described(
            f"TouchIndex {self.source}",
            touches=f"{len(self.values):,}, features of {self.values.shape[1]}",
            keys=", ".join(self.keys),
            **{
                name: self.about[name]
                for name in ("encoder", "pooling", "frames", "input")
                if name in self.about
            },
        )

    def search(self, features: Array, count: int = 10) -> tuple[Array, Array]:
        """Return row numbers and cosines (m, count), nearest first, of features (m, d).

        Raises UserError.
        """
        features = np.atleast_2d(np.asarray(features, np.float32))
        if (
            features.ndim != 2
            or features.shape[1] != self.values.shape[1]
            or not np.isfinite(features).all()
        ):
            width = self.values.shape[1]
            raise UserError(
                f"{self.source} holds features of {width} finite values, not {features.shape}."
            )
        count = min(count, len(self.values))
        query = unit_rows(features)
        if self.cells is None:
            return nearest(self.values, query, count)
        cosines, ids = self.cells.search(query, count)
        missed = ids[:, -1] < 0  # the cells held fewer
        ids[missed], cosines[missed] = nearest(self.values, query[missed], count)
        return ids, cosines

    def check(self, source: str, fingerprint: str) -> None:
        """Raise UserError unless the index was made by the encoder with that fingerprint."""
        if self.about.get("weights") != fingerprint:
            raise UserError(
                f"{self.source} was made by another encoder "
                f"({self.about.get('weights', 'unknown')}) than {source} "
                f"({fingerprint}). Embed again, or name its encoder with --model."
            )

    def describe(self, row: int) -> dict[str, str]:
        """Return what is known of a row: its place, sensor, object and labels."""
        names = [name for name in self.keys if name in SHOWN or name.startswith("label.")]
        return {name: str(self.keys[name][row]) for name in names}


def load_index(path: str | Path, *, approximate: bool = False) -> TouchIndex:
    """Return the index of a features file.

    Raises UserError for another file, and without FAISS if `approximate`.
    """
    features, about = read_npz(path)
    unit = unit_rows(features.values).astype(np.float32)
    cells = _cells(unit) if approximate else None
    return TouchIndex(unit, features.rows, features.keys, about, str(path), cells, features.gels)


def _cells(values: Array) -> Any:
    """Return an inverted file: cells around middles of k-means, of which a search looks into the
    nearest.
    """
    try:
        import faiss
    except ImportError:
        raise UserError(
            'Approximate search needs FAISS: pip install "anytouch_jax[search]"'
        ) from None
    count = max(1, min(int(2 * len(values) ** 0.5), len(values) // _OF_CELL))
    index: Any = faiss.index_factory(
        values.shape[1], f"IVF{count},Flat", faiss.METRIC_INNER_PRODUCT
    )
    index.train(values[:: max(1, len(values) // (_OF_CELL * count))])
    index.add(values)
    index.nprobe = _LOOKED_INTO
    return index
