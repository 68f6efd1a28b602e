"""Subsets of a simulated data set, one for each training or task, written next to its manifest."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa

from anytouch_jax.data.background.contact import contact_scores, mark_contact
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.evaluate.retrieval import deepest_rows

MADE = "manifest.parquet"
WHOLE = "contact.parquet"
STATIC = "static.parquet"
SPLITS = ("train", "val", "test")


def cut(
    table: Manifest,
    rows: np.ndarray,
    path: Path,
    change: Callable[[pa.Table], pa.Table] | None = None,
) -> Path:
    """Write `rows` of a manifest, changed, as another manifest next to it."""
    part = table.table.take(pa.array(np.sort(rows)))
    columns = (change(part) if change else part).to_pydict()
    manifests.write(manifests.from_columns(columns, path), path)
    return path


def mark(folder: Path, fraction: float) -> None:
    """Write the simulated manifest as WHOLE, with `label.contact`: which frames are touched
    (`anytouch contact`).
    """
    table = manifests.read(folder / MADE)
    manifests.write(
        mark_contact(table, contact_scores(table), fraction=fraction)[0], folder / WHOLE
    )


def cut_all(folder: Path) -> None:
    """The cuts of a data set: <sensor>.parquet to train on, static.parquet."""
    table = manifests.read(folder / WHOLE)
    sensors = table.text_column("sensor")
    splits = table.text_column("split")
    for sensor in np.unique(sensors):
        rows = np.flatnonzero((sensors == sensor) & np.isin(splits, SPLITS))
        cut(table, rows, folder / f"{sensor}.parquet", lock)
    there = [split for split in SPLITS if (splits == split).any()]
    rows = np.concatenate([deepest_rows(table, split=split) for split in there])
    cut(table, rows, folder / STATIC)


def content_hash(path: Path) -> str:
    """Return the content hash of a manifest. A file that has changed is read again."""
    return _content_hash(path, path.stat().st_mtime_ns)


@cache
def _content_hash(path: Path, changed: int) -> str:
    return manifests.read(path).content_hash


def lock(part: pa.Table) -> pa.Table:
    """Return the rows without `touch`: no touch is shared with another sensor."""
    return part.set_column(
        part.column_names.index("touch"), "touch", pa.nulls(part.num_rows, pa.string())
    )
