"""Embedding of many touches in equal batches: arrays, manifest rows, frames of a folder or a video; features files."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pyarrow as pa

from anytouch_jax.bars import tracked
from anytouch_jax.data.gels import ADVICE, UnitGels, gel_arrays, gels_of_arrays
from anytouch_jax.data.loading.samples import evaluation
from anytouch_jax.data.manifest.manifest import Manifest
from anytouch_jax.encoder.arrays import BATCH, Join, Log, Pooling, run_in_batches, warn
from anytouch_jax.errors import UserError
from anytouch_jax.files import atomic_path, read_arrays
from anytouch_jax.shown import shown_short

if TYPE_CHECKING:
    from anytouch_jax.encoder.base import Encoder


@shown_short
@dataclass(frozen=True)
class Features:
    """Features f32 (n, d), their `rows` i64 (n,) and further `keys` (n,).

    Rows are those of a manifest, or frame numbers of a video or folder. `predictions`: arrays (n, ...) of a head.
    `skipped` counts rows without features. `gels`: pictures of the untouched gel by unit.
    """

    values: np.ndarray
    rows: np.ndarray
    keys: dict[str, np.ndarray]
    skipped: int = 0
    predictions: dict[str, np.ndarray] = field(default_factory=dict)
    gels: dict[str, np.ndarray] = field(default_factory=dict)


def embed_rows(
    encoder: Encoder, manifest: Manifest, rows: np.ndarray, frames: int = 1, pooling: Pooling = "class",
    join: Join = "mean", *, batch: int = BATCH, on_bad_sample: Literal["error", "skip"] = "error",
    sensor_row: int | None = None, edit: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    gels: UnitGels | None = None, log: Log = warn,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return (row numbers i64 (n,), features f32 (n, d)) of manifest rows, each frame encoded once.

    A row's clip is the `frames` frames that end at it. A sensor that the model does not know gets the universal tokens,
    which is logged; `sensor_row` serves all rows by one row of the table. `edit` changes clips u8 (B, T, H, W, 3) of
    rows (B,) before they are encoded. With `on_bad_sample` "skip", rows that cannot be read are left out, and the first
    are logged. So are rows for which `gels` (default: the rule of `data.gels`) has no picture of the untouched gel, if
    the encoder needs one. Raises UserError.
    """
    if not len(rows):
        raise UserError("there are no rows to embed; check the split and the filters")
    if gels is None and encoder.subtracts:
        gels = UnitGels(manifest)
        log(gels.report(rows))
    rows = rows_with_gel(encoder, gels, rows, log)
    for name in sorted(set(manifest.text_column("sensor")[rows])) if sensor_row is None else ():
        encoder.sensor_row(name, log)
    settings = {"data.batch_size": min(batch, len(rows)), "data.on_bad_sample": on_bad_sample}
    config, ids, skipped = encoder.config.with_settings(settings), [], list[str]()

    def touches() -> Iterator[tuple[np.ndarray, np.ndarray]]:
        kind: Literal["still", "clip"] = "still" if frames == 1 else "clip"
        for row_ids, part in evaluation(
            manifest, rows, config, kind, frames=frames, unknown="universal", prepare=encoder.prepare,
            like=encoder.blank, skipped=skipped, gels=gels,
        ):  # fmt: skip
            ids.append(row_ids)
            clips = part.clip[: len(row_ids)]
            clips = clips if edit is None else edit(clips, row_ids)
            yield from zip(clips, part.sensor[: len(row_ids)], strict=True)

    def encode(part: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        clips, sensor = part
        sensor = sensor if sensor_row is None else np.full_like(sensor, sensor_row)
        return encoder.encode_touch(clips, sensor, pooling=pooling, join=join)

    values = run_in_batches(encode, tracked(touches(), "frames embedded", len(rows)), config.data.batch_size)
    for sentence in skipped:
        log(f"skipped: {sentence}")
    if not ids:
        raise UserError(f"none of the {len(rows)} rows can be read; check them with `anytouch data verify`")
    return np.concatenate(ids), values


def embed_frames(
    encoder: Encoder, frames: Iterable[tuple[int, str, np.ndarray | None]], sensor_row: int,
    preprocess: Callable[[np.ndarray], np.ndarray] | None = None, *, length: int = 1, pooling: Pooling = "class",
    join: Join = "mean", batch: int = BATCH,
) -> Features:  # fmt: skip
    """Return features of every clip of `length` consecutive frames, keyed by the place of its last frame.

    `frames` yields number, name ("" for a video) and pixels of each frame, None for an unreadable one. No clip spans a
    gap in the numbers or an unreadable frame. `preprocess` is `encoder.preprocess` by default. Raises UserError if
    there is no clip.
    """
    prepare = encoder.preprocess if preprocess is None else preprocess
    names: list[str] = []
    ends: list[int] = []

    def clips() -> Iterator[np.ndarray]:
        last, ring = None, list[np.ndarray]()
        for number, name, frame in frames:
            names.append(name)
            ring = ring if last is None or number == last + 1 else []
            ring = [] if frame is None else [*ring, prepare(frame)][-length:]
            last = number
            if len(ring) == length:
                ends.append(len(names) - 1)
                yield np.stack(ring)

    def encode(clips: np.ndarray) -> np.ndarray:
        return encoder.encode_touch(clips, np.full(len(clips), sensor_row), pooling=pooling, join=join)

    values = run_in_batches(encode, clips(), batch)
    if not ends:
        raise UserError(f"{len(names)} frames are too few for clips of {length} readable frames; ask for fewer")
    index = np.array(ends)
    keys = {"frame_index": index} | ({"path": np.array(names)[index]} if any(names) else {})
    return Features(values, index, keys, max(0, len(names) - length + 1) - len(index))


def rows_with_gel(encoder: Encoder, gels: UnitGels | None, rows: np.ndarray, log: Log = warn) -> np.ndarray:
    """Return those of `rows` that have an untouched gel, all of them for an encoder that needs none.

    The others are counted. Raises UserError if none has one.
    """
    if not encoder.needs_background or gels is None:
        return rows
    has = gels.has(rows)
    if not has.any():
        raise UserError(
            f"{encoder.source} subtracts the untouched gel. {len(rows)} rows have no picture of it, and too few frames "
            f"to estimate it. {ADVICE}"
        )
    if not has.all():
        log(f"{(~has).sum()} of {len(rows)} rows have no picture of the untouched gel, and are left out")
    return rows[has]


def plain_column(manifest: Manifest, name: str) -> np.ndarray:
    """Return a column of a manifest as an array without objects: numbers with NaN for null, all others as text."""
    kind = manifest.column(name).type
    if not (pa.types.is_integer(kind) or pa.types.is_floating(kind)):
        return manifest.text_column(name)
    return np.asarray([np.nan if value is None else value for value in manifest.column(name).to_pylist()])


def save_npz(path: str | Path, features: Features, metadata: dict[str, str]) -> None:
    """Write features, rows, keys and metadata as one `.npz`, whole or not at all. Raises OSError."""
    described = {f"about/{name}": np.asarray(value) for name, value in metadata.items()}
    keys = {f"key/{name}": values for name, values in features.keys.items()}
    arrays: dict[str, Any] = {"features": features.values, "rows": features.rows}
    arrays |= features.predictions | keys | described | gel_arrays(features.gels)
    with atomic_path(path) as part, open(part, "wb") as file:
        np.savez(file, **arrays)


def read_npz(path: str | Path) -> tuple[Features, dict[str, str]]:
    """Return the features and the metadata of a file of `save_npz`. Raises UserError for any other file."""
    try:
        arrays = read_arrays(path)
        gels = gels_of_arrays(arrays)
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"{path} is not a features file of `anytouch embed`: {error}") from None
    values, rows = (arrays.get(name, np.zeros(0, str)) for name in ("features", "rows"))
    numeric = values.dtype.kind in "fiu" and rows.dtype.kind in "iu"
    if values.ndim != 2 or not numeric or rows.shape != values.shape[:1] or not len(rows):
        raise UserError(f"{path} needs numeric arrays features (n, d) and rows (n,), not {values.shape}, {rows.shape}.")
    if not values.shape[1] or not np.isfinite(values).all():
        raise UserError(f"{path}: the array features has no columns, or values that are not finite (NaN or infinite).")
    keys = {name.removeprefix("key/"): array for name, array in arrays.items() if name.startswith("key/")}
    if any(array.shape != rows.shape for array in keys.values()):
        raise UserError(f"{path}: its keys (key/path and others) must be one for each of the {len(rows)} rows.")
    about = {name.removeprefix("about/"): str(array)[:200] for name, array in arrays.items() if name[:6] == "about/"}
    return Features(values, rows, keys, gels=gels), about
