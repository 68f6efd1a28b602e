"""Accuracy of a taught head, and of raw pixels, on recordings that are left out."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from anytouch_jax.data.background.rule import Backgrounds
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.evaluate import feature_cache, probing, splits

if TYPE_CHECKING:
    from anytouch_jax.data.manifest.manifest import Manifest
    from anytouch_jax.evaluate.heads import Scaling
    from anytouch_jax.evaluate.tasks import TaskRows
    from anytouch_jax.live.page.fitting import TaughtHead

# what `measure_head` gives
RESULT = (
    "once",
    "right",
    "right_low",
    "right_high",
    "pixels",
    "pixels_low",
    "pixels_high",
    "chance",
)
# penalties that are tried: all that there are take three times as long
_TRIED = (1.0, 0.1, 0.01)


def measure_head(table: Manifest, fitted: TaughtHead) -> dict[str, float]:
    """Return the accuracy of a head and of raw pixels on recordings that are left out.

    Only names that were recorded more than once are counted.
    """
    rows = fitted.rows
    pixels = feature_cache.pixel_components(
        feature_cache.pixel_features(table, backgrounds=Backgrounds(table)), rows
    )
    result = _accuracies(fitted.x, pixels, rows, np.isin(rows.labels, fitted.repeated))
    result["once"] = fitted.once
    return result


def _accuracies(x: Array, pixels: Array, rows: TaskRows, tested: Array) -> dict[str, float]:
    """Return the accuracies of features and of raw pixels, for `tested` (n,) bool rows."""
    _, counts = np.unique(rows.labels[tested], return_counts=True)
    result = {"chance": float(counts.max() / tested.sum())}
    scalings: dict[str, Scaling] = {"right": "column", "pixels": "common"}
    for name, values in (("right", x), ("pixels", pixels)):
        arrays = values[tested], rows.labels[tested], rows.groups[tested]
        found = probing.leave_groups_out(
            *arrays, folds=splits.FOLDS, penalties=_TRIED, scaling=scalings[name]
        )
        result[name] = found.accuracy
        if found.low is not None and found.high is not None:
            result |= {f"{name}_low": found.low, f"{name}_high": found.high}
    return result
