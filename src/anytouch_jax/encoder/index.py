"""Features files, and nearest-neighbour search in them.

Search is exact, by numpy, or `approximate`, by FAISS (an extra).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from anytouch_jax.data.background.rule import background_arrays, backgrounds_of_arrays
from anytouch_jax.encoder.arrays import Array, unit_rows
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, read_arrays
from anytouch_jax.shown import described, shown_short

# Features of a cell that k-means reads, and cells that a search looks into.
_OF_CELL = 64
_LOOKED_INTO = 64
_ROWS = 512  # of a query at a time, so that their cosines with all features fit in the cache
_BLOCK = 64  # columns whose maximum is compared first, see `_largest`
_LETTERS = 200  # of a text about features
# keys of a hit, besides labels
SHOWN = ("path", "frame_index", "sensor", "unit", "sequence", "object")


@shown_short
@dataclass(frozen=True)
class Features:
    """Features of touches, with what is known of each.

    Attributes:
        values: f32 (n, d).
        rows: i64 (n,), those of a manifest, or frame numbers of a video or folder.
        keys: further arrays (n,) by name.
        skipped: how many rows have no features.
        predictions: arrays (n, ...) of a head by name.
        backgrounds: images of the untouched gel by unit.
    """

    values: np.ndarray
    rows: np.ndarray
    keys: dict[str, np.ndarray]
    skipped: int = 0
    predictions: dict[str, np.ndarray] = field(default_factory=dict)
    backgrounds: dict[str, np.ndarray] = field(default_factory=dict)


def save_npz(path: str | Path, features: Features, metadata: dict[str, str]) -> None:
    """Write features, rows, keys and metadata as one `.npz`, whole or not at all.

    Raises OSError.
    """
    arrays: dict[str, Any] = {"features": features.values, "rows": features.rows}
    arrays |= features.predictions
    arrays |= {f"key/{name}": values for name, values in features.keys.items()}
    arrays |= {f"about/{name}": np.asarray(value) for name, value in metadata.items()}
    arrays |= background_arrays(features.backgrounds)
    with atomic_path(path) as part, open(part, "wb") as file:
        np.savez(file, **arrays)


def read_npz(path: str | Path) -> tuple[Features, dict[str, str]]:
    """Return the features and the metadata of a file of `save_npz`.

    Raises UserError for any other file.
    """
    try:
        arrays = read_arrays(path)
        backgrounds = backgrounds_of_arrays(arrays)
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"{path} is not a features file of `anytouch embed`: {error}") from None
    nothing = np.zeros(0, str)
    values = arrays.get("features", nothing)
    rows = arrays.get("rows", nothing)
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
    keys = _named(arrays, "key/")
    if any(array.shape != rows.shape for array in keys.values()):
        raise UserError(
            f"{path}: its keys (key/path and others) must be one for each of the {len(rows)} rows."
        )
    about = {name: str(array)[:_LETTERS] for name, array in _named(arrays, "about/").items()}
    return Features(values, rows, keys, backgrounds=backgrounds), about


def _named(arrays: dict[str, Array], start: str) -> dict[str, Array]:
    """Return the arrays whose names have that start, without it."""
    return {
        name.removeprefix(start): array for name, array in arrays.items() if name.startswith(start)
    }


def nearest(z_train: Array, z_rows: Array, k: int) -> tuple[Array, Array]:
    """Return row numbers in `z_train` and cosines of the k nearest of each row, nearest first.

    Rows are unit features: `z_train` (n, d), `z_rows` (m, d). The results are (m, k).
    """
    # Measured on 100,000 rows: scikit-learn's NearestNeighbors, brute force, takes 1.5 (euclidean)
    # to 6 times longer (cosine).
    k = min(k, len(z_train))
    ids = np.empty((len(z_rows), k), np.int64)
    cosines = np.empty((len(z_rows), k), np.float32)
    for start in range(0, len(z_rows), _ROWS):
        part = slice(start, start + _ROWS)
        ids[part], cosines[part] = _largest(z_rows[part] @ z_train.T, k)
    return ids, cosines


def _largest(values: Array, k: int) -> tuple[Array, Array]:
    """Return columns and values of the k largest of each row, largest first.

    They lie in the k blocks of columns with the largest maxima. Partitioning whole rows takes ten
    times longer.
    """
    blocks = values.shape[1] // _BLOCK
    columns = np.broadcast_to(np.arange(values.shape[1]), values.shape)
    if blocks > 2 * k:
        in_blocks = values[:, : blocks * _BLOCK].reshape(len(values), blocks, _BLOCK)
        best = np.argpartition(-in_blocks.max(2), k - 1, axis=1)[:, :k]
        inside = (best[:, :, None] * _BLOCK + np.arange(_BLOCK)).reshape(len(values), -1)
        # Columns behind the last whole block are candidates too.
        columns = np.concatenate([inside, columns[:, blocks * _BLOCK :]], axis=1)
    candidates = np.take_along_axis(values, columns, 1)
    near = np.argpartition(-candidates, k - 1, axis=1)[:, :k]
    order = np.argsort(-np.take_along_axis(candidates, near, 1), axis=1, kind="stable")
    near = np.take_along_axis(near, order, 1)
    return np.take_along_axis(columns, near, 1), np.take_along_axis(candidates, near, 1)


@dataclass(frozen=True, eq=False)
class TouchIndex:
    """Unit features in which touches are searched.

    Attributes:
        values: f32 (n, d), of norm 1.
        rows: i64 (n,).
        keys: arrays (n,) by name.
        about: metadata.
        source: the name of the index, for sentences.
        cells: FAISS's inverted file for approximate search, or None.
        backgrounds: images of the untouched gel by unit.
    """

    values: Array
    rows: Array
    keys: dict[str, Array]
    about: dict[str, str]
    source: str = "the index"
    cells: Any = field(default=None, repr=False)
    backgrounds: dict[str, Array] = field(default_factory=dict)

    def __repr__(self) -> str:
        names = [name for name in ("encoder", "pooling", "frames", "input") if name in self.about]
        return described(
            f"TouchIndex {self.source}",
            touches=f"{len(self.values):,}, features of {self.values.shape[1]}",
            keys=", ".join(self.keys),
            **{name: self.about[name] for name in names},
        )

    def search(self, features: Array, count: int = 10) -> tuple[Array, Array]:
        """Return row numbers and cosines (m, count), nearest first, of features (m, d).

        Raises UserError.
        """
        features = np.atleast_2d(np.asarray(features, np.float32))
        width = self.values.shape[1]
        if features.ndim != 2 or features.shape[1] != width or not np.isfinite(features).all():
            raise UserError(
                f"{self.source} holds features of {width} finite values, not {features.shape}."
            )
        count = min(count, len(self.values))
        query = unit_rows(features)
        if self.cells is None:
            return nearest(self.values, query, count)
        cosines, ids = self.cells.search(query, count)
        # FAISS gives -1 where the cells that it looked into held fewer.
        missed = ids[:, -1] < 0
        ids[missed], cosines[missed] = nearest(self.values, query[missed], count)
        return ids, cosines

    def check(self, source: str, fingerprint: str) -> None:
        """Raise UserError unless the index was made by the encoder with that fingerprint."""
        if self.about.get("weights") != fingerprint:
            raise UserError(
                f"{self.source} was made by another encoder "
                f"({self.about.get('weights', 'unknown')}) than {source} ({fingerprint}). Embed "
                "again, or name its encoder with --model."
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
    return TouchIndex(
        unit, features.rows, features.keys, about, str(path), cells, features.backgrounds
    )


def _cells(values: Array) -> Any:
    """Return an inverted file of unit features.

    Cells lie around the middles of k-means, and a search looks into the nearest.
    """
    try:
        import faiss
    except ImportError:
        raise UserError(
            'Approximate search needs FAISS: pip install "anytouch_jax[search]"'
        ) from None
    # As many cells as FAISS advises, but so few that k-means has _OF_CELL features for each.
    count = max(1, min(int(2 * len(values) ** 0.5), len(values) // _OF_CELL))
    index: Any = faiss.index_factory(
        values.shape[1], f"IVF{count},Flat", faiss.METRIC_INNER_PRODUCT
    )
    index.train(values[:: max(1, len(values) // (_OF_CELL * count))])
    index.add(values)
    index.nprobe = _LOOKED_INTO
    return index
