"""Search by touch: the nearest of many stored features to a frame, a clip or a sentence.

The index is a features file of `anytouch embed`. Search is exact, by numpy. With `approximate`, FAISS (an extra)
compares a query with the features of the nearest cells alone.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.encoder.arrays import unit_rows
from anytouch_jax.encoder.embed import read_npz
from anytouch_jax.errors import UserError
from anytouch_jax.shown import described

Array = npt.NDArray[Any]
_OF_CELL, _LOOKED_INTO = 64, 64  # features of a cell that k-means reads, and cells that a search looks into
SHOWN = ("path", "frame_index", "sensor", "unit", "sequence", "object")  # keys of a hit, besides labels


def nearest(z_train: Array, z_rows: Array, k: int) -> tuple[Array, Array]:
    """Return row numbers in `z_train` and cosines of the k nearest of each unit row of `z_rows`, nearest first."""
    # scikit-learn's NearestNeighbors, brute force, takes 1.5 (euclidean) to 6 times longer (cosine) on 100,000 rows.
    k = min(k, len(z_train))
    ids, cosines = np.empty((len(z_rows), k), np.int64), np.empty((len(z_rows), k), np.float32)
    for start in range(0, len(z_rows), 512):
        part = slice(start, start + 512)
        ids[part], cosines[part] = _largest(z_rows[part] @ z_train.T, k)
    return ids, cosines


def _largest(values: Array, k: int, block: int = 64) -> tuple[Array, Array]:
    """Return columns and values of the k largest of each row, largest first."""
    # They lie in the k blocks of columns with the largest maxima. Partitioning whole rows takes ten times longer.
    blocks = values.shape[1] // block
    columns = np.broadcast_to(np.arange(values.shape[1]), values.shape)
    if blocks > 2 * k:
        whole = values[:, : blocks * block].reshape(len(values), blocks, block)
        best = np.argpartition(-whole.max(2), k - 1, axis=1)[:, :k]
        inside = (best[:, :, None] * block + np.arange(block)).reshape(len(values), -1)
        columns = np.concatenate([inside, columns[:, blocks * block :]], axis=1)
    candidates = np.take_along_axis(values, columns, 1)
    near = np.argpartition(-candidates, k - 1, axis=1)[:, :k]
    near = np.take_along_axis(near, np.argsort(-np.take_along_axis(candidates, near, 1), axis=1, kind="stable"), 1)
    return np.take_along_axis(columns, near, 1), np.take_along_axis(candidates, near, 1)


@dataclass(frozen=True, eq=False)
class TouchIndex:
    """Unit features f32 (n, d), their `rows` and `keys` (n,), and metadata (`about`: weights, pooling, frames).

    `gels` are the pictures of the untouched gel of their units.
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
            **{name: self.about[name] for name in ("encoder", "pooling", "frames", "input") if name in self.about},
        )

    def search(self, features: Array, count: int = 10) -> tuple[Array, Array]:
        """Return row numbers i64 (m, count) and cosines f32 (m, count) of the nearest, nearest first, of (m, d).

        Raises UserError for another width, and for features that are not finite.
        """
        features = np.atleast_2d(np.asarray(features, np.float32))
        if features.ndim != 2 or features.shape[1] != self.values.shape[1] or not np.isfinite(features).all():
            raise UserError(
                f"{self.source} holds features of {self.values.shape[1]} finite values, not {features.shape}."
            )
        count, query = min(count, len(self.values)), unit_rows(features)
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
                f"{self.source} was made by another encoder ({self.about.get('weights', 'unknown')}) than {source} "
                f"({fingerprint}). Embed again, or name its encoder with --model."
            )

    def describe(self, row: int) -> dict[str, str]:
        """Return what is known of a row: its place, sensor, object and labels."""
        names = [name for name in self.keys if name in SHOWN or name.startswith("label.")]
        return {name: str(self.keys[name][row]) for name in names}


def load_index(path: str | Path, *, approximate: bool = False) -> TouchIndex:
    """Return the index of a features file. Raises UserError for another file, and without FAISS if `approximate`."""
    features, about = read_npz(path)
    unit = unit_rows(features.values).astype(np.float32)
    cells = _cells(unit) if approximate else None
    return TouchIndex(unit, features.rows, features.keys, about, str(path), cells, features.gels)


def _cells(values: Array) -> Any:
    """Return an inverted file: cells around middles of k-means, of which a search looks into the nearest."""
    try:
        import faiss
    except ImportError:
        raise UserError('Approximate search needs FAISS: pip install "anytouch_jax[search]"') from None
    count = max(1, min(int(2 * len(values) ** 0.5), len(values) // _OF_CELL))
    index: Any = faiss.index_factory(values.shape[1], f"IVF{count},Flat", faiss.METRIC_INNER_PRODUCT)
    index.train(values[:: max(1, len(values) // (_OF_CELL * count))])
    index.add(values)
    index.nprobe = _LOOKED_INTO
    return index
