"""What a manifest itself says of its touches: the deepest frame, the contact's numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.embed import text_column
from anytouch_jax.errors import UserError

Array = npt.NDArray[Any]

COVARIATES = ("label.x", "label.y", "label.depth", "label.force")  # mm, mm, mm, N
VECTOR = ("label.area", "label.x", "label.y", "label.force")  # mm2, mm, mm, N


def numbers(manifest: Manifest, names: Sequence[str], rows: Array) -> Array:
    """Columns of measured values, f64 (rows, columns), NaN where a cell is empty. Raises UserError on text."""
    columns = []
    for name in names:
        try:
            column = manifest.column(name).cast(pa.float64())
        except pa.ArrowException:
            raise UserError(f"column {name!r} holds text; it must hold numbers") from None
        columns.append(column.to_numpy().astype(np.float64))
    return np.stack(columns, axis=1)[rows] if columns else np.zeros((len(rows), 0))


def deepest_rows(manifest: Manifest, rows: Array | None = None, *, split: str = "test", frames: int = 1) -> Array:
    """One row for each touch, sensor and unit: that of the largest `label.force`, the first of equals; in order.

    Looks at `rows`, or at the whole `split`; with `frames` > 1 only at rows that end a clip of so many. Without forces
    it goes by `label.depth`, without either it takes the middle frame. Rows without a touch are nobody's and left
    out. Raises UserError when none is left.
    """
    rows = np.unique(manifest.rows_of(split) if rows is None else np.asarray(rows))
    rows = rows[manifest.present("touch")[rows]]
    if frames > 1 and len(rows):
        rows = np.intersect1d(rows, manifest.clips(frames)[:, -1])
        if not len(rows):
            raise UserError(f"no touch ends a clip of {frames} frames; take fewer, or 1")
    if not len(rows):
        raise UserError("no row has a touch; cross-sensor tasks need the column 'touch' (the place, whoever feels it)")
    codes = np.stack([manifest.codes("touch", own=True), manifest.codes("sensor"), manifest.codes("unit", own=True)], 1)
    _, contact = np.unique(codes[rows], axis=0, return_inverse=True)
    order = np.lexsort((rows, -_depth(manifest, rows, contact.ravel()), contact.ravel()))
    first = np.unique(contact.ravel()[order], return_index=True)[1]
    return np.sort(rows[order[first]])


def _depth(manifest: Manifest, rows: Array, contact: Array) -> Array:
    """How deep each row (n,) is among those of its contact, by what the rows of its file have."""
    frame = np.asarray(manifest.column("frame_index"))[rows].astype(np.float64)
    middle = np.array([np.median(frame[contact == one]) for one in range(contact.max() + 1)])
    found = -np.abs(frame - middle[contact])
    for name in ("label.depth", "label.force"):
        if name in manifest.table.column_names:
            depth, source = numbers(manifest, (name,), rows)[:, 0], manifest.source[rows]
            told = np.isin(source, source[np.isfinite(depth)])
            found[told] = np.where(np.isfinite(depth), depth, -np.inf)[told]
    return found


def contact_vector(manifest: Manifest, rows: Array) -> Array:
    """Area, centroid and force of each contact, those the manifest has, f32 (rows, up to 4).

    Each is brought to mean 0 and spread 1 within its sensor; compare them by Euclidean distance. Raises UserError when
    the manifest has none of them, or a row lacks one.
    """
    names = [name for name in VECTOR if name in manifest.table.column_names]
    if not names:
        raise UserError(f"the manifest has none of the columns {', '.join(VECTOR)}")
    values = numbers(manifest, names, rows)
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise UserError(f"{manifest.where(int(rows[bad[0]]))} has no value in one of {', '.join(names)}")
    sensors = text_column(manifest, "sensor")[rows]
    for sensor in np.unique(sensors):
        here = values[sensors == sensor]
        spread = here.std(axis=0, keepdims=True)
        values[sensors == sensor] = (here - here.mean(axis=0, keepdims=True)) / np.where(spread > 0, spread, 1.0)
    return values.astype(np.float32)
