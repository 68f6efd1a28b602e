"""Equal batches, unit rows, rows of sensors, spread of features.

All in numpy, for `info` and exported encoders.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from itertools import islice
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt

from anytouch_jax.errors import UserError

if TYPE_CHECKING:
    from anytouch_jax.config import ModelConfig

Array = npt.NDArray[Any]
Pooling = Literal["class", "mean", "both"]
Join = Literal["mean", "sum", "concat"]
Log = Callable[[str], None]
BATCH = 64
METADATA = "fields"  # of weights: factors on the deviations by name, and the modulus of sensors
# rows that are compared, and the mean cosine of nearly constant features
SPREAD_ROWS = 2000
SPREAD_LEAST = 0.99


def warn(sentence: str) -> None:
    """Show a sentence as a Python warning."""
    warnings.warn(sentence, stacklevel=4)


def check_features(values: np.ndarray) -> np.ndarray:
    """Return what an encoder computed.

    Raises UserError if it is not finite, since finite weights may overflow.
    """
    if not np.isfinite(values).all():
        raise UserError(
            "the features are not finite (NaN or infinite): the weights are damaged or much too "
            "large. Load them again "
            "from their source, or take an earlier checkpoint."
        )
    return values


def run_in_batches(
    function: Callable[[Any], Any], items: Iterable[Any], size: int = BATCH
) -> np.ndarray:
    """Return the results (n, ...) of `function` over n items, in batches of `size`.

    Arrays are stacked, and tuples of arrays one by one. The last batch is filled up with its last
    item, so that one shape is compiled. Without items the result is of shape (0,). Raises UserError
    for results that are not finite.
    """
    values = list[np.ndarray]()
    left = iter(items)
    while part := list(islice(left, size)):
        full = part + part[-1:] * (size - len(part) if values else 0)
        batch = (
            tuple(map(np.stack, zip(*full, strict=True)))
            if isinstance(full[0], tuple)
            else np.stack(full)
        )
        values.append(check_features(np.asarray(function(batch))[: len(part)]))
    if values:
        return np.concatenate(values)
    return np.zeros(0, np.float32)


def binary_scale(values: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Return the exponent e of two that brings the largest |value| * 2**-e below 1, so that squares
    do not overflow.
    """
    return np.frexp(np.abs(values).max(axis=axis, keepdims=True, initial=0.0))[1]


def as_array(values: Any, name: str) -> np.ndarray:
    """Return an array of an array-like. Raises UserError for lists of unequal lengths."""
    try:
        return np.asarray(values)
    except ValueError:
        raise UserError(
            f"{name} must be one array; its parts differ in size, so bring them to one size"
        ) from None


def check_frames(model: ModelConfig, frames: int) -> None:
    """Raise UserError unless a touch may have `frames` frames: 1 (a still), or at least those of
    the model's clips.
    """
    if frames != 1 and frames < model.frames:
        raise UserError(f"a clip needs {model.frames} frames or more (or 1, a still), not {frames}")


def filled(batch: np.ndarray) -> np.ndarray:
    """Return a batch (n, ...) with zeros up to 1, 2, 4, ... 64, 128, 192, ... rows: each number of
    rows is compiled.
    """
    count = len(batch)
    size = 1 << max(count - 1, 0).bit_length() if count <= 64 else -(-count // 64) * 64
    if count == size:
        return batch
    return np.concatenate([batch, np.zeros((size - count, *batch.shape[1:]), batch.dtype)])


def unit_rows(values: np.ndarray) -> np.ndarray:
    """Return rows (n, d) divided by their Euclidean norms, of any magnitude; a row of zeros stays
    zero.
    """
    values = np.ldexp(values, -binary_scale(values, 1))
    return np.asarray(values / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), 1e-12))


def spread_lines(values: np.ndarray) -> list[str]:
    """Return a line with the mean cosine of pairs of features (n, d), and a warning if they are
    nearly constant.
    """
    rows = np.asarray(
        values[np.linspace(0, len(values) - 1, min(len(values), SPREAD_ROWS)).astype(int)],
        np.float64,
    )
    if len(rows) < 2 or not np.isfinite(rows).all():
        return []
    unit = unit_rows(rows)
    count = len(unit)
    cosine = (np.square(unit.sum(axis=0)).sum() - np.square(unit).sum()) / (count * (count - 1))
    lines = [f"spread: the mean cosine of two features is {cosine:.4f}"]
    if cosine > SPREAD_LEAST:
        lines.append(
            f"The features are nearly constant: a mean cosine above {SPREAD_LEAST} cannot "
            "distinguish touches. "
            "Train longer, and check background subtraction and that the frames differ."
        )
    return lines


def rows_of_sensors(sensor: Any, count: int, row: Callable[[str], int], rows: int) -> np.ndarray:
    """Return rows i32 (count,) of a sensor name (by `row`), of names (count,), or of numbers.

    Raises UserError.
    """
    ids = np.full(count, row(sensor)) if isinstance(sensor, str) else np.asarray(sensor)
    if ids.dtype.kind in "UO":
        ids = np.array([row(name) for name in ids.reshape(-1)], np.int32).reshape(ids.shape)
    if ids.shape != (count,) or ids.dtype.kind not in "iu":
        raise UserError(
            f"sensor rows must be one integer for each of the {count} touches, not {ids.dtype} "
            f"{ids.shape}"
        )
    if ids.min(initial=0) < 0 or ids.max(initial=0) >= rows:
        raise UserError(f"sensor rows must be 0 to {rows - 1}")
    return ids.astype(np.int32)
