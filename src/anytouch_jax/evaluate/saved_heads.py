"""Heads that a probe saves: the linear head of its score, calibrated on rows it has not seen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from anytouch_jax.data.background.rule import Backgrounds
from anytouch_jax.encoder.arrays import Array, Log
from anytouch_jax.encoder.linear_head import LinearHead, save_head
from anytouch_jax.errors import UserError
from anytouch_jax.evaluate import heads, splits
from anytouch_jax.evaluate.feature_cache import FeatureSource
from anytouch_jax.evaluate.options import LabelProbeOptions
from anytouch_jax.evaluate.results import ProbeResult
from anytouch_jax.evaluate.tasks import TaskRows


def save_probed(
    source: FeatureSource,
    x: Array,
    rows: TaskRows,
    result: ProbeResult,
    options: LabelProbeOptions,
    backgrounds: Backgrounds,
    log: Log,
) -> None:
    """Write the linear head that a result was scored with, calibrated on rows it has not seen.

    Where groups were left out in turn it is fitted on all rows.

    Args:
        source: what the features are of.
        x: f32 (n, d).
        rows: that have the label.
        result: of the probe, with the selected penalty.
        options: of the probe; `save` is the file.
        backgrounds: the untouched gels, which go into the file.
        log: takes a sentence on the head.
    """
    path = options.save
    encoder = source.encoder
    if path is None or encoder is None or result.outcome is None:
        return
    penalty = result.penalty or 1.0
    model = None
    if result.outcome.fitted is not None:
        model, names = result.outcome.fitted
    if model is None:
        # Groups were left out in turn, each for another head: the one to keep has all rows.
        rows = rows._replace(split=np.full(len(rows.split), "train"))
        model, names, penalty = fit_all(x, rows)
        log("The saved head is fitted on all rows")
    head = heads.linear_head(
        model,
        names,
        label=options.label.removeprefix("label."),
        pooling=options.pooling,
        frames=options.frames,
        fingerprint=encoder.fingerprint,
    )
    if encoder.subtracts:
        head = replace(head, backgrounds=backgrounds.images(rows.rows[:, 0]))
    limits = {"coverage": options.coverage, "false_alarms": options.false_alarms}
    save_head(path, calibrated(head, x, rows, penalty, log, **limits))
    log(f"{path}: the linear head")


def fit_all(x: Array, rows: TaskRows) -> tuple[heads.LinearModel, Array, float]:
    """Return a linear head of all rows, which are of train, the names of its classes, its penalty.

    The penalty is chosen by cross-validation over groups.
    """
    data, cut, _ = splits.check_rows(x, rows.labels, rows.groups, rows.split, tested=False)
    penalty = splits.select_option(heads.ProbeHead(), data, cut, "grouped").option
    (model,) = data.fit(heads.ProbeHead(options=(penalty,)), cut.fit).models
    return model, data.names, penalty


def calibrated(
    head: LinearHead, x: Array, rows: TaskRows, penalty: float, log: Log, **limits: float
) -> LinearHead:
    """Return the head with its calibration, and log what it says.

    It has none if the data do not allow it.

    Args:
        head: fitted on the rows of train.
        x: features f32 (n, d) of all rows.
        rows: their labels, groups, splits and sensors.
        penalty: of the head.
        log: is called with what the calibration promises.
        limits: `coverage` and `false_alarms` of `LinearHead.calibrated`.
    """
    fit = np.flatnonzero(rows.split == "train")
    val = np.flatnonzero(rows.split == "val")
    numbers = np.unique(rows.labels, return_inverse=True)[1]
    try:
        folds = splits.group_folds(fit, rows.groups, numbers, splits.FOLDS)
        head = heads.calibrate_head(
            head, x, rows.labels, rows.groups, rows.sensors, fit, val, folds, penalty, **limits
        )
    except UserError as error:
        log(f"The head has no calibration: {error}")
    for sentence in head.promises():
        log(sentence)
    return head
