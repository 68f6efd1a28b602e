"""Embedding of many touches: manifest rows, and frames of a folder or a video."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pyarrow as pa

from anytouch_jax.data.background.rule import ADVICE, Backgrounds
from anytouch_jax.data.loading.samples import evaluation
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import BATCH, Aggregation, Log, Pooling, warn
from anytouch_jax.encoder.arrays import run_in_batches as run_in_batches
from anytouch_jax.encoder.index import Features as Features
from anytouch_jax.encoder.index import TouchIndex as TouchIndex
from anytouch_jax.encoder.index import load_index as load_index
from anytouch_jax.encoder.index import nearest as nearest
from anytouch_jax.encoder.index import read_npz as read_npz
from anytouch_jax.encoder.index import save_npz as save_npz
from anytouch_jax.encoder.interface import TouchEncoder
from anytouch_jax.errors import UserError
from anytouch_jax.progress import tracked

# of a frame: its number, its name ("" in a video) and its pixels, None if it cannot be read
NumberedFrame = tuple[int, str, np.ndarray | None]
Edit = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class RowSettings:
    """How rows of a manifest are embedded.

    Attributes:
        frames: those of a touch. A row's clip is the `frames` frames that end at it.
        pooling: see `Encoder.encode_touch`.
        aggregation: the temporal aggregation of a long clip.
        batch: touches at a time.
        on_bad_sample: "skip" leaves out rows that cannot be read, and the first are logged.
        sensor_row: serves all rows, instead of their own sensors.
        edit: changes clips u8 (B, T, H, W, 3) of rows (B,) before they are encoded.
    """

    frames: int = 1
    pooling: Pooling = "class"
    aggregation: Aggregation = "mean"
    batch: int = BATCH
    on_bad_sample: Literal["error", "skip"] = "error"
    sensor_row: int | None = None
    edit: Edit | None = None


def embed_rows(  # noqa: PLR0913  the public call; `embed_with` takes the record
    encoder: TouchEncoder,
    manifest: Manifest,
    rows: np.ndarray,
    frames: int = 1,
    pooling: Pooling = "class",
    aggregation: Aggregation = "mean",
    *,
    batch: int = BATCH,
    on_bad_sample: Literal["error", "skip"] = "error",
    sensor_row: int | None = None,
    edit: Edit | None = None,
    backgrounds: Backgrounds | None = None,
    log: Log = warn,
) -> tuple[np.ndarray, np.ndarray]:
    """Return row numbers i64 (n,) and features f32 (n, d) of manifest rows, see `embed_with`.

    Args:
        encoder: what encodes them.
        manifest: the table.
        rows: row numbers (m,), of which n can be embedded.
        frames: see `RowSettings`.
        pooling: see `RowSettings`.
        aggregation: see `RowSettings`.
        batch: see `RowSettings`.
        on_bad_sample: see `RowSettings`.
        sensor_row: see `RowSettings`.
        edit: see `RowSettings`.
        backgrounds: images of the untouched gel, for an encoder that subtracts them.
        log: takes sentences.
    """
    settings = RowSettings(
        frames=frames,
        pooling=pooling,
        aggregation=aggregation,
        batch=batch,
        on_bad_sample=on_bad_sample,
        sensor_row=sensor_row,
        edit=edit,
    )
    return embed_with(encoder, manifest, rows, settings, backgrounds=backgrounds, log=log)


def embed_with(
    encoder: TouchEncoder,
    manifest: Manifest,
    rows: np.ndarray,
    settings: RowSettings,
    *,
    backgrounds: Backgrounds | None = None,
    log: Log = warn,
) -> tuple[np.ndarray, np.ndarray]:
    """Return row numbers i64 (n,) and features f32 (n, d) of manifest rows, each encoded once.

    An unknown sensor gets the universal tokens, which is logged. Rows without an image of the
    untouched gel are left out if the encoder needs one, and so are, with `on_bad_sample` "skip",
    rows that cannot be read.

    Args:
        encoder: what encodes them.
        manifest: the table.
        rows: row numbers (m,).
        settings: how they are embedded.
        backgrounds: images of the untouched gel, for an encoder that subtracts them. By default
            they are those of the manifest.
        log: takes sentences.

    Raises:
        UserError: there are no rows, or none can be embedded.
    """
    if not len(rows):
        raise UserError("there are no rows to embed; check the split and the filters")
    if backgrounds is None and encoder.subtracts:
        backgrounds = Backgrounds(manifest)
        log(backgrounds.report(rows))
    rows = rows_with_gel(encoder, backgrounds, rows, log)
    if settings.sensor_row is None:
        # The loader asks for each row without a log, so that a name is reported once.
        for name in sorted(set(manifest.text_column("sensor")[rows])):
            encoder.sensor_row(name, log)
    config = encoder.config.with_settings(
        {
            "data.batch_size": min(settings.batch, len(rows)),
            "data.on_bad_sample": settings.on_bad_sample,
        }
    )
    kind: Literal["still", "clip"] = "still" if settings.frames == 1 else "clip"
    ids = []
    skipped = list[str]()

    def touches() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        batches = evaluation(
            manifest,
            rows,
            config,
            kind,
            frames=settings.frames,
            unknown="universal",
            prepare=encoder.prepare,
            like=encoder.blank,
            skipped=skipped,
            backgrounds=backgrounds,
        )
        for row_ids, part in batches:
            ids.append(row_ids)
            # A last batch is filled up to its size.
            clips = part.clip[: len(row_ids)]
            sensors = part.sensor[: len(row_ids)]
            if settings.edit is not None:
                clips = settings.edit(clips, row_ids)
            yield from zip(clips, sensors, strict=True)

    def encode(part: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        clips, sensor = part
        if settings.sensor_row is not None:
            sensor = np.full_like(sensor, settings.sensor_row)
        return encoder.encode_touch(
            clips, sensor, pooling=settings.pooling, aggregation=settings.aggregation
        )

    values = run_in_batches(
        encode, tracked(touches(), "frames embedded", len(rows)), config.data.batch_size
    )
    for sentence in skipped:
        log(f"skipped: {sentence}")
    if not ids:
        raise UserError(
            f"none of the {len(rows)} rows can be read; check them with `anytouch data verify`"
        )
    return np.concatenate(ids), values


def embed_frames(
    encoder: TouchEncoder,
    frames: Iterable[NumberedFrame],
    sensor_row: int,
    preprocess: Callable[[np.ndarray], np.ndarray] | None = None,
    *,
    length: int = 1,
    pooling: Pooling = "class",
    aggregation: Aggregation = "mean",
    batch: int = BATCH,
) -> Features:
    """Return features of every clip of consecutive frames, keyed by the place of its last frame.

    Args:
        encoder: what encodes them.
        frames: number, name ("" for a video) and pixels of each frame, None for an unreadable one,
            which no clip spans.
        sensor_row: that of all frames.
        preprocess: `encoder.preprocess` by default.
        length: frames of a clip.
        pooling: see `Encoder.encode_touch`.
        aggregation: the temporal aggregation of a long clip.
        batch: clips at a time.

    Raises:
        UserError: there is no clip.
    """
    prepare = encoder.preprocess if preprocess is None else preprocess
    names = list[str]()
    ends = list[int]()

    def clips() -> Iterator[np.ndarray]:
        last = None
        ring = list[np.ndarray]()
        for number, name, frame in frames:
            names.append(name)
            follows = last is None or number == last + 1
            if frame is None or not follows:
                ring = []
            if frame is not None:
                ring = [*ring, prepare(frame)][-length:]
            last = number
            if len(ring) == length:
                ends.append(len(names) - 1)
                yield np.stack(ring)

    def encode(clips: np.ndarray) -> np.ndarray:
        rows = np.full(len(clips), sensor_row)
        return encoder.encode_touch(clips, rows, pooling=pooling, aggregation=aggregation)

    values = run_in_batches(encode, clips(), batch)
    if not ends:
        raise UserError(
            f"{len(names)} frames are too few for clips of {length} readable frames; ask for fewer"
        )
    index = np.array(ends)
    keys = {"frame_index": index}
    if any(names):
        keys["path"] = np.array(names)[index]
    possible = max(0, len(names) - length + 1)
    return Features(values, index, keys, skipped=possible - len(index))


def rows_with_gel(
    encoder: TouchEncoder, backgrounds: Backgrounds | None, rows: np.ndarray, log: Log = warn
) -> np.ndarray:
    """Return those of `rows` that have an untouched gel, if the encoder needs one.

    Raises UserError if none has one.

    Args:
        encoder: whose training decides whether a gel is needed.
        backgrounds: the untouched gels, if there are any.
        rows: i64 (n,) of the manifest.
        log: takes a sentence on the rows left out.
    """
    if not encoder.needs_background or backgrounds is None:
        return rows
    has = backgrounds.has(rows)
    if not has.any():
        raise UserError(
            f"{encoder.source} subtracts the untouched gel. {len(rows)} rows have no image of "
            f"it, and too few frames to estimate it. {ADVICE}"
        )
    if not has.all():
        log(
            f"{(~has).sum()} of {len(rows)} rows have no image of the untouched gel, and are "
            "left out"
        )
    return rows[has]


def plain_column(manifest: Manifest, name: str) -> np.ndarray:
    """Return a column of a manifest as an array without objects.

    Numbers have NaN for null, and all other values are text.
    """
    column = manifest.column(name)
    if not (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)):
        return manifest.text_column(name)
    return np.asarray([np.nan if value is None else value for value in column.to_pylist()])
