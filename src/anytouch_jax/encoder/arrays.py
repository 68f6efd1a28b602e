"""Equal batches, unit rows, rows of sensors, spread of features.

All of it is numpy, because `info` and exported encoders use it without jax. The words of the
encoder's signatures (pooling, temporal aggregation, engine) are defined here too.
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
Params = dict[str, Any]
Size = tuple[int, int]  # height and width, pixels
Pooling = Literal["class", "mean", "both"]
Aggregation = Literal["mean", "sum", "concat"]
# What computes the features of touch. "auto" chooses among them, see `export.export.cached_export`.
Engine = Literal["xla", "onnxruntime", "openvino"]
EngineChoice = Engine | Literal["auto"]
ENGINE_CHOICES = ("auto", "xla", "onnxruntime", "openvino")
Log = Callable[[str], None]
BATCH = 64
METADATA = "fields"  # of weights: factors on the deviations by name, and the modulus of sensors
# Features whose mean cosine is above SPREAD_LEAST are nearly constant. SPREAD_ROWS are compared.
SPREAD_ROWS = 2000
SPREAD_LEAST = 0.99


def warn(sentence: str) -> None:
    """Show a sentence as a Python warning."""
    warnings.warn(sentence, stacklevel=4)


def check_features(values: np.ndarray) -> np.ndarray:
    """Return what an encoder computed, if it is finite.

    Raises UserError otherwise: finite weights may still overflow.
    """
    if not np.isfinite(values).all():
        raise UserError(
            "the features are not finite (NaN or infinite): the weights are damaged or much too "
            "large. Load them again from their source, or take an earlier checkpoint."
        )
    return values


def run_in_batches(
    function: Callable[[Any], Any], items: Iterable[Any], size: int = BATCH
) -> np.ndarray:
    """Return the results (n, ...) of `function` over n items, in batches of `size`.

    Items are arrays, which are stacked, or tuples of arrays, which are stacked one by one. Without
    items the result has shape (0,). Raises UserError for results that are not finite.
    """
    values = list[np.ndarray]()
    left = iter(items)
    while part := list(islice(left, size)):
        batch = part
        if values:
            # The last batch is filled up with its last item, so that one shape is compiled. A first
            # batch that is small stays small: nothing else was compiled yet.
            batch = part + part[-1:] * (size - len(part))
        result = np.asarray(function(_stack(batch)))
        values.append(check_features(result[: len(part)]))
    if values:
        return np.concatenate(values)
    return np.zeros(0, np.float32)


def _stack(items: list[Any]) -> Any:
    """Return items as one array, or tuples of arrays as a tuple of arrays."""
    if isinstance(items[0], tuple):
        return tuple(np.stack(each) for each in zip(*items, strict=True))
    return np.stack(items)


def binary_scale(values: np.ndarray, axis: int | None = None) -> np.ndarray:
    """Return the exponents e that bring the largest |value| * 2**-e below 1.

    A division by a power of two is exact, and squares of what is left do not overflow.
    """
    largest = np.abs(values).max(axis=axis, keepdims=True, initial=0.0)
    return np.frexp(largest)[1]


def as_array(values: Any, name: str) -> np.ndarray:
    """Return an array of an array-like. Raises UserError for lists of unequal lengths."""
    try:
        return np.asarray(values)
    except ValueError:
        raise UserError(
            f"{name} must be one array; its parts differ in size, so bring them to one size"
        ) from None


def check_frames(model: ModelConfig, frames: int) -> None:
    """Raise UserError unless a touch of a model may have `frames` frames.

    These are 1 (a still), or at least those of the model's clips.
    """
    if frames != 1 and frames < model.frames:
        raise UserError(f"a clip needs {model.frames} frames or more (or 1, a still), not {frames}")


def filled(batch: np.ndarray) -> np.ndarray:
    """Return a batch (n, ...) with zeros up to 1, 2, 4, ... 64, 128, 192, ... rows.

    Each number of rows is compiled, so there should be few of them.
    """
    count = len(batch)
    if count <= 64:
        size = 1 << max(count - 1, 0).bit_length()
    else:
        size = -(-count // 64) * 64
    if count == size:
        return batch
    return np.concatenate([batch, np.zeros((size - count, *batch.shape[1:]), batch.dtype)])


def unit_rows(values: np.ndarray) -> np.ndarray:
    """Return rows (n, d) divided by their Euclidean norms; a row of zeros stays zero.

    Rows of any magnitude are taken, because they are scaled by a power of two first.
    """
    values = np.ldexp(values, -binary_scale(values, 1))
    norms = np.linalg.norm(values, axis=1, keepdims=True)
    return np.asarray(values / np.maximum(norms, 1e-12))


def spread_lines(values: np.ndarray) -> list[str]:
    """Return a line with the mean cosine of pairs of features (n, d).

    A warning follows if they are nearly constant.
    """
    chosen = np.linspace(0, len(values) - 1, min(len(values), SPREAD_ROWS)).astype(int)
    rows = np.asarray(values[chosen], np.float64)
    if len(rows) < 2 or not np.isfinite(rows).all():
        return []
    unit = unit_rows(rows)
    count = len(unit)
    # The square of the sum is the sum over all pairs. Pairs of a row with itself are left out.
    of_pairs = np.square(unit.sum(axis=0)).sum() - np.square(unit).sum()
    cosine = of_pairs / (count * (count - 1))
    lines = [f"spread: the mean cosine of two features is {cosine:.4f}"]
    if cosine > SPREAD_LEAST:
        lines.append(
            f"The features are nearly constant: a mean cosine above {SPREAD_LEAST} cannot "
            "distinguish touches. Train longer, and check background subtraction and that the "
            "frames differ."
        )
    return lines


def rows_of_sensors(sensor: Any, count: int, row: Callable[[str], int], rows: int) -> np.ndarray:
    """Return rows i32 (count,) of the sensor table.

    Args:
        sensor: one name, names (count,), or row numbers (count,).
        count: how many touches there are.
        row: gives the row of a name.
        rows: how many rows the table has.

    Raises:
        UserError: another count or type, or a number outside of the table.
    """
    ids = np.full(count, row(sensor)) if isinstance(sensor, str) else np.asarray(sensor)
    if ids.dtype.kind in "UO":
        of_names = [row(name) for name in ids.reshape(-1)]
        ids = np.array(of_names, np.int32).reshape(ids.shape)
    if ids.shape != (count,) or ids.dtype.kind not in "iu":
        raise UserError(
            f"sensor rows must be one integer for each of the {count} touches, not {ids.dtype} "
            f"{ids.shape}"
        )
    # Checked here, because jax clamps an index outside of a table silently.
    if ids.min(initial=0) < 0 or ids.max(initial=0) >= rows:
        raise UserError(f"sensor rows must be 0 to {rows - 1}")
    return ids.astype(np.int32)
