"""The distinct files that a manifest names."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.manifest.schema import PATHS


class Files(NamedTuple):
    """Distinct files i = 0 .. n - 1 of a manifest: `code[column]` i64 (rows,) which one a cell names, -1 for null.

    `row` i64 (n,) and `column` (n,) a cell that names the file: the first one, `path` before the other columns.
    """

    code: dict[str, np.ndarray]
    row: np.ndarray
    column: np.ndarray

    def __len__(self) -> int:
        return len(self.row)


def distinct_files(manifest: Manifest, columns: Sequence[str] = PATHS) -> Files:
    """The files of the path columns `columns`, each one once (by its path as it is written, and its manifest)."""
    columns = [name for name in columns if name in manifest.table.column_names]
    rows = len(manifest)
    cells = pa.chunked_array([chunk for name in columns for chunk in manifest.table[name].chunks], pa.string())
    encoded = cells.dictionary_encode().unify_dictionaries()
    number = np.concatenate([np.asarray(pc.fill_null(chunk.indices, -1)) for chunk in encoded.chunks]).astype(np.int64)
    key = number * len(manifest.files) + np.tile(manifest.source.astype(np.int64), len(columns))
    known = np.flatnonzero(number >= 0)
    _, first, code = np.unique(key[known], return_index=True, return_inverse=True)
    full = np.full(len(number), -1, np.int64)
    full[known] = code
    first = known[first]
    code_of = {name: full[i * rows : (i + 1) * rows] for i, name in enumerate(columns)}
    return Files(code_of, first % rows, np.array(columns)[first // rows])
