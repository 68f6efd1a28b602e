"""Subsets of a simulated data set, one for each training or task, written next to its manifest."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa

from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.data.prepare.contact import contact_scores, mark_contact
from anytouch_jax.evaluate.retrieval import deepest_rows, numbers

MADE, WHOLE, STATIC, GRASP = "manifest.parquet", "contact.parquet", "static.parquet", "grasp.parquet"
SPLITS = ("train", "val", "test")


def cut(table: Manifest, rows: np.ndarray, path: Path, change: Callable[[pa.Table], pa.Table] | None = None) -> Path:
    """Write `rows` of a manifest, changed, as another manifest next to it."""
    part = table.table.take(pa.array(np.sort(rows)))
    columns = (change(part) if change else part).to_pydict()
    manifests.write(manifests.from_columns(columns, path), path)
    return path


def mark(folder: Path, share: float) -> None:
    """Write the simulated manifest as WHOLE, with `label.contact`: which frames are touched (`anytouch contact`)."""
    table = manifests.read(folder / MADE)
    manifests.write(mark_contact(table, contact_scores(table), share=share)[0], folder / WHOLE)


def cut_all(folder: Path) -> None:
    """The cuts of a data set: <sensor>.parquet to train on, static.parquet, grasp.parquet."""
    table = manifests.read(folder / WHOLE)
    sensors, splits = table.text_column("sensor"), table.text_column("split")
    for sensor in np.unique(sensors):
        rows = np.flatnonzero((sensors == sensor) & np.isin(splits, SPLITS))
        cut(table, rows, folder / f"{sensor}.parquet", lock)
    there = [split for split in SPLITS if (splits == split).any()]
    rows = np.concatenate([deepest_rows(table, split=split) for split in there])
    cut(table, rows, folder / STATIC)
    cut(table, *held(table, folder / GRASP))


def content_hash(path: Path) -> str:
    """Return the content hash of a manifest. A file that has changed is read again."""
    return _content_hash(path, path.stat().st_mtime_ns)


@cache
def _content_hash(path: Path, changed: int) -> str:
    return manifests.read(path).content_hash


def lock(part: pa.Table) -> pa.Table:
    """Return the rows without `touch`: no touch is shared with another sensor."""
    return part.set_column(part.column_names.index("touch"), "touch", pa.nulls(part.num_rows, pa.string()))


def held(table: Manifest, path: Path) -> tuple[np.ndarray, Path, Callable[[pa.Table], pa.Table]]:
    """Of each recording that moves, the frame when it is pressed and that when it has moved, with the label `held`.

    What a simulated recording has of a grasp: the press is the closing of the gripper (`label.moment` during), the end
    of the motion is after the lift (after). It slipped when more than half of its contact slid half-way through.
    """
    splits, motion = table.text_column("split"), table.text_column("label.motion")
    frame = np.asarray(table.column("frame_index"))
    slip = numbers(table, ("label.slip",), np.arange(len(table)))[:, 0]
    moving = np.isin(splits, SPLITS) & np.isin(motion, ("slide", "twist"))
    names, codes = np.unique(table.text_column("sequence"), return_inverse=True)
    last = np.zeros(len(names), np.int64)
    np.maximum.at(last, codes, frame)
    during, midway, after = (frame == np.round(part * last[codes]).astype(np.int64) for part in (0.35, 0.6, 0.8))
    slipped = np.zeros(len(names), bool)
    slipped[codes[moving & midway]] = slip[moving & midway] > 0.5
    rows = np.flatnonzero(moving & (during | after))

    def labelled(part: pa.Table) -> pa.Table:
        part = part.append_column("label.held", pa.array(np.where(slipped[codes[rows]], "slipped", "held")))
        return part.append_column("label.moment", pa.array(np.where(after[rows], "after", "during")))

    return rows, path, labelled
