"""A head fitted on recordings of live touch, its calibration, and its accuracy.

It is fitted as `anytouch probe label --save` does. Recordings are left out to calibrate it, and to
compare it with raw pixels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from anytouch_jax.data.background.contact import DEFAULT_THRESHOLD, THRESHOLDS
from anytouch_jax.data.background.rule import UnitGels
from anytouch_jax.encoder.arrays import Array
from anytouch_jax.encoder.embed import Pooling, embed_rows
from anytouch_jax.encoder.linear_head import COVERAGE, FALSE_ALARMS, LinearHead
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import feature_cache, heads, probing, splits
from anytouch_jax.live.page.recorder import SCORE

if TYPE_CHECKING:
    from anytouch_jax.data.manifest.manifest import Manifest
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.evaluate.heads import Scaling
    from anytouch_jax.evaluate.tasks import TaskRows

# of a measured head
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
_FRAMES = 20  # frames of a recording that are fitted on, evenly spread
# penalties, of measuring a head: all that there are take three times as long
_TRIED = (1.0, 0.1, 0.01)
_BATCH = 4  # frames embedded at once: live touch waits for them


@dataclass(frozen=True, eq=False)
class Fitted:
    """A head, and what it was fitted on.

    Attributes:
        head: with its calibration, where several recordings of a name allow one.
        x: features f32 (n, E).
        ids: their rows (n,) of the manifest.
        rows: their names and recordings.
        repeated: names that were recorded more than once.
        once: how many names were recorded once.
    """

    head: LinearHead
    x: Array
    ids: Array
    rows: TaskRows
    repeated: Array
    once: int


def fit_head(
    encoder: Encoder,
    table: Manifest,
    sensor: str,
    pooling: Pooling,
    known: dict[str, Array],
    log: Callable[[str], None],
) -> Fitted:
    """Fit a head on the recordings of a manifest, and calibrate it.

    Args:
        encoder: the one that live touch is embedded by.
        table: the manifest of the recordings.
        sensor: the sensor of the recordings that are used.
        pooling: that of the features.
        known: features of frames by their path, to which those that are missing are added.
        log: gets what the calibration promises.

    Raises:
        UserError: recordings that a head cannot be fitted on.
    """
    rows, _ = probing.label_rows(table, "object", group="sequence", sensor=sensor)
    rows = rows.take(_typical(table, rows, THRESHOLDS.get(sensor, DEFAULT_THRESHOLD)))
    ids = rows.rows[:, 0]
    x = _embed(encoder, table, ids, pooling, known, log)
    data, cut, _ = splits.check_rows(x, rows.labels, rows.groups, rows.split, tested=False)
    # Without rows for validation, the penalty is chosen on recordings that are left out in turn.
    penalty = splits.select_option(
        heads.ProbeHead(), data, cut._replace(val=cut.val[:0]), "honest"
    ).option
    (model,) = data.fit(heads.ProbeHead(options=(penalty,)), cut.fit).models
    head = heads.linear_head(
        model,
        data.names,
        label="object",
        pooling=pooling,
        frames=1,
        fingerprint=encoder.fingerprint,
    )
    if encoder.subtracts:
        head = replace(head, gels=UnitGels(table).pictures(ids))
    # the name of each recording
    recorded = dict(zip(rows.groups.tolist(), rows.labels.tolist(), strict=True))
    names, times = np.unique(list(recorded.values()), return_counts=True)
    # Only a name with several recordings can be met again when one is left out.
    several = int(times[times > 1].sum())
    once = len(recorded) - several
    if several:
        # A fold that lacks a name is not counted, so recordings that stand alone cost some.
        count = max(1, several - once * math.ceil(len(recorded) / splits.FOLDS))
        # What so few recordings can promise: a fraction of 0.9 takes nine.
        coverage = min(COVERAGE, math.floor(100 * count / (count + 1)) / 100)
        false_alarms = max(FALSE_ALARMS, math.ceil(100 / (count + 1)) / 100)
        head = probing.calibrated(
            head, x, rows, penalty, log, coverage=coverage, false_alarms=false_alarms
        )
    return Fitted(head, x, ids, rows, names[times > 1], once)


def measure_head(table: Manifest, fitted: Fitted) -> dict[str, float]:
    """Return the accuracy of a head and of raw pixels on recordings that are left out.

    Only names that were recorded more than once are counted.
    """
    rows = fitted.rows
    pixels = feature_cache.pixel_components(
        feature_cache.pixel_features(table, gels=UnitGels(table)), rows
    )
    result = _accuracies(fitted.x, pixels, rows, np.isin(rows.labels, fitted.repeated))
    result["once"] = fitted.once
    return result


def _embed(
    encoder: Encoder,
    table: Manifest,
    ids: Array,
    pooling: Pooling,
    known: dict[str, Array],
    log: Callable[[str], None],
) -> Array:
    """Return features (n, E) of rows: those that live touch had, and those of earlier frames."""
    paths = table.text_column("path")[ids].tolist()
    unknown = [place for place, path in enumerate(paths) if path not in known]
    if unknown:
        found, values = embed_rows(
            encoder, table, ids[unknown], pooling=pooling, batch=_BATCH, log=log
        )
        if len(found) < len(unknown):
            raise UserError(
                f"{len(unknown) - len(found)} recorded frames have no picture of the untouched gel."
            )
        known.update({paths[place]: one for place, one in zip(unknown, values, strict=True)})
    return np.stack([known[path] for path in paths])


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


def _typical(table: Manifest, rows: TaskRows, threshold: float) -> Array:
    """Return places of rows to fit on: at most _FRAMES of a recording, evenly spread.

    They are frames with contact where a recording has any.
    """
    scores = table.number_column(SCORE)
    chosen = []
    for group in dict.fromkeys(rows.groups.tolist()):
        places = np.flatnonzero(rows.groups == group)
        touched = places[scores[rows.rows[places, 0]] > threshold]
        if len(touched):
            places = touched
        even = np.linspace(0, len(places) - 1, min(_FRAMES, len(places))).astype(int)
        chosen.append(places[np.unique(even)])
    return np.concatenate(chosen)
