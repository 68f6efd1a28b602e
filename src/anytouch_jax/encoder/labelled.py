"""Labelled frames of a new sensor, and prototypes of their classes by known sensors."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa

from anytouch_jax.config import Config
from anytouch_jax.data.background.rule import Backgrounds
from anytouch_jax.data.loading.samples import evaluation
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import Log, unit_rows
from anytouch_jax.encoder.embed import embed_rows
from anytouch_jax.encoder.encoder import load_encoder
from anytouch_jax.errors import UserError

MEASURED = 64  # frames on which the loss is measured before and after
PROTOTYPE_ROWS = 1000  # frames of the known sensors for the prototypes of the classes


def class_prototypes(
    run: str | Path, manifest: Manifest, sensor: str, labels: str, log: Log
) -> tuple[np.ndarray, np.ndarray]:
    """Return the class i32 of every row, -1 for none, and unit-norm prototypes f32 (classes, E).

    A prototype is the mean embedding of the known sensors' frames of its class in split train.

    Args:
        run: a run or weights, whose encoder embeds the frames.
        manifest: the frames.
        sensor: the new one, whose frames are in no prototype.
        labels: the column of classes.
        log: takes sentences of the encoder.
    """
    value = manifest.text_column(_class_column(manifest, labels))
    sensors = manifest.text_column("sensor")
    encoder = load_encoder(run)
    known = np.isin(sensors, encoder.config.model.sensors) & (sensors != sensor)
    labelled = known & (value != "") & (manifest.text_column("split") == "train")
    rows = np.random.default_rng(0).permutation(np.flatnonzero(labelled))[:PROTOTYPE_ROWS]
    if not rows.size:
        raise UserError(
            f"--labels needs frames of sensors that {run} knows, with a {labels}, in split 'train'"
        )
    rows, values = embed_rows(encoder, manifest, np.sort(rows), log=log)
    names, class_ids = np.unique(value[rows], return_inverse=True)
    if len(names) < 2 or len(names) == len(rows):
        raise UserError(
            f"--labels {labels} must name classes: two values or more, each of several frames"
        )
    unit = unit_rows(values)
    mean = np.stack([unit[class_ids == number].mean(axis=0) for number in range(len(names))])
    # Values that no known sensor has shown are no class.
    place = np.minimum(np.searchsorted(names, value), len(names) - 1)
    classes = np.where(names[place] == value, place, -1).astype(np.int32)
    return classes, unit_rows(mean)


def _class_column(manifest: Manifest, labels: str) -> str:
    """Return the column of classes, label.LABELS or LABELS. Raises UserError without one."""
    columns = manifest.table.column_names
    for name in (f"label.{labels}", labels):
        if name not in columns:
            continue
        if pa.types.is_floating(manifest.table[name].type):
            raise UserError(
                f"--labels {labels} is a column of measurements; name a column of classes"
            )
        return name
    raise UserError(
        f"the manifest has no column {labels!r} or 'label.{labels}' for --labels; name another"
    )


def read_stills(manifest: Manifest, config: Config, rows: np.ndarray) -> np.ndarray:
    """Return stills u8 (rows, 1, H, W, 3)."""
    config = config.with_settings(
        {"data.batch_size": min(64, len(rows)), "data.on_bad_sample": "error"}
    )
    parts = [part.clip[: len(ids)] for ids, part in evaluation(manifest, rows, config)]
    return np.concatenate(parts)


def drop_without_gel(classes: np.ndarray, manifest: Manifest, sensor: str) -> None:
    """Take the class from rows of a sensor that have no image of the untouched gel, in place."""
    rows = np.flatnonzero((manifest.text_column("sensor") == sensor) & (classes >= 0))
    has = rows[Backgrounds(manifest).has(rows)]
    classes[np.setdiff1d(rows, has)] = -1


def measured_rows(
    manifest: Manifest, sensor: str, classes: np.ndarray, fitted: np.ndarray, seed: int
) -> tuple[np.ndarray, str]:
    """Return rows on which the loss is measured, and what they are: of split val, or fitted.

    Args:
        manifest: the frames.
        sensor: the new one.
        classes: i32 (N,) of every row, -1 for none.
        fitted: i64 (n,) rows that are trained on.
        seed: of the choice among rows of val.
    """
    is_sensor = manifest.text_column("sensor") == sensor
    is_val = manifest.text_column("split") == "val"
    count = min(int((is_sensor & is_val & (classes >= 0)).sum()), MEASURED)
    if not count:
        return fitted[:MEASURED], "fitted"
    return choose_frames(manifest, sensor, "val", count, classes, seed), "val"


def choose_frames(
    manifest: Manifest,
    sensor: str,
    split: str,
    count: int,
    classes: np.ndarray | None = None,
    seed: int = 0,
) -> np.ndarray:
    """Return rows i64 (count,) of a sensor in a split, in order.

    They are of as many sequences as possible, because frames of one press are alike.

    Args:
        manifest: the table.
        sensor: the name of the sensor.
        split: the split.
        count: how many rows.
        classes: i32 (rows of the manifest,). Only rows that have a class (not -1) are chosen.
        seed: of the draw.

    Raises:
        UserError: there are too few rows.
    """
    sensors = manifest.text_column("sensor")
    usable_rows = (sensors == sensor) & (manifest.text_column("split") == split)
    if classes is not None:
        usable_rows = usable_rows & (classes >= 0)
    rows = np.flatnonzero(usable_rows)
    if len(rows) < count:
        raise UserError(
            f"split {split!r} has {len(rows)} usable frames of {sensor}, not {count}; ask for "
            f"fewer, or name another sensor ({', '.join(sorted(set(sensors)))})"
        )
    # 77 separates these draws from others of the same seed. numpy takes no negative seeds.
    rows = np.random.default_rng([seed % 2**63, 77]).permutation(rows)
    sequence = manifest.codes("sequence", own=True)[rows]
    order = np.argsort(sequence, kind="stable")
    # How many rows of its own sequence come before a row. Taken in this order, every sequence gives
    # its first row before any gives its second.
    place = np.empty(len(rows), np.int64)
    place[order] = np.arange(len(rows)) - np.searchsorted(sequence[order], sequence[order])
    return np.sort(rows[np.argsort(place, kind="stable")[:count]])
