"""A head fitted on recordings of live touch, and its calibration.

It is fitted as `anytouch probe label --save` does. Recordings are left out to calibrate it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from anytouch_jax.data.background.contact import DEFAULT_THRESHOLD, THRESHOLDS
from anytouch_jax.data.background.rule import Backgrounds
from anytouch_jax.data.manifest import manifest as manifests
from anytouch_jax.encoder.arrays import Array, Pooling
from anytouch_jax.encoder.linear_head import COVERAGE, FALSE_ALARMS, LinearHead
from anytouch_jax.evaluate import heads, probing, splits
from anytouch_jax.live.page.recorder import SCORE

if TYPE_CHECKING:
    from pathlib import Path

    from anytouch_jax.data.manifest.manifest import Manifest
    from anytouch_jax.encoder.encoder import Encoder
    from anytouch_jax.evaluate.tasks import TaskRows

FEWEST = (
    9  # recordings from which a set of names, or a novel touch, can be told: COVERAGE takes them
)
_FRAMES = 20  # frames of a recording that are fitted on, evenly spread


@dataclass(frozen=True, eq=False)
class TaughtHead:
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
    embed: Callable[[Array], Array],
    log: Callable[[str], None],
) -> TaughtHead:
    """Fit a head on the recordings of a manifest, and calibrate it.

    Args:
        encoder: the one that live touch is embedded by.
        table: the manifest of the recordings.
        sensor: the sensor of the recordings that are used.
        pooling: that of the features.
        embed: gives features f32 (n, E) of rows (n,) of the manifest.
        log: gets what the calibration promises.

    Raises:
        UserError: recordings that a head cannot be fitted on.
    """
    rows, _ = probing.label_rows(table, "object", group="sequence", sensor=sensor)
    rows = rows.take(_typical(table, rows, THRESHOLDS.get(sensor, DEFAULT_THRESHOLD)))
    ids = rows.rows[:, 0]
    x = embed(ids)
    data, cut, _ = splits.check_rows(x, rows.labels, rows.groups, rows.split, tested=False)
    # Without rows for validation, the penalty is chosen on recordings that are left out in turn.
    penalty = splits.select_option(
        heads.ProbeHead(), data, cut._replace(val=cut.val[:0]), "grouped"
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
        head = replace(head, backgrounds=Backgrounds(table).images(ids))
    # the name of each recording
    recorded = dict(zip(rows.groups.tolist(), rows.labels.tolist(), strict=True))
    names, times = np.unique(list(recorded.values()), return_counts=True)
    # Only a name with several recordings can be met again when one is left out.
    several = int(times[times > 1].sum())
    once = len(recorded) - several
    if several:
        # A fold that lacks a name is not counted, so recordings that stand alone cost some.
        count = max(1, several - once * math.ceil(len(recorded) / splits.FOLDS))
        head = probing.calibrated(
            head,
            x,
            rows,
            penalty,
            log,
            coverage=COVERAGE,
            false_alarms=false_alarms_of(count),
        )
    return TaughtHead(head, x, ids, rows, names[times > 1], once)


def recordings_of(file: Path, sensor: str) -> int:
    """Return the number of recordings by a sensor in a manifest."""
    table = manifests.read(file)
    own = table.text_column("sensor") == sensor
    return len(np.unique(table.text_column("sequence")[own]))


def false_alarms_of(recordings: int) -> float:
    """Return the fraction of known touches that a head of so many recordings may call novel.

    Under nine recordings nothing can be promised: sets hold every name, and nothing is novel. From
    nine on, false alarms are as rare as so many recordings allow.
    """
    if recordings < FEWEST:
        return FALSE_ALARMS
    return max(FALSE_ALARMS, math.ceil(100 / (recordings + 1)) / 100)


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
