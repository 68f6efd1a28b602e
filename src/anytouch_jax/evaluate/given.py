"""Features of anybody's encoder as a file (`anytouch probe --features`): what `anytouch embed` writes, or the like."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.encoder import text_column
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate.battery_features import Store
from anytouch_jax.weights.safetensors import read_npz

Array = npt.NDArray[Any]


def given(path: Path, table: Manifest) -> Store:
    """The features of `path` by row of the manifest: arrays `features` (n, d) and `rows` (n,), i.e. row numbers.

    Raises UserError for another file, for features of another manifest (`key/path` tells, where it is there), of
    touches of another length (`about/frames`), and, when they are asked for, for rows that it lacks.
    """
    arrays = read_npz(path)
    if not {"features", "rows"} <= arrays.keys():
        raise UserError(f"{path} needs the arrays features (n, d) and rows (n,); it has {', '.join(arrays) or 'none'}")
    values, rows = arrays["features"], arrays["rows"]
    if (
        values.ndim != 2
        or values.dtype.kind not in "fiu"
        or rows.shape != values.shape[:1]
        or rows.dtype.kind not in "iu"
    ):
        raise UserError(
            f"{path} needs features (n, d) of numbers and rows (n,) of whole ones, not {values.shape}, {rows.shape}"
        )
    if len(np.unique(rows)) < len(rows) or not len(rows) or rows.min() < 0 or rows.max() >= len(table):
        raise UserError(
            f"{path}: rows must each be named once, from 0 to {len(table) - 1}, as the manifest numbers them"
        )
    names = arrays.get("key/path")
    if names is not None and (names != text_column(table, "path")[rows]).any() and len(table.files) == 1:
        raise UserError(f"{path} holds features of another manifest: its paths are not those of these rows")
    order = np.argsort(rows)
    there, values = rows[order], values[order].astype(np.float32)

    def compute(wanted: Array, frames: int) -> Array:
        told = arrays.get("about/frames")
        if told is not None and str(told) != str(frames):
            raise UserError(
                f"{path} holds features of {told} frames a touch; {frames} are probed: give --frames {told}"
            )
        lacking = len(np.setdiff1d(wanted, there))
        if lacking:
            raise UserError(f"{path} lacks {lacking} of the {len(wanted)} rows that are probed; embed them too")
        return values[np.searchsorted(there, wanted)]

    return Store(compute, {}, None)
