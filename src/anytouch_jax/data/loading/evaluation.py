"""Evaluation batches: given rows in order, resized and not augmented, for embedding and probing."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Literal

import numpy as np

from anytouch_jax.batch import TouchBatch
from anytouch_jax.config import Config
from anytouch_jax.data.loading.samples import NAMED, Prepare, SampleError, SampleReader
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
    prepare: Prepare | None = None,
    like: np.ndarray | None = None,
    skipped: list[str] | None = None,
) -> Iterator[tuple[np.ndarray, TouchBatch]]:
    """Yield (row ids i64 (n,), TouchBatch of B rows) over `rows` in order, with the same bytes every time.

    Stills have T = 1; clips are the `frames` (default `model.frames`) frames that end at each row. B is
    `data.batch_size`. The last batch is filled up with its last row, so only the first n rows of a batch are valid.
    With `data.on_bad_sample` "skip" bad rows are left out, which the row ids show, and `skipped` gets a sentence for
    each of the first NAMED. `unknown` "universal" gives unknown sensors the universal tokens. `prepare` makes an array
    of the form of `like` from a frame u8 (h, w, 3) and its background or None, in place of the resizing and the
    subtraction. Raises UserError: ManifestError for an unknown sensor, SampleError for a bad sample, and for a row that
    ends no clip.
    """
    rows = np.asarray(rows, np.int64)
    windows = rows[:, None] if kind == "still" else _clips_ending_at(manifest, rows, frames or config.model.frames)
    sensor, _ = sensor_rows(manifest, config.model, rows, unknown=unknown)
    if rows.size and (sensor[rows] < 0).any():
        row = int(rows[sensor[rows] < 0][0])
        name = manifest.value(row, "sensor")
        raise UserError(
            f"{manifest.where(row)}: sensor {name!r} measures a force field and has no images; leave it out"
        )
    side = config.model.image_size
    blank = np.zeros((side, side, 3), np.uint8) if like is None else like
    return _batches(
        SampleReader(manifest, config), rows, windows, sensor, prepare, blank, [] if skipped is None else skipped
    )


def _batches(
    reader: SampleReader,
    rows: np.ndarray,
    windows: np.ndarray,
    sensor: np.ndarray,
    prepare: Prepare | None,
    blank: np.ndarray,
    skipped: list[str],
) -> Iterator[tuple[np.ndarray, TouchBatch]]:
    data = reader.config.data

    def write(clip: np.ndarray, is_good: np.ndarray, start: int, slot: int) -> int:
        try:
            clip[slot] = reader.touch(windows[start + slot], None, prepare=prepare)
        except SampleError as error:
            if data.on_bad_sample == "error":
                raise
            if len(skipped) < NAMED:
                skipped.append(str(error))
            is_good[slot] = False
        return 0

    def plan(start: int) -> BatchJobs[tuple[TouchBatch, np.ndarray]]:
        chosen = windows[start : start + data.batch_size]
        clip = np.zeros((data.batch_size, chosen.shape[1], *blank.shape), blank.dtype)
        batch, is_good = TouchBatch(clip, np.zeros(data.batch_size, np.int32)), np.ones(len(chosen), bool)
        batch.sensor[: len(chosen)] = sensor[chosen[:, -1]]
        return BatchJobs((batch, is_good), [partial(write, clip, is_good, start, slot) for slot in range(len(chosen))])

    starts = range(0, len(rows), data.batch_size)
    for start, (batch, is_good), _ in prefetch_batches(plan, starts, data.threads, data.prefetch):
        good = np.flatnonzero(is_good)
        if good.size and good.size < data.batch_size:  # move the good rows to the front and repeat the last one
            order = np.concatenate([good, np.repeat(good[-1:], data.batch_size - good.size)])
            batch = TouchBatch(batch.clip[order], batch.sensor[order])
        if good.size:
            yield rows[start + good], batch


def _clips_ending_at(manifest: Manifest, rows: np.ndarray, length: int) -> np.ndarray:
    clips = manifest.clips(length)
    if not rows.size:
        return np.empty((0, length), np.int64)
    at = np.minimum(np.searchsorted(clips[:, -1], rows), max(len(clips) - 1, 0))
    is_end = clips[at, -1] == rows if len(clips) else np.zeros(len(rows), bool)
    if not is_end.all():
        row, others = int(rows[~is_end][0]), np.count_nonzero(~is_end) - 1
        raise UserError(
            f"{manifest.where(row)} does not end a clip of {length} frames (nor do {others} other rows); "
            "choose rows by Manifest.clips, or use stills"
        )
    return clips[at]
