"""Rows of a report: which touches take part, and their grades of alignment."""

from __future__ import annotations

import numpy as np

from anytouch_jax.config import FIELD_SENSORS
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.evaluate.retrieval import deepest_rows
from anytouch_jax.evaluate.tasks import best_rows


def with_images(table: Manifest, rows: Array) -> Array:
    """Return those of `rows` that are by sensors with images."""
    return rows[~np.isin(table.text_column("sensor")[rows], FIELD_SENSORS)]


def chosen_touches(table: Manifest, split: str, touches: int, seed: int) -> Array:
    """Return the deepest rows of at most `touches` whole touches of a split.

    There are none of an empty train or val. An empty test raises UserError.

    Args:
        table: the frames.
        split: train, val or test.
        touches: most of them.
        seed: of the choice.
    """
    if split != "test" and split not in set(table.text_column("split")):
        return np.zeros(0, np.int64)
    rows = deepest_rows(table, with_images(table, table.rows_of(split)))
    codes = table.codes("touch", own=True)[rows]
    names = np.unique(codes)
    if len(names) <= touches:
        return rows
    # Whole touches, so that retrieval finds each by all of its sensors.
    drawn = np.random.default_rng(seed).choice(names, touches, replace=False)
    return rows[np.isin(codes, drawn)]


def grades_of(table: Manifest, rows: Array, default: str) -> Array:
    """Return the grade of alignment of each row, or the `default` if the manifest has none."""
    if "grade" in table.table.column_names:
        return table.text_column("grade")[rows]
    return np.full(len(rows), default)


def deepest_by_sensor(table: Manifest, rows: Array) -> Array:
    """Return the row of each sensor with the largest force, the last one without forces."""
    sensor = table.codes("sensor")[rows]
    force = np.array([table.value(int(row), "label.force") or 0.0 for row in rows], np.float64)
    return np.sort(best_rows(rows, sensor, force, rows))
