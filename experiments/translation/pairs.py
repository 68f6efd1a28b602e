"""Fine-aligned pairs: the same frame of the same touch by two sensors, and their pixels or fields
as arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from anytouch_jax.config import FIELD_SENSORS, Config, DataConfig, preset
from anytouch_jax.data.loading.samples import SampleReader
from anytouch_jax.data.manifest.files import read_file, unpack_npy
from anytouch_jax.data.manifest.manifest import Manifest, select_rows
from anytouch_jax.errors import UserError

FIELD = (20, 20, 6)  # points of a Tac3D; displacement x, y, z mm, force x, y, z N
_THREADS = 2


class Pairs(NamedTuple):
    """Manifest rows i64 (n,) of the sensor that is given and of the one that is wanted, in manifest
    order.
    """

    source: np.ndarray
    target: np.ndarray


class Split(NamedTuple):
    """The pairs to train on, those that choose when to stop (there may be none), and those to test
    on: of objects never seen in training.
    """

    train: Pairs
    val: Pairs
    test: Pairs


def find_pairs(manifest: Manifest, source: str, target: str) -> Split:
    """Pairs by split, of frames with equal `touch` and `frame_index`, grade fine where rows have a
    grade.

    Raises UserError when a sensor has no rows, nothing pairs, a sensor felt a frame twice, or an
    object is in both.
    """
    if source == target:
        raise UserError(f"{source} is both sensors; name two")
    if source in FIELD_SENSORS:
        raise UserError(
            f"{source} measures a field and has no images to translate from; name it as the target"
        )
    train, val, test = (
        _pairs(manifest, source, target, split) for split in ("train", "val", "test")
    )
    for name, part in (("train", train), ("val", val)):
        both = sorted(_objects(manifest, part.source) & _objects(manifest, test.source))
        if both:
            raise UserError(
                f"object {both[0]!r} is in the splits {name} and test (and {len(both) - 1} "
                "others): test pairs must be of objects never seen; move its rows to one split"
            )
    return Split(train, val, test)


def _pairs(manifest: Manifest, source: str, target: str, split: str) -> Pairs:
    first, second = (_frames(manifest, name, split) for name in (source, target))
    shared = [key for key in first if key in second]
    if not shared and split != "val":
        raise UserError(
            f"split {split} has no frame of one touch felt by both {source} and {target}; give "
            "fine-aligned data (anytouch data simulate --grade fine --units one --sensors "
            f"{source},{target})"
        )
    return Pairs(*(np.array([rows[key] for key in shared], np.int64) for rows in (first, second)))


def _frames(manifest: Manifest, sensor: str, split: str) -> dict[tuple[int, int], int]:
    """(touch, frame index) -> row of a sensor."""
    names = manifest.text_column("sensor")
    touch = manifest.codes("touch", own=True)
    if sensor not in names:
        raise UserError(
            f"the manifest has no rows of sensor {sensor!r}; it has {', '.join(np.unique(names))}"
        )
    usable = (names == sensor) & (manifest.text_column("split") == split) & (touch >= 0)
    if "grade" in manifest.table.column_names:
        usable &= np.isin(manifest.text_column("grade"), ("", "fine"))
    frame = np.asarray(manifest.column("frame_index"))
    result = dict[tuple[int, int], int]()
    for row in np.flatnonzero(usable).tolist():
        key = (int(touch[row]), int(frame[row]))
        if key in result:
            raise UserError(
                f"{manifest.where(row)}: {sensor} felt frame {key[1]} of touch "
                f"{manifest.value(row, 'touch')!r} twice (row {manifest.number[result[key]]}); "
                "keep one unit of it"
            )
        result[key] = row
    return result


def _objects(manifest: Manifest, rows: np.ndarray) -> set[str]:
    result = {manifest.value(int(row), "object") for row in rows}
    if None in result:
        row = next(int(row) for row in rows if manifest.value(int(row), "object") is None)
        raise UserError(
            f"{manifest.where(row)} has no object; test pairs must be of objects never seen"
        )
    return result


def without_objects(manifest: Manifest, pairs: Manifest) -> Manifest:
    """The rows of `manifest` of objects that `pairs` does not have, in any split: what an encoder
    may be trained on.

    The paper takes the coarse rows that overlap with the fine data out of training (App.
    "Cross-sensor generation"); here that is every row of such an object. Rows without an object
    stay. Raises UserError when nothing is left.
    """
    names = manifest.text_column("object")
    kept = ~np.isin(names, list(set(pairs.text_column("object")) - {""}))
    if not (manifest.text_column("split")[kept] == "train").any():
        raise UserError(
            "every object to train on is in the pairs too; simulate pairs of fewer or other objects"
        )
    return select_rows(manifest, np.flatnonzero(kept))


def read_pairs(
    manifest: Manifest, pairs: Pairs, size: int, *, subtract: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Source images u8 (n, size, size, 3), and the targets: images alike, or fields f32 (n, 20, 20,
    6).

    `subtract`: source images less their backgrounds, for an encoder that `subtracts`.
    """
    field = len(pairs.target) and manifest.value(int(pairs.target[0]), "sensor") in FIELD_SENSORS
    targets = (
        read_fields(manifest, pairs.target) if field else read_pixels(manifest, pairs.target, size)
    )
    return read_pixels(manifest, pairs.source, size, subtract=subtract), targets


def read_pixels(
    manifest: Manifest, rows: np.ndarray, size: int, *, subtract: bool = False
) -> np.ndarray:
    """Return images u8 (n, size, size, 3) of manifest rows, background-subtracted or not.

    Raises UserError.
    """
    out = np.empty((len(rows), size, size, 3), np.uint8)
    model = replace(preset("tiny").model, image_size=size)
    reader = SampleReader(
        manifest, Config(model, data=DataConfig(background="subtract" if subtract else "keep"))
    )

    def one(k: int) -> None:
        reader.touch(rows[k : k + 1], None, out[k : k + 1])

    return _each(one, out)


def read_fields(manifest: Manifest, rows: np.ndarray) -> np.ndarray:
    """Fields f32 (n, 20, 20, 6), displacement mm and force N, of manifest rows (column
    `field_path`).
    """
    out = np.empty((len(rows), *FIELD), np.float32)

    def one(k: int) -> None:
        row = int(rows[k])
        if manifest.value(row, "field_path") is None:
            raise UserError(
                f"{manifest.where(row)} has no field_path; regression needs its field (.npy)"
            )
        file = manifest.file(row, "field_path")
        try:
            field = unpack_npy(read_file(file))
        except (OSError, ValueError) as error:
            raise UserError(
                f"{manifest.where(row)}, column 'field_path': {file} cannot be read: {error}"
            ) from None
        if field.shape != FIELD or not np.isfinite(field).all():
            raise UserError(
                f"{manifest.where(row)}: {file} is {field.shape}; a field is {FIELD} of finite "
                "numbers"
            )
        out[k] = field

    return _each(one, out)


def _each(one: Callable[[int], None], out: np.ndarray) -> Any:
    with ThreadPoolExecutor(_THREADS) as pool:
        for _ in pool.map(one, range(len(out))):
            pass
    return out
