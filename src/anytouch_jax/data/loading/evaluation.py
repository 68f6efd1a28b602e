"""A pass over given rows without augmentation, in order: what embedding and probing read."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Literal

import numpy as np

from anytouch_jax.batch import TouchBatch
from anytouch_jax.config import Config
from anytouch_jax.data.loading.samples import SampleError, SampleReader
from anytouch_jax.data.loading.threads import BatchJobs, prefetch_batches
from anytouch_jax.data.manifest.manifest import Manifest, sensor_rows
from anytouch_jax.errors import UserError


def evaluation(
    manifest: Manifest,
    rows: np.ndarray,
    config: Config,
    kind: Literal["still", "clip"] = "still",
    *,
    frames: int | None = None,
    unknown: Literal["error", "universal"] = "error",
) -> Iterator[tuple[np.ndarray, TouchBatch]]:
    """(row ids i64 (n,), TouchBatch of B rows) over `rows` in order, resized only; the same bytes every time.

    Stills have T = 1; clips are the `frames` (default `model.frames`) frames that end at each row. B is
    `data.batch_size`; the last batch is filled up with its last row, so only the first n rows of a batch are
    valid. With `data.on_bad_sample` "skip" bad rows are left out: the caller counts by the row ids that come back.
    `unknown` "universal" serves sensors that the table lacks by the universal tokens. Raises UserError: ManifestError
    for an unknown sensor, SampleError for a bad sample, and for a row that ends no clip.
    """
    rows = np.asarray(rows, np.int64)
    windows = rows[:, None] if kind == "still" else _clips_ending(manifest, rows, frames or config.model.frames)
    sensor, _ = sensor_rows(manifest, config.model, rows, unknown=unknown)
    if rows.size and (sensor[rows] < 0).any():
        row = int(rows[sensor[rows] < 0][0])
        name = manifest.value(row, "sensor")
        raise UserError(
            f"{manifest.where(row)}: sensor {name!r} measures a force field and has no images; leave it out"
        )
    return _passes(SampleReader(manifest, config), rows, windows, sensor)


def _passes(
    reader: SampleReader, rows: np.ndarray, windows: np.ndarray, sensor: np.ndarray
) -> Iterator[tuple[np.ndarray, TouchBatch]]:
    data, size = reader.config.data, reader.config.model.image_size

    def plan(start: int) -> BatchJobs[tuple[TouchBatch, np.ndarray]]:
        here = windows[start : start + data.batch_size]
        batch = TouchBatch(
            np.zeros((data.batch_size, here.shape[1], size, size, 3), np.uint8), np.zeros(data.batch_size, np.int32)
        )
        good = np.ones(len(here), bool)
        batch.sensor[: len(here)] = sensor[here[:, -1]]
        return BatchJobs((batch, good), [partial(_write, reader, batch, good, here, slot) for slot in range(len(here))])

    starts = range(0, len(rows), data.batch_size)
    for start, (batch, good), _ in prefetch_batches(plan, starts, data.threads, data.prefetch):
        kept = np.flatnonzero(good)
        if not kept.size:
            continue
        if kept.size < data.batch_size:  # move the good ones to the front, fill up with the last of them
            order = np.concatenate([kept, np.repeat(kept[-1:], data.batch_size - kept.size)])
            batch = TouchBatch(batch.clip[order], batch.sensor[order])
        yield rows[start + kept], batch


def _write(reader: SampleReader, batch: TouchBatch, good: np.ndarray, windows: np.ndarray, slot: int) -> int:
    try:
        batch.clip[slot] = reader.touch(windows[slot], None)
    except SampleError:
        if reader.config.data.on_bad_sample == "error":
            raise
        good[slot] = False
        return 1
    return 0


def _clips_ending(manifest: Manifest, rows: np.ndarray, length: int) -> np.ndarray:
    clips = manifest.clips(length)
    if not rows.size:
        return np.empty((0, length), np.int64)
    place = np.minimum(np.searchsorted(clips[:, -1], rows), max(len(clips) - 1, 0))
    there = clips[place, -1] == rows if len(clips) else np.zeros(len(rows), bool)
    if not there.all():
        row = int(rows[~there][0])
        others = np.count_nonzero(~there) - 1
        raise UserError(
            f"{manifest.where(row)} does not end a clip of {length} frames (nor do {others} other rows); "
            "choose rows by Manifest.clips, or use stills"
        )
    return clips[place]
